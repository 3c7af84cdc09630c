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
from bms_estimator.model.payloads import Alarm, HookHealth
from bms_estimator.protocols.base.relay import Relay
from bms_estimator.service import alarm_hooks
from bms_estimator.service.alarm_hooks import AlarmHooks, unusable
from bms_estimator.service.pack_service import run_pack_service
from bms_estimator.settings.alarms import AlarmHook
from bms_estimator.settings.pack import Settings
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.simulation.virtual_board import VirtualBoard
from bms_estimator.telemetry.alarms import Change
from tests.collector import Collector
from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S

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
TOPIC = "bms/pack/alarm/discharge_over_current"
CLEARED = RAISED.model_copy(update={"active": False, "since": None, "value": None, "text": ""})


@asynccontextmanager
async def hooks(*told: dict[str, Any], **edges: Any) -> AsyncIterator[AlarmHooks]:
    options = {"say": None, "switch": None} | edges
    async with AlarmHooks([AlarmHook.model_validate(each) for each in told], "pack", **options) as made:
        yield made


def program(path: Path, text: str) -> str:
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o700)
    return str(path)


async def relay(board: VirtualBoard, *, high: bool) -> None:
    """Until the board's relay is there."""
    async with asyncio.timeout(LONG_S):
        while board.relay_high != high:  # noqa: ASYNC110 - a pin has no event
            await asyncio.sleep(0.01)


async def until(path: Path, lines: int) -> list[str]:
    async with asyncio.timeout(LONG_S):
        while len(said := _lines(path)) < lines:  # noqa: ASYNC110 - a program has no event
            await asyncio.sleep(0.01)
    return said


async def until_health(made: AlarmHooks, fits: Callable[[HookHealth], bool]) -> HookHealth:
    async with asyncio.timeout(LONG_S):
        while (health := made.health) is None or not fits(health):  # noqa: ASYNC110 - as above
            await asyncio.sleep(0.01)
    return health


def _runs(process: int) -> bool:
    stat = Path(f"/proc/{process}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.exists() else []


async def test_a_program_gets_the_alarm_on_stdin_and_in_its_environment_one_after_the_other(tmp_path: Path) -> None:
    out = tmp_path / "out"
    tell = program(
        tmp_path / "tell", f'json=$(cat); echo "$1 $BMS_NAME $BMS_STATE $BMS_VALUE $BMS_DEVICE $json" >> {out}'
    )
    async with hooks({"run": [tell, "a b;c"]}) as made:
        for alarm in (RAISED, CLEARED):
            made.on_alarm_change(Change(0.0, alarm))
        said = await until(out, 2)
    assert said[0].startswith("a b;c soc_low raised 0.09 pack {")
    assert json.loads(said[0][said[0].index("{") :]) == RAISED.model_dump()
    assert said[1].startswith("a b;c soc_low cleared  pack {")


async def test_a_program_that_could_not_be_started_before_a_restart_is_started_after_it(tmp_path: Path) -> None:
    out = tmp_path / "out"
    tell = program(tmp_path / "tell", f'echo "$BMS_NAME $BMS_STATE" >> {out}')
    failed = RAISED.model_copy(update={"name": "hook_failed"})
    async with hooks({"run": [tell]}) as made:
        made.restore_active([RAISED, failed, CLEARED.model_copy(update={"name": "soc_high"})])
        assert await until(out, 1) == ["soc_low raised"]
        made.on_alarm_change(Change(0.0, CLEARED))
        assert await until(out, 2) == ["soc_low raised", "soc_low cleared"]


async def test_an_alarm_of_a_former_run_is_not_announced_again(tmp_path: Path) -> None:
    out = tmp_path / "out"
    tell = program(tmp_path / "tell", f'echo "$BMS_NAME $BMS_STATE" >> {out}')
    async with hooks({"run": [tell]}) as made:
        made.restore_active([RAISED])
        made.on_alarm_change(Change(0.0, CLEARED))
        assert await until(out, 1) == ["soc_low cleared"]


async def test_only_what_is_asked_for_is_done(tmp_path: Path) -> None:
    out = tmp_path / "out"
    tell = program(tmp_path / "tell", f'echo "$BMS_NAME $BMS_STATE" >> {out}')
    other = RAISED.model_copy(update={"name": "link_lost"})
    async with hooks({"run": [tell], "alarms": ["soc_low"], "on": ["raised"]}) as made:
        for alarm in (other, CLEARED, RAISED):
            made.on_alarm_change(Change(0.0, alarm))
        assert await until(out, 1) == ["soc_low raised"]


async def test_after_a_program_that_hangs_the_next_alarm_is_told(tmp_path: Path) -> None:
    out = tmp_path / "out"
    hang = program(tmp_path / "hang", f"[ $BMS_STATE = raised ] && sleep 1000; echo $BMS_STATE > {out}")
    with capture_logs() as lines:
        async with hooks({"run": [hang], "timeout_s": 2.0}) as made:
            for alarm in (RAISED, CLEARED):
                made.on_alarm_change(Change(0.0, alarm))
            assert await until(out, 1) == ["cleared"]
    assert [line["event"] for line in lines] == ["alarm hook: the program takes too long and is killed"]


ESCAPES = (
    "{daemon} &",
    "setsid {daemon} &",
    "(setsid {daemon} &)",
    "env -i {daemon} &",
)
"""Ways in which a program starts another one that is found also after its own end."""
CHILD = "env -i setsid {daemon} &"
"""A way that is found while the program runs."""


@pytest.mark.parametrize(
    ("ways", "then"), [pytest.param(ESCAPES, "exit", marks=pytest.mark.thorough), ((*ESCAPES, CHILD), "sleep 1000")]
)
async def test_all_that_a_program_has_started_is_killed_after_the_time_limit(
    tmp_path: Path, ways: tuple[str, ...], then: str
) -> None:
    started = tmp_path / "started"
    started.touch()
    daemon = program(tmp_path / "daemon", f"echo $$ >> {started}; exec /bin/sleep 1000")
    lines = [way.format(daemon=daemon) for way in ways]
    lines += [f"until [ $(wc -l < {started}) = {len(ways)} ]; do :; done", then]
    tell = program(tmp_path / "tell", "\n".join(lines))
    async with hooks({"run": [tell], "timeout_s": 10.0}) as made:
        made.on_alarm_change(Change(0.0, RAISED))
        failed = await until_health(made, lambda health: health.failures == 1)
    assert failed.failing == [f"run {tell}: took longer than 10 s"]
    assert [_runs(int(line)) for line in _lines(started)] == [False] * len(ways)


async def test_a_child_that_outlives_its_program_has_until_the_time_limit(tmp_path: Path) -> None:
    out, go = tmp_path / "out", tmp_path / "go"
    child = program(tmp_path / "child", f"until [ -e {go} ]; do sleep 0.01; done; echo sent > {out}")
    async with hooks({"run": [program(tmp_path / "tell", f"{child} & : > {go}")], "timeout_s": LONG_S}) as made:
        made.on_alarm_change(Change(0.0, RAISED))
        assert (await until_health(made, lambda health: health.done == 1)).failing == []
    assert _lines(out) == ["sent"]


async def test_a_program_that_cannot_be_started_is_tried_again_until_its_alarm_has_ended(tmp_path: Path) -> None:
    out, path = tmp_path / "out", tmp_path / "tell"
    async with hooks({"run": [str(path)]}) as made:
        made.on_alarm_change(Change(0.0, RAISED))
        await until_health(made, lambda health: health.failures >= 2)
        made.on_alarm_change(Change(0.0, CLEARED))
        program(path, f"echo $BMS_STATE >> {out}")
        assert await until(out, 1) == ["cleared"]
        assert (await until_health(made, lambda health: health.done == 1)).failing == []


async def test_another_alarm_does_not_hasten_the_next_attempt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(alarm_hooks, "FIRST_RETRY_S", LONG_S)
    async with hooks({"run": [str(tmp_path / "none")]}) as made:
        made.on_alarm_change(Change(0.0, RAISED))
        await until_health(made, lambda health: health.failures == 1)
        made.on_alarm_change(Change(0.0, RAISED.model_copy(update={"name": "link_lost"})))
        made.on_alarm_change(Change(0.0, CLEARED.model_copy(update={"name": "link_lost"})))
        for _ in range(100):  # each pass of the loop would let the hook try
            await asyncio.sleep(0)
        assert made.health is not None
        assert made.health.failures == 1


async def test_a_program_that_finds_no_descriptor_is_started_once_there_are_some(tmp_path: Path) -> None:
    out = tmp_path / "out"
    tell = program(tmp_path / "tell", f"echo $BMS_STATE >> {out}")
    most = resource.getrlimit(resource.RLIMIT_NOFILE)
    async with hooks({"run": [tell]}) as made:
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, most[1]))
        try:
            made.on_alarm_change(Change(0.0, RAISED))
            failed = await until_health(made, lambda health: health.failures >= 2)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, most)
        assert failed.failing == [f"run {tell}: cannot be started: [Errno 24] Too many open files"]
        assert await until(out, 1) == ["raised"]


async def test_descriptors_that_run_out_while_a_program_runs_neither_save_it_nor_run_it_twice(tmp_path: Path) -> None:
    child = tmp_path / "child"
    tell = program(tmp_path / "tell", f"sleep 1000 & echo $! >> {child}; echo $$ >> {child}; exec sleep 1000")
    most = resource.getrlimit(resource.RLIMIT_NOFILE)
    async with hooks({"run": [tell], "timeout_s": 10.0}) as made:
        made.on_alarm_change(Change(0.0, RAISED))
        await until(child, 2)
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, most[1]))
        try:
            failed = await until_health(made, lambda health: health.failures == 1)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, most)
    assert failed.failing == [f"run {tell}: took longer than 10 s"]
    assert [_runs(int(line)) for line in _lines(child)] == [False, False]


@pytest.mark.parametrize("error", [RuntimeError("can't start new thread"), MemoryError()])
async def test_a_program_for_which_no_thread_or_memory_is_free_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    out = tmp_path / "out"
    start, errors = asyncio.create_subprocess_exec, [error]

    async def fail_first(*command: str, **options: Any) -> asyncio.subprocess.Process:
        if errors:
            raise errors.pop()
        return await start(*command, **options)

    monkeypatch.setattr(asyncio, "create_subprocess_exec", fail_first)
    async with hooks({"run": [program(tmp_path / "tell", f"echo $BMS_STATE >> {out}")]}) as made:
        made.on_alarm_change(Change(0.0, RAISED))
        assert await until(out, 1) == ["raised"]
        assert (await until_health(made, lambda health: health.done == 1)).failures == 1


async def test_a_text_from_outside_cannot_keep_a_program_from_its_start(tmp_path: Path) -> None:
    """A publisher's last will becomes the reason of ``link_lost``; no environment can hold a null character."""
    out = tmp_path / "out"
    tell = program(tmp_path / "tell", f'echo "$BMS_TEXT" > {out}')
    async with hooks({"run": [tell]}) as made:
        made.on_alarm_change(Change(0.0, RAISED.model_copy(update={"text": "the publisher says offline\0"})))
        assert await until(out, 1) == ["the publisher says offline "]


async def test_an_internal_error_does_not_end_a_hook() -> None:
    said: list[bytes] = []

    def say(_: str, payload: bytes) -> None:
        if payload == b"raised":
            raise RuntimeError("a fault of ours")
        said.append(payload)

    async with hooks({"topic": "load/set", "payload": "$state"}, say=say) as made:
        made.on_alarm_change(Change(0.0, RAISED))
        failed = await until_health(made, lambda health: health.failures == 1)
        assert failed.failing == ["publish on load/set: internal error: RuntimeError('a fault of ours')"]
        made.on_alarm_change(Change(0.0, CLEARED))
        await until_health(made, lambda health: health.done == 1)
    assert said == [b"cleared"]


async def test_a_program_gets_the_variables_on_the_list_and_those_that_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("LC_TIME", "MQTT_PASSWORD", "NOTIFY_SOCKET", "GATEWAY"):
        monkeypatch.setenv(name, "here")
    out = tmp_path / "out"
    show = program(tmp_path / "show", f"env > {out}.part; mv {out}.part {out}")
    async with hooks({"run": [show], "pass_environment": ["GATEWAY", "NOT_SET"]}) as made:
        made.on_alarm_change(Change(0.0, RAISED))
        names = {line.partition("=")[0] for line in await until(out, 1)}
    assert {"PATH", "LC_TIME", "GATEWAY", "BMS_NAME"} <= names
    assert names.isdisjoint({"MQTT_PASSWORD", "NOTIFY_SOCKET", "NOT_SET", "PYTHONPATH"})


async def test_a_critical_alarm_that_cannot_be_watched_counts_as_raised() -> None:
    """It is told once, though it is raised meanwhile, and ends only when it can be watched and its cause is gone."""
    hot = RAISED.model_copy(update={"name": "over_temperature", "severity": "critical", "text": "hot"})
    blind = {"watched": False, "unwatched_reason": "no temperature"}
    cold = hot.model_copy(update={"active": False, "since": None, "text": ""})
    said: list[bytes] = []
    told = {"topic": "load/set", "payload": "$name $state $text"}
    async with hooks(told, say=lambda _, payload: said.append(payload)) as made:
        for alarm in (
            cold.model_copy(update=blind),
            hot.model_copy(update=blind),
            cold.model_copy(update=blind),
            cold,
            cold.model_copy(update=blind | {"severity": "warning"}),
            cold.model_copy(update={"severity": "warning"}),
        ):
            made.on_alarm_change(Change(0.0, alarm))
        made.on_alarm_change(Change(0.0, RAISED))
        await until_health(made, lambda health: health.done == 3)
    assert said == [
        b"over_temperature raised no temperature",
        b"over_temperature cleared ",
        b"soc_low raised little charge is left",
    ]


async def test_a_failed_hook_is_told_to_hooks_that_list_it_and_works_again_once_one_run_succeeds(
    tmp_path: Path,
) -> None:
    failed = RAISED.model_copy(update={"name": "hook_failed"})
    tell = program(tmp_path / "tell", '[ "$BMS_NAME" = hook_failed ]')
    said: list[bytes] = []
    told = {"run": [tell], "alarms": ["soc_low", "hook_failed"]}, {"topic": "all", "payload": "$name"}
    async with hooks(*told, say=lambda _, payload: said.append(payload)) as made:
        made.on_alarm_change(Change(0.0, RAISED))
        await until_health(made, lambda health: health.failing == [f"run {tell}: exit code 1"])
        made.on_alarm_change(Change(0.0, failed))
        await until_health(made, lambda health: health.failing == [])
    assert said == [b"soc_low"]


async def test_the_arguments_of_a_program_are_neither_published_nor_logged(tmp_path: Path) -> None:
    with capture_logs() as lines:
        async with hooks({"run": [str(tmp_path / "none"), "token=secret"]}) as made:
            made.on_alarm_change(Change(0.0, RAISED))
            await until_health(made, lambda health: health.failures >= 1)
            assert "secret" not in str(made.health)
    assert "secret" not in str(lines)


def test_a_relay_is_safe_when_the_service_is_silent() -> None:
    """Without ``when_silent`` the pin takes the level of an alarm, and `config check` says so."""
    settings = Settings.model_validate({"sensor": {"port": "/dev/none"}, "alarms": {"hook": [{"relay": "low"}]}})
    (line,) = unusable(settings)
    assert line.startswith(
        "alarms.hook.0.when_silent: not set, so the board switches its pin to low, as in an alarm, after 30 s"
    )


async def test_a_silent_service_leaves_the_relay_at_the_level_of_an_alarm() -> None:
    switched: asyncio.Queue[Relay] = asyncio.Queue()
    async with hooks({"relay": "low"}, switch=switched.put):
        assert await asyncio.wait_for(switched.get(), LONG_S) == Relay(high=True, high_when_silent=False, silent_s=30)


async def test_a_program_that_is_not_there_or_fails_is_logged_and_ends_nothing(tmp_path: Path) -> None:
    told = {"run": [str(tmp_path / "none")]}, {"run": [program(tmp_path / "fail", "exit 3")]}
    with capture_logs() as lines:
        async with hooks(*told) as made:
            made.on_alarm_change(Change(0.0, RAISED))
    said = {line["event"]: line for line in lines}
    assert set(said) == {
        "alarm hook: the program cannot be started",
        "alarm hook: the program was never started",
        "alarm hook: the program has failed",
    }
    assert said["alarm hook: the program has failed"]["exit_code"] == 3


async def test_a_dry_run_says_what_would_be_done_and_does_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    tell = program(tmp_path / "tell", f"echo >> {out}")
    said: list[object] = []
    told: tuple[dict[str, Any], ...] = {"run": [tell]}, {"topic": "load/set", "payload": "OFF"}, {"relay": "high"}
    with capture_logs() as lines:
        async with hooks(*({**each, "dry_run": True} for each in told), say=said.append, switch=said.append) as made:
            made.on_alarm_change(Change(0.0, RAISED))
    assert [line.get("would") or line.get("hook") for line in lines] == [
        "relay pin high",
        f"run {tell}",
        "publish on load/set",
    ]
    assert not out.exists()
    assert not said


@pytest.mark.parametrize(
    ("told", "reason"),
    [
        ({"topic": "load/set"}, r"alarms\.hook\.0\.topic = load/set: there is no broker"),
        ({"relay": "high"}, r"alarms\.hook\.0\.relay: only the board of \[sensor\]"),
    ],
)
def test_a_hook_that_needs_what_is_not_there_is_refused_at_the_start(told: dict[str, Any], reason: str) -> None:
    with pytest.raises(UserError, match=reason):
        AlarmHooks([AlarmHook.model_validate(told)], "pack", None, None)


async def test_an_over_current_cuts_the_load_by_the_relay_is_published_and_acknowledged(
    broker: Broker, tmp_path: Path
) -> None:
    """A virtual board whose relay takes the load off, over its line; the alarm latches, over a restart, too."""
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
    async def served() -> AsyncIterator[None]:
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
            async with served():
                said = await live.wait_json(TOPIC, lambda told: told["latched"])
                assert board.relay_high
                assert (said["active"], said["limit"], said["severity"]) == (True, 5.0, "critical")
                assert said["value"] == pytest.approx(load_a, abs=0.1)
                assert live.all("load/set") == [b'{"discharge_over_current": "raised"}']
            load_a = 1.0
            board.reset()
            assert not board.relay_high
            async with served():
                await relay(board, high=True)
                told = len(live.messages)
                await live.publish("bms/pack/request/acknowledge_alarm", b'{"name": "discharge_over_current"}')
                assert await live.wait_json("bms/pack/response/acknowledge_alarm", skip=told) == {
                    "status": "ok",
                    "data": {"acknowledged": ["discharge_over_current"]},
                    "error": None,
                    "transaction": None,
                }
                await live.wait_json(TOPIC, lambda alarm: not alarm["active"], told)
                await relay(board, high=False)
                await live.wait("load/set", lambda payload: b"cleared" in payload)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def test_a_lost_temperature_sensor_takes_the_load_off_and_a_hook_that_cannot_be_started_is_an_alarm(
    broker: Broker, tmp_path: Path
) -> None:
    """A virtual board whose NTC breaks while the pack is charged, over its line."""
    temperature_c, out, missing = 25.0, tmp_path / "out", tmp_path / "later"
    board = VirtualBoard(lambda _: Reading(-8.0, 22.0, temperature_c))
    hot = {"alarms": ["over_temperature"]}
    tables: dict[str, Any] = {
        "publish": {"rate_hz": 10.0},
        "mqtt": {"url": broker.url},
        "alarms": {
            "lost_s": 0.5,
            "hook_failed": {"delay_s": 0.0, "clear_delay_s": 0.0},
            "hook": [
                hot | {"relay": "high", "when_silent": "high"},
                hot | {"topic": "load/set", "payload": "$name $state"},
                hot | {"run": [str(missing)], "on": ["raised"]},
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
            await relay(board, high=False)
            temperature_c = math.nan
            said = await live.wait_json("bms/pack/alarm/over_temperature", lambda alarm: not alarm["watched"])
            assert (said["active"], said["unwatched_reason"]) == (False, "the temperature is no longer measured")
            fault = await live.wait_json("bms/pack/alarm/sensor_fault", lambda alarm: alarm["active"])
            assert "over_temperature" in fault["text"]
            await live.wait("load/set", lambda payload: payload == b"over_temperature raised")
            await relay(board, high=True)
            failed = await live.wait_json(
                "bms/pack/alarm/hook_failed", lambda alarm: alarm["active"] and str(missing) in alarm["text"]
            )
            assert f"run {missing}: cannot be started" in failed["text"]
            await live.wait_json("bms/pack/health", lambda health: (health["hooks"] or {}).get("failures", 0) > 0)
            program(missing, f"echo $BMS_NAME $BMS_STATE > {out}")
            assert await until(out, 1) == ["over_temperature raised"]
            told = len(live.messages)
            await live.wait_json("bms/pack/alarm/hook_failed", lambda alarm: not alarm["active"])
            temperature_c = 25.0
            await live.wait_json("bms/pack/alarm/over_temperature", lambda alarm: alarm["watched"], told)
            await relay(board, high=False)
            await live.wait("load/set", lambda payload: payload == b"over_temperature cleared")
            stop.set()
            await asyncio.wait_for(service, LONG_S)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
