"""Successive runs of a pack: counters, crashes, gaps, checkpoints of all formats, and the SOC after a long gap."""

import asyncio
import dataclasses
import shutil
import subprocess
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from structlog.testing import capture_logs

from bms_estimator.checkpoint.run_file import RunCounters, RunFile
from bms_estimator.checkpoint.state_files import FORMAT, MAX_LATER_FILES, CheckpointFile, StateFiles
from bms_estimator.estimator.estimator import compiled_estimator
from bms_estimator.model.payloads.health import Totals
from bms_estimator.process.boot_timestamp import BootTimestamp
from bms_estimator.service import checkpoint_writer
from bms_estimator.service.live_loop import run_estimation_loop
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.publish_window import ChargeEnergy, gap_lengths
from tests.checkpoint.test_checkpoint import (
    CELL,
    SETTINGS,
    edit_settings,
    learned_estimator,
    run_samples,
    run_with_frequent_saves,
    save_as,
    with_checkpoint,
)
from tests.patience import LONG_S
from tests.scripted_source import Collector, ScriptedSource

pytestmark = pytest.mark.usefixtures("few_draws")


def clock_at(hours: float) -> BootTimestamp:
    """Return the clocks of one boot of the machine at a time [h]. At 0 h it is 2023-11-14T22:13:20Z."""
    return BootTimestamp(1.7e9 + 3600.0 * hours, synchronised=True, boot_s=5000.0 + 3600.0 * hours, boot="one")


async def run_at(hours: float, folder: Path, *rows: tuple[float, float, float], settings: Settings = SETTINGS) -> Any:
    """Run a service that starts at a time [h] and gets samples of time [s], current [A] and voltage [V].

    Return its estimator and its last snapshot.
    """
    source, sink = ScriptedSource(), Collector()
    source.give(*rows)
    source.finish()
    files = StateFiles(folder, settings, CELL, lambda: clock_at(hours))
    running = run_estimation_loop(settings, CELL, source=source, sinks=[sink], stop=asyncio.Event(), files=files)
    return await asyncio.wait_for(running, LONG_S), sink.snapshots[-1]


async def test_total_counters_and_gaps_add_up_the_values_of_all_runs(tmp_path: Path) -> None:
    # one sample is out of the voltage range, and a minute is without samples
    await run_at(0.0, tmp_path, (0.0, 0.1, 3.8), (1.0, 0.1, 3.8), (1.5, 0.1, 9.9), (61.0, 0.1, 3.8), (62.0, 0.1, 3.8))
    _, last = await run_at(1.0, tmp_path, (7.0, 0.1, 3.8), (8.0, 0.1, 3.8))
    health = last.health
    assert health.samples["samples"] == 2
    assert health.samples["dropped_range"] == 0
    assert health.total.samples["samples"] == 6
    assert health.total.samples["dropped_range"] == 1
    assert health.total.samples["gaps"] == 1
    assert health.total.since.startswith("2023-11-14T22:13:20")
    assert health.unseen_s == pytest.approx(3600.0, abs=LONG_S)
    assert health.total.unseen_s == pytest.approx(health.unseen_s + 60.0)
    assert (health.restarts, health.total.crashes) == (1, 0)


async def test_charge_and_energy_survive_restarts(tmp_path: Path) -> None:
    hour = [(float(s), 2.0, 3.8) for s in range(3601)]  # 2 Ah and 7.6 Wh
    _, discharged = await run_at(0.0, tmp_path, *hour)
    _, charged = await run_at(2.0, tmp_path, *((s, -1.0, v) for s, _, v in hour))
    async with run_with_frequent_saves(StateFiles(tmp_path, SETTINGS, CELL, lambda: clock_at(4.0))) as (
        source,
        sink,
        _,
    ):
        source.give(hour[0])
        estimate = (await sink.until(lambda s: s.estimate is not None)).estimate
    assert ChargeEnergy.from_totals(discharged.health.total) == pytest.approx((2.0, 0.0, 7.6e-3, 0.0))
    assert ChargeEnergy.from_totals(charged.health.total) == pytest.approx((2.0, 1.0, 7.6e-3, 3.8e-3))
    assert estimate
    assert ChargeEnergy(*(getattr(estimate, name) for name in ChargeEnergy._fields)) == ChargeEnergy.from_totals(
        charged.health.total
    )
    assert estimate.equivalent_cycles == pytest.approx(2.0 / CELL.cell.capacity_ah)


async def test_charge_and_energy_are_published_only_once_saved_so_that_a_kill_does_not_decrease_them(
    tmp_path: Path,
) -> None:
    release = threading.Event()

    class SlowDisk(RunFile):
        def save(self, counters: RunCounters) -> None:
            assert not counters.total.samples or release.wait(LONG_S)
            super().save(counters)

    file = StateFiles(tmp_path, SETTINGS, CELL)
    file.run_file = SlowDisk(tmp_path, "pack", lambda: clock_at(0.0).wall_s)
    async with run_with_frequent_saves(file) as (source, sink, _):
        source.give(*((float(s), 2.0, 3.8) for s in range(1801)))
        last = await sink.until(lambda s: s.health.total.charge_out_ah > 0.9)
        published = [s.estimate.charge_out_ah for s in sink.snapshots if s.estimate]
        saved = file.run_file.load().counters.total.charge_out_ah
        release.set()
    assert last.health.samples["samples"] == 1801
    assert set(published) == {saved} == {0.0}
    assert file.run_file.load().counters.total.charge_out_ah == pytest.approx(1.0)


async def test_a_run_without_usable_samples_does_not_change_the_age_of_the_saved_state(tmp_path: Path) -> None:
    await run_at(0.0, tmp_path, (0.0, 0.1, 3.8))
    await run_at(1.0, tmp_path, (0.0, 0.1, 9.9))  # out of range
    file = StateFiles(tmp_path, SETTINGS, CELL, lambda: clock_at(2.0))
    counters = file.run_file.load().counters
    assert file.checkpoint.load().gap_s == pytest.approx(7200.0)
    assert counters.restarts == 2
    assert counters.total.samples["dropped_range"] == 1


async def run_and_kill(folder: Path, *, with_a_sample: bool) -> None:
    """Run a service that ends without its final save, as after a kill."""

    class Killed(RunFile):
        def save(self, counters: RunCounters) -> None:
            if not counters.clean:
                super().save(counters)
                written.set()

    written = threading.Event()
    file = StateFiles(folder, SETTINGS, CELL)
    file.run_file = Killed(folder, "pack", lambda: clock_at(0.0).wall_s)
    async with run_with_frequent_saves(file) as (source, _, _):
        if with_a_sample:
            source.give((0.0, 0.1, 3.8))
        assert await asyncio.to_thread(written.wait, LONG_S)


async def test_a_start_after_an_unclean_end_counts_as_a_crash(tmp_path: Path) -> None:
    crashes = []
    await run_samples(tmp_path, samples=1)
    for with_a_sample in (True, False):
        crashes.append((await run_samples(tmp_path, samples=1)).health.total.crashes)
        await run_and_kill(tmp_path, with_a_sample=with_a_sample)
    crashes.append((await run_samples(tmp_path, samples=1)).health.total.crashes)
    crashes.append((await run_samples(tmp_path, samples=1)).health.total.crashes)
    assert crashes == [0, 1, 2, 2]


async def test_a_checkpoint_older_than_the_configured_age_is_rejected(tmp_path: Path) -> None:
    CheckpointFile(tmp_path, SETTINGS, CELL, lambda: clock_at(0.0)).save(learned_estimator().record)
    for hours, settings, reason in (
        (24 * 400.0, SETTINGS, ""),  # without a limit
        (47.0, edit_settings("state", longest_days=2.0), ""),
        (49.0, edit_settings("state", longest_days=2.0), "refused: it is 2.0 days old, state.longest_days is 2"),
    ):
        assert (
            CheckpointFile(tmp_path, settings, CELL, lambda hours=hours: clock_at(hours))
            .load()
            .reasons.get("checkpoint", "")
            == reason
        )


COUNTERS = RunCounters(
    restarts=6,
    total=Totals(since="2023-11-14T22:13:20Z", crashes=2, samples={"samples": 70}, unseen_s=30.0),
    clean=True,
)


async def test_counters_continue_from_a_checkpoint_that_is_too_old(tmp_path: Path) -> None:
    file = StateFiles(tmp_path, SETTINGS, CELL, lambda: clock_at(0.0))
    file.checkpoint.save(learned_estimator().record)
    file.run_file.save(COUNTERS)
    _, last = await run_at(72.0, tmp_path, (0.0, 0.1, 3.8), settings=edit_settings("state", longest_days=2.0))
    assert (last.health.restarts, last.health.total.crashes, last.health.total.samples["samples"]) == (7, 2, 71)


async def test_checkpoints_of_later_versions_are_preserved_and_their_counters_continue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The later version runs once more than files are preserved. The oldest files remain, and the last one is replaced."""
    file, inodes = StateFiles(tmp_path, SETTINGS, CELL), []
    (tmp_path / "pack.refused.npz").write_bytes(b"an older one")
    for attempt in range(MAX_LATER_FILES + 1):
        counters = dataclasses.replace(COUNTERS, restarts=6 + attempt)
        save_as(FORMAT + 1, file.checkpoint, learned_estimator(), monkeypatch)
        file.run_file.save(counters)
        inodes.append(file.checkpoint.path.stat().st_ino)
        health = (await run_samples(tmp_path, samples=1)).health
        files = min(attempt + 1, MAX_LATER_FILES)
        assert f"reads {FORMAT}; set aside as pack.later-{files}.npz; once the version" in health.checkpoint
        assert (health.restarts, health.total.crashes, health.total.unseen_s) == (7 + attempt, 2, 30.0)
    preserved_inodes = [(tmp_path / f"pack.later-{n}.npz").stat().st_ino for n in range(1, MAX_LATER_FILES + 1)]
    assert preserved_inodes == [*inodes[: MAX_LATER_FILES - 1], inodes[MAX_LATER_FILES]]
    assert (tmp_path / "pack.refused.npz").read_bytes() == b"an older one"


async def test_a_checkpoint_of_a_later_version_is_restored_by_that_version_after_the_logged_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, learned = tmp_path / "a folder", learned_estimator()
    folder.mkdir()
    save_as(FORMAT + 1, CheckpointFile(folder, SETTINGS, CELL), learned, monkeypatch)
    with capture_logs() as lines:
        outcome = (await run_samples(folder, samples=1)).health.checkpoint
    assert [line["log_level"] for line in lines if line.get("outcome") == outcome] == ["warning"]
    before, command, _ = outcome.split("`")
    assert before.endswith("is installed again, stop the service and ")
    subprocess.run(command, shell=True, check=True)  # noqa: ASYNC221 - a user enters the command in a shell
    monkeypatch.setattr("bms_estimator.checkpoint.state_files.FORMAT", FORMAT + 1)
    restored = (await run_samples(folder, samples=1)).health.checkpoint
    assert restored == f"restored: SOC {learned.state['soc'][0]:.4f}"


@pytest.mark.parametrize(
    "implausible",
    [
        {"crashes": -3},
        {"samples": {"samples": 10**30}},
        {"unseen_s": float("nan")},
        {"unseen_s": -1.0},
        {"since": "yesterday"},
    ],
    ids=str,
)
async def test_implausible_counters_are_reset_and_the_state_is_restored(
    tmp_path: Path, implausible: dict[str, Any]
) -> None:
    learned = learned_estimator()
    total = COUNTERS.total.model_copy(update=implausible)
    file = StateFiles(tmp_path, SETTINGS, CELL)
    file.checkpoint.save(learned.record)
    file.run_file.save(dataclasses.replace(COUNTERS, total=total))
    with capture_logs() as lines:
        health = (await run_samples(tmp_path, samples=1)).health
    assert "restart from zero" in lines[0]["event"]
    assert health.checkpoint == f"restored: SOC {learned.state['soc'][0]:.4f}"
    assert (health.restarts, health.total.crashes) == (1, 0)
    assert 0 <= health.total.samples["samples"] <= 1
    assert 0.0 <= health.total.unseen_s < LONG_S


async def test_a_deleted_state_folder_is_recreated_with_access_for_the_owner_only(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    async with run_with_frequent_saves(StateFiles(folder, SETTINGS, CELL)) as (source, sink, _):
        for second in range(3):
            snapshots_before = len(sink.snapshots)
            source.give((float(second), 0.1, 3.8))
            await sink.until(
                lambda s, n=second + 1: s.health.samples["samples"] == n and s.health.checkpoint == "saved",
                skip=snapshots_before,
            )
            while not folder.exists():  # noqa: ASYNC110 - a file has no event
                await asyncio.sleep(0.01)
            assert folder.stat().st_mode & 0o777 == 0o700
            shutil.rmtree(folder, ignore_errors=True)
    assert {path.stat().st_mode & 0o777 for path in folder.iterdir()} == {0o600}


async def test_a_hanging_disk_delays_neither_estimates_nor_shutdown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint_writer, "DISK_HUNG_S", 0.01)
    monkeypatch.setattr(checkpoint_writer, "FINAL_SAVE_TIMEOUT_S", 0.01)
    release = threading.Event()

    class HungFile(CheckpointFile):
        def save(self, *_: Any, **_whole: bool) -> None:
            release.wait()

    with capture_logs() as lines:
        await run_with_hanging_disk(with_checkpoint(HungFile(tmp_path, SETTINGS, CELL)))
    assert "the disk hangs: the last checkpoint is not written" in {line["event"] for line in lines}
    release.set()


async def run_with_hanging_disk(hung_files: StateFiles) -> None:
    """Check that a service with a checkpoint on a hanging disk publishes samples and ends."""
    async with run_with_frequent_saves(hung_files) as (source, sink, task):
        source.give((0.0, 0.1, 3.8))
        await sink.until(lambda s: s.health.checkpoint == "not saved: the disk hangs")
        source.give((1.0, 0.1, 3.8))
        await sink.until(lambda s: s.health.samples["samples"] == 2)
        source.finish()
        await asyncio.wait_for(task, LONG_S)


async def test_after_a_gap_of_a_week_the_soc_is_estimated_from_the_voltage(tmp_path: Path) -> None:
    """The pack was charged while the service was off for a week."""
    estimator = compiled_estimator(SETTINGS, CELL)
    for second in range(600):
        estimator.step(float(second), 0.0, 3.75)
    CheckpointFile(tmp_path, SETTINGS, CELL, lambda: clock_at(0.0)).save(estimator.record)
    restored, _ = await run_at(24.0 * 7.0, tmp_path, *((float(i), 0.0, 3.95) for i in range(60)))
    fresh = compiled_estimator(Settings(), CELL)  # its SOC is that of its first voltage
    fresh.step(0.0, 0.0, 3.95)
    assert fresh.state["soc"][0] > estimator.state["soc"][0] + 0.3
    assert restored.state["soc"][0] == pytest.approx(fresh.state["soc"][0], abs=0.03)
    assert abs(restored.state["soc"][0] - fresh.state["soc"][0]) < 2.0 * restored.record["filter"]["soc_std"][0]


def test_gap_lengths_are_those_that_the_kernel_counts_as_gaps() -> None:
    """Steps of the time are regular, twice the limit of a gap, long, or backward, in random order."""
    estimator, rng = compiled_estimator(SETTINGS, CELL), np.random.default_rng(5)
    gap_s = float(estimator.settings["gap_s"][0])
    steps = rng.choice([0.1, 1.0, 2.0 * gap_s, 100.0, -50.0], 400)
    times = np.cumsum(steps)
    lengths = []
    for time_s in times:
        gaps_before, before_s, step_s = (float(estimator.state[n][0]) for n in ("gaps", "time_s", "step_s"))
        started = estimator.state["started"][0]
        estimator.step(float(time_s), 0.0, 3.8)
        if started:
            new_lengths = gap_lengths(np.array([time_s]), before_s, step_s, gap_s, np.inf)
            assert len(new_lengths) == estimator.state["gaps"][0] - gaps_before
            lengths += new_lengths
    assert gap_lengths(times[1:], float(times[0]), 0.0, gap_s, np.inf) == pytest.approx(lengths)
