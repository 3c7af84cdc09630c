"""History of one pack with its last fit, from the messages of the stream ``HISTORY``."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.checkpoint.arrays_file import to_bytes
from bms_estimator.estimator.restore import checked_rows
from bms_estimator.fleet.fits.messages import (
    FitRequest,
    FitResult,
    RowsPosition,
    digest_of,
    encode_result,
    from_bytes,
    position_of,
)
from bms_estimator.pack_model.bank_comparison import ComparedCell
from bms_estimator.pack_model.bank_monitor import BankMonitor
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.fit import PackFit, fit
from bms_estimator.pack_model.history import History
from bms_estimator.pack_model.saved import Arrays, history_arrays, history_from_arrays
from bms_estimator.pack_model.slow_fit import MAX_FAILED_FITS, has_enough_data, min_filter_std

NO_POSITION = RowsPosition(0, 0)


class PackHistory:
    """Rows of a pack and the last fit.

    Args:
        capacity_as: Declared capacity [A s].

    Attributes:
        position: Position of the last rows.
        answered: ``FitRequest.sequence`` of the last answered request; 0: none.
    """

    def __init__(self, capacity_as: float) -> None:
        self._capacity_as = capacity_as
        self._digest = (0, 0)
        self._history = History()
        self._last_fit: PackFit | None = None
        self._new_rows = self._failures = 0
        self.position, self.answered = NO_POSITION, 0

    def _reset(self) -> None:
        """Discard the rows, and the fit to them."""
        self._history, self._last_fit = History(), None
        self._new_rows = self._failures = 0

    def add(self, arrays: Arrays) -> None:
        """Add the next message of the stream, which has new rows, or the whole history up to this message.

        Raises:
            ValueError: An array is damaged.
            KeyError: An array is missing.
        """
        position, digest = position_of(arrays), digest_of(arrays)
        if "answered" in arrays:
            self._history, self._last_fit = history_from_arrays(arrays)
            self._new_rows, self._failures, self.answered = (
                int(arrays[name]) for name in ("new_rows", "failures", "answered")
            )
        else:
            if digest != self._digest:
                self._reset()
            self._add_rows(checked_rows(arrays["rows"]), position)
        self.position, self._digest = max(position, self.position), digest

    def _add_rows(self, rows: NDArray[np.void], position: RowsPosition) -> None:
        """Append rows that were not added before. After a worker's return to an earlier checkpoint, replace later rows."""
        before = self._history.rows
        if rows.size and before.size and rows["elapsed_s"][0] <= before["elapsed_s"][-1]:
            if position <= self.position:
                return
            self._return_to(float(rows["elapsed_s"][0]))
        self._history.append(rows, self._capacity_as)
        self._new_rows += rows.size

    def _return_to(self, elapsed_s: float) -> None:
        """Drop the rows from a time on, and a fit to them."""
        rows = self._history.rows
        self._history.rows = rows[rows["elapsed_s"] < elapsed_s]
        if self._last_fit is not None and self._last_fit.elapsed_s >= elapsed_s:
            self._last_fit, self._new_rows = None, self._history.rows.size

    def fit(self, cell: CellCurves, request: int) -> FitResult:
        """Fit the rows if there are enough new ones."""
        rows, previous, self.answered = self._history.rows, self._last_fit, request
        if not has_enough_data(rows, self._new_rows, previous):
            return FitResult(request, is_fitted=False)
        weakest = None if previous is None else self._weakest(cell, previous)
        self._new_rows = 0
        try:
            fitted = fit(cell, rows, previous)
        except Exception:  # noqa: BLE001 - the result reports the failure
            self._failures += 1
            if self._failures == MAX_FAILED_FITS:
                self._reset()
            return FitResult(request, is_fitted=True, min_filter_std=np.inf, weakest=weakest)
        self._last_fit, self._failures = fitted, 0
        return FitResult(request, True, fitted, min_filter_std(fitted, rows), weakest)

    def _weakest(self, cell: CellCurves, previous: PackFit) -> ComparedCell | None:
        """Compare the discharges since the previous fit with earlier ones. Return the weakest cell of a bank; None if unknown."""
        if cell.series <= 1.0:
            return None
        monitor = BankMonitor(cell)
        try:
            monitor.add(self._history, self._new_rows, previous)
        except Exception:  # noqa: BLE001 - the comparison must not prevent the fit
            return None
        return monitor.weakest

    def to_bytes(self) -> bytes:
        """Encode the whole history for ``add``."""
        state = {
            "position": np.array(self.position, np.uint64),
            "digest": np.array(self._digest, np.uint64),
            "answered": np.uint64(self.answered),
            "new_rows": np.int64(self._new_rows),
            "failures": np.int64(self._failures),
        }
        return to_bytes(history_arrays(self._history, self._last_fit) | state)


@dataclass(frozen=True)
class FitJob:
    """Request for a fit with all data that it needs, so that another process can run it.

    Attributes:
        request: The request.
        settings: ``Estimator.cell_file_settings`` of the pack, shape (1,), dtype EKF_SETTINGS.
        messages: Messages of the pack's history in the order of the stream.
    """

    request: FitRequest
    settings: NDArray[np.void]
    messages: Sequence[bytes]


@dataclass(frozen=True)
class FitAnswer:
    """Answer to a request for a fit.

    Attributes:
        result: Encoded ``FitResult``; None: the request was answered before.
        history: Encoded history, which replaces the messages of the job.
        error: Reason for which messages were skipped; empty if none was.
    """

    result: bytes | None
    history: bytes
    error: str = ""


def run_job(job: FitJob) -> FitAnswer | None:
    """Run a fit. Rows after the request are not fitted. Return None if the rows up to the request are not stored yet."""
    cell = CellCurves(job.settings[0])
    history, later, error = PackHistory(cell.capacity_as), list[Arrays](), ""
    for data in job.messages:
        try:
            arrays = from_bytes(data)
            if "answered" not in arrays and position_of(arrays) > job.request.position:
                later.append(arrays)
            else:
                history.add(arrays)
        except (ValueError, KeyError) as damage:
            error = str(damage)
    if history.answered == job.request.sequence:
        return FitAnswer(None, history.to_bytes(), error)
    if history.position < job.request.position and not error:
        return None
    result = history.fit(cell, job.request.sequence)
    for rows in later:
        history.add(rows)
    return FitAnswer(encode_result(result), history.to_bytes(), error)
