"""What is done of alarms: real programs, a real broker, a board's relay over its line."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from bms_estimator.model.alarm_settings import AlarmHook
from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.model.estimate import Alarm
from bms_estimator.model.settings import Settings
from bms_estimator.service.alarm_hooks import Hooks, unusable
from bms_estimator.service.serve import serve
from bms_estimator.simulation.virtual_board import VirtualBoard
from bms_estimator.simulation.virtual_converter import Reading
from bms_estimator.snapshot.alarms import Change
from bms_estimator.sources.protocol import Relay
from tests.collector import Collector
from tests.mosquitto import Broker, Listener, broker
from tests.patience import LONG_S

__all__ = ["broker"]

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
async def hooks(*told: dict[str, Any], **edges: Any) -> AsyncIterator[Hooks]:
    options = {"say": None, "switch": None} | edges
    async with Hooks([AlarmHook.model_validate(each) for each in told], "pack", **options) as made:
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
            made.tell(Change(0.0, alarm))
        said = await until(out, 2)
    assert said[0].startswith("a b;c soc_low raised 0.09 pack {")
    assert json.loads(said[0][said[0].index("{") :]) == RAISED.model_dump()
    assert said[1].startswith("a b;c soc_low cleared  pack {")


async def test_only_what_is_asked_for_is_done(tmp_path: Path) -> None:
    out = tmp_path / "out"
    tell = program(tmp_path / "tell", f'echo "$BMS_NAME $BMS_STATE" >> {out}')
    other = RAISED.model_copy(update={"name": "link_lost"})
    async with hooks({"run": [tell], "alarms": ["soc_low"], "on": ["raised"]}) as made:
        for alarm in (other, CLEARED, RAISED):
            made.tell(Change(0.0, alarm))
        assert await until(out, 1) == ["soc_low raised"]


async def test_a_program_that_hangs_is_killed_with_what_it_started_and_the_next_alarm_is_told(tmp_path: Path) -> None:
    out, child = tmp_path / "out", tmp_path / "child"
    hang = program(
        tmp_path / "hang",
        f"[ $BMS_STATE = raised ] && {{ sleep 1000 & echo $! > {child}; wait; }}; echo $BMS_STATE > {out}",
    )
    with capture_logs() as lines:
        async with hooks({"run": [hang], "timeout_s": 2.0}) as made:
            for alarm in (RAISED, CLEARED):
                made.tell(Change(0.0, alarm))
            assert await until(out, 1) == ["cleared"]
    assert [line["event"] for line in lines] == ["alarm hook: the program takes too long and is killed"]
    async with asyncio.timeout(LONG_S):
        while _runs(int(child.read_text())):  # noqa: ASYNC110 - nor has one that is not ours
            await asyncio.sleep(0.01)


async def test_a_descendant_in_a_session_of_its_own_is_killed_too(tmp_path: Path) -> None:
    child = tmp_path / "child"
    hang = program(tmp_path / "hang", f"setsid sh -c 'echo $$ > {child}; exec sleep 1000' & wait")
    async with hooks({"run": [hang], "timeout_s": 2.0}) as made:
        made.tell(Change(0.0, RAISED))
        await until(child, 1)
        async with asyncio.timeout(LONG_S):
            while _runs(int(child.read_text())):  # noqa: ASYNC110 - it is not a child of this process
                await asyncio.sleep(0.01)


async def test_a_program_that_cannot_be_started_is_tried_again(tmp_path: Path) -> None:
    out, tell = tmp_path / "out", tmp_path / "tell"
    async with hooks({"run": [str(tell)]}) as made:
        with capture_logs() as lines:
            made.tell(Change(0.0, RAISED))
            async with asyncio.timeout(LONG_S):
                while not lines:  # noqa: ASYNC110 - a log line has no event
                    await asyncio.sleep(0.01)
        program(tell, f"echo $BMS_STATE > {out}")
        assert await until(out, 1) == ["raised"]


async def test_the_end_of_an_alarm_ends_the_retries(tmp_path: Path) -> None:
    out, tell = tmp_path / "out", tmp_path / "tell"
    async with hooks({"run": [str(tell)], "on": ["raised"]}) as made:
        with capture_logs() as lines:
            made.tell(Change(0.0, RAISED))
            async with asyncio.timeout(LONG_S):
                while not lines:  # noqa: ASYNC110 - a log line has no event
                    await asyncio.sleep(0.01)
        program(tell, f"echo $BMS_NAME >> {out}")
        made.tell(Change(0.0, CLEARED))
        made.tell(Change(0.0, RAISED.model_copy(update={"name": "link_lost"})))
        assert await until(out, 1) == ["link_lost"]


async def test_a_program_gets_only_named_variables_of_the_service(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("SECRET_OF_THE_SERVICE", "a")
    monkeypatch.setenv("WANTED", "b")
    out = tmp_path / "out"
    tell = program(tmp_path / "tell", f'echo "$SECRET_OF_THE_SERVICE-$WANTED" > {out}')
    async with hooks({"run": [tell], "pass_environment": ["WANTED"]}) as made:
        made.tell(Change(0.0, RAISED))
        assert await until(out, 1) == ["-b"]


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
            made.tell(Change(0.0, RAISED))
    said = {line["event"]: line for line in lines}
    assert set(said) == {"alarm hook: the program cannot be started", "alarm hook: the program has failed"}
    assert said["alarm hook: the program has failed"]["exit_code"] == 3


async def test_a_dry_run_says_what_would_be_done_and_does_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    tell = program(tmp_path / "tell", f"echo >> {out}")
    said = []
    told = {"run": [tell]}, {"topic": "load/set", "payload": "OFF"}, {"relay": "high"}
    with capture_logs() as lines:
        async with hooks(*({**each, "dry_run": True} for each in told), say=said.append, switch=said.append) as made:
            made.tell(Change(0.0, RAISED))
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
        Hooks([AlarmHook.model_validate(told)], "pack", None, None)


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
        task = asyncio.create_task(serve(settings, cell, sinks=[sink], stop=stop, folder=tmp_path))
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
