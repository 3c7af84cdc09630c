"""Fits of packs in a worker: agreement with a replay, takeovers, and results that are late, repeated or of another request."""

import json

import numpy as np
import pytest

from bms_estimator.edge import subjects
from bms_estimator.fleet.fits.messages import FitRequest, decode_result
from bms_estimator.fleet.fits.pack_history import FitJob, run_job
from bms_estimator.fleet.hour_row import Hour
from bms_estimator.fleet.packs.pack_type import type_estimator
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.kernels.accumulators.history import HISTORY_ROW
from bms_estimator.kernels.kalman_filter.records import SCRATCH
from bms_estimator.model.cell import CellModel
from bms_estimator.pack.pack import new_pack
from bms_estimator.settings.observer import IdentifierSettings
from bms_estimator.settings.pack import PackSettings, Settings
from tests.estimator.simulated_cell import measured, wrong_cell
from tests.fleet.partition_stream import STORE_ID_NS, Stream, blocks_of

PACK, HOURS, PERIOD_S = "a", 10, 10.0
FACTOR = 1.5
"""Factor on the resistances of the cell file."""
CELL = wrong_cell(FACTOR)
SETTINGS = Settings(
    pack=PackSettings(cell="ncr18650"), identifier=IdentifierSettings(fit_interval_s=5400.0, soc_std=0.1)
)
BLOCK_SAMPLES = 6
"""Number of samples of a block, which lasts a minute."""


@pytest.fixture(scope="module")
def samples():
    rng = np.random.default_rng(1)
    level_a = np.where(np.arange(HOURS * 6) // 9 % 2, -1.2, 1.2)  # discharge and charge for 90 min each
    current_a = np.repeat(level_a, 60) + 0.4 * np.repeat(rng.choice([-1.0, 1.0], HOURS * 60), 6)
    return measured(current_a, 0.9, rng, step_s=PERIOD_S)[0]


def table(_: str) -> tuple[Settings, CellModel]:
    return SETTINGS, CELL


class FittedStream(Stream):
    """Stream whose requests for fits are answered, as by ``fleet fit``."""

    def __init__(self) -> None:
        super().__init__(Partition(0, table))
        self.history: dict[str, bytes] = {}
        self.requests: list[FitRequest] = []
        self.hours: list[Hour] = []
        self.events: list[str] = []

    def send(self, pack: str, data: bytes, *, defer: bool = False):
        result = super().send(pack, data, defer=defer)
        self.events += [json.loads(each.payload)["name"] for each in result.alarms if each.topic == "event"]
        self.hours += [Hour.model_validate_json(row) for _, row in result.hours]
        for message in result.history:
            if message.subject == subjects.history(pack):
                self.history.setdefault(message.headers["Nats-Msg-Id"], message.data)  # the server drops repetitions
            else:
                self.requests.append(FitRequest.model_validate_json(message.data))
        return result

    def fit(self, request: FitRequest) -> bytes:
        """Return the result of a request, and replace the history."""
        settings = np.array([type_estimator(SETTINGS, CELL).cell_file_settings])
        answer = run_job(FitJob(request, settings, list(self.history.values())))
        assert answer is not None
        assert answer.result is not None
        assert answer.error == ""
        self.history = {"all": answer.history}
        return answer.result

    def send_all(self, blocks: list[bytes], *, take_over: bool = False, late_blocks: int = 0) -> None:
        """Send blocks. A request is answered ``late_blocks`` blocks after the one that caused it."""
        answers: list[tuple[int, bytes]] = []
        for number, block in enumerate(blocks):
            self.send(PACK, block)
            answers += [(number + late_blocks, self.fit(request)) for request in self.requests]
            self.requests.clear()
            while answers and answers[0][0] <= number:
                self.send(PACK, answers.pop(0)[1])
            if take_over:
                self.take_over()


def record_of(stream: Stream) -> np.ndarray:
    """Return the estimator's record of the pack, without the rows that are not taken yet."""
    record = stream.partition.state(PACK)["estimator"].copy()
    record["history"]["rows"], record["history"]["count"] = np.zeros((), HISTORY_ROW), 0
    return record


def test_worker_that_is_killed_after_each_message_agrees_with_a_replay_bit_for_bit(samples) -> None:
    stream, pack = FittedStream(), new_pack(SETTINGS, CELL, has_forecasts=False)
    stream.send_all(blocks_of(samples, size=2 * BLOCK_SAMPLES), take_over=True)
    pack.run(samples)
    assert pack.slow_fit.fits >= 2
    assert stream.partition.counters["fits"] == pack.slow_fit.fits
    assert "late_fits" not in stream.partition.counters
    assert stream.events.count("pack_fitted") == pack.slow_fit.changes > 0
    assert stream.hours[-1].r_s_ratio == pytest.approx(1.0 / FACTOR, rel=0.15)
    pack.estimator.record["filter"][SCRATCH] = 0.0
    assert record_of(stream).tobytes() == pack.estimator.record.tobytes()


def test_late_fit_is_adopted_at_the_next_sample_and_a_takeover_in_between_changes_nothing(samples) -> None:
    streams = [FittedStream(), FittedStream()]
    for stream, take_over in zip(streams, (False, True), strict=True):
        stream.send_all(blocks_of(samples, size=5 * BLOCK_SAMPLES), take_over=take_over, late_blocks=2)
        assert min(stream.partition.counters["fits"], stream.partition.counters["late_fits"]) >= 2
    assert record_of(streams[0]).tobytes() == record_of(streams[1]).tobytes()
    assert streams[0].partition.snapshot().packs == streams[1].partition.snapshot().packs


def test_unanswered_request_is_repeated_after_an_interval_and_other_results_are_ignored(samples) -> None:
    stream, blocks = FittedStream(), blocks_of(samples, size=BLOCK_SAMPLES)
    for block in blocks[:200]:
        stream.send(PACK, block)
    first, second, *_ = stream.requests
    assert second.sequence > first.sequence
    stale = stream.fit(first)
    before = record_of(stream).tobytes()
    stream.send(PACK, stale)
    stream.send(PACK, b"BMSF damaged")
    assert (stream.partition.counters["stale_fits"], stream.partition.counters["damaged"]) == (1, 1)
    assert record_of(stream).tobytes() == before


def test_changed_cell_discards_the_fit_and_its_history(samples) -> None:
    stream, blocks = FittedStream(), blocks_of(samples, size=BLOCK_SAMPLES)
    stream.send_all(blocks[:400])
    assert stream.partition.counters["fits"]
    other = CELL.model_copy(update={"cell": CELL.cell.model_copy(update={"capacity_ah": 3.3})})
    stream.partition.in_force._table = lambda _: (SETTINGS, other)
    stream.partition.in_force.on_table_changed(PACK)
    stream.send_all(blocks[400:401])
    record = stream.partition.state(PACK)
    assert record["fit"]["in_force"]["sequence"] == 0
    assert record["estimator"]["history"]["elapsed_s"] < 120.0
    fresh = Stream(Partition(0, lambda _: (SETTINGS, other)))
    fresh.send(PACK, blocks_of(samples[2400:2406], STORE_ID_NS)[0])
    assert record["estimator"]["filter"].tobytes() == fresh.partition.state(PACK)["estimator"]["filter"].tobytes()


def test_failed_fit_and_rows_with_odd_values_leave_the_estimator_unchanged(samples) -> None:
    stream, blocks = FittedStream(), blocks_of(samples, size=BLOCK_SAMPLES)
    while not stream.requests:
        stream.send(PACK, blocks[len(stream.messages)])
    stream.history = {"odd": b"no arrays"} | stream.history
    settings = np.array([type_estimator(SETTINGS, CELL).cell_file_settings])
    answer = run_job(FitJob(stream.requests[0], settings, list(stream.history.values())))
    assert answer.error.startswith("damaged arrays")
    assert decode_result(answer.result).request == stream.requests[0].sequence
