"""Checkpoints: restored for the same pack, after any change of settings or version."""

import asyncio
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

from bms_estimator.checkpoint.checkpoint_file import FORMAT, KEPT, CheckpointFile, RunCounters
from bms_estimator.checkpoint.identity import fields, pack_identity
from bms_estimator.checkpoint.restore import restore_state
from bms_estimator.estimator import Estimator
from bms_estimator.kernels.kalman_filter.records import NODE, OFFSET
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.payloads import Health
from bms_estimator.service import checkpoint_writer, live_loop
from bms_estimator.service.live_loop import new_estimator, run_estimation_loop
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.lifetime_totals import new_totals
from tests.collector import Collector
from tests.patience import LONG_S
from tests.scripted_source import ScriptedSource

CELL = load_cell("chen_mora")
SETTINGS = Settings.model_validate({"pack": {"initial_soc": 0.5}, "publish": {"rate_hz": 10.0}})
NEW = RunCounters(0, new_totals(0.0))


def edited(section: str, **values: Any) -> Settings:
    tables = SETTINGS.model_dump(by_alias=True, exclude_none=True)
    return Settings.model_validate(tables | {section: tables[section] | values})


def a_used_pack() -> Estimator:
    """An estimator that has learned."""
    estimator = new_estimator(SETTINGS, CELL)
    for i in range(600):
        estimator.step(float(i), 0.3 * (i // 60 % 2), 3.8)
    estimator.record["map"]["weight"] = estimator.record["map"]["moment"] = 1.0
    return estimator


@dataclass
class Ended:
    """Result of a run."""

    estimator: Estimator
    health: Health
    """The first publication, with the result of reading the checkpoint."""


async def ran(
    folder: Path, settings: Settings = SETTINGS, cell: CellModel = CELL, current_a: float = 0.275, samples: int = 361
) -> Ended:
    """A run of one sample a second at ``current_a``: by default a tenth of the capacity."""
    source, sink = ScriptedSource(), Collector()
    source.give(*((float(i), current_a, 3.8 * cell.cell.series_count) for i in range(samples)))
    source.finish()
    checkpoint = CheckpointFile(folder, settings, cell)
    running = run_estimation_loop(
        settings, cell, source=source, sinks=[sink], stop=asyncio.Event(), checkpoint=checkpoint
    )
    estimator = await asyncio.wait_for(running, LONG_S)
    return Ended(estimator, sink.snapshots[0].health)


async def test_a_restart_goes_on_from_the_checkpoint(tmp_path: Path) -> None:
    first = await ran(tmp_path)
    assert first.estimator.state["soc_coulomb"][0] == pytest.approx(0.4)
    second = await ran(tmp_path, samples=2)  # the board's clock has started anew
    unseen_s = second.estimator.record["unseen_s"][0]  # the load went on meanwhile
    assert 0.0 < unseen_s < LONG_S
    assert second.estimator.state["soc_coulomb"][0] == pytest.approx(0.4 - (unseen_s + 1.0) / 3600.0, abs=1e-9)
    assert second.estimator.state["samples"][0] == 2
    assert second.health.restarts == 1
    assert second.health.checkpoint == f"restored: SOC {first.estimator.state['soc'][0]:.4f}"


async def test_without_the_identifier_a_restart_goes_on_too(tmp_path: Path) -> None:
    counting = edited("identifier", enabled=False)
    await ran(tmp_path, counting)
    second = await ran(tmp_path, counting, samples=2)
    assert second.health.restarts == 1
    unseen_s = second.estimator.record["unseen_s"][0]
    assert second.estimator.state["soc"][0] == pytest.approx(0.4 - (unseen_s + 1.0) / 3600.0, abs=1e-9)


async def test_samples_that_cannot_be_used_do_not_prolong_what_nobody_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    await ran(tmp_path)
    monkeypatch.setattr(live_loop, "since_boot", itertools.count().__next__)  # a second passes with each look
    source = ScriptedSource()
    for i in range(40):
        source.give((0.1 * i, 0.0, 9.9))
    source.give((5.0, 0.275, 3.8))
    source.finish()
    checkpoint = CheckpointFile(tmp_path, SETTINGS, CELL)
    running = run_estimation_loop(
        SETTINGS, CELL, source=source, sinks=[Collector()], stop=asyncio.Event(), checkpoint=checkpoint
    )
    estimator = await asyncio.wait_for(running, LONG_S)
    assert 41.0 < estimator.record["unseen_s"][0] < 41.0 + LONG_S


@pytest.mark.parametrize(
    "settings",
    [
        edited("observer", lock_time_s=20.0),
        edited("observer", law="scheme-1"),
        edited("observer", law="learning"),
        edited("identifier", map_memory_h=100.0),
        edited("identifier", current_offset_std_a=0.1),
        edited("sensor", voltage_noise_v=0.01),
        edited("sensor", port="/dev/ttyUSB7"),
        edited("pack", initial_soc=0.9),
    ],
    ids=lambda settings: str(settings.model_dump(exclude_defaults=True)),
)
async def test_an_edited_setting_costs_nothing_that_was_learned(tmp_path: Path, settings: Settings) -> None:
    learned = a_used_pack()
    CheckpointFile(tmp_path, SETTINGS, CELL).save(learned.record, NEW)
    run = await ran(tmp_path, settings, samples=1)
    assert run.health.checkpoint == f"restored: SOC {learned.state['soc'][0]:.4f}"
    assert run.estimator.record["map"].tobytes() == learned.record["map"].tobytes()


async def test_what_the_learning_law_has_learned_outlives_a_restart_and_not_another_law(tmp_path: Path) -> None:
    settings = edited("observer", law="learning")
    learned = new_estimator(settings, CELL)
    for i in range(3600):
        learned.step(float(i), 0.3 * (i // 60 % 2), 3.8 - 0.03 * (i // 60 % 2))
    theta = learned.record[0]["learning"]["theta"].copy()
    assert theta.any()
    CheckpointFile(tmp_path, settings, CELL).save(learned.record, NEW)
    again = await ran(tmp_path, settings, samples=1)
    assert (again.estimator.record[0]["learning"]["theta"] == theta).all()
    assert again.health.checkpoint == f"restored: SOC {learned.state['soc'][0]:.4f}"
    other = await ran(tmp_path, edited("observer", law="learning", lock_time_s=20.0), samples=1)
    assert not other.estimator.record[0]["learning"]["theta"].any()


async def test_a_checkpoint_of_the_version_before_the_learning_law_is_taken_up(tmp_path: Path) -> None:
    learned = a_used_pack()
    file = CheckpointFile(tmp_path, SETTINGS, CELL)
    file.save(learned.record, NEW)
    with np.load(file.path) as saved:
        state = saved["state"]
        before = dict(saved) | {"state": repack_fields(state[[n for n in state.dtype.names if n != "learning"]])}
    np.savez(file.path, **before)
    run = await ran(tmp_path, edited("observer", law="learning"), samples=1)
    assert run.health.checkpoint == f"restored: SOC {learned.state['soc'][0]:.4f}"


async def test_an_edited_description_costs_nothing_that_was_learned(tmp_path: Path) -> None:
    learned = a_used_pack()
    CheckpointFile(tmp_path, SETTINGS, CELL).save(learned.record, NEW)
    described = CELL.model_copy(update={"cell": CELL.cell.model_copy(update={"name": "mine", "description": "new"})})
    run = await ran(tmp_path, cell=described, samples=2)
    assert run.health.checkpoint == f"restored: SOC {learned.state['soc'][0]:.4f}"


def test_only_what_gives_the_state_its_meaning_is_the_identity() -> None:
    known = pack_identity(SETTINGS, CELL)
    larger = CELL.model_copy(update={"cell": CELL.cell.model_copy(update={"capacity_ah": 3.0})})
    curve = CELL.model_copy(update={"ocv": CELL.ocv.model_copy(update={"constant_v": 3.7})})
    turned = edited("sensor", current_sign="charge_positive")
    others = [pack_identity(SETTINGS, cell) for cell in (larger, curve, CELL.pack(2, 1), CELL.pack(1, 2))]
    assert len({known, *others, pack_identity(turned, CELL)}) == 6


def test_a_version_with_other_fields_reads_what_it_knows() -> None:
    saved, fresh, estimator = a_used_pack(), new_estimator(SETTINGS, CELL), new_estimator(SETTINGS, CELL)
    fresh.step(0.0, 0.0, CELL.cell.nominal_voltage_v)
    later = {name: field for name, field in fields(saved.record) if name not in ("checks.good_soc", "map.dwell_s")}
    later |= {"filter.ohm": np.zeros((1, 99)), "map.of_a_later_version": np.ones(3)}
    assert restore_state(estimator, later, 0.0) == ""
    assert estimator.state["soc"][0] == saved.state["soc"][0]
    assert (estimator.record["map"]["weight"] == saved.record["map"]["weight"]).all()
    assert estimator.record["checks"]["good_soc"] == fresh.record["checks"]["good_soc"]
    assert not estimator.record["map"]["dwell_s"].any()
    assert estimator.record["filter"]["ohm"].shape == fresh.record["filter"]["ohm"].shape


def test_a_version_whose_filter_has_more_states_keeps_those_it_knows() -> None:
    """The curve states were added last: capacity and offset are as certain as before, the curve is unknown."""
    learned = a_used_pack()
    cut = {"filter.mean": 1, "filter.covariance": 2, "checks.good_mean": 1, "checks.good_covariance": 2}
    saved = dict(fields(learned.record.copy()))
    for name, axes in cut.items():
        saved[name] = saved[name][(..., *axes * (slice(NODE),))]
    estimator = new_estimator(SETTINGS, CELL)
    assert restore_state(estimator, saved, 1.0) == ""
    learned.resume(1.0)
    now, before = (one.record[0]["filter"] for one in (estimator, learned))
    assert np.array_equal(now["covariance"][:, :NODE, :NODE], before["covariance"][:, :NODE, :NODE])
    assert np.array_equal(now["mean"][:, :NODE], before["mean"][:, :NODE])
    for q in range(now["count"]):
        assert (now["mean"][q, NODE:] == 0.0).all()
        assert (np.diag(now["covariance"][q])[NODE:] == 1.0).all()
    assert np.linalg.eigvalsh(now["covariance"][0]).min() > -1e-12
    good = estimator.record[0]["checks"]["good_mean"]
    assert np.array_equal(good[:NODE], saved["filter.mean"][0, now["best"]])
    assert (good[NODE:] == 0.0).all()


def saved_as(
    version: int, file: CheckpointFile, estimator: Estimator, monkeypatch: pytest.MonkeyPatch, ledger: RunCounters = NEW
) -> None:
    """A checkpoint of another format."""
    with monkeypatch.context() as patch:
        patch.setattr("bms_estimator.checkpoint.checkpoint_file.FORMAT", version)
        file.save(estimator.record, ledger)


@pytest.mark.parametrize("damage", ["other cell", "nan", "range", "truncated", "garbage", "earlier", "pipe"])
async def test_a_checkpoint_that_is_foreign_or_insane_is_refused_with_the_reason(
    tmp_path: Path, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = CheckpointFile(tmp_path, SETTINGS, CELL)
    (tmp_path / "pack.refused.npz").write_bytes(b"an older one")
    estimator = new_estimator(SETTINGS, CELL)
    estimator.step(0.0, 0.1, 3.8)
    reason = "refused: damaged, perhaps by a power cut"
    if damage == "nan":
        estimator.state["a"][0][3], reason = np.nan, "refused: a of the observer is not finite"
    if damage == "range":
        estimator.state["soc"], reason = 1.7, r"refused: soc = 1.7 is outside 0.0..1.0"
    file.save(estimator.record, NEW)
    if damage == "other cell":
        other = CheckpointFile(tmp_path, SETTINGS, CELL.pack(2, 1))
        other.save(estimator.record, NEW)
        other.path.replace(file.path)
        reason = "refused: it belongs to another pack or cell"
    if damage in ("truncated", "garbage"):
        file.path.write_bytes(file.path.read_bytes()[:500] if damage == "truncated" else bytes(range(256)) * 8)
    if damage == "earlier":
        saved_as(FORMAT - 1, file, estimator, monkeypatch)
        reason = f"refused: format {FORMAT - 1}, this version reads {FORMAT}"
    if damage == "pipe":  # whoever opens it for reading waits for a writer
        file.path.unlink()
        os.mkfifo(file.path)
        reason = "refused: no file"
    inode = file.path.stat().st_ino
    run = await ran(tmp_path, current_a=0.0, samples=1)
    assert run.health.checkpoint.startswith(reason)
    assert run.health.checkpoint.endswith("; set aside as pack.refused.npz")
    assert (tmp_path / "pack.refused.npz").stat().st_ino == inode
    assert run.estimator.state["soc_coulomb"][0] == 0.5


async def test_each_of_several_cells_that_were_tried_finds_its_own_checkpoint(tmp_path: Path) -> None:
    tried = [CELL, CELL.pack(2, 1), CELL.pack(3, 1), CELL]
    runs = [await ran(tmp_path, cell=cell) for cell in tried]
    assert [run.health.restarts for run in runs] == [0, 0, 0, 1]
    last = runs[-1].estimator
    assert last.state["soc_coulomb"][0] == pytest.approx(0.3 - last.record["unseen_s"][0] / 3600.0, abs=1e-6)


def test_the_checkpoints_of_a_pack_are_bounded_in_number(tmp_path: Path) -> None:
    estimator = new_estimator(SETTINGS, CELL)
    (tmp_path / "pack-2-0123abcd.npz").write_bytes(b"of another pack")
    for series in range(1, KEPT + 4):
        file = CheckpointFile(tmp_path, SETTINGS, CELL.pack(series, 1))
        file.save(estimator.record, NEW)
        os.utime(file.path, (series, series))
    names = {path.name for path in tmp_path.iterdir()}
    assert len(names) == KEPT + 1
    assert {file.path.name, "pack-2-0123abcd.npz"} <= names
    assert CheckpointFile(tmp_path, SETTINGS, CELL).path.name not in names


def test_what_is_written_is_private_and_goes_through_no_planted_link(tmp_path: Path) -> None:
    file, victim = CheckpointFile(tmp_path, SETTINGS, CELL), tmp_path / "victim"
    victim.write_text("precious")
    file.path.with_suffix(".new").symlink_to(victim)
    file.save(new_estimator(SETTINGS, CELL).record, NEW)
    assert victim.read_text() == "precious"
    assert stat.S_IMODE(file.path.lstat().st_mode) == 0o600


def offset_covariance(estimator: Estimator) -> np.ndarray:
    f = estimator.record[0]["filter"]
    return np.asarray(f["covariance"][f["best"], OFFSET])


def test_an_offset_that_may_be_learned_from_now_on_begins_as_configured() -> None:
    before = new_estimator(edited("identifier", current_offset_std_a=0.0), CELL)
    before.step(0.0, 0.1, 3.8)
    after = new_estimator(edited("identifier", current_offset_std_a=0.1), CELL)
    assert restore_state(after, dict(fields(before.record)), 1.0) == ""
    assert offset_covariance(after)[OFFSET] == pytest.approx(0.01)
    after.step(0.0, 0.1, 3.8)
    assert restore_state(before, dict(fields(after.record)), 1.0) == ""
    assert not offset_covariance(before).any()


def test_an_identifier_that_is_switched_on_begins_at_the_soc_that_was_counted() -> None:
    counted = new_estimator(edited("identifier", enabled=False), CELL)
    counted.step(0.0, 0.1, 3.8)
    identifying = new_estimator(SETTINGS, CELL)
    assert restore_state(identifying, dict(fields(counted.record)), 1.0) == ""
    for i in range(3):
        identifying.step(float(i), 0.0, 3.8)
    assert identifying.state["soc"][0] == pytest.approx(0.5, abs=0.15)
    assert 0.01 < identifying.record["filter"]["soc_std"][0] < 0.35


@asynccontextmanager
async def often(checkpoint: CheckpointFile) -> AsyncIterator[tuple[ScriptedSource, Collector, Any]]:
    """A run that saves every 20 ms."""
    settings = SETTINGS.model_copy(update={"state": SETTINGS.state.model_copy(update={"checkpoint_s": 0.02})})
    source, sink = ScriptedSource(), Collector()
    task = asyncio.create_task(
        run_estimation_loop(settings, CELL, source=source, sinks=[sink], stop=asyncio.Event(), checkpoint=checkpoint)
    )
    yield source, sink, task
    source.finish()
    await asyncio.wait_for(task, LONG_S)


async def test_the_last_save_waits_for_the_one_that_the_end_has_interrupted(tmp_path: Path) -> None:
    slow, began, release, saves = threading.Lock(), threading.Event(), threading.Event(), []

    class SlowDisk(CheckpointFile):
        def save(self, state: Any, ledger: RunCounters) -> None:
            assert slow.acquire(blocking=False), "two saves at once"
            began.set()
            assert release.wait(LONG_S)
            super().save(state, ledger)
            saves.append(int(state["observer"]["samples"][0]))
            slow.release()

    file = SlowDisk(tmp_path, SETTINGS, CELL)
    async with often(file) as (source, sink, task):
        source.give((0.0, 0.1, 3.8))
        assert await asyncio.to_thread(began.wait, LONG_S)
        source.give((1.0, 0.1, 3.8))
        await sink.until(lambda s: s.health.samples["samples"] == 2)
        source.finish()
        await asyncio.sleep(0.1)
        assert not task.done()
        release.set()
        last = await asyncio.wait_for(task, LONG_S)
    assert saves == [1, 2]
    state = file.load().state
    for name, field in fields(last.record):
        assert state[name].tobytes() == field.tobytes()


async def test_a_kill_costs_little_however_seldom_is_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first sample is saved, and the state after this change of the SOC."""
    monkeypatch.setattr(checkpoint_writer, "CHECK_S", 0.01)
    saved: asyncio.Queue[float] = asyncio.Queue()
    loop = asyncio.get_running_loop()

    class Noting(CheckpointFile):
        def save(self, state: Any, ledger: RunCounters) -> None:
            super().save(state, ledger)
            loop.call_soon_threadsafe(saved.put_nowait, float(state["observer"]["soc"][0]))

    class Looking(checkpoint_writer.CheckpointWriter):
        async def _save(self, *, clean: bool = False) -> bool:
            looked.set()
            return await super()._save(clean=clean)

    looked = asyncio.Event()
    monkeypatch.setattr(live_loop, "CheckpointWriter", Looking)
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
            checkpoint=Noting(tmp_path, settings, CELL),
        )
    )
    await asyncio.wait_for(
        looked.wait(), LONG_S
    )  # else the first sample may be there when it is looked for the first time
    for i in range(4):
        source.give((i * 10.0, 0.275, 3.8))  # 0.28 % of the capacity in 10 s
        soc = await asyncio.wait_for(saved.get(), LONG_S)
        assert soc == pytest.approx(0.5 - i * 10.0 / 3600.0)
    source.finish()
    await asyncio.wait_for(task, LONG_S)


async def test_a_checkpoint_that_cannot_be_written_is_reported_and_the_loop_goes_on(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("no folder")
    file = CheckpointFile(tmp_path / "state", SETTINGS, CELL)
    async with often(file) as (source, sink, _):
        source.give((0.0, 0.1, 3.8))
        await sink.until(lambda s: s.health.checkpoint.startswith("cannot be saved: "))
        source.give((1.0, 0.1, 3.8))
        await sink.until(lambda s: s.health.samples["samples"] == 2)


async def test_a_disk_that_is_full_is_not_tried_again_and_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint_writer, "CHECK_S", 0.01)
    attempts = []

    class Full(CheckpointFile):
        def save(self, state: Any, ledger: RunCounters) -> None:
            attempts.append((state, ledger))
            raise OSError(28, "No space left on device")

    settings = Settings.model_validate(
        SETTINGS.model_dump(by_alias=True, exclude_none=True) | {"state": {"checkpoint_s": 1e6}}
    )
    source, sink = ScriptedSource(), Collector()
    checkpoint = Full(tmp_path, settings, CELL)
    task = asyncio.create_task(
        run_estimation_loop(settings, CELL, source=source, sinks=[sink], stop=asyncio.Event(), checkpoint=checkpoint)
    )
    for second in range(5):
        source.give((30.0 * second, 0.275, 3.8))
        await sink.until(lambda s, n=second + 1: s.health.samples["samples"] == n)
    source.finish()
    await asyncio.wait_for(task, LONG_S)
    assert len(attempts) <= 2  # once, and at the end


async def test_a_checkpoint_is_of_the_last_sample_and_not_of_a_later_time_without_any(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bms_estimator.service.publisher.SLOW_S", 0.05)
    states = []

    class Counting(CheckpointFile):
        def save(self, state: Any, ledger: RunCounters) -> None:
            super().save(state, ledger)
            states.append(state["observer"]["samples"][0])

    async with often(Counting(tmp_path, SETTINGS, CELL)) as (source, sink, _):
        for second in range(2):
            source.give((float(second), 0.1, 3.8))
            source.give((float(second), 0.1, 9.9))  # dropped: nothing is learned from it
            await sink.until(lambda s, n=second + 1: s.health.checkpoint == "saved" and n in states)
            at_s = sink.snapshots[-1].health.uptime_s
            await sink.until(lambda s, at_s=at_s: s.health.uptime_s > at_s + 0.2)
    assert states == [1, 2]


async def test_what_was_learned_is_saved_when_a_fault_ends_the_loop(tmp_path: Path) -> None:
    class Broken(ScriptedSource):
        async def __aiter__(self) -> AsyncIterator[Any]:
            async for block in super().__aiter__():
                yield block
            raise ZeroDivisionError

    source, file = Broken(), CheckpointFile(tmp_path, SETTINGS, CELL)
    source.give((0.0, 0.1, 3.8))
    source.finish()
    with pytest.raises(ZeroDivisionError):
        await run_estimation_loop(SETTINGS, CELL, source=source, sinks=[], stop=asyncio.Event(), checkpoint=file)
    found = file.load()
    assert found.state["observer.samples"] == 1
    assert found.ledger.total.crashes == 1


async def test_the_last_checkpoint_does_not_wait_for_a_broker_that_parts_slowly(tmp_path: Path) -> None:
    saved = []

    class SlowBroker(Collector):
        async def __aexit__(self, *_: object) -> None:
            saved.append(file.path.exists())

    source, sink = ScriptedSource(), SlowBroker()
    source.give((0.0, 0.1, 3.8))
    source.finish()
    file = CheckpointFile(tmp_path, SETTINGS, CELL)
    running = run_estimation_loop(SETTINGS, CELL, source=source, sinks=[sink], stop=asyncio.Event(), checkpoint=file)
    await asyncio.wait_for(running, LONG_S)
    assert saved == [True]
    assert sink.snapshots[-1].health.checkpoint == "saved"
