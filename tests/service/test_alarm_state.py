"""Raised alarms, lost sensors and counters over a restart, after edited settings and with damaged or missing files."""

import asyncio
import dataclasses
import errno
import json
import math
import os
import shutil
import signal
import subprocess
import threading
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import structlog

from bms_estimator.checkpoint.run_file import RunCounters, add_checksum
from bms_estimator.checkpoint.state_files import CheckpointFile, StateFiles
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import NO_CELLS, SAMPLE, CellBlock
from bms_estimator.model.cell import CellModel
from bms_estimator.model.clock import Clock
from bms_estimator.model.events import events
from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.mqtt.connection import DeliveryStats
from bms_estimator.process.state_folder import instance_lock
from bms_estimator.protocols.base.relay import Relay
from bms_estimator.service import checkpoint_writer, relay_hook
from bms_estimator.service.alarm_hooks import AlarmHooks
from bms_estimator.service.checkpoint_writer import lacks_alarm
from bms_estimator.service.live_loop import ServiceParts, run_estimation_loop
from bms_estimator.settings.alarms import AlarmHook
from bms_estimator.settings.pack import Settings
from bms_estimator.sinks.mqtt.requests import RequestDispatcher
from bms_estimator.telemetry.alarms.evaluator import AlarmEvaluator
from tests.checkpoint.test_checkpoint import CELL, SETTINGS, edit_settings
from tests.checkpoint.test_identity import CHECKPOINT_FILE
from tests.patience import LONG_S, until as wait_until
from tests.scripted_source import Collector, ScriptedSource
from tests.service.test_alarm_hooks import acknowledge_in

OVER_VOLTAGE = [(float(t), 0.0, 4.4 if t < 5 else 3.8, 25.0, 0) for t in range(20)]
"""Samples that raise ``pack_over_voltage``, whose cause is then gone: it is latched."""
NORMAL = [(float(t), 0.0, 3.8, 25.0, 0) for t in range(12)]
"""Samples without an alarm, long enough for the relay to follow the alarms."""
NO_TEMPERATURE = [(float(t), 0.0, 3.8, 25.0 if t < 3 else math.nan, 0) for t in range(20)]
HOOKS = (
    {"alarms": ["pack_over_voltage", "over_temperature"], "relay": "low"},
    {"alarms": ["soc_low"], "topic": "alarm", "payload": "$name $state $text"},
)
"""Hooks of the tests. The second hook is for none of the raised alarms."""


class Run(NamedTuple):
    """Result of a run of the service."""

    alarms: dict[str, Alarm]
    """Alarms in the last snapshot."""
    relay: list[bool]
    """Levels of the relay commands: True is high, which connects the load."""
    messages: list[str]
    """Messages of the topic hook."""
    events: list[str]
    """Texts of the events ``alarm_raised``."""
    restarts: int
    checkpoint: str


class RecordingBoard:
    """Board that records the levels of its relay commands."""

    boots = 0

    def __init__(self) -> None:
        self.levels = list[bool]()

    async def relay(self, relay: Relay, _boots: int) -> None:
        self.levels.append(relay.high)


async def run(
    folder: Path,
    rows: list[tuple[float, float, float, float, int]],
    settings: Settings = SETTINGS,
    cell: CellModel = CELL,
    until: Callable[[dict[str, Alarm]], bool] = lambda _: True,
    acknowledge: str = "",
    signal_after: asyncio.Barrier | None = None,
    added_hooks: Sequence[dict[str, Any]] = (),
    slots_v: CellBlock = NO_CELLS,
) -> Run:
    """Run the service over samples, at least until the alarms fulfil a condition.

    Args:
        folder: State folder.
        rows: Samples, as for ``ScriptedSource.give``.
        settings: Settings of the pack.
        cell: Model of the pack.
        until: Condition.
        acknowledge: Alarm to acknowledge; empty: none.
        signal_after: Barrier, after which one of the packs that wait there acknowledges with a signal; None: with a request.
        added_hooks: Hooks besides ``HOOKS``.
        slots_v: Voltages of the cell slots at each sample [V]; empty without any.
    """
    board, messages = RecordingBoard(), list[str]()
    tables = [AlarmHook.model_validate(table) for table in (*HOOKS, *added_hooks)]
    hooks = AlarmHooks(tables, "pack", acknowledge_in(messages), board)
    requests = RequestDispatcher(DeliveryStats(), ("acknowledge_alarm",))
    files, volts = StateFiles(folder, settings, cell), cell.cell.series_count
    async with running(files, settings, cell, hooks=hooks, requests=requests) as (source, sink):
        source.give_block(np.array([(t, a, v * volts, c, c, c, s) for t, a, v, c, s in rows], SAMPLE), slots_v)
        await sink.until(lambda s: s.estimate is not None and until(by_name(s.alarms)))
        if acknowledge:
            if signal_after is None:
                await requests.handle("acknowledge_alarm", json.dumps({"name": acknowledge}).encode())
            elif await signal_after.wait() == 0:
                os.kill(os.getpid(), signal.SIGUSR1)
            await sink.until(lambda s: not by_name(s.alarms)[acknowledge].active)
            board.levels.clear()
        await wait_until(lambda: board.levels)
    pairs = zip([None, *sink.snapshots[:-1]], sink.snapshots, strict=True)
    raised = [each.text for pair in pairs for each in events(*pair) if each.name == "alarm_raised"]
    health = sink.snapshots[0].health
    return Run(by_name(sink.snapshots[-1].alarms), board.levels, messages, raised, health.restarts, health.checkpoint)


@asynccontextmanager
async def running(
    files: StateFiles, settings: Settings = SETTINGS, cell: CellModel = CELL, clock: Clock | None = None, **parts: Any
) -> AsyncIterator[tuple[ScriptedSource, Collector]]:
    """Run the service. At the end its source ends. ``parts`` are fields of ``ServiceParts``."""
    source, sink, stop = ScriptedSource(), Collector(), asyncio.Event()
    task = asyncio.create_task(
        run_estimation_loop(
            settings,
            cell,
            source=source,
            sinks=[sink],
            stop=stop,
            files=files,
            parts=ServiceParts(**parts),
            clock=clock,
        )
    )
    yield source, sink
    source.finish()
    await asyncio.wait_for(task, LONG_S)


def by_name(alarms: tuple[Alarm, ...]) -> dict[str, Alarm]:
    return {alarm.name: alarm for alarm in alarms}


def is_latched(alarms: dict[str, Alarm]) -> bool:
    return "pack_over_voltage" in alarms and alarms["pack_over_voltage"].latched


def is_temperature_lost(alarms: dict[str, Alarm]) -> bool:
    return "over_temperature" in alarms and not alarms["over_temperature"].watched


@pytest.fixture(scope="module")
def latched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """State folder of a run with a latched over-voltage."""
    folder = tmp_path_factory.mktemp("latched")
    asyncio.run(run(folder, OVER_VOLTAGE, until=is_latched))
    return folder


@pytest.fixture
def folder(latched: Path, tmp_path: Path) -> Path:
    """Copy of the state folder with a latched over-voltage."""
    return Path(shutil.copytree(latched, tmp_path / "state"))


EDITS: dict[str, tuple[Settings, CellModel]] = {
    "none": (SETTINGS, CELL),
    "capacity": (SETTINGS, CELL.model_copy(update={"cell": CELL.cell.model_copy(update={"capacity_ah": 0.5})})),
    "series": (SETTINGS, CELL.pack(2, 1)),
    "sign": (edit_settings("sensor", current_sign="charge_positive"), CELL),
    "curve": (SETTINGS, CELL.model_copy(update={"ocv": CELL.ocv.model_copy(update={"constant_v": 3.7})})),
    "latch": (edit_settings("alarms", pack_over_voltage={"latch": False}), CELL),
}
"""Edited settings."""


@pytest.mark.parametrize("edit", EDITS)
async def test_a_latched_alarm_keeps_the_relay_at_its_level_after_edited_settings(folder: Path, edit: str) -> None:
    settings, cell = EDITS[edit]
    restarted = await run(folder, NORMAL, settings, cell)
    assert is_latched(restarted.alarms)
    assert not any(restarted.relay)
    assert not restarted.alarms["alarm_state_lost"].active
    assert (restarted.restarts, restarted.messages) == (1, [])


@pytest.mark.parametrize("damage", ["deleted", "damaged"])
async def test_alarms_and_counters_continue_without_the_checkpoint(folder: Path, damage: str) -> None:
    checkpoint = CheckpointFile(folder, SETTINGS, CELL).path
    if damage == "deleted":
        checkpoint.unlink()
    else:
        checkpoint.write_bytes(b"damaged")
    restarted = await run(folder, NORMAL)
    assert is_latched(restarted.alarms)
    assert not any(restarted.relay)
    assert restarted.restarts == 1
    assert not restarted.checkpoint.startswith("restored")


def flip_bit(content: bytes) -> bytes:
    flipped = bytearray(content)
    flipped[len(content) // 2] ^= 1
    return bytes(flipped)


def with_alarms(alarms: Any) -> Callable[[bytes], bytes]:
    """Return an edit of the run file that replaces the alarms and has a valid checksum."""
    return lambda content: add_checksum(
        json.dumps(json.loads(content.partition(b"\n")[2]) | {"alarms": alarms}).encode()
    )


DAMAGES: dict[str, Callable[[bytes], bytes] | None] = {
    "deleted": None,
    "empty": lambda _: b"",
    "truncated": lambda content: content[:-9],
    "zeroed": lambda content: bytes(len(content)),
    "one bit": flip_bit,
    "another format": lambda _: add_checksum(b'{"format": 99}'),
    "no text": with_alarms(None),
    "no JSON": with_alarms("{"),
    "no object": with_alarms("[1]"),
    "NaN": with_alarms('{"pack_over_voltage": {"since_s": NaN, "value": 1, "gone": true, "acknowledged": false}}'),
    "wrong type": with_alarms('{"pack_over_voltage": {"since_s": 1, "value": 1, "gone": 1, "acknowledged": false}}'),
    "missing key": with_alarms('{"pack_over_voltage": {}}'),
    "wrong inputs": with_alarms('{"inputs": {"temperature": [true]}}'),
    "unknown critical alarm": with_alarms(
        '{"fire": {"since_s": 1, "value": 1, "gone": true, "acknowledged": false, "severity": "critical"}}'
    ),
}
"""Damages of the run file, and contents that hide a raised alarm."""


@pytest.mark.parametrize("damage", ["deleted", "one bit", "NaN"])
async def test_lost_alarms_keep_the_relay_at_its_level_until_they_are_acknowledged(folder: Path, damage: str) -> None:
    file, edit = folder / "pack.run", DAMAGES[damage]
    if edit is None:
        file.unlink()
    else:
        file.write_bytes(edit(file.read_bytes()))
    restarted = await run(folder, NORMAL)
    lost = restarted.alarms["alarm_state_lost"]
    assert (lost.active, lost.severity) == (True, "critical")
    assert not any(restarted.relay)
    assert [text.split(" ")[:2] for text in restarted.messages] == [["alarm_state_lost", "raised"]]
    assert [text for text in restarted.events if text.startswith("alarm_state_lost: ")]
    again = await run(folder, NORMAL)
    assert again.alarms["alarm_state_lost"].active
    assert not any(again.relay)
    assert (again.messages, again.events) == ([], [])
    acknowledged = await run(folder, NORMAL, acknowledge="alarm_state_lost")
    assert all(acknowledged.relay)
    assert acknowledged.messages == ["alarm_state_lost cleared "]
    assert all((await run(folder, NORMAL)).relay)


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_alarms_are_recognized(latched: Path, tmp_path: Path, damage: str) -> None:
    shutil.copy(latched / "pack.run", tmp_path)
    shutil.copy(CheckpointFile(latched, SETTINGS, CELL).path, tmp_path)
    file, edit = StateFiles(tmp_path, SETTINGS, CELL).run_file, DAMAGES[damage]
    if edit is None:
        file.path.unlink()
    else:
        file.path.write_bytes(edit(file.path.read_bytes()))
    saved = file.load()
    assert saved.lost_reason or restore_fails(saved.counters.alarms)


def restore_fails(alarms: str) -> bool:
    """Return True if an evaluator reports that alarms are missing, or raises an exception."""
    evaluator = AlarmEvaluator(SETTINGS, Estimator(CELL))
    try:
        return bool(evaluator.restore(alarms))
    except Exception:  # noqa: BLE001 - the monitor catches any exception
        return True


def test_a_crashed_run_is_recognized(folder: Path) -> None:
    file = StateFiles(folder, SETTINGS, CELL).run_file
    assert not file.load().crashed
    file.save(file.load().counters)
    assert file.load().crashed


async def test_a_damaged_file_with_alarms_is_renamed(folder: Path) -> None:
    (folder / "pack.run").write_bytes(b"damaged")
    await run(folder, NORMAL)
    assert (folder / "pack.refused.run").read_bytes() == b"damaged"


@pytest.mark.parametrize(
    ("name", "others"),
    [
        ("pack", ["pack-2.sqlite", "pack-2-0123abcd.npz"]),
        ("pack", ["pack-0123abcd.sqlite", "pack-0123abcd.board.json", "pack-0123abcd.refused.npz"]),
        ("pack-0123abcd", ["pack-0123abcd.npz", "pack-0123abcd.history.npz", "pack-0123abcd.changes-0"]),
    ],
)
async def test_a_first_start_raises_no_alarm_and_neither_does_one_beside_another_pack(
    tmp_path: Path, name: str, others: list[str]
) -> None:
    for other in others:
        (tmp_path / other).write_bytes(b"of another pack")
    first = await run(tmp_path, NORMAL, edit_settings("pack", name=name))
    assert not first.alarms["alarm_state_lost"].active
    assert all(first.relay)
    assert first.restarts == 0


@pytest.mark.parametrize("edit", [bytes, with_alarms('{"pending": ["over_temperature"]}')])
async def test_a_renamed_pack_takes_the_safe_side_while_its_former_name_has_an_alarm(
    folder: Path, edit: Callable[[bytes], bytes]
) -> None:
    file = folder / "pack.run"
    file.write_bytes(edit(file.read_bytes()))
    renamed = await run(folder, NORMAL, edit_settings("pack", name="renamed"))
    assert "pack has an alarm in pack.run" in renamed.alarms["alarm_state_lost"].text
    assert not any(renamed.relay)


async def test_a_new_pack_beside_a_running_one_with_an_alarm_raises_none(folder: Path) -> None:
    with instance_lock(folder, "pack"):
        second = await run(folder, NORMAL, edit_settings("pack", name="second"))
    assert not second.alarms["alarm_state_lost"].active
    assert all(second.relay)


def settings_on(name: str, tables: dict[str, Any]) -> Settings:
    """Return ``SETTINGS`` of a pack with this name, and with these tables."""
    base = SETTINGS.model_dump(by_alias=True, exclude_unset=True)
    return Settings.model_validate(base | tables | {"pack": base["pack"] | tables.get("pack", {}) | {"name": name}})


BY_ID, TOPIC = "/dev/serial/by-id/usb-1a86_", {"kind": "mqtt", "profile": "esphome-jk", "prefix": "jk-1"}


@pytest.mark.parametrize(
    ("former", "later", "is_raised"),
    [
        ({"sensor": {"port": BY_ID + "1"}}, {"sensor": {"port": BY_ID + "2"}}, False),
        ({"source": TOPIC}, {"source": TOPIC | {"prefix": "jk-2"}, "pack": {"series": 16}}, False),
        ({"source": TOPIC}, {"source": TOPIC | {"prefix": "jk-2"}}, True),  # the node may have been renamed, too
        ({"sensor": {"port": "/dev/ttyUSB0"}}, {"sensor": {"port": "/dev/ttyUSB1"}, "pack": {"series": 16}}, False),
        ({"sensor": {"port": "/dev/ttyUSB0"}}, {"sensor": {"port": "/dev/ttyUSB1"}}, True),
        ({"sensor": {"port": BY_ID + "1"}}, {"sensor": {"port": BY_ID + "1"}, "pack": {"series": 16}}, True),
        ({"sensor": {"port": BY_ID + "1"}}, {"source": TOPIC}, True),
    ],
)
def test_only_a_pack_that_is_surely_another_one_starts_beside_an_alarm_without_one(
    folder: Path, former: dict[str, Any], later: dict[str, Any], *, is_raised: bool
) -> None:
    """With other cells and another device, or on another device whose hardware gives the address, it is another pack."""
    file = StateFiles(folder, settings_on("pack", former), CELL).run_file
    file.save(file.load().counters)
    assert bool(StateFiles(folder, settings_on("new", later), CELL).run_file.load().lost_reason) == is_raised


async def test_settings_that_the_first_values_contradict_are_logged_once_and_stay_in_health(tmp_path: Path) -> None:
    with structlog.testing.capture_logs() as lines:
        async with running(StateFiles(tmp_path, SETTINGS, CELL)) as (source, sink):
            for time_s in range(3):
                source.give_block(np.array([(time_s, 0.0, 4.4, 25.0, 25.0, 25.0, 0)], SAMPLE), capacity_ah=280.0)
            await sink.until(lambda s: s.estimate is not None)
    reasons = [line["reason"] for line in lines if line["event"] == "implausible setting"]
    assert [reason.partition(" ")[0] for reason in reasons] == ["pack.capacity_ah:", "pack.series"]
    assert sink.snapshots[-1].health.suspects == reasons


async def test_an_alarm_that_is_disabled_while_it_is_raised_needs_an_acknowledgement(folder: Path) -> None:
    disabled = edit_settings("alarms", pack_over_voltage={"enabled": False})
    restarted = await run(folder, NORMAL, disabled)
    assert restarted.alarms["alarm_state_lost"].text.endswith(
        "no longer monitored, but raised or due before the restart: pack_over_voltage"
    )
    assert not any(restarted.relay)


async def test_a_raised_warning_of_another_version_is_dropped(folder: Path) -> None:
    file = folder / "pack.run"
    entry = {"since_s": 1.0, "value": None, "gone": False, "acknowledged": False, "severity": "warning"}
    file.write_bytes(with_alarms(json.dumps({"moisture": entry}))(file.read_bytes()))
    assert all((await run(folder, NORMAL)).relay)


def write_former_checkpoint(path: Path, alarms: dict[str, Any]) -> None:
    """Write a checkpoint of the former format, which contains counters and alarms, for another identity."""
    with np.load(CHECKPOINT_FILE) as file:
        np.savez(path, **(dict(file) | {"alarms": json.dumps(alarms), "identity": "0123abcd"}))


RAISED = {"pack_over_voltage": {"since_s": 1.7e9, "value": 4.4, "gone": True, "acknowledged": False}}
"""Latched alarm in the former format."""


async def test_after_an_upgrade_alarms_and_counters_come_from_the_newest_readable_checkpoint(tmp_path: Path) -> None:
    write_former_checkpoint(tmp_path / "pack-0123abcd.npz", RAISED | {"inputs": {"temperature": [1, True]}})
    restarted = await run(tmp_path, NORMAL)
    assert is_latched(restarted.alarms)
    assert not restarted.alarms["alarm_state_lost"].active
    assert not any(restarted.relay)
    assert restarted.restarts == 4


async def test_an_upgrade_beside_a_newer_damaged_checkpoint_takes_the_safe_side(tmp_path: Path) -> None:
    write_former_checkpoint(tmp_path / "pack-0123abcd.npz", {})
    (tmp_path / "pack-4567cdef.npz").write_bytes(b"damaged")
    restarted = await run(tmp_path, NORMAL)
    assert restarted.alarms["alarm_state_lost"].active
    assert not any(restarted.relay)
    assert restarted.restarts == 4


def copy_from_another_pack(folder: Path) -> None:
    another = StateFiles(folder, edit_settings("pack", name="another"), CELL).run_file
    another.save(another.load().counters)
    another.path.replace(folder / "pack.run")
    os.utime(folder / "pack.run", (5e9, 5e9))  # newer than the checkpoint, which alone would also be a reason


def interrupt_quarantine(folder: Path) -> None:
    """Leave only a refused file, as if the service had been killed before its first save."""
    (folder / "pack.run").rename(folder / "pack.refused.run")
    for path in folder.glob("pack-*"):
        path.unlink()


def return_from_former_version(folder: Path) -> None:
    """Leave a file without alarms that is older than the checkpoint of the former version."""
    file = folder / "pack.run"
    file.write_bytes(with_alarms("")(file.read_bytes()))
    os.utime(file, (1e9, 1e9))


@pytest.mark.parametrize(
    "edit",
    [
        copy_from_another_pack,
        lambda folder: (folder / "pack.run").unlink(),
        interrupt_quarantine,
        return_from_former_version,
    ],
)
async def test_a_checkpoint_of_a_former_version_does_not_hide_lost_alarms(
    folder: Path, edit: Callable[[Path], None]
) -> None:
    edit(folder)
    write_former_checkpoint(folder / "pack-0123abcd.npz", {})
    os.utime(folder / "pack-0123abcd.npz", (4e9, 4e9))
    restarted = await run(folder, NORMAL)
    assert restarted.alarms["alarm_state_lost"].active
    assert not any(restarted.relay)


@pytest.mark.parametrize("edit", ["none", "capacity", "series"])
async def test_a_lost_sensor_stays_lost_after_edited_settings(tmp_path: Path, edit: str) -> None:
    await run(tmp_path, NO_TEMPERATURE, until=is_temperature_lost)
    restarted = await run(tmp_path, [(float(t), 0.0, 3.8, math.nan, 0) for t in range(5)], *EDITS[edit])
    assert is_temperature_lost(restarted.alarms)
    assert not any(restarted.relay)


async def test_a_lost_sensor_stays_lost_after_damaged_alarms_and_their_acknowledgement(tmp_path: Path) -> None:
    """The estimator's checkpoint shows that the temperature was measured."""
    await run(tmp_path, NO_TEMPERATURE, until=is_temperature_lost)
    (tmp_path / "pack.run").write_bytes(b"damaged")
    rows = [(float(t), 0.0, 3.8, math.nan, 0) for t in range(30)]
    restarted = await run(tmp_path, rows, acknowledge="alarm_state_lost")
    assert is_temperature_lost(restarted.alarms)
    assert not any(restarted.relay)


async def test_lost_cells_stay_lost_after_damaged_alarms(tmp_path: Path) -> None:
    pack, rows = CELL.pack(4, 1), [(float(t), 0.0, 3.8, 25.0, 0) for t in range(30)]
    await run(tmp_path, rows, cell=pack, slots_v=np.full((30, 4), 3.8))
    (tmp_path / "pack.run").write_bytes(b"damaged")
    two = np.full((30, 4), [3.8, 3.8, math.nan, math.nan])
    restarted = await run(tmp_path, rows, cell=pack, slots_v=two)
    assert not restarted.alarms["cell_over_voltage"].watched


async def test_fewer_cells_in_series_than_measured_before_drop_no_alarm(tmp_path: Path) -> None:
    file = StateFiles(tmp_path, SETTINGS, CELL).run_file
    saved = file.load().counters
    state = json.dumps(RAISED | {"inputs": {"cells": [16, False]}})
    file.save(type(saved)(saved.restarts, saved.total, clean=True, alarms=state))
    restarted = await run(tmp_path, NORMAL, cell=CELL.pack(4, 1))
    assert is_latched(restarted.alarms)


async def test_a_raised_alarm_is_saved_without_the_wait_for_the_next_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint_writer, "CHECK_INTERVAL_S", 1e6)
    settings = edit_settings("state", checkpoint_s=1e6)
    files = StateFiles(tmp_path, settings, CELL)
    async with running(files, settings) as (source, _):
        await wait_until(files.run_file.path.exists)
        source.give(*OVER_VOLTAGE)
        await wait_until(lambda: "pack_over_voltage" in files.run_file.load().counters.alarms)


async def test_the_final_save_has_an_alarm_of_samples_that_arrived_since_the_last_evaluation(tmp_path: Path) -> None:
    """The clock stands, so that the next evaluation is not due."""
    files = StateFiles(tmp_path, SETTINGS, CELL)
    clock = Clock(monotonic=lambda: 0.0)
    async with running(files, clock=clock) as (source, sink):
        source.give(*NORMAL)
        await sink.until(lambda s: s.estimate is not None)
        source.give(*((12.0 + t, 0.0, 4.4, 25.0, 0) for t in range(5)))
    assert by_name(sink.snapshots[-1].alarms)["pack_over_voltage"].active
    assert "pack_over_voltage" in files.run_file.load().counters.alarms


async def test_an_acknowledgement_during_the_final_save_is_rejected(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer, the hooks and the saved alarms agree."""
    files = StateFiles(folder, SETTINGS, CELL)
    requests, save, is_saving, may_save = (
        RequestDispatcher(DeliveryStats(), ("acknowledge_alarm",)),
        files.run_file.save,
        threading.Event(),
        threading.Event(),
    )

    def save_slowly(counters: RunCounters) -> None:
        if counters.clean:
            is_saving.set()
            may_save.wait(LONG_S)
        save(counters)

    monkeypatch.setattr(files.run_file, "save", save_slowly)
    async with running(files, requests=requests) as (source, sink):
        source.give(*NORMAL)
        source.finish()
        await asyncio.to_thread(is_saving.wait, LONG_S)
        response = json.loads(await requests.handle("acknowledge_alarm", b"{}") or b"{}")
        os.kill(os.getpid(), signal.SIGUSR1)
        may_save.set()
    assert response["error"] == "the service is stopping"
    assert is_latched(by_name(sink.snapshots[-1].alarms))
    assert "pack_over_voltage" in files.run_file.load().counters.alarms


async def test_a_deleted_file_with_alarms_is_written_again_without_samples(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint_writer, "CHECK_INTERVAL_S", 0.01)
    settings = edit_settings("state", checkpoint_s=1e6)
    files = StateFiles(folder, settings, CELL)
    async with running(files, settings):
        await wait_until(lambda: not json.loads(files.run_file.path.read_bytes().partition(b"\n")[2])["clean"])
        shutil.rmtree(folder)
        await wait_until(files.run_file.path.exists)
        assert "pack_over_voltage" in files.run_file.load().counters.alarms


async def test_a_raised_alarm_is_saved_at_once_and_again_after_the_disk_was_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checkpoint interval is 1e6 s. The process is killed, which is the same as to read the file before the end."""
    monkeypatch.setattr(checkpoint_writer, "CHECK_INTERVAL_S", 0.01)
    monkeypatch.setattr(checkpoint_writer, "RETRY_S", 0.02)
    settings = edit_settings("state", checkpoint_s=1e6)
    blocked = tmp_path / "state"
    blocked.write_text("a file instead of the folder")
    files = StateFiles(blocked, settings, CELL)
    async with running(files, settings) as (source, sink):
        source.give(*OVER_VOLTAGE)
        await sink.until(lambda s: is_latched(by_name(s.alarms)))
        await sink.until(lambda s: s.health.checkpoint.startswith("cannot be saved"))
        blocked.unlink()
        await wait_until(lambda: "pack_over_voltage" in files.run_file.load().counters.alarms)


async def test_an_alarm_that_a_failing_disk_does_not_save_is_announced_as_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint_writer, "CHECK_INTERVAL_S", 0.01)
    monkeypatch.setattr(checkpoint_writer, "RETRY_S", 0.02)
    folder = tmp_path / "state"
    files = StateFiles(folder, SETTINGS, CELL)
    async with running(files) as (source, sink):
        await wait_until(files.run_file.path.exists)
        folder.rename(tmp_path / "former")
        folder.write_text("a file instead of the folder")
        source.give(*OVER_VOLTAGE)
        await sink.until(
            lambda s: "alarm_state_lost" in (alarms := by_name(s.alarms)) and alarms["alarm_state_lost"].active
        )
        assert "cannot be written" in by_name(sink.snapshots[-1].alarms)["alarm_state_lost"].text


async def test_a_disk_that_hangs_between_two_saves_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint_writer, "CHECK_INTERVAL_S", 0.01)
    monkeypatch.setattr(checkpoint_writer, "DISK_HUNG_S", 0.01)
    files, may_continue = StateFiles(tmp_path, edit_settings("state", checkpoint_s=1e6), CELL), threading.Event()
    async with running(files, edit_settings("state", checkpoint_s=1e6)) as (source, sink):
        source.give(*NORMAL)
        await sink.until(lambda s: s.health.checkpoint == "saved")
        files.thread.submit(may_continue.wait)
        await sink.until(lambda s: s.health.checkpoint == "not saved: the disk hangs", skip=len(sink.snapshots))
        may_continue.set()
        await sink.until(lambda s: s.health.checkpoint == "saved", skip=len(sink.snapshots))


async def test_an_alarm_that_is_saved_at_the_second_attempt_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint_writer, "RETRY_S", 0.02)
    monkeypatch.setattr(checkpoint_writer, "CHECK_INTERVAL_S", 0.01)
    files = StateFiles(tmp_path, SETTINGS, CELL)
    save, failures = files.run_file.save, [OSError(errno.EROFS, "read-only")]

    def save_after_a_failure(counters: RunCounters) -> None:
        if "pack_over_voltage" in counters.alarms and failures:
            raise failures.pop()
        save(counters)

    monkeypatch.setattr(files.run_file, "save", save_after_a_failure)
    async with running(files) as (source, sink):
        await wait_until(files.run_file.path.exists)
        source.give(*OVER_VOLTAGE)
        await wait_until(lambda: "pack_over_voltage" in files.run_file.load().counters.alarms)
    assert not failures
    assert not by_name(sink.snapshots[-1].alarms)["alarm_state_lost"].active


async def test_after_a_suspend_the_relay_stays_open_until_new_samples_are_watched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first samples after it are old, from the buffers of the port. The pack has become hot meanwhile."""
    monkeypatch.setattr(relay_hook, "COMMAND_INTERVAL_S", relay_hook.RESET_POLL_S)
    now_s, board = 0.0, RecordingBoard()
    hooks, clock = AlarmHooks([AlarmHook.model_validate(HOOKS[0])], "pack", None, board), Clock(monotonic=lambda: now_s)
    files = StateFiles(tmp_path, SETTINGS, CELL)
    async with running(files, clock=clock, hooks=hooks) as (source, sink):
        source.give(*NORMAL)
        await wait_until(lambda: board.levels)
        assert all(board.levels)
        board.levels.clear()
        now_s = 1000.0  # beyond the long limit of ``link_lost``
        source.give(*((float(t), 0.0, 3.8, 25.0, 0) for t in range(12, 32)))
        await wait_until(lambda: board.levels)
        for t in range(1000, 1020):
            commands, now_s = len(board.levels), t + 1.0
            source.give((float(t), 0.0, 3.8, 25.0 if t < 1003 else 70.0, 0))
            await wait_until(lambda least=commands + 2: len(board.levels) >= least)
    assert by_name(sink.snapshots[-1].alarms)["over_temperature"].active
    assert not any(board.levels)


async def test_a_kill_within_the_delay_of_an_alarm_raises_it_although_its_cause_is_gone(tmp_path: Path) -> None:
    files = StateFiles(tmp_path, SETTINGS, CELL)
    async with running(files) as (source, _):
        source.give(*OVER_VOLTAGE[:1])
        await wait_until(lambda: "pending" in files.run_file.load().counters.alarms)
        killed = Path(shutil.copytree(tmp_path, tmp_path / "killed"))
    restarted = await run(killed, NORMAL)
    assert restarted.alarms["pack_over_voltage"].active
    assert not any(restarted.relay)


def test_an_alarm_is_saved_in_a_folder_that_cannot_be_written(folder: Path) -> None:
    if os.geteuid() != 0 or subprocess.run(["chattr", "+i", folder], check=False).returncode != 0:
        pytest.skip("no folder can be made immutable here")
    file = StateFiles(folder, SETTINGS, CELL).run_file
    try:
        file.save(dataclasses.replace(file.load().counters, alarms=json.dumps(RAISED | {"silence": "no samples"})))
    finally:
        subprocess.run(["chattr", "-i", folder], check=True)
    assert "silence" in file.load().counters.alarms


def test_an_alarm_is_saved_on_a_full_disk(folder: Path, full_disk: Path) -> None:
    path = (full_disk / "file").rename(full_disk / "pack.run")  # the only block of this disk
    file = StateFiles(folder, SETTINGS, CELL).run_file
    counters = file.load().counters
    shutil.copy(file.path, path)
    full = StateFiles(full_disk, SETTINGS, CELL).run_file
    full.save(dataclasses.replace(counters, alarms=json.dumps(RAISED)))
    assert full.load().counters.alarms == json.dumps(RAISED)
    assert not full.load().lost_reason


async def test_a_restart_connects_the_load_only_once_a_due_alarm_would_be_raised(tmp_path: Path) -> None:
    """The delay of ``over_temperature`` is 10 s."""
    hot = [(float(t), 0.0, 3.8, 70.0, 0) for t in range(20)]
    assert not any((await run(tmp_path / "first", hot, until=lambda a: a["over_temperature"].active)).relay)
    folder = tmp_path / "second"
    assert all((await run(folder, NORMAL)).relay)
    assert not any((await run(folder, hot, until=lambda a: a["over_temperature"].active)).relay)


async def test_a_start_that_cannot_save_alarms_takes_the_safe_side(tmp_path: Path, disk_without_files: Path) -> None:
    unwritable = await run(disk_without_files / "state", NORMAL)
    assert "cannot be written" in unwritable.alarms["alarm_state_lost"].text
    assert not any(unwritable.relay)


@pytest.mark.parametrize("left", ["pack.new", "pack.board.json", "pack-3105fc89.changes-0"])
async def test_a_start_beside_any_file_of_an_earlier_run_takes_the_safe_side(tmp_path: Path, left: str) -> None:
    (tmp_path / left).touch()
    assert (await run(tmp_path, NORMAL)).alarms["alarm_state_lost"].active


async def test_a_hook_that_is_added_before_a_restart_acts_on_a_raised_alarm(folder: Path) -> None:
    added = {"alarms": ["pack_over_voltage"], "topic": "added", "payload": "$name $state"}
    assert (await run(folder, NORMAL, added_hooks=[added])).messages == ["pack_over_voltage raised"]
    assert (await run(folder, NORMAL, added_hooks=[added])).messages == []


async def test_a_signal_acknowledges_the_alarms_of_all_packs(folder: Path, tmp_path: Path) -> None:
    another = Path(shutil.copytree(folder, tmp_path / "another"))
    both = asyncio.Barrier(2)
    packs = (run(each, NORMAL, acknowledge="pack_over_voltage", signal_after=both) for each in (folder, another))
    assert all(all(each.relay) for each in await asyncio.gather(*packs))


async def test_a_slot_that_floats_at_a_restart_does_not_replace_the_dead_cell_that_raised_an_alarm(
    tmp_path: Path,
) -> None:
    """The device has six slots. A pack without a raised alarm may have been wired to others."""
    rows, name = [(float(t), 0.0, 3.3, 25.0, 0) for t in range(60)], "cell_under_voltage"
    low, dead = np.full((60, 6), 3.7), np.full((60, 6), 3.7)
    low[:, 4:], low[20:, 1] = 0.0, 2.0
    dead[:, 1], dead[:, 5] = 0.02, 0.0
    pack = CELL.pack(4, 1)
    assert (await run(tmp_path, rows, cell=pack, slots_v=low, until=lambda a: a[name].active)).alarms[name].active
    assert (await run(tmp_path, rows, cell=pack, slots_v=dead)).alarms[name].active
    assert (await run(tmp_path, rows, cell=pack, slots_v=np.flip(dead, axis=1))).alarms[name].active
    assert not (await run(tmp_path / "new", rows, cell=pack, slots_v=dead)).alarms[name].active


async def test_a_slot_that_floats_at_a_restart_does_not_replace_a_lost_cell_without_the_alarm_of_the_sensor(
    tmp_path: Path,
) -> None:
    rule = SETTINGS.alarms.sensor_fault.model_copy(update={"enabled": False})
    settings = SETTINGS.model_copy(update={"alarms": SETTINGS.alarms.model_copy(update={"sensor_fault": rule})})
    rows, pack = [(float(t), 0.0, 3.8, 25.0, 0) for t in range(60)], CELL.pack(4, 1)
    lost, floating = np.full((60, 6), 3.8), np.full((60, 6), 3.8)
    lost[:, 4:], lost[20:, 1] = 0.0, np.nan
    floating[:, 1], floating[:, 5] = np.nan, 0.0
    for slots_v in (lost, floating):
        run_ = await run(
            tmp_path, rows, settings, pack, lambda a: a["cell_under_voltage"].unwatched_reason, slots_v=slots_v
        )
        assert run_.alarms["cell_under_voltage"].unwatched_reason


async def test_cells_in_other_slots_than_before_a_restart_need_an_acknowledgement(tmp_path: Path) -> None:
    """The wire of a cell broke shortly before the restart, and the slot behind the last cell floats."""
    rows, pack, whole = [(float(t), 0.0, 3.8, 25.0, 0) for t in range(12)], CELL.pack(4, 1), np.full((12, 6), 3.8)
    whole[:, 4:] = 0.0
    floating = whole[:, [0, 4, 2, 3, 1, 5]]
    assert all((await run(tmp_path, rows, cell=pack, slots_v=whole)).relay)
    assert all((await run(tmp_path, rows, cell=pack, slots_v=whole)).relay)
    moved = await run(tmp_path, rows, cell=pack, slots_v=floating)
    assert "in slots 1, 3, 4, 5, and were in 1, 2, 3, 4" in moved.alarms["alarm_state_lost"].text
    assert not any(moved.relay)
    assert all((await run(tmp_path, rows, cell=pack, slots_v=floating, acknowledge="alarm_state_lost")).relay)
    assert all((await run(tmp_path, rows, cell=pack, slots_v=floating)).relay)


def alarm_state(**acknowledged: bool) -> str:
    return json.dumps({name: {"acknowledged": flag, "gone": flag} for name, flag in acknowledged.items()})


def test_only_what_a_restart_would_lack_is_saved_at_once() -> None:
    assert lacks_alarm("", alarm_state(a=False))
    assert lacks_alarm(alarm_state(a=False), alarm_state(a=True))
    assert lacks_alarm(alarm_state(a=True), alarm_state(a=False))
    assert lacks_alarm("{}", '{"inputs": {"temperature": [1, true]}}')
    assert lacks_alarm("{}", '{"silence": "no samples"}')
    assert not lacks_alarm(alarm_state(a=False, b=False), alarm_state(b=False))
    assert not lacks_alarm(alarm_state(a=False), "")
    assert lacks_alarm(alarm_state(a=True), "")  # the acknowledgement would cover a new cause
    assert lacks_alarm('{"probes": 2}', '{"probes": 3}')
    assert not lacks_alarm('{"probes": 3}', '{"probes": 2}')
    gone, returned = (json.dumps({"a": {"acknowledged": False, "gone": flag}}) for flag in (True, False))
    assert lacks_alarm(gone, returned)
    assert not lacks_alarm(returned, gone)
    assert lacks_alarm("", '{"pending": ["a"]}')
    assert not lacks_alarm('{"pending": ["a"]}', "")
