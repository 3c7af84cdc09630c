"""Slow fit in the service: same results as a replay, restarts, damaged files, failing and slow fits, exchanged packs."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bms_estimator.checkpoint.arrays_file import FORMAT, ArraysFile
from bms_estimator.checkpoint.state_files import CheckpointFile, StateFiles
from bms_estimator.estimator.estimator import Estimator, compiled_estimator
from bms_estimator.estimator.identified_parameters import relative_capacity, relative_series_resistance
from bms_estimator.model.arrays import NO_CELLS, SampleBlock, fields
from bms_estimator.model.cell import load_cell
from bms_estimator.model.events import events
from bms_estimator.model.payloads.health import PackModelHealth
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.mqtt.connection import DeliveryStats
from bms_estimator.pack.pack import Pack, new_pack
from bms_estimator.pack_model import fit as fit_module, slow_fit as slow_fit_module
from bms_estimator.pack_model.slow_fit import SlowFit
from bms_estimator.service.live_loop import ServiceParts, run_estimation_loop
from bms_estimator.settings.pack import Settings
from bms_estimator.sinks.mqtt.requests import RequestDispatcher
from bms_estimator.sources.source import ReceivedSamples
from bms_estimator.telemetry.state import finite
from tests.estimator.anywhere.use import days
from tests.estimator.simulated_cell import TRUTH, measured, wrong_cell
from tests.pack_model.quick_fit import LN_CAPACITY, quick_fit
from tests.patience import LONG_S
from tests.scripted_source import Collector, ScriptedSource

pytestmark = pytest.mark.usefixtures("few_draws")

FORMAT_7_FILE = Path(__file__).parent.parent / "checkpoint" / "checkpoint_format_7.npz"
"""Checkpoint of a ``chen_mora`` cell by a version without history; SOC 0.3710."""
FORMAT_7_SETTINGS = {"pack": {"initial_soc": 0.5}, "publish": {"rate_hz": 10.0}}
CELL = wrong_cell(1.3)
SETTINGS = Settings.model_validate({"pack": {"name": "bike"}, "publish": {"rate_hz": 10.0}})
STEP_S = 10.0
"""Sample period [s]."""
HOUR = int(3600.0 / STEP_S)
"""Samples of an hour."""
BLOCK = 6
"""Samples of a block, a minute."""


@pytest.fixture(scope="module")
def day() -> SampleBlock:
    """Samples of a day with drives, rests and charges."""
    rng = np.random.default_rng(2)
    current_a = days(rng, TRUTH.cell.capacity_ah, 1, 0.9)
    return measured(current_a.reshape(-1, int(STEP_S)).mean(axis=1), 0.9, rng, step_s=STEP_S)[0]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the fit by ``quick_fit``, from the first hour on."""
    monkeypatch.setattr(slow_fit_module, "fit", quick_fit)
    monkeypatch.setattr(slow_fit_module, "MIN_THROUGHPUT_SOC", 0.0)


class OneThread(ThreadPoolExecutor):
    """Thread for the fits, whose last future is known."""

    def __init__(self) -> None:
        super().__init__(1)
        self.last: Future[Any] | None = None

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.last = super().submit(fn, *args, **kwargs)
        return self.last


class DaySource(ScriptedSource):
    """Source that yields samples minute by minute, and waits for each fit, so that none is late."""

    def __init__(self, samples: SampleBlock, executor: OneThread) -> None:
        super().__init__()
        self._samples, self._executor = samples, executor

    async def __aiter__(self) -> AsyncIterator[ReceivedSamples]:
        for start in range(0, self._samples.size, BLOCK):
            if self._executor.last:
                await asyncio.to_thread(wait, [self._executor.last])
            yield ReceivedSamples(self._samples[start : start + BLOCK], NO_CELLS)


@dataclass
class Result:
    """Result of a run of the service."""

    estimator: Estimator
    sink: Collector

    @property
    def model(self) -> PackModelHealth:
        """State of the slow fit in the last health message."""
        model = self.sink.snapshots[-1].health.pack_model
        assert model
        return model


async def run_service(
    samples: SampleBlock,
    folder: Path | None = None,
    settings: Settings = SETTINGS,
    source: ScriptedSource | None = None,
    **parts: Any,
) -> Result:
    """Run the service over samples until they end, with further ``ServiceParts``."""
    sink = Collector()
    with OneThread() as executor:
        running = run_estimation_loop(
            settings,
            CELL,
            source=source or DaySource(samples, executor),
            sinks=[sink],
            stop=asyncio.Event(),
            files=StateFiles(folder, settings, CELL) if folder else None,
            parts=ServiceParts(**{"fit_executor": executor, **parts}),
        )
        estimator = await asyncio.wait_for(running, LONG_S)
    return Result(estimator, sink)


async def test_service_and_replay_agree_to_the_last_bit(
    day: SampleBlock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_module, "STARTS", fit_module.STARTS[:1])  # for a shorter test
    part = day[: 17 * HOUR]  # with the first hourly fits
    live = await run_service(part, tmp_path)  # the first start with a state folder
    pack = new_pack(SETTINGS, CELL)
    replayed, slow_fit, step = pack.estimator, pack.slow_fit, pack.run(part)
    assert slow_fit
    assert slow_fit.fits >= 3
    assert (live.model.fits, live.model.late, live.model.failed) == (slow_fit.fits, 0, 0)
    assert live.estimator.settings_record.tobytes() == replayed.settings_record.tobytes()
    assert slow_fit.saved_fit
    assert live.model.soc_bound == slow_fit.saved_fit.soc_bound is not None
    same_fields(live.estimator, replayed)
    same_forecasts(live.sink.snapshots, step.trace, step.forecasts)


def same_forecasts(snapshots: list[Snapshot], trace: np.ndarray, rows: np.ndarray) -> None:
    """Check that the published probabilities and quantities are those of the replay at the same sample, to the last bit."""
    names = [name for name in rows.dtype.names if not name.startswith("time_to_")]  # times count down after a forecast
    row_by_time = dict(zip(trace["time_s"].tolist(), rows, strict=True))
    estimates = [snapshot.estimate for snapshot in snapshots if snapshot.estimate]
    published = [[getattr(each, name) for name in names] for each in estimates]
    replayed = [[finite(row_by_time[each.board_time_s][name]) for name in names] for each in estimates]
    assert any(value is not None for values in published for value in values)
    assert published == replayed


def same_fields(a: Estimator, b: Estimator, without: tuple[str, ...] = ()) -> None:
    """Check that all fields of two states are equal to the last bit, except ``without``."""
    pairs = zip(fields(a.record), fields(b.record), strict=True)
    differing = [name for (name, one), (_, other) in pairs if one.tobytes() != other.tobytes()]
    assert [name for name in differing if name not in without] == []


class SlowExecutor(Executor):
    """Executor whose fits never end by themselves."""

    def __init__(self) -> None:
        self.calls: list[tuple[Future[Any], Callable[[], Any]]] = []

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.calls.append((future, lambda: fn(*args, **kwargs)))
        return future

    def end_all(self) -> None:
        """Run the fits."""
        for future, call in self.calls:
            future.set_result(call())
        self.calls.clear()


@pytest.mark.usefixtures("quick")
async def test_samples_do_not_wait_for_a_fit_and_a_late_one_is_adopted_once_done(day: SampleBlock) -> None:
    executor, counted = SlowExecutor(), list[int]()

    class Source(DaySource):
        async def __aiter__(self) -> AsyncIterator[ReceivedSamples]:
            yield ReceivedSamples(day[: 3 * HOUR], NO_CELLS)
            counted.append(len(executor.calls))
            executor.end_all()
            yield ReceivedSamples(day[3 * HOUR : 3 * HOUR + 1], NO_CELLS)

    result = await run_service(day, source=Source(day, OneThread()), fit_executor=executor)
    assert counted == [1]
    assert result.estimator.state["samples"][0] == 3 * HOUR + 1
    assert (result.model.fits, result.model.late) == (1, 1)
    assert relative_capacity(result.estimator.record[0]).value == pytest.approx(np.exp(LN_CAPACITY), abs=1e-6)


async def test_a_failing_fit_is_counted_and_leaves_the_previous_one(
    day: SampleBlock, monkeypatch: pytest.MonkeyPatch, quick: None
) -> None:
    calls = iter(range(99))

    def failing(*arguments: Any) -> Any:
        if next(calls):
            raise ValueError("no minimum")
        return quick_fit(*arguments)

    monkeypatch.setattr(slow_fit_module, "fit", failing)
    result = await run_service(day[: 6 * HOUR])
    assert result.estimator.state["samples"][0] == 6 * HOUR
    assert result.model.fits == 1
    assert result.model.failed >= 1
    assert relative_capacity(result.estimator.record[0]).value == pytest.approx(np.exp(LN_CAPACITY), abs=0.02)


@pytest.mark.usefixtures("quick")
async def test_the_event_names_soc_and_capacity_before_and_after(day: SampleBlock) -> None:
    snapshots = (await run_service(day[: 3 * HOUR])).sink.snapshots
    before = next(s for s in snapshots if s.health.pack_model and not s.health.pack_model.changes)
    (event,) = [e for e in events(before, snapshots[-1]) if e.name == "pack_fitted"]
    assert event.fit
    assert event.fit.capacity_before_ah == pytest.approx(CELL.cell.capacity_ah, rel=0.02)
    assert event.fit.capacity_after_ah == pytest.approx(CELL.cell.capacity_ah * np.exp(LN_CAPACITY))
    assert "capacity from" in event.text


@pytest.mark.usefixtures("quick")
async def test_a_restart_continues_history_curves_and_state(day: SampleBlock, tmp_path: Path) -> None:
    first = await run_service(day[: 5 * HOUR], tmp_path)
    second = await run_service(day[5 * HOUR : 5 * HOUR + 1], tmp_path)
    assert second.sink.snapshots[0].health.checkpoint.startswith("restored")
    assert second.estimator.settings_record.tobytes() == first.estimator.settings_record.tobytes()
    assert second.model.rows >= first.model.rows
    assert second.estimator.record["history"]["segment"][0] > first.estimator.record["history"]["segment"][0]
    assert second.estimator.record["history"]["elapsed_s"][0] >= first.estimator.record["history"]["elapsed_s"][0]
    same_estimates(first.estimator, second.estimator)
    third = await run_service(day[5 * HOUR :][: 4 * HOUR], tmp_path)
    assert third.model.segments >= 2
    assert third.model.fits >= 1


def same_estimates(first: Estimator, second: Estimator) -> None:
    """Check that SOC, capacity and R_s of two estimators agree."""
    assert second.state["soc"][0] == pytest.approx(first.state["soc"][0], abs=0.01)
    a, b = first.record[0], second.record[0]
    assert relative_capacity(b).value == pytest.approx(relative_capacity(a).value, abs=0.005)
    ratios = [
        relative_series_resistance(e.record[0], e.settings_record[0], e.cell_file_settings) for e in (first, second)
    ]
    assert ratios[1].value == pytest.approx(ratios[0].value, rel=0.02)


@pytest.mark.usefixtures("quick")
async def test_without_the_history_file_the_state_keeps_its_curves(day: SampleBlock, tmp_path: Path) -> None:
    first = await run_service(day[: 5 * HOUR], tmp_path)
    StateFiles(tmp_path, SETTINGS, CELL).history.path.unlink()
    second = await run_service(day[5 * HOUR : 5 * HOUR + 1], tmp_path)
    assert second.estimator.settings_record.tobytes() == first.estimator.settings_record.tobytes()
    same_estimates(first.estimator, second.estimator)
    third = await run_service(day[5 * HOUR :][: 4 * HOUR], tmp_path)
    assert third.model.fits >= 1
    assert third.model.failed == 0


@pytest.mark.usefixtures("quick")
async def test_with_the_fit_switched_off_the_curves_are_those_of_the_cell_file(
    day: SampleBlock, tmp_path: Path
) -> None:
    first = await run_service(day[: 5 * HOUR], tmp_path)
    off = SETTINGS.model_copy(update={"identifier": SETTINGS.identifier.model_copy(update={"pack_model": False})})
    second = await run_service(day[5 * HOUR : 5 * HOUR + 1], tmp_path, off)
    assert second.estimator.settings_record[0]["filter"] == second.estimator.cell_file_settings
    same_estimates(first.estimator, second.estimator)
    second = await run_service(day[5 * HOUR + 1 : 6 * HOUR + 1], tmp_path, off)
    assert second.sink.snapshots[-1].health.pack_model is None
    assert second.estimator.state["samples"][0] == HOUR


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("fault", ["damaged", "foreign", "later", "other layout"])
async def test_an_unusable_history_is_set_aside(day: SampleBlock, tmp_path: Path, fault: str) -> None:
    first = await run_service(day[: 3 * HOUR], tmp_path)
    path = StateFiles(tmp_path, SETTINGS, CELL).history.path
    with np.load(path) as file:
        content: dict[str, Any] = dict(file)
    if fault == "damaged":
        path.write_bytes(path.read_bytes()[:1000])
    else:
        changes = {
            "foreign": {"identity": "another"},
            "later": {"format": FORMAT + 1},
            "other layout": {"rows": np.zeros(3)},
        }
        np.savez(path, **content | changes[fault])
    second = await run_service(day[3 * HOUR : 3 * HOUR + 1], tmp_path)
    kept = "bike.later.history.npz" if fault == "later" else "bike.refused.history.npz"
    assert (tmp_path / kept).exists()
    same_estimates(first.estimator, second.estimator)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("failing", ["adopt_state", "History.append"])
async def test_a_history_whose_use_raises_exceptions_is_set_aside_and_the_service_goes_on(
    day: SampleBlock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    first = await run_service(day[: 2 * HOUR], tmp_path)

    def fail(*_: Any) -> None:
        raise ArithmeticError("odd value")

    monkeypatch.setattr(f"bms_estimator.pack_model.slow_fit.{failing}", fail)
    second = await run_service(day[2 * HOUR : 5 * HOUR], tmp_path)
    assert second.estimator.state["samples"][0] == 3 * HOUR
    assert (tmp_path / "bike.refused.history.npz").exists()
    assert second.estimator.settings_record.tobytes() == first.estimator.settings_record.tobytes()


@pytest.mark.usefixtures("quick")
async def test_without_a_checkpoint_the_fit_of_the_history_is_used(day: SampleBlock, tmp_path: Path) -> None:
    first = await run_service(day[: 3 * HOUR], tmp_path)
    CheckpointFile(tmp_path, SETTINGS, CELL).path.unlink()
    second = await run_service(day[3 * HOUR : 4 * HOUR], tmp_path)
    assert second.model.rows >= first.model.rows
    assert second.estimator.record["history"]["segment"][0] > first.estimator.record["history"]["segment"][0]
    assert relative_capacity(second.estimator.record[0]).value == pytest.approx(np.exp(LN_CAPACITY), abs=0.02)


async def test_a_checkpoint_of_a_version_without_history_is_restored(tmp_path: Path) -> None:
    settings, cell = Settings.model_validate(FORMAT_7_SETTINGS), load_cell("chen_mora")
    files = StateFiles(tmp_path, settings, cell)
    files.checkpoint.path.write_bytes(FORMAT_7_FILE.read_bytes())
    sink, source = Collector(), ScriptedSource()
    source.give((0.0, 0.0, 3.8))
    source.finish()
    running = run_estimation_loop(settings, cell, sinks=[sink], stop=asyncio.Event(), source=source, files=files)
    estimator = await asyncio.wait_for(running, LONG_S)
    assert sink.snapshots[0].health.checkpoint == "restored: SOC 0.3710"
    assert estimator.record["history"]["segment"][0] >= 1
    assert estimator.record["history"]["enabled"][0] == 1


@pytest.mark.usefixtures("quick")
async def test_forget_pack_starts_again_as_with_a_new_pack(day: SampleBlock, tmp_path: Path) -> None:
    requests, answers = RequestDispatcher(DeliveryStats(), ("forget_pack",)), list[Any]()

    class Source(DaySource):
        async def __aiter__(self) -> AsyncIterator[ReceivedSamples]:
            async for received in super().__aiter__():
                if received.samples["time_s"][0] == day["time_s"][3 * HOUR]:
                    answers.append(json.loads(await requests.handle("forget_pack", b"") or b""))
                yield received

    with OneThread() as executor:
        source = Source(day[: 3 * HOUR + BLOCK], executor)
        forgetful = await run_service(day, tmp_path, source=source, fit_executor=executor, requests=requests)
    new = compiled_estimator(SETTINGS, CELL)
    Pack(new, SlowFit(new)).run(day[3 * HOUR : 3 * HOUR + BLOCK])
    assert answers[0]["data"]["rows"] > 0
    assert forgetful.estimator.state["samples"][0] == 3 * HOUR + BLOCK  # the counters go on
    same_fields(forgetful.estimator, new, without=("observer.samples", "observer.gaps"))
    assert forgetful.estimator.settings_record.tobytes() == new.settings_record.tobytes()
    restarted = await run_service(day[:1], tmp_path)
    assert restarted.model.rows <= 2  # the row that had begun since the exchange, and the count of the charge
    assert relative_capacity(restarted.estimator.record[0]).value == pytest.approx(1.0, abs=0.01)


@pytest.mark.usefixtures("quick")
async def test_the_state_is_saved_though_the_history_cannot_be(
    day: SampleBlock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(ArraysFile, "save", full)
    first = await run_service(day[: 3 * HOUR], tmp_path)
    assert not StateFiles(tmp_path, SETTINGS, CELL).history.path.exists()
    second = await run_service(day[3 * HOUR : 3 * HOUR + 1], tmp_path)
    assert second.sink.snapshots[0].health.checkpoint.startswith("restored")
    same_estimates(first.estimator, second.estimator)


async def test_no_fit_where_the_identifier_is_off(day: SampleBlock) -> None:
    off = SETTINGS.model_copy(update={"identifier": SETTINGS.identifier.model_copy(update={"enabled": False})})
    result = await run_service(day[:HOUR], settings=off)
    assert result.sink.snapshots[-1].health.pack_model is None
    assert result.estimator.state["samples"][0] == HOUR
