"""Alarm hooks with real programs, a real broker and a board's relay over its line."""

import asyncio
import json
import math
import resource
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads.health import HookHealth
from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.mqtt.connection import OnResult
from bms_estimator.service import alarm_hooks, job_hook
from bms_estimator.service.alarm_hooks import AlarmHooks
from bms_estimator.service.hook_check import hook_warnings
from bms_estimator.service.job_hook import PublishRaw
from bms_estimator.service.pack_service import run_pack_service
from bms_estimator.settings.alarms import AlarmHook
from bms_estimator.settings.pack import Settings
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.simulation.virtual_board import VirtualBoard
from bms_estimator.sources.serial.port_list import NO_BOARD, KnownBoardFile
from bms_estimator.telemetry.alarms.definitions import Change
from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S
from tests.scripted_source import Collector

RAISED = Alarm(
    name="soc_low",
    severity="warning",
    active=True,
    latched=False,
    since="2026-01-01T00:00:00.000Z",
    value=0.09,
    limit=0.1,
    unit=None,
    text="little charge is left",
)
STANDARD_DESCRIPTORS = 3
"""Number of file descriptors that are open in any case: stdin, stdout and stderr."""
ALARM_TOPIC = "bms/pack/alarm/discharge_over_current"
CLEARED = RAISED.model_copy(update={"active": False, "since": None, "value": None, "text": ""})


@asynccontextmanager
async def run_hooks(*tables: dict[str, Any], **changes: Any) -> AsyncIterator[AlarmHooks]:
    """Run the hooks of these tables ``[[alarms.hook]]``. ``changes`` are arguments of ``AlarmHooks``."""
    options = {"publish": None, "board": None} | changes
    async with AlarmHooks([AlarmHook.model_validate(table) for table in tables], "pack", **options) as running:
        yield running


def acknowledge_in(output: list[str]) -> PublishRaw:
    """Return a publisher that appends each payload to ``output`` and acknowledges the message at once."""

    def publish(_: str, payload: bytes, on_result: OnResult) -> None:
        output.append(payload.decode())
        on_result("")

    return publish


def write_program(path: Path, text: str) -> str:
    """Write a shell script. Return its path."""
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o700)
    return str(path)


async def wait_for_relay(board: VirtualBoard, *, high: bool) -> None:
    """Wait until the relay of the board has this level."""
    async with asyncio.timeout(LONG_S):
        while board.relay_high != high:  # noqa: ASYNC110 - a pin has no event
            await asyncio.sleep(0.01)


async def wait_for_lines(path: Path, lines: int) -> list[str]:
    """Wait until a file has at least this number of lines. Return all of them."""
    async with asyncio.timeout(LONG_S):
        while len(output := lines_of(path)) < lines:  # noqa: ASYNC110 - a program has no event
            await asyncio.sleep(0.01)
    return output


async def wait_for_health(running: AlarmHooks, condition: Callable[[HookHealth], bool]) -> HookHealth:
    """Wait until the health of the hooks fulfils the condition. Return the health."""
    async with asyncio.timeout(LONG_S):
        while (health := running.health) is None or not condition(health):  # noqa: ASYNC110 - health has no event
            await asyncio.sleep(0.01)
    return health


def _is_running(process: int) -> bool:
    """Return True if the process exists and is no zombie."""
    stat = Path(f"/proc/{process}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


def lines_of(path: Path) -> list[str]:
    """Return the lines of a file; none if it does not exist."""
    return path.read_text().splitlines() if path.exists() else []


async def test_programs_get_the_alarm_on_stdin_and_in_the_environment_and_run_in_sequence(tmp_path: Path) -> None:
    out = tmp_path / "out"
    script = write_program(
        tmp_path / "script", f'json=$(cat); echo "$1 $BMS_NAME $BMS_STATE $BMS_VALUE $BMS_DEVICE $json" >> {out}'
    )
    async with run_hooks({"run": [script, "a b;c"]}) as running:
        for lines, alarm in enumerate((RAISED, CLEARED), 1):
            running.on_alarm_change(Change(at_s=0.0, alarm=alarm))
            output = await wait_for_lines(out, lines)
    assert output[0].startswith("a b;c soc_low raised 0.09 pack {")
    assert json.loads(output[0][output[0].index("{") :]) == RAISED.model_dump() | {"raised": ["soc_low"]}
    assert output[1].startswith("a b;c soc_low cleared  pack {")


async def test_alarms_whose_hook_failed_before_a_restart_are_reported_after_it(tmp_path: Path) -> None:
    out = tmp_path / "out"
    script = write_program(tmp_path / "script", f'echo "$BMS_NAME $BMS_STATE" >> {out}')
    failed = RAISED.model_copy(update={"name": "hook_failed"})
    async with run_hooks({"run": [script]}) as running:
        running.restore_active([RAISED, failed, CLEARED.model_copy(update={"name": "soc_high"})])
        assert await wait_for_lines(out, 1) == ["soc_low raised"]
        running.on_alarm_change(Change(at_s=0.0, alarm=CLEARED))
        assert await wait_for_lines(out, 2) == ["soc_low raised", "soc_low cleared"]


async def test_an_alarm_reported_in_an_earlier_run_is_not_reported_again_and_its_end_is(tmp_path: Path) -> None:
    out = tmp_path / "out"
    script = write_program(tmp_path / "script", f'echo "$BMS_NAME $BMS_STATE" >> {out}')
    async with run_hooks({"run": [script]}) as running:
        running.restore_active([RAISED])
        running.on_alarm_change(Change(at_s=0.0, alarm=CLEARED))
        assert await wait_for_lines(out, 1) == ["soc_low cleared"]


async def test_an_alarm_that_waits_for_a_program_at_a_restart_is_reported_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(alarm_hooks, "CLOSE_TIMEOUT_S", 0.01)
    out = tmp_path / "out"
    script = write_program(tmp_path / "script", f'echo "$BMS_NAME" >> {out}; [ ! -e {tmp_path}/hang ] || sleep 1000')
    (tmp_path / "hang").touch()
    critical = RAISED.model_copy(update={"name": "cell_over_voltage", "severity": "critical"})
    async with run_hooks({"run": [script]}) as running:
        running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
        await wait_for_lines(out, 1)
        running.on_alarm_change(Change(at_s=0.0, alarm=critical))
        known = running.finished_hashes
    (tmp_path / "hang").unlink()
    async with run_hooks({"run": [script]}) as running:
        running.restore_active([RAISED, critical], known)
        assert await wait_for_lines(out, 3) == ["soc_low", "cell_over_voltage", "soc_low"]


async def test_a_program_that_failed_before_a_restart_runs_again(tmp_path: Path) -> None:
    out = tmp_path / "out"
    script = write_program(tmp_path / "script", f"echo run >> {out}; exit 1")
    async with run_hooks({"run": [script]}) as running:
        running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
        await wait_for_health(running, lambda health: bool(health.failing))
        known = running.finished_hashes
    async with run_hooks({"run": [script]}) as running:
        running.restore_active([RAISED], known)
        await wait_for_lines(out, 2)


async def test_all_raised_alarms_are_reported_after_a_crash() -> None:
    output: list[str] = []
    for crashed in (False, True):
        async with run_hooks({"topic": "load/set", "payload": "$name"}, publish=acknowledge_in(output)) as running:
            running.restore_active([RAISED], running.finished_hashes, crashed=crashed)
    assert output == ["soc_low"]


@pytest.mark.parametrize(("is_finished", "crashed"), [(True, False), (True, True), (False, False)])
async def test_an_interrupted_job_for_the_failure_of_another_hook_is_repeated(is_finished: bool, crashed: bool) -> None:
    output, failed = list[str](), RAISED.model_copy(update={"name": "hook_failed"})
    hook = {"alarms": ["hook_failed"], "topic": "load/set", "payload": "$name"}
    async with run_hooks(hook, publish=acknowledge_in(output)) as running:
        running.restore_active([failed], running.finished_hashes if is_finished else [], crashed=crashed)
    assert output == ([] if is_finished and not crashed else ["hook_failed"])


async def test_a_hook_that_was_added_or_changed_before_a_restart_acts_on_an_alarm_that_is_already_raised() -> None:
    output: list[str] = []
    first, second = ({"topic": topic, "payload": f"{topic} $name"} for topic in ("first", "second"))
    dry_run = first | {"dry_run": True}
    known: list[str] | None = None
    for tables in ((first,), (first,), (first, second), (dry_run, second), (first, second)):
        async with run_hooks(*tables, publish=acknowledge_in(output)) as running:
            running.restore_active([RAISED], known)
            async with asyncio.timeout(LONG_S):
                while len(known := running.finished_hashes) < len(tables):  # noqa: ASYNC110 - a hook has no event
                    await asyncio.sleep(0.01)
        output.append("restart")
    assert output == [*["restart"] * 2, "second soc_low", *["restart"] * 2, "first soc_low", "restart"]


async def test_a_hook_runs_only_for_its_alarms_and_states(tmp_path: Path) -> None:
    out = tmp_path / "out"
    script = write_program(tmp_path / "script", f'echo "$BMS_NAME $BMS_STATE" >> {out}')
    other = RAISED.model_copy(update={"name": "link_lost"})
    async with run_hooks({"run": [script], "alarms": ["soc_low"], "on": ["raised"]}) as running:
        for alarm in (other, CLEARED, RAISED):
            running.on_alarm_change(Change(at_s=0.0, alarm=alarm))
        assert await wait_for_lines(out, 1) == ["soc_low raised"]


async def test_after_a_program_that_hangs_the_next_alarm_is_reported(tmp_path: Path) -> None:
    out = tmp_path / "out"
    cut_name = r"printf 'batteriew\303' > /proc/$$/comm"  # the system cuts names, also within a character
    hang = write_program(
        tmp_path / "hang", f"{cut_name}; echo $BMS_STATE >> {out}; [ $BMS_STATE = cleared ] || sleep 1000"
    )
    with capture_logs() as lines:
        async with run_hooks({"run": [hang], "timeout_s": 2.0}) as running:
            for count, alarm in enumerate((RAISED, CLEARED), 1):
                running.on_alarm_change(Change(at_s=0.0, alarm=alarm))
                assert (await wait_for_lines(out, count))[-1] == ("raised", "cleared")[count - 1]
            await wait_for_health(running, lambda health: health.done == 1)
    assert [line["event"] for line in lines] == ["alarm hook: the program takes too long and is killed"]


FOUND_AFTER_THEIR_PARENT = (
    "{daemon} &",
    "setsid {daemon} &",
    "(setsid {daemon} &)",
    "env -i {daemon} &",
)
"""Commands that start a daemon. The hook finds the daemon even after the end of the script that started it."""
FOUND_DURING_ITS_PARENT = "env -i setsid {daemon} &"
"""Command that starts a daemon, which the hook finds only while the script runs."""


@pytest.mark.parametrize(
    ("starts", "last_line"),
    [
        pytest.param(FOUND_AFTER_THEIR_PARENT, "exit", marks=pytest.mark.thorough),
        ((*FOUND_AFTER_THEIR_PARENT, FOUND_DURING_ITS_PARENT), "sleep 1000"),
    ],
)
async def test_all_descendants_of_a_program_are_killed_after_the_time_limit(
    tmp_path: Path, starts: tuple[str, ...], last_line: str
) -> None:
    started = tmp_path / "started"  # has the process number of each daemon
    started.touch()
    daemon = write_program(tmp_path / "daemon", f"echo $$ >> {started}; exec /bin/sleep 1000")
    lines = [start.format(daemon=daemon) for start in starts]
    lines += [f"until [ $(wc -l < {started}) = {len(starts)} ]; do :; done", last_line]
    script = write_program(tmp_path / "script", "\n".join(lines))
    async with run_hooks({"run": [script], "timeout_s": 10.0}) as running:
        running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
        failed = await wait_for_health(running, lambda health: health.failures == 1)
    assert failed.failing == [f"run {script}: took longer than 10 s"]
    assert [_is_running(int(line)) for line in lines_of(started)] == [False] * len(starts)


async def test_a_child_that_outlives_its_program_runs_until_the_time_limit(tmp_path: Path) -> None:
    out, go = tmp_path / "out", tmp_path / "go"
    child = write_program(tmp_path / "child", f"until [ -e {go} ]; do sleep 0.01; done; echo sent > {out}")
    async with run_hooks(
        {"run": [write_program(tmp_path / "script", f"{child} & : > {go}")], "timeout_s": LONG_S}
    ) as running:
        running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
        assert (await wait_for_health(running, lambda health: health.done == 1)).failing == []
    assert lines_of(out) == ["sent"]


async def test_a_program_that_cannot_be_started_is_tried_again_until_its_alarm_has_ended(tmp_path: Path) -> None:
    out, path = tmp_path / "out", tmp_path / "script"
    other = RAISED.model_copy(update={"name": "link_lost"})
    async with run_hooks({"run": [str(path)]}) as running:
        running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
        await wait_for_health(running, lambda health: health.failures >= 2)
        running.on_alarm_change(Change(at_s=0.0, alarm=CLEARED))  # neither is reported
        write_program(path, f"echo $BMS_NAME $BMS_STATE >> {out}")
        running.on_alarm_change(Change(at_s=0.0, alarm=other))
        assert await wait_for_lines(out, 1) == ["link_lost raised"]
        assert (await wait_for_health(running, lambda health: health.done == 1)).failing == []


async def test_another_alarm_does_not_shorten_the_retry_delay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job_hook, "FIRST_RETRY_S", LONG_S)
    async with run_hooks({"run": [str(tmp_path / "none")]}) as running:
        running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
        await wait_for_health(running, lambda health: health.failures == 1)
        running.on_alarm_change(Change(at_s=0.0, alarm=RAISED.model_copy(update={"name": "link_lost"})))
        running.on_alarm_change(Change(at_s=0.0, alarm=CLEARED.model_copy(update={"name": "link_lost"})))
        for _ in range(100):  # without the delay, the hook would retry in the next cycles of the loop
            await asyncio.sleep(0)
        assert running.health is not None
        assert running.health.failures == 1


async def test_a_program_that_finds_no_free_file_descriptor_is_started_once_one_is_free(tmp_path: Path) -> None:
    out = tmp_path / "out"
    script = write_program(tmp_path / "script", f"echo $BMS_STATE >> {out}")
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    async with run_hooks({"run": [script]}) as running:
        resource.setrlimit(resource.RLIMIT_NOFILE, (STANDARD_DESCRIPTORS, limits[1]))
        try:
            running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
            failed = await wait_for_health(running, lambda health: health.failures >= 2)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        assert failed.failing == [f"run {script}: cannot be started: [Errno 24] Too many open files"]
        assert await wait_for_lines(out, 1) == ["raised"]


async def test_a_program_is_killed_at_the_time_limit_and_not_run_again_without_free_file_descriptors(
    tmp_path: Path,
) -> None:
    child = tmp_path / "child"
    script = write_program(tmp_path / "script", f"sleep 1000 & echo $! >> {child}; echo $$ >> {child}; exec sleep 1000")
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    async with run_hooks({"run": [script], "timeout_s": 10.0}) as running:
        running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
        await wait_for_lines(child, 2)
        resource.setrlimit(resource.RLIMIT_NOFILE, (STANDARD_DESCRIPTORS, limits[1]))
        try:
            failed = await wait_for_health(running, lambda health: health.failures == 1)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert failed.failing == [f"run {script}: took longer than 10 s"]
    assert [_is_running(int(line)) for line in lines_of(child)] == [False, False]


@pytest.mark.parametrize("error", [RuntimeError("can't start new thread"), MemoryError()])
async def test_a_program_that_finds_no_free_thread_or_memory_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    out = tmp_path / "out"
    create_subprocess, errors = asyncio.create_subprocess_exec, [error]

    async def fail_first(*command: str, **options: Any) -> asyncio.subprocess.Process:
        if errors:
            raise errors.pop()
        return await create_subprocess(*command, **options)

    monkeypatch.setattr(asyncio, "create_subprocess_exec", fail_first)
    async with run_hooks({"run": [write_program(tmp_path / "script", f"echo $BMS_STATE >> {out}")]}) as running:
        running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
        assert await wait_for_lines(out, 1) == ["raised"]
        assert (await wait_for_health(running, lambda health: health.done == 1)).failures == 1


async def test_a_null_character_in_a_text_does_not_prevent_the_start_of_a_program(tmp_path: Path) -> None:
    """A publisher's last will becomes the reason of ``link_lost``; no environment can hold a null character."""
    out = tmp_path / "out"
    script = write_program(tmp_path / "script", f'echo "$BMS_TEXT" > {out}')
    async with run_hooks({"run": [script]}) as running:
        running.on_alarm_change(
            Change(at_s=0.0, alarm=RAISED.model_copy(update={"text": "the publisher says offline\0"}))
        )
        assert await wait_for_lines(out, 1) == ["the publisher says offline "]


async def test_an_internal_error_does_not_end_a_hook() -> None:
    output: list[str] = []

    def publish(topic: str, payload: bytes, on_result: OnResult) -> None:
        if payload == b"raised":
            raise RuntimeError("a fault of ours")
        acknowledge_in(output)(topic, payload, on_result)

    async with run_hooks({"topic": "load/set", "payload": "$state"}, publish=publish) as running:
        running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
        failed = await wait_for_health(running, lambda health: health.failures == 1)
        assert failed.failing == ["publish on load/set: internal error: RuntimeError('a fault of ours')"]
        running.on_alarm_change(Change(at_s=0.0, alarm=CLEARED))
        await wait_for_health(running, lambda health: health.done == 1)
    assert output == ["cleared"]


async def test_a_program_inherits_only_listed_and_configured_variables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("LC_TIME", "MQTT_PASSWORD", "NOTIFY_SOCKET", "GATEWAY"):
        monkeypatch.setenv(name, "here")
    out = tmp_path / "out"
    show = write_program(tmp_path / "show", f"env > {out}.part; mv {out}.part {out}")
    async with run_hooks({"run": [show], "pass_environment": ["GATEWAY", "NOT_SET"]}) as running:
        running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
        names = {line.partition("=")[0] for line in await wait_for_lines(out, 1)}
    assert {"PATH", "LC_TIME", "GATEWAY", "BMS_NAME"} <= names
    assert names.isdisjoint({"MQTT_PASSWORD", "NOTIFY_SOCKET", "NOT_SET", "PYTHONPATH"})


async def test_a_critical_alarm_that_cannot_be_watched_counts_as_raised() -> None:
    """While the alarm is unwatched, the hook runs once, also if it is raised. It runs again once it is watched and cleared."""
    hot = RAISED.model_copy(update={"name": "over_temperature", "severity": "critical", "text": "hot"})
    unwatched = {"watched": False, "unwatched_reason": "no temperature"}
    cold = hot.model_copy(update={"active": False, "since": None, "text": ""})
    output: list[str] = []
    tables = {"topic": "load/set", "payload": "$name $state $text"}
    async with run_hooks(tables, publish=acknowledge_in(output)) as running:
        for done, alarm in (
            (1, cold.model_copy(update=unwatched)),
            (1, hot.model_copy(update=unwatched)),
            (1, cold.model_copy(update=unwatched)),
            (2, cold),
            (2, cold.model_copy(update=unwatched | {"severity": "warning"})),
            (2, cold.model_copy(update={"severity": "warning"})),
            (3, RAISED),
        ):
            running.on_alarm_change(Change(at_s=0.0, alarm=alarm))
            await wait_for_health(running, lambda health, done=done: health.done == done)  # type: ignore[misc]
    assert output == [
        "over_temperature raised no temperature",
        "over_temperature cleared ",
        "soc_low raised little charge is left",
    ]


async def test_a_new_critical_alarm_is_reported_before_waiting_warnings_and_pairs_of_changes_are_not(
    tmp_path: Path,
) -> None:
    out, go = tmp_path / "out", tmp_path / "go"
    script = write_program(
        tmp_path / "script", f'echo "$BMS_NAME $BMS_STATE" >> {out}; until [ -e {go} ]; do sleep 0.01; done'
    )
    hot = RAISED.model_copy(update={"name": "over_temperature", "severity": "critical"})
    lost, not_lost = (alarm.model_copy(update={"name": "link_lost"}) for alarm in (RAISED, CLEARED))
    async with run_hooks({"run": [script], "timeout_s": LONG_S}) as running:
        running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
        await wait_for_lines(out, 1)
        for alarm in (*[CLEARED, RAISED] * 40, *[lost, not_lost] * 40, lost, hot):
            running.on_alarm_change(Change(at_s=0.0, alarm=alarm))
        go.touch()
        await wait_for_health(running, lambda health: health.done == 3)
    assert lines_of(out) == ["soc_low raised", "over_temperature raised", "link_lost raised"]


async def test_a_hook_for_first_and_last_reports_only_the_change_from_and_to_no_raised_alarm() -> None:
    output: list[str] = []
    hook = {"topic": "load/set", "payload": "$name $state: $raised"}
    set_hook = hook | {"on": ["first_raised", "last_cleared"]}
    lost, not_lost = (alarm.model_copy(update={"name": "link_lost"}) for alarm in (RAISED, CLEARED))
    for each in (hook, set_hook):
        async with run_hooks(each, publish=acknowledge_in(output)) as running:
            for alarm in (RAISED, lost, CLEARED, not_lost):
                running.on_alarm_change(Change(at_s=0.0, alarm=alarm))
                await asyncio.sleep(0)
                await asyncio.sleep(0)
    assert output == [
        *("soc_low raised: soc_low", "link_lost raised: soc_low link_lost", "soc_low cleared: link_lost"),
        *("link_lost cleared: ", "soc_low raised: soc_low", "link_lost cleared: "),
    ]


async def test_a_failed_hook_is_reported_until_its_next_run_succeeds(
    tmp_path: Path,
) -> None:
    failed = RAISED.model_copy(update={"name": "hook_failed"})
    script = write_program(tmp_path / "script", '[ "$BMS_NAME" = hook_failed ]')
    output: list[str] = []
    tables = {"run": [script], "alarms": ["soc_low", "hook_failed"]}, {"topic": "all", "payload": "$name"}
    async with run_hooks(*tables, publish=acknowledge_in(output)) as running:
        running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
        await wait_for_health(running, lambda health: health.failing == [f"run {script}: exit code 1"])
        running.on_alarm_change(Change(at_s=0.0, alarm=failed))
        await wait_for_health(running, lambda health: health.failing == [])
    assert output == ["soc_low"]


async def test_the_arguments_of_a_program_are_neither_published_nor_logged(tmp_path: Path) -> None:
    with capture_logs() as lines:
        async with run_hooks({"run": [str(tmp_path / "none"), "token=secret"]}) as running:
            running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
            await wait_for_health(running, lambda health: health.failures >= 1)
            assert "secret" not in str(running.health)
    assert "secret" not in str(lines)


@pytest.mark.parametrize(
    ("hook", "warnings"),
    [
        ({"relay": "low", "when_silent": "low"}, []),
        ({"relay": "low", "when_silent": "keep"}, []),
        (
            {"relay": "low", "when_silent": "high"},
            ["when_silent = 'high': the board ends the level of an alarm 30 s after"],
        ),
        ({"relay": "low"}, ["when_silent: not set, so the board switches its pin to low, as in an alarm, after 30 s"]),
        (
            {"relay": "high", "when_silent": "high"},
            ['relay = "high": the pin is low after each reset and without power'],
        ),
        ({"relay": "high", "when_silent": "high", "alarms": ["soc_low"]}, []),
        (
            {"relay": "low", "when_silent": "low", "alarms": ["cell_over_voltage", "cell_short"]},
            ["alarms: the board measures no cell voltages"],
        ),
        ({"relay": "low", "when_silent": "low", "alarms": ["cell_over_voltage", "pack_over_voltage"]}, []),
        ({"run": ["true"]}, ["on: with several alarms, cleared is reported while others are still raised"]),
        ({"run": ["true"], "on": ["first_raised", "last_cleared"]}, []),
        ({"run": ["true"], "alarms": ["soc_low"]}, []),
        (
            {"run": ["true"], "on": ["raised"], "timeout_s": 61},
            ["timeout_s = 61: a new critical alarm may wait this long"],
        ),
    ],
)
def test_likely_mistakes_in_a_hook_cause_warnings(hook: dict[str, Any], warnings: list[str]) -> None:
    settings = Settings.model_validate({"sensor": {"port": "/dev/none"}, "alarms": {"hook": [hook]}})
    found = hook_warnings(settings)
    assert len(found) == len(warnings)
    assert all(line.startswith(f"alarms.hook.0.{start}") for line, start in zip(found, warnings, strict=True))


async def test_programs_that_are_missing_or_fail_are_logged(tmp_path: Path) -> None:
    tables = {"run": [str(tmp_path / "none")]}, {"run": [write_program(tmp_path / "fail", "exit 3")]}
    with capture_logs() as lines:
        async with run_hooks(*tables) as running:
            running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
    output = {line["event"]: line for line in lines}
    assert set(output) == {
        "alarm hook: the program cannot be started",
        "alarm hook: the program was never started",
        "alarm hook: the program has failed",
    }
    assert output["alarm hook: the program has failed"]["exit_code"] == 3


async def test_a_dry_run_logs_the_action_and_does_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    script = write_program(tmp_path / "script", f"echo >> {out}")
    output: list[object] = []
    tables: tuple[dict[str, Any], ...] = {"run": [script]}, {"topic": "load/set", "payload": "OFF"}, {"relay": "high"}
    with capture_logs() as lines:
        async with run_hooks(
            *({**table, "dry_run": True} for table in tables), publish=output.append, board=object()
        ) as running:
            running.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
    assert [line.get("would") or line.get("hook") for line in lines] == [
        "relay pin high",
        f"run {script}",
        "publish on load/set",
    ]
    assert not out.exists()
    assert not output


@pytest.mark.parametrize(
    ("tables", "reason"),
    [
        ({"topic": "load/set"}, r"alarms\.hook\.0\.topic = load/set: there is no broker"),
        ({"relay": "high"}, r"alarms\.hook\.0\.relay: only the board of \[sensor\]"),
    ],
)
def test_a_hook_without_its_broker_or_relay_is_rejected_at_the_start(tables: dict[str, Any], reason: str) -> None:
    with pytest.raises(UserError, match=reason):
        AlarmHooks([AlarmHook.model_validate(tables)], "pack", None, None)


async def test_an_over_current_switches_the_relay_is_published_and_acknowledged(broker: Broker, tmp_path: Path) -> None:
    """The relay of a virtual board disconnects the load. The latched alarm survives a restart of service and board."""
    load_a = 8.0
    board = VirtualBoard(lambda _: Reading(0.0 if board.relay_high else load_a, 22.0, 25.0))
    tables: dict[str, Any] = {
        "publish": {"rate_hz": 10.0},
        "mqtt": {"url": broker.url, "commands": ["acknowledge_alarm"]},
        "alarms": {
            "discharge_over_current": {"limit_a": 5.0, "delay_s": 0.2, "clear_delay_s": 0.2},
            "hook": [
                {"alarms": ["discharge_over_current"], "relay": "high", "when_silent": "high"},
                {"alarms": ["discharge_over_current"], "topic": "load/set", "payload": '{"$name": "$state"}'},
            ],
        },
    }
    cell, sink = load_cell("thunder_power_6s"), Collector()

    @asynccontextmanager
    async def run_service() -> AsyncIterator[None]:
        stop = asyncio.Event()
        settings = Settings.model_validate(tables | {"sensor": {"port": board.path}})
        task = asyncio.create_task(run_pack_service(settings, cell, sinks=[sink], stop=stop, folder=tmp_path))
        try:
            yield
        finally:
            stop.set()
            await asyncio.wait_for(task, LONG_S)

    with board:
        running = asyncio.create_task(board.run())
        async with Listener(broker) as live:
            async with run_service():
                alarm = await live.wait_json(ALARM_TOPIC, lambda alarm: alarm["latched"])
                assert board.relay_high
                assert (alarm["active"], alarm["limit"], alarm["severity"]) == (True, 5.0, "critical")
                assert alarm["value"] == pytest.approx(load_a, abs=0.1)
                assert live.all("load/set") == [b'{"discharge_over_current": "raised"}']
            load_a = 1.0
            board.reset()
            assert not board.relay_high
            async with run_service():
                await wait_for_relay(board, high=True)
                messages_before = len(live.messages)
                await live.publish("bms/pack/request/acknowledge_alarm", b'{"name": "discharge_over_current"}')
                assert await live.wait_json("bms/pack/response/acknowledge_alarm", skip=messages_before) == {
                    "status": "ok",
                    "data": {"acknowledged": ["discharge_over_current"]},
                    "error": None,
                    "transaction": None,
                }
                await live.wait_json(ALARM_TOPIC, lambda alarm: not alarm["active"], skip=messages_before)
                await wait_for_relay(board, high=False)
                await live.wait("load/set", lambda payload: b"cleared" in payload)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def test_a_lost_temperature_sensor_switches_the_relay_and_a_missing_program_raises_hook_failed(
    broker: Broker, tmp_path: Path
) -> None:
    """The NTC of a virtual board breaks while the pack is charged."""
    temperature_c, out, missing = 25.0, tmp_path / "out", tmp_path / "later"
    board = VirtualBoard(lambda _: Reading(-8.0, 22.0, temperature_c))
    over_temperature_only = {"alarms": ["over_temperature"]}
    tables: dict[str, Any] = {
        "publish": {"rate_hz": 10.0},
        "mqtt": {"url": broker.url},
        "alarms": {
            "lost_s": 0.5,
            "hook_failed": {"delay_s": 0.0, "clear_delay_s": 0.0},
            "hook": [
                over_temperature_only | {"relay": "high", "when_silent": "high"},
                over_temperature_only | {"topic": "load/set", "payload": "$name $state"},
                over_temperature_only | {"run": [str(missing)], "on": ["raised"]},
            ],
        },
    }
    stop, cell = asyncio.Event(), load_cell("thunder_power_6s")
    with board:
        running = asyncio.create_task(board.run())
        async with Listener(broker) as live:
            settings = Settings.model_validate(tables | {"sensor": {"port": board.path}})
            service = asyncio.create_task(run_pack_service(settings, cell, stop=stop, folder=tmp_path))
            await live.wait_json("bms/pack/alarm/over_temperature", lambda alarm: alarm["watched"])
            await wait_for_relay(board, high=False)
            temperature_c = math.nan
            alarm = await live.wait_json("bms/pack/alarm/over_temperature", lambda alarm: not alarm["watched"])
            assert (alarm["active"], alarm["unwatched_reason"]) == (False, "the temperature is no longer measured")
            fault = await live.wait_json("bms/pack/alarm/sensor_fault", lambda alarm: alarm["active"])
            assert "over_temperature" in fault["text"]
            await live.wait("load/set", lambda payload: payload == b"over_temperature raised")
            await wait_for_relay(board, high=True)
            failed = await live.wait_json(
                "bms/pack/alarm/hook_failed", lambda alarm: alarm["active"] and str(missing) in alarm["text"]
            )
            assert f"run {missing}: cannot be started" in failed["text"]
            await live.wait_json("bms/pack/health", lambda health: (health["hooks"] or {}).get("failures", 0) > 0)
            write_program(missing, f"echo $BMS_NAME $BMS_STATE > {out}")
            assert await wait_for_lines(out, 1) == ["over_temperature raised"]
            messages_before = len(live.messages)
            await live.wait_json("bms/pack/alarm/hook_failed", lambda alarm: not alarm["active"])
            temperature_c = 25.0
            await live.wait_json(
                "bms/pack/alarm/over_temperature", lambda alarm: alarm["watched"], skip=messages_before
            )
            await wait_for_relay(board, high=False)
            await live.wait("load/set", lambda payload: payload == b"over_temperature cleared")
            stop.set()
            await asyncio.wait_for(service, LONG_S)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def test_a_lost_calibration_of_the_board_needs_an_acknowledgement_and_is_not_stored_before(
    tmp_path: Path,
) -> None:
    """The board measures with a default slope, because its memory is damaged. The load stays disconnected."""
    memory, sink, stop = KnownBoardFile(tmp_path, "pack"), Collector(), asyncio.Event()
    cell = load_cell("thunder_power_6s")
    with VirtualBoard(lambda _: Reading(1.0, 22.0, 25.0)) as board:
        running = asyncio.create_task(board.run())
        settings = Settings.model_validate({"sensor": {"port": board.path}, "alarms": {"hook": [{"relay": "low"}]}})
        stop.set()
        await run_pack_service(settings, cell, stop=stop, folder=tmp_path)  # an earlier run
        stored = NO_BOARD | {"serial": "00000001", "volts_per_ampere": "0.04"}
        memory.save(stored)
        stop.clear()
        service = asyncio.create_task(run_pack_service(settings, cell, sinks=[sink], stop=stop, folder=tmp_path))
        snapshot = await sink.until(lambda s: any(each.active and each.name == "alarm_state_lost" for each in s.alarms))
        assert "volts_per_ampere 0.04 to 0.1" in next(each.text for each in snapshot.alarms if each.active)
        stop.set()
        await service
        running.cancel()
        assert not board.relay_high
    assert memory.load() == stored
