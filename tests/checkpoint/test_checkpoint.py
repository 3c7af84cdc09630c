"""Checkpoints: a pack's state is saved, and restored after changes of settings or version."""

import asyncio
import errno
import itertools
import os
import stat
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.lib.recfunctions import repack_fields

from bms_estimator.checkpoint.identity import pack_identity
from bms_estimator.checkpoint.state_files import FORMAT, MAX_FILES, CheckpointFile, StateFiles
from bms_estimator.estimator.estimator import Estimator, compiled_estimator
from bms_estimator.estimator.restore import restore_state
from bms_estimator.kernels.kalman_filter.anchors import FULL
from bms_estimator.kernels.kalman_filter.records import OFFSET, SCRATCH
from bms_estimator.model.arrays import fields
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.payloads.health import Health
from bms_estimator.service import checkpoint_writer, live_loop
from bms_estimator.service.live_loop import run_estimation_loop
from bms_estimator.settings.pack import Settings
from tests.patience import LONG_S
from tests.scripted_source import Collector, ScriptedSource

CELL = load_cell("chen_mora")
SETTINGS = Settings.model_validate(
    {"pack": {"initial_soc": 0.5}, "publish": {"rate_hz": 10.0}, "alarms": {"link_lost": {"limit_s": LONG_S}}}
)
"""Settings with a long limit of ``link_lost``, because most sources of the tests send only a few samples."""


def edit_settings(section: str, **values: Any) -> Settings:
    """Return ``SETTINGS`` with these values in one section."""
    tables = SETTINGS.model_dump(by_alias=True, exclude_none=True)
    return Settings.model_validate(tables | {section: tables[section] | values})


def learned_estimator() -> Estimator:
    """Return an estimator after eleven minutes of load, with a map of elements that no sample without a load changes."""
    estimator = compiled_estimator(SETTINGS, CELL)
    for i in range(660):
        estimator.step(float(i), 0.3 * (i // 60 % 2), 3.8)
    estimator.record["map"]["weight"] = estimator.record["map"]["moment"] = 1.0
    estimator.record["filter"]["rms_a2"] = 0.0
    return estimator


@dataclass
class RunResult:
    """Result of a run of the service."""

    estimator: Estimator
    health: Health
    """First published health message, which contains the result of reading the checkpoint."""


async def run_samples(
    folder: Path, settings: Settings = SETTINGS, cell: CellModel = CELL, current_a: float = 0.275, samples: int = 361
) -> RunResult:
    """Run the service over samples at 1 Hz with ``current_a``. By default they draw a tenth of the capacity."""
    source, sink = ScriptedSource(), Collector()
    source.give(*((float(i), current_a, 3.8 * cell.cell.series_count) for i in range(samples)))
    source.finish()
    files = StateFiles(folder, settings, cell)
    running = run_estimation_loop(settings, cell, source=source, sinks=[sink], stop=asyncio.Event(), files=files)
    estimator = await asyncio.wait_for(running, LONG_S)
    return RunResult(estimator, sink.snapshots[0].health)


async def test_a_restart_continues_from_the_checkpoint(tmp_path: Path) -> None:
    first = await run_samples(tmp_path)
    assert first.estimator.state["soc_coulomb"][0] == pytest.approx(0.4)
    second = await run_samples(tmp_path, samples=2)  # the board's clock starts from zero again
    # The load is assumed to continue during the gap, which lasts ``unseen_s``.
    unseen_s = second.estimator.record["unseen_s"][0]
    assert 0.0 < unseen_s < LONG_S
    assert second.estimator.state["soc_coulomb"][0] == pytest.approx(0.4 - (unseen_s + 1.0) / 3600.0, abs=1e-9)
    assert second.estimator.state["samples"][0] == 2
    assert second.health.restarts == 1
    assert second.health.checkpoint == f"restored: SOC {first.estimator.state['soc'][0]:.4f}"


async def test_a_restart_continues_from_the_checkpoint_without_the_identifier(tmp_path: Path) -> None:
    without_identifier = edit_settings("identifier", enabled=False)
    await run_samples(tmp_path, without_identifier)
    second = await run_samples(tmp_path, without_identifier, samples=2)
    assert second.health.restarts == 1
    unseen_s = second.estimator.record["unseen_s"][0]
    assert second.estimator.state["soc"][0] == pytest.approx(0.4 - (unseen_s + 1.0) / 3600.0, abs=1e-9)


async def test_the_gap_of_a_restart_lasts_until_the_first_valid_sample(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    await run_samples(tmp_path)
    monkeypatch.setattr(live_loop, "since_boot", itertools.count().__next__)  # each call advances by a second
    source = ScriptedSource()
    for i in range(40):
        source.give((0.1 * i, 0.0, 9.9))  # an implausible voltage
    source.give((5.0, 0.275, 3.8))
    source.finish()
    files = StateFiles(tmp_path, SETTINGS, CELL)
    running = run_estimation_loop(SETTINGS, CELL, source=source, sinks=[Collector()], stop=asyncio.Event(), files=files)
    estimator = await asyncio.wait_for(running, LONG_S)
    assert 41.0 < estimator.record["unseen_s"][0] < 41.0 + LONG_S


@pytest.mark.parametrize(
    "settings",
    [
        edit_settings("observer", lock_time_s=20.0),
        edit_settings("observer", law="scheme-1"),
        edit_settings("observer", law="learning"),
        edit_settings("identifier", map_memory_h=100.0),
        edit_settings("identifier", current_offset_std_a=0.1),
        edit_settings("sensor", voltage_noise_v=0.01),
        edit_settings("sensor", port="/dev/ttyUSB7"),
        edit_settings("pack", initial_soc=0.9),
    ],
    ids=lambda settings: str(settings.model_dump(exclude_defaults=True)),
)
async def test_a_learned_state_is_restored_after_a_change_of_settings(tmp_path: Path, settings: Settings) -> None:
    learned = learned_estimator()
    CheckpointFile(tmp_path, SETTINGS, CELL).save(learned.record)
    run = await run_samples(tmp_path, settings, current_a=0.0, samples=1)
    assert run.health.checkpoint == f"restored: SOC {learned.state['soc'][0]:.4f}"
    assert run.estimator.record["map"].tobytes() == learned.record["map"].tobytes()


async def test_parameters_of_the_learning_law_are_restored_only_under_the_same_settings_of_the_observer(
    tmp_path: Path,
) -> None:
    settings = edit_settings("observer", law="learning")
    learned = compiled_estimator(settings, CELL)
    for i in range(3600):
        learned.step(float(i), 0.3 * (i // 60 % 2), 3.8 - 0.03 * (i // 60 % 2))
    theta = learned.record[0]["learning"]["theta"].copy()
    assert theta.any()
    CheckpointFile(tmp_path, settings, CELL).save(learned.record)
    restored = await run_samples(tmp_path, settings, samples=1)
    assert (restored.estimator.record[0]["learning"]["theta"] == theta).all()
    assert restored.health.checkpoint == f"restored: SOC {learned.state['soc'][0]:.4f}"
    relearned = await run_samples(tmp_path, edit_settings("observer", law="learning", lock_time_s=20.0), samples=1)
    assert not relearned.estimator.record[0]["learning"]["theta"].any()


async def test_a_checkpoint_without_the_fields_of_the_learning_law_is_restored(tmp_path: Path) -> None:
    learned = learned_estimator()
    file = CheckpointFile(tmp_path, SETTINGS, CELL)
    file.save(learned.record)
    with np.load(file.path) as saved:
        state = saved["state"]
        without_learning = dict(saved) | {
            "state": repack_fields(state[[n for n in state.dtype.names if n != "learning"]])
        }
    np.savez(file.path, **without_learning)
    run = await run_samples(tmp_path, edit_settings("observer", law="learning"), samples=1)
    assert run.health.checkpoint == f"restored: SOC {learned.state['soc'][0]:.4f}"


async def test_a_learned_state_is_restored_after_a_change_of_the_cells_name_and_description(tmp_path: Path) -> None:
    learned = learned_estimator()
    CheckpointFile(tmp_path, SETTINGS, CELL).save(learned.record)
    described = CELL.model_copy(update={"cell": CELL.cell.model_copy(update={"name": "mine", "description": "new"})})
    run = await run_samples(tmp_path, cell=described, samples=2)
    assert run.health.checkpoint == f"restored: SOC {learned.state['soc'][0]:.4f}"


def test_the_identity_of_a_pack_depends_on_number_of_cells_capacity_ocv_and_sign_of_the_current() -> None:
    original = pack_identity(SETTINGS, CELL)
    larger = CELL.model_copy(update={"cell": CELL.cell.model_copy(update={"capacity_ah": 3.0})})
    other_ocv = CELL.model_copy(update={"ocv": CELL.ocv.model_copy(update={"constant_v": 3.7})})
    reversed_sign = edit_settings("sensor", current_sign="charge_positive")
    others = [pack_identity(SETTINGS, cell) for cell in (larger, other_ocv, CELL.pack(2, 1), CELL.pack(1, 2))]
    assert len({original, *others, pack_identity(reversed_sign, CELL)}) == 6


def test_known_fields_of_a_checkpoint_of_another_version_are_restored() -> None:
    """The other version lacks two fields, has another shape of one, and has one that this version does not know."""
    saved, fresh, estimator = (
        learned_estimator(),
        compiled_estimator(SETTINGS, CELL),
        compiled_estimator(SETTINGS, CELL),
    )
    fresh.step(0.0, 0.0, CELL.cell.nominal_voltage_v)
    of_other_version = dict(fields(saved.record))
    del of_other_version["checks.good_soc"], of_other_version["map.dwell_s"]
    of_other_version |= {"filter.ohm": np.zeros((1, 99)), "map.of_a_later_version": np.ones(3)}
    assert restore_state(estimator, of_other_version, 0.0) == ""
    assert estimator.state["soc"][0] == saved.state["soc"][0]
    assert (estimator.record["map"]["weight"] == saved.record["map"]["weight"]).all()
    assert estimator.record["checks"]["good_soc"] == fresh.record["checks"]["good_soc"]
    assert not estimator.record["map"]["dwell_s"].any()
    assert estimator.record["filter"]["ohm"].shape == fresh.record["filter"]["ohm"].shape


def test_a_checkpoint_without_anchors_is_restored_and_one_with_anchors_keeps_the_last_anchor() -> None:
    """A restart counts anchors from zero, and trickle charging after it causes no second anchor."""
    saved = learned_estimator()
    a = saved.record[0]["anchors"]
    a["last"], a["full_anchors"], a["full_wait_soc"], a["soc_before"] = FULL, 3, 0.02, 0.9
    by_name = dict(fields(saved.record))
    without_anchors = {name: v for name, v in by_name.items() if not name.startswith("anchors.")}
    for state, expected in ((without_anchors, (0, 0, 0.0, 0.0)), (by_name, (FULL, 0, 0.02, 0.9))):
        estimator = compiled_estimator(SETTINGS, CELL)
        assert restore_state(estimator, state, 1.0) == ""
        assert estimator.state["soc"][0] == saved.state["soc"][0]
        restored = estimator.record[0]["anchors"]
        names = "last", "full_anchors", "full_wait_soc", "soc_before"
        assert tuple(restored[name] for name in names) == expected


def save_as(version: int, file: CheckpointFile, estimator: Estimator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Save a checkpoint with the number ``version`` of its format."""
    with monkeypatch.context() as patch:
        patch.setattr("bms_estimator.checkpoint.state_files.FORMAT", version)
        file.save(estimator.record, whole=True)


@pytest.mark.parametrize("damage", ["other cell", "nan", "range", "truncated", "garbage", "earlier", "pipe"])
async def test_an_invalid_checkpoint_is_set_aside_with_the_reason(
    tmp_path: Path, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = CheckpointFile(tmp_path, SETTINGS, CELL)
    (tmp_path / "pack.refused.npz").write_bytes(b"an older one")
    estimator = compiled_estimator(SETTINGS, CELL)
    estimator.step(0.0, 0.1, 3.8)
    reason = "refused: damaged, perhaps by a power cut"
    if damage == "nan":
        estimator.state["a"][0][3], reason = np.nan, "refused: a of the observer is not finite"
    if damage == "range":
        estimator.state["soc"], reason = 1.7, r"refused: soc = 1.7 is outside 0.0..1.0"
    file.save(estimator.record)
    if damage == "other cell":
        other = CheckpointFile(tmp_path, SETTINGS, CELL.pack(2, 1))
        other.save(estimator.record)
        other.path.replace(file.path)
        reason = "refused: it belongs to another pack or cell"
    if damage in ("truncated", "garbage"):
        file.path.write_bytes(file.path.read_bytes()[:500] if damage == "truncated" else bytes(range(256)) * 8)
    if damage == "earlier":
        save_as(FORMAT - 2, file, estimator, monkeypatch)
        reason = f"refused: format {FORMAT - 2}, this version reads {FORMAT}"
    if damage == "pipe":  # opening it for reading would block until a writer comes
        file.path.unlink()
        os.mkfifo(file.path)
        reason = "refused: not a regular file"
    inode = file.path.stat().st_ino
    run = await run_samples(tmp_path, current_a=0.0, samples=1)
    assert run.health.checkpoint.startswith(reason)
    assert run.health.checkpoint.endswith("; set aside as pack.refused.npz")
    assert (tmp_path / "pack.refused.npz").stat().st_ino == inode
    assert run.estimator.state["soc_coulomb"][0] == 0.5


async def test_each_cell_has_its_own_checkpoint(tmp_path: Path) -> None:
    cells = [CELL, CELL.pack(2, 1), CELL.pack(3, 1), CELL]
    runs = [await run_samples(tmp_path, cell=cell) for cell in cells]
    assert [run.health.restarts for run in runs] == [0, 1, 2, 3]
    last = runs[-1].estimator
    assert last.state["soc_coulomb"][0] == pytest.approx(0.3 - last.record["unseen_s"][0] / 3600.0, abs=1e-6)


def test_the_oldest_checkpoints_of_a_pack_name_are_removed_above_the_maximum_number(tmp_path: Path) -> None:
    """A pack has one checkpoint for each cell model. Checkpoints of another pack are not removed."""
    estimator = compiled_estimator(SETTINGS, CELL)
    (tmp_path / "pack-2-0123abcd.npz").write_bytes(b"of another pack")
    for series in range(1, MAX_FILES + 4):
        file = CheckpointFile(tmp_path, SETTINGS, CELL.pack(series, 1))
        file.save(estimator.record)
        os.utime(file.path, (series, series))
    names = {path.name for path in tmp_path.iterdir()}
    assert len(names) == MAX_FILES + 1
    assert {file.path.name, "pack-2-0123abcd.npz"} <= names
    assert CheckpointFile(tmp_path, SETTINGS, CELL).path.name not in names


def test_a_checkpoint_is_private_and_a_symlink_at_its_temporary_name_is_not_followed(tmp_path: Path) -> None:
    file, victim = CheckpointFile(tmp_path, SETTINGS, CELL), tmp_path / "victim"
    victim.write_text("precious")
    file.path.with_suffix(".new").symlink_to(victim)
    file.save(compiled_estimator(SETTINGS, CELL).record)
    assert victim.read_text() == "precious"
    assert stat.S_IMODE(file.path.lstat().st_mode) == 0o600


def offset_covariance(estimator: Estimator) -> np.ndarray:
    """Return the covariance of the current sensor's offset with each state."""
    f = estimator.record[0]["filter"]
    return np.asarray(f["covariance"][f["best"], OFFSET])


def test_an_offset_that_was_disabled_starts_with_the_configured_std_and_vice_versa() -> None:
    before = compiled_estimator(edit_settings("identifier", current_offset_std_a=0.0), CELL)
    before.step(0.0, 0.1, 3.8)
    after = compiled_estimator(edit_settings("identifier", current_offset_std_a=0.1), CELL)
    assert restore_state(after, dict(fields(before.record)), 1.0) == ""
    assert offset_covariance(after)[OFFSET] == pytest.approx(0.01)
    after.step(0.0, 0.1, 3.8)
    assert restore_state(before, dict(fields(after.record)), 1.0) == ""
    assert not offset_covariance(before).any()


def test_an_identifier_that_was_disabled_starts_at_the_counted_soc() -> None:
    counted = compiled_estimator(edit_settings("identifier", enabled=False), CELL)
    counted.step(0.0, 0.1, 3.8)
    identifying = compiled_estimator(SETTINGS, CELL)
    assert restore_state(identifying, dict(fields(counted.record)), 1.0) == ""
    for i in range(3):
        identifying.step(float(i), 0.0, 3.8)
    assert identifying.state["soc"][0] == pytest.approx(0.5, abs=0.15)
    assert 0.01 < identifying.record["filter"]["soc_std"][0] < 0.35


def with_checkpoint(file: CheckpointFile) -> StateFiles:
    """Return the files of the state beside a checkpoint file."""
    files = StateFiles(file.path.parent, SETTINGS, CELL)
    files.checkpoint = file
    return files


@asynccontextmanager
async def run_with_frequent_saves(files: StateFiles) -> AsyncIterator[tuple[ScriptedSource, Collector, Any]]:
    """Run the service with a save every 20 ms; yield its source, its sink and its task."""
    settings = SETTINGS.model_copy(update={"state": SETTINGS.state.model_copy(update={"checkpoint_s": 0.02})})
    source, sink = ScriptedSource(), Collector()
    task = asyncio.create_task(
        run_estimation_loop(settings, CELL, source=source, sinks=[sink], stop=asyncio.Event(), files=files)
    )
    yield source, sink, task
    source.finish()
    await asyncio.wait_for(task, LONG_S)


async def test_the_final_save_waits_for_a_running_save(tmp_path: Path) -> None:
    saving, began, release, saved_samples = threading.Lock(), threading.Event(), threading.Event(), []

    class SlowDisk(CheckpointFile):
        def save(self, state: Any, curves: Any = None, cells: Any = None, *, whole: bool = False) -> None:
            assert saving.acquire(blocking=False), "two saves at once"
            began.set()
            assert release.wait(LONG_S)
            super().save(state, curves, cells, whole=whole)
            saved_samples.append(int(state["observer"]["samples"][0]))
            saving.release()

    file = SlowDisk(tmp_path, SETTINGS, CELL)
    async with run_with_frequent_saves(with_checkpoint(file)) as (source, sink, task):
        source.give((0.0, 0.1, 3.8))
        assert await asyncio.to_thread(began.wait, LONG_S)
        source.give((1.0, 0.1, 3.8))
        await sink.until(lambda s: s.health.samples["samples"] == 2)
        source.finish()
        await asyncio.sleep(0.1)
        assert not task.done()
        release.set()
        last = await asyncio.wait_for(task, LONG_S)
    assert saved_samples == [1, 2]
    state = file.load().record
    last.record["filter"][SCRATCH] = 0.0
    for name, field in fields(last.record):
        assert state[name].tobytes() == field.tobytes()


async def test_changes_of_the_soc_are_saved_before_a_long_checkpoint_interval_has_passed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first sample and each SOC change of 0.28 % cause a save. The checkpoint interval is 1e6 s."""
    monkeypatch.setattr(checkpoint_writer, "CHECK_INTERVAL_S", 0.01)
    saved: asyncio.Queue[float] = asyncio.Queue()
    loop = asyncio.get_running_loop()

    class ReportingFile(CheckpointFile):
        def save(self, state: Any, curves: Any = None, cells: Any = None, *, whole: bool = False) -> None:
            super().save(state, curves, cells, whole=whole)
            loop.call_soon_threadsafe(saved.put_nowait, float(state["observer"]["soc"][0]))

    class ReportingWriter(checkpoint_writer.CheckpointWriter):
        async def _save(self, *, whole: bool = False) -> bool:
            first_call.set()
            return await super()._save(whole=whole)

    first_call = asyncio.Event()
    monkeypatch.setattr(live_loop, "CheckpointWriter", ReportingWriter)
    tables = {"state": {"checkpoint_s": 1e6}, "identifier": {"enabled": False}}
    settings = Settings.model_validate(SETTINGS.model_dump(by_alias=True, exclude_none=True) | tables)
    source = ScriptedSource()
    task = asyncio.create_task(
        run_estimation_loop(
            settings,
            CELL,
            source=source,
            sinks=[Collector()],
            stop=asyncio.Event(),
            files=with_checkpoint(ReportingFile(tmp_path, settings, CELL)),
        )
    )
    # Otherwise, the first sample may arrive before the first call of _save.
    await asyncio.wait_for(first_call.wait(), LONG_S)
    for i in range(4):
        source.give((i * 10.0, 0.275, 3.8))  # 0.28 % of the capacity in 10 s
        soc = await asyncio.wait_for(saved.get(), LONG_S)
        assert soc == pytest.approx(0.5 - i * 10.0 / 3600.0)
    source.finish()
    await asyncio.wait_for(task, LONG_S)


async def test_a_failed_save_is_reported_and_does_not_end_the_loop(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file instead of the folder")
    file = StateFiles(tmp_path / "state", SETTINGS, CELL)
    async with run_with_frequent_saves(file) as (source, sink, _):
        source.give((0.0, 0.1, 3.8))
        await sink.until(lambda s: s.health.checkpoint.startswith("cannot be saved: "))
        source.give((1.0, 0.1, 3.8))
        await sink.until(lambda s: s.health.samples["samples"] == 2)


async def test_a_save_on_a_full_disk_is_not_retried_at_each_change_of_the_soc(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint_writer, "CHECK_INTERVAL_S", 0.01)
    attempts = []

    class FullDiskFile(CheckpointFile):
        def save(self, state: Any, *_: Any, **_whole: bool) -> None:
            attempts.append(state)
            raise OSError(errno.ENOSPC, "No space left on device")

    settings = Settings.model_validate(
        SETTINGS.model_dump(by_alias=True, exclude_none=True) | {"state": {"checkpoint_s": 1e6}}
    )
    source, sink = ScriptedSource(), Collector()
    files = with_checkpoint(FullDiskFile(tmp_path, settings, CELL))
    task = asyncio.create_task(
        run_estimation_loop(settings, CELL, source=source, sinks=[sink], stop=asyncio.Event(), files=files)
    )
    for second in range(5):
        source.give((30.0 * second, 0.275, 3.8))
        await sink.until(lambda s, n=second + 1: s.health.samples["samples"] == n)
    source.finish()
    await asyncio.wait_for(task, LONG_S)
    assert len(attempts) <= 2  # the first attempt, and one at shutdown


async def test_an_unchanged_state_is_not_saved_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # health is published often enough to show each save
    monkeypatch.setattr("bms_estimator.service.publisher.SLOW_INTERVAL_S", 0.05)
    saved_samples = []

    class CountingFile(CheckpointFile):
        def save(self, state: Any, curves: Any = None, cells: Any = None, *, whole: bool = False) -> None:
            super().save(state, curves, cells, whole=whole)
            saved_samples.append(state["observer"]["samples"][0])

    async with run_with_frequent_saves(with_checkpoint(CountingFile(tmp_path, SETTINGS, CELL))) as (source, sink, _):
        for second in range(2):
            source.give((float(second), 0.1, 3.8))
            source.give((float(second), 0.1, 9.9))  # dropped, because its voltage is implausible
            await sink.until(lambda s, n=second + 1: s.health.checkpoint == "saved" and n in saved_samples)
            saved_s = sink.snapshots[-1].health.uptime_s
            await sink.until(lambda s, saved_s=saved_s: s.health.uptime_s > saved_s + 0.2)  # ten intervals
    assert saved_samples == [1, 2]


async def test_the_state_is_saved_when_an_error_ends_the_loop(tmp_path: Path) -> None:
    class SensorError(Exception):
        pass

    class FailingSource(ScriptedSource):
        async def __aiter__(self) -> AsyncIterator[Any]:
            async for block in super().__aiter__():
                yield block
            raise SensorError

    source, files = FailingSource(), StateFiles(tmp_path, SETTINGS, CELL)
    source.give((0.0, 0.1, 3.8))
    source.finish()
    with pytest.raises(SensorError):
        await run_estimation_loop(SETTINGS, CELL, source=source, sinks=[], stop=asyncio.Event(), files=files)
    content = files.read()
    assert not content.reasons
    assert content.record["observer.samples"] == 1
    assert files.run_file.load().counters.total.crashes == 1


async def test_the_final_save_does_not_wait_for_a_slow_broker(tmp_path: Path) -> None:
    """The checkpoint exists when the sink is closed, which may take long."""
    is_saved_at_close = []

    class SlowBroker(Collector):
        async def __aexit__(self, *_: object) -> None:
            is_saved_at_close.append(files.checkpoint.path.exists())

    source, sink = ScriptedSource(), SlowBroker()
    source.give((0.0, 0.1, 3.8))
    source.finish()
    files = StateFiles(tmp_path, SETTINGS, CELL)
    running = run_estimation_loop(SETTINGS, CELL, source=source, sinks=[sink], stop=asyncio.Event(), files=files)
    await asyncio.wait_for(running, LONG_S)
    assert is_saved_at_close == [True]
    assert sink.snapshots[-1].health.checkpoint == "saved"
