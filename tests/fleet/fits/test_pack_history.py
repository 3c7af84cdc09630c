"""History of one pack from the messages of its workers: repetitions, returns to a checkpoint, and other packs."""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.fleet.fits.messages import (
    FitRequest,
    FitResult,
    Rows,
    RowsPosition,
    decode_result,
    encode_result,
    encode_rows,
    from_bytes,
    is_fit,
)
from bms_estimator.fleet.fits.pack_history import FitAnswer, FitJob, PackHistory, run_job
from bms_estimator.fleet.worker.pack_fits import weakest_of_record, write_weakest
from bms_estimator.fleet.worker.pack_state import PACK_STATE
from bms_estimator.kernels.accumulators.history import HISTORY_ROW
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model.history import History
from bms_estimator.pack_model.slow_fit import SlowFit
from bms_estimator.settings.alarm_limits import WEAK_CELL_STD
from tests.estimator.simulated_cell import TRUTH, measured
from tests.pack_model.test_bank_monitor import CURVES, FIT, discharges

DIGEST, OTHER_DIGEST = (1, 2), (3, 4)
ROWS_OF_A_MESSAGE = 10


@pytest.fixture(scope="module")
def history() -> np.ndarray:
    """Return the rows of a simulated cell."""
    slow_fit = SlowFit(Estimator(TRUTH, initial_soc=0.9), interval_s=np.inf)
    rng = np.random.default_rng(1)
    samples = measured(np.repeat(rng.choice([-1.5, 0.0, 1.5, 2.0], 240), 60), 0.9, rng, step_s=5.0)[0]
    Pack(slow_fit.estimator, slow_fit).run(samples)
    slow_fit.take_rows()
    assert slow_fit.history.rows.size > 4 * ROWS_OF_A_MESSAGE
    return slow_fit.history.rows


def message(rows: np.ndarray, sequence: int, digest: tuple[int, int] = DIGEST) -> bytes:
    """Return rows of a block with a stream sequence number as a message."""
    return encode_rows(Rows(rows, RowsPosition(sequence, 0), digest))


def messages(rows: np.ndarray, count: int) -> list[bytes]:
    """Return ``count`` messages, of the blocks 1, 2 ..."""
    n = ROWS_OF_A_MESSAGE
    return [message(rows[n * k : n * (k + 1)], k + 1) for k in range(count)]


def job(request: int, stored: list[bytes]) -> FitJob:
    return FitJob(FitRequest(sequence=request, part=0), np.array([Estimator(TRUTH).cell_file_settings]), stored)


def elapsed_s(answer: FitAnswer) -> list[float]:
    """Return the times of the rows of a history."""
    return from_bytes(answer.history)["rows"]["elapsed_s"].tolist()


def test_rows_after_the_request_are_kept_for_the_next_fit_but_not_fitted(history) -> None:
    first = run_job(job(2, messages(history, 3)))
    without_later = run_job(job(2, messages(history, 2)))
    assert is_fit(first.result)
    assert first.result == without_later.result
    assert decode_result(first.result).fit.elapsed_s == history["elapsed_s"][2 * ROWS_OF_A_MESSAGE - 1]
    assert elapsed_s(first) == history["elapsed_s"][: 3 * ROWS_OF_A_MESSAGE].tolist()
    stored = messages(history, 4)
    later, at_once = (
        run_job(job(4, [first.history, *stored[3:]])),
        run_job(job(4, [without_later.history, *stored[2:]])),
    )
    assert later.result == at_once.result
    assert decode_result(later.result).is_fitted


def test_request_without_its_rows_waits_and_an_answered_request_is_not_fitted_again(history) -> None:
    assert run_job(job(3, messages(history, 2))) is None
    answer = run_job(job(2, messages(history, 2)))
    again = run_job(job(2, [answer.history]))
    assert again.result is None
    assert again.history == answer.history


def test_too_few_new_rows_are_not_fitted(history) -> None:
    result = decode_result(run_job(job(1, [message(history[:5], 1)])).result)
    assert (result.request, result.is_fitted, result.fit) == (1, False, None)


def test_rows_that_a_takeover_sends_again_are_dropped(history) -> None:
    stored = messages(history, 4)
    once = run_job(job(4, stored))
    repeated = run_job(job(4, [*stored[:3], *stored[1:3], stored[3]]))
    assert (repeated.result, repeated.history) == (once.result, once.history)


def test_rows_after_the_checkpoint_are_dropped_when_a_partition_returns_to_it(history) -> None:
    stored = messages(history, 4)
    n = ROWS_OF_A_MESSAGE
    again = message(history[2 * n : 3 * n], 11)  # other blocks, since the later blocks of the stream were skipped
    assert elapsed_s(run_job(job(11, [*stored, again]))) == history["elapsed_s"][: 3 * n].tolist()


def test_history_of_another_capacity_begins_anew(history) -> None:
    other = message(history[30:40], 4, OTHER_DIGEST)
    assert elapsed_s(run_job(job(4, [*messages(history, 3), other]))) == history["elapsed_s"][30:40].tolist()


def test_damaged_rows_are_skipped_and_named(history) -> None:
    odd = history[:ROWS_OF_A_MESSAGE].copy()
    odd["voltage_v"][3] = np.nan
    answer = run_job(job(3, [message(odd, 1), b"", *messages(history, 3)[1:]]))
    assert answer.error
    assert elapsed_s(answer) == history["elapsed_s"][ROWS_OF_A_MESSAGE : 3 * ROWS_OF_A_MESSAGE].tolist()
    assert odd.dtype == HISTORY_ROW


@pytest.mark.parametrize("capacity_ratio", [1.0, 0.8])
def test_result_names_a_weak_cell_of_a_bank_by_the_discharges_since_the_previous_fit(capacity_ratio) -> None:
    stored = PackHistory(CURVES.capacity_as)
    stored._history = History(discharges(range(6), 1.0))
    stored.add(from_bytes(message(discharges(range(6, 7), capacity_ratio), 2, (0, 0))))
    result = decode_result(encode_result(FitResult(2, is_fitted=True, weakest=stored._weakest(CURVES, FIT))))
    weakest = result.weakest
    assert (weakest.deviation_std > WEAK_CELL_STD) == (capacity_ratio < 1.0)
    record = np.zeros(1, PACK_STATE)[0]["fit"]
    write_weakest(record, result)
    assert weakest_of_record(record).capacity_ratio == weakest.capacity_ratio == pytest.approx(capacity_ratio, abs=0.05)
