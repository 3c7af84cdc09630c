"""Slow fit of the pack's model to the recorded history of an estimator, at intervals. The filter adopts each fit."""

import math
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import relative_capacity
from bms_estimator.kernels.kalman_filter.hypotheses import MAX_STD_OF_ONE_HYPOTHESIS
from bms_estimator.pack_model.accuracy import with_soc_bound
from bms_estimator.pack_model.bank_monitor import BankMonitor
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.fit import SOC as FIT_SOC, PackFit, fit
from bms_estimator.pack_model.handover import adopt_state, use_fitted_curves
from bms_estimator.pack_model.history import History
from bms_estimator.pack_model.resume import resume_history

FIT_INTERVAL_S = 3600.0
"""Maximum interval between two fits, on the clock of the samples [s]."""
MIN_INTERVAL_S = 1800.0
"""Minimum interval between two fits [s]. Under load, a fit to the first half hour already determines the SOC better than the
filter."""
INTERVAL_PER_AGE = 1.0 / 12.0
"""Interval between two fits as a fraction of the age of the history, within its limits: an hour after twelve hours. A row
changes a fit of a short history more than a fit of a long one."""
ADOPT_DELAY_S = 120.0
"""Time from the start of a fit to the adoption of its result, on the clock of the samples [s]. In this time the service fits in
another thread. A replay waits for the fit, and adopts it at the same sample."""
MIN_ROWS = 8
"""Minimum number of new rows for a fit."""
MIN_GROWTH, MAX_CERTAIN_STD = 0.04, 0.015
"""Minimum number of new rows for a fit, as a fraction of all rows, if the std of the previous fit's SOC is at most
``MAX_CERTAIN_STD``. Fewer rows hardly change such a fit. With a larger std, a few rows may decide between several minima."""
MAX_UNKNOWN_CURRENT = 0.05
"""Maximum variance of the current at the times of the voltages, as a fraction of its mean square, for a fit. An error of the
current makes the fitted resistances too small by about this fraction, because least squares assume exact currents. The error of
the resistances then distorts OCV and capacity. The fraction is 0.02 for a load that changes every 20 s if voltage and current
come every 10 s, 5 s apart, and 0.2 to 0.3 if they come every 60 s, 30 s apart."""
MIN_THROUGHPUT_SOC = 1.0
"""Minimum throughput of the history for the adoption of a fit with a large std of the SOC [SOC]. In a shorter history several
separate SOCs may be possible, which the filter's hypotheses represent and the single normal distribution of a fit does not."""
MAX_FAILED_FITS = 3
"""Number of successive failed fits after which the history is discarded. A fit may fail for lack of rows. A history with an
implausible value makes every fit fail."""
MIN_CHANGE = 0.01
"""Minimum change of the SOC, or of the ratio of the capacity to the declared one, that is reported as an event."""

Submit = Callable[[Callable[[], PackFit]], "Future[PackFit]"]
"""Function that runs a fit and returns its future."""


@dataclass(frozen=True)
class FitChange:
    """Change of the estimates by the adoption of a fit. Capacities are ratios to the declared capacity."""

    soc_before: float
    soc_after: float
    capacity_before: float
    capacity_after: float


def run_now(call: Callable[[], PackFit]) -> "Future[PackFit]":
    """Run a fit at once, and return its completed future."""
    future: Future[PackFit] = Future()
    try:
        future.set_result(call())
    except Exception as error:  # noqa: BLE001 - it is counted and reported when the fit is due
        future.set_exception(error)
    return future


class SlowFit:
    """Fit of an estimator's cell model to the pack's history.

    To continue from earlier runs, call ``load``, restore the estimator's state, and call ``resume``, before the first
    sample.

    Args:
        estimator: Estimator of a battery with the identifier enabled; its history is switched on.
        submit: Runs a fit, for example in another thread, and returns its future.
        interval_s: Maximum interval between two fits, on the clock of the samples [s]. A history that is younger than
            ``interval_s / INTERVAL_PER_AGE`` is fitted more often. Infinite: no fits.
        on_failure: Called with an exception in a fit or in the processing of rows. The previous fit stays in use.

    Attributes:
        history: Rows of this and earlier runs.
        bank: Monitor of the weakest cell; None for a single cell.
        saved_fit: The latest fit, adopted or not, which is saved with the history; None: no fit yet.
        fit: The adopted fit, whose curves the filter uses; None: the filter uses the curves of the cell file.
        fits: Number of adopted fits.
        late: Number of fits that were not done when due, so that they were adopted at a later sample.
        failed: Number of exceptions in fits and in the processing of rows.
        discarded: Number of histories that were discarded because of such exceptions.
        changes: Number of fits that changed the SOC or the capacity by more than ``MIN_CHANGE``.
        last_change: The last of these changes; None: no change yet.
        unsaved_rows: Number of rows since the last increase of ``revision``.
        revision: Number that increases when history and fit should be saved.
    """

    def __init__(
        self,
        estimator: Estimator,
        *,
        submit: Submit = run_now,
        interval_s: float = FIT_INTERVAL_S,
        on_failure: Callable[[BaseException], None] = lambda _: None,
    ) -> None:
        self.estimator, self.history = estimator, History()
        self.cell = CellCurves(estimator.cell_file_settings)
        self.bank = BankMonitor(self.cell) if self.cell.series > 1.0 else None
        self.fit: PackFit | None = None
        self.fits = self.late = self.failed = self.changes = self.revision = self.unsaved_rows = self.discarded = 0
        self._successive_failures = 0  # number of failed fits since the last successful one
        self.last_change: FitChange | None = None
        self._submit, self._interval_s, self._on_failure = submit, interval_s, on_failure
        self._pending: Future[PackFit] | None = None
        self._fitted_rows: NDArray[np.void] = self.history.rows  # of the pending fit
        self._is_late = False
        self._new_rows = 0  # number of rows since the last fit
        self.saved_fit: PackFit | None = None
        estimator.schedule(self.interval())

    def advance(self) -> None:
        """Take completed rows, and begin or end a fit that is due. Call it each time ``Estimator.run_part`` stops."""
        self.take_rows()
        if self._history_state["elapsed_s"] >= self._history_state["event_s"]:
            self._handle_event()

    def load(self, history: History, fit: PackFit | None, state_fit: PackFit | None) -> None:
        """Set history and fit of earlier runs, and adopt the curves.

        Args:
            history: Rows of earlier runs.
            fit: Last fit of the history; None: no fit yet.
            state_fit: Fit that was in use when the state to be restored was saved; None: the cell file's curves were in use,
                or no state will be restored.
        """
        self.history, self.saved_fit = history, fit
        self._adopt_curves(state_fit)

    def resume(self, gap_s: float, *, restored: bool) -> None:
        """Continue the history in a new segment, after the estimator's state was restored or found unusable.

        If a fit is due, it begins at the first sample. Otherwise the next fit begins within an interval.

        Args:
            gap_s: Time since the state was saved [s]; infinite if unknown.
            restored: True if the state was restored. Otherwise the last fit supplies the curves.
        """
        if not restored and self.saved_fit is not None:
            self._adopt_curves(self.saved_fit)
        resume_history(self.estimator, self.history, gap_s, self.cell.capacity_as, restored=restored)
        self._schedule_after_restart(restored=restored)

    def _schedule_after_restart(self, *, restored: bool) -> None:
        """Set the time of the next event. If the state does not contain the saved fit, this event adopts it like a new fit."""
        h, saved = self._history_state, self.saved_fit
        fitted_s = -math.inf if saved is None else saved.elapsed_s
        self._new_rows = int((self.history.rows["elapsed_s"] > fitted_s).sum())
        next_s = float(h["event_s"]) if restored else math.inf
        self.estimator.schedule(min(max(next_s, h["elapsed_s"]), h["elapsed_s"] + self.interval()))
        is_adopted = restored and self.fit is not None and saved is not None and self.fit.elapsed_s >= saved.elapsed_s
        if saved is not None and not is_adopted:
            self._pending, self._fitted_rows = run_now(lambda: saved), self.history.rows
            self.estimator.schedule(h["elapsed_s"] + ADOPT_DELAY_S)

    def forget(self) -> None:
        """Discard history and fit, and restart the estimator with the curves of the cell file, as for a new pack."""
        self._pending, self.fit, self.saved_fit, self.last_change = None, None, None, None
        self.history, self._is_late, self._new_rows, self.unsaved_rows = History(), False, 0, 0
        if self.bank:
            self.bank.reset()
        self.estimator.forget()
        self.estimator.schedule(self.interval())
        self.revision += 1

    def adopt(self, fitted: PackFit) -> None:
        """Hand a fit to the filter: its curves become the settings, its results the state."""
        estimator, record = self.estimator, self.estimator.record[0]
        before = float(estimator.state["soc"][0]), relative_capacity(record).value
        self._adopt_curves(fitted)
        adopt_state(estimator, fitted)
        self.fits += 1
        self.saved_fit = fitted
        after = float(estimator.state["soc"][0]), relative_capacity(record).value
        if max(abs(after[0] - before[0]), abs(after[1] - before[1])) > MIN_CHANGE:
            self.changes += 1
            self.last_change = FitChange(before[0], after[0], before[1], after[1])

    def take_rows(self) -> None:
        """Append the completed rows of the estimator's state to the history. An exception discards the history."""
        rows = self.estimator.take_rows()
        if rows.size:
            try:
                self._append(rows)
            except Exception as error:  # noqa: BLE001 - an odd value of the history must not end the estimator
                self._report_failure(error)
                self._discard_history()

    def _append(self, rows: NDArray[np.void]) -> None:
        """Append rows to the history, and compare them with earlier discharges."""
        self.history.append(rows, self.cell.capacity_as)
        self._new_rows += rows.size
        self.unsaved_rows += rows.size
        if self.bank and self.saved_fit is not None:
            self.bank.add(self.history, rows.size, self.saved_fit)

    def _report_failure(self, error: BaseException) -> None:
        self.failed += 1
        self._on_failure(error)

    def _discard_history(self) -> None:
        """Discard history and last fit. The adopted fit stays in use, as after a restart without the history's file."""
        self._pending, self.saved_fit, self.history = None, None, History()
        self._is_late, self._new_rows, self._successive_failures = False, 0, 0
        if self.bank:
            self.bank.reset()
        self.discarded += 1
        self.revision += 1

    @property
    def weak_cell_std(self) -> float:
        """Significance of a weak cell in the last comparison of a bank [std]; NaN before a comparison."""
        return self.bank.weakest.deviation_std if self.bank and self.bank.weakest else math.nan

    @property
    def _history_state(self) -> np.void:
        """Recording of the history in the estimator's state, a record of HISTORY."""
        record: np.void = self.estimator.record[0]["history"]
        return record

    def interval(self) -> float:
        """Return the interval until the next fit [s]; infinite if there are no fits."""
        return fit_interval(float(self._history_state["elapsed_s"]), self._interval_s)

    def _handle_event(self) -> None:
        """Begin a fit, or end a pending one, at the time ``event_s`` of the record of the history."""
        h = self._history_state
        if self._pending is None:
            self._begin_fit()
        elif self._pending.done():
            self._end_fit(self._pending)
            self._pending, self._is_late = None, False
            self.estimator.schedule(h["event_s"] + (self.interval() - ADOPT_DELAY_S))
        elif not self._is_late:  # ``event_s`` does not change, so that this function runs again after the next sample
            self.late += 1
            self._is_late = True

    def _begin_fit(self) -> None:
        """Begin a fit if there is enough new data with known currents, and set the time of the next event."""
        h = self._history_state
        rows, previous, cell = self.history.rows, self.saved_fit, self.cell
        if has_enough_data(rows, self._new_rows, previous):
            self._new_rows, self._fitted_rows = 0, rows
            has_temperature = bool(self.estimator.record[0]["filter"]["sensed"])
            self._pending = self._submit(lambda: with_soc_bound(fit(cell, rows, previous), cell, rows, has_temperature))
            self.estimator.schedule(h["elapsed_s"] + ADOPT_DELAY_S)
            return
        self.estimator.schedule(h["elapsed_s"] + self.interval())
        if self.unsaved_rows:
            self.unsaved_rows = 0
            self.revision += 1

    def _end_fit(self, done: "Future[PackFit]") -> None:
        """Adopt the result of a completed fit if it is ready for use, or report its failure."""
        estimator = self.estimator
        before, fit_before = (estimator.record.copy(), estimator.settings_record.copy()), self.fit
        try:
            fitted = done.result()
            if min_filter_std(fitted, self._fitted_rows) <= estimator.record[0]["filter"]["soc_std"]:
                self.adopt(fitted)
            self.saved_fit, self._successive_failures = fitted, 0
        except Exception as error:  # noqa: BLE001 - a failed fit must not end the estimator
            estimator.load_exact(*before)
            self.fit = fit_before
            self._successive_failures += 1
            self._report_failure(error)
            if self._successive_failures == MAX_FAILED_FITS:
                self._discard_history()
        self.unsaved_rows = 0
        self.revision += 1

    def _adopt_curves(self, fitted: PackFit | None) -> None:
        """Write the curves of a fit, or of the cell file, to the filter's settings."""
        self.fit = fitted
        use_fitted_curves(self.estimator, fitted)


def fit_interval(elapsed_s: float, interval_s: float) -> float:
    """Return the interval until the next fit [s].

    Args:
        elapsed_s: Age of the history [s].
        interval_s: Maximum interval [s]; infinite: no fits.
    """
    return interval_s if math.isinf(interval_s) else min(max(INTERVAL_PER_AGE * elapsed_s, MIN_INTERVAL_S), interval_s)


def has_enough_data(rows: NDArray[np.void], new_rows: int, previous: PackFit | None) -> bool:
    """Return True if a history has enough new rows with known currents for a fit.

    Args:
        rows: Shape (n,), dtype HISTORY_ROW.
        new_rows: Number of rows since the previous fit.
        previous: Previous fit; None: no fit yet.
    """
    min_rows = float(MIN_ROWS)
    if previous is not None and previous.covariance[FIT_SOC, FIT_SOC] <= MAX_CERTAIN_STD**2:
        min_rows = max(min_rows, MIN_GROWTH * rows.size)
    return new_rows >= min_rows and unknown_current_fraction(rows) <= MAX_UNKNOWN_CURRENT


def min_filter_std(fitted: PackFit, rows: NDArray[np.void]) -> float:
    """Return the minimum std of the filter's SOC for the adoption of a fit; 0: always, infinite: never.

    A fit is always adopted if one normal distribution represents the SOC: its std is small, or the history is long. In a short
    history with a known SOC or a gap the fit may know more than the filter, which learns neither capacity nor OCV from an end of
    charge, and stops learning at a gap. It is then adopted unless it enlarges the std of the SOC.

    Args:
        fitted: The fit.
        rows: Fitted rows, shape (n,), dtype HISTORY_ROW.
    """
    std = math.sqrt(fitted.covariance[FIT_SOC, FIT_SOC])
    if std <= MAX_STD_OF_ONE_HYPOTHESIS or throughput(rows) >= MIN_THROUGHPUT_SOC:
        return 0.0
    is_known = bool(np.isfinite(rows["reference_soc"]).any())
    has_gap = bool(rows["segment"][0] != rows["segment"][-1])
    return std if is_known or has_gap else math.inf


def unknown_current_fraction(rows: NDArray[np.void]) -> float:
    """Return the variance of the current at the times of the voltages, divided by its mean square; 0 without a current.

    Args:
        rows: Shape (n,), dtype HISTORY_ROW.
    """
    square_a2s = float(rows["duration_s"] @ rows["current_a"] ** 2)
    return float(rows["duration_s"] @ rows["skew_a2"]) / square_a2s if square_a2s > 0.0 else 0.0


def throughput(rows: NDArray[np.void]) -> float:
    """Return the charge throughput of all segments of a history [SOC].

    Args:
        rows: Shape (n,), dtype HISTORY_ROW, in order of time.
    """
    is_last = np.append(rows["segment"][1:] != rows["segment"][:-1], True)
    return float(rows["throughput_soc"][is_last].sum())
