"""Pack with all its stages. Only this module assembles the stages and decides their order."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from bms_estimator.estimator.cell_estimator import CellEstimator
from bms_estimator.estimator.estimator import Estimator, TraceBlock, compiled_estimator
from bms_estimator.estimator.identified_parameters import relative_capacity
from bms_estimator.estimator.restore import restore_state
from bms_estimator.estimator.settings_plausibility import forecast_end_v
from bms_estimator.forecast.available_power import NO_FORECAST, ForecastRows, power_limits
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.forecast.load_history import load_arrays, restore_load
from bms_estimator.kernels.records import TRACE
from bms_estimator.model.arrays import NO_CELLS, NO_SOC, CellBlock, Floats, SampleBlock
from bms_estimator.model.pack_model import PackModel
from bms_estimator.pack.state import (
    CAPACITY,
    CELLS,
    CHECKPOINT,
    CURVES,
    HISTORY,
    LOAD,
    REFUSED,
    DeclaredValues,
    PackState,
    with_capacity,
)
from bms_estimator.pack_model.fit import PackFit
from bms_estimator.pack_model.handover import use_fitted_curves
from bms_estimator.pack_model.history import History
from bms_estimator.pack_model.saved import curve_arrays, fit_from_arrays, history_arrays, history_from_arrays
from bms_estimator.pack_model.slow_fit import FIT_INTERVAL_S, SlowFit, Submit, run_now
from bms_estimator.settings.pack import Settings

PRIOR_S = 600.0
"""Time from the first sample of a new pack within which the SOC that its device reports is used as a prior [s]."""
T = TypeVar("T")


@dataclass(frozen=True)
class RunResult:
    """Result of a block of samples. The arrays are valid until the next block."""

    trace: TraceBlock
    """Estimates, one row of dtype ``TRACE`` for each accepted sample."""
    forecast_parts: tuple[tuple[ForecastRows, int], ...]
    """Values of each forecast, and the number of rows at which it was the latest; empty without forecasts."""

    @property
    def forecasts(self) -> ForecastRows:
        """Values of the latest forecast at each row of ``trace``, dtype ``FORECAST``; without forecasts a single row of NaN."""
        parts = [np.repeat(values, count) for values, count in self.forecast_parts]
        return np.concatenate(parts) if parts else NO_FORECAST


class Pack:
    """Estimator of a pack with its other stages. It alone decides when a stage runs; no stage runs another.

    Any division of the samples into blocks gives the same results to the last bit.

    Args:
        estimator: Estimator of the pack.
        slow_fit: Fit of the pack's model to its history; None: no slow fit.
        cells: Estimators of the single cells; None: single cells are not estimated.
        forecaster: Forecaster; None: there are no forecasts.
        has_forecasts: False: the observed load is kept, but no forecasts are made at intervals.
        device_soc_std: Std of the SOC that the device reports, which is the prior of a new pack; None: it is not used.

    Attributes:
        awaits_prior: True until an estimate contains the SOC of the device as a prior, or this SOC is not used. The row of the
            sample with this SOC does not contain it, because the prior is added after the row.
    """

    def __init__(
        self,
        estimator: Estimator,
        slow_fit: SlowFit | None = None,
        cells: CellEstimator | None = None,
        forecaster: Forecaster | None = None,
        *,
        has_forecasts: bool = True,
        device_soc_std: float | None = None,
    ) -> None:
        self._device_soc_std = device_soc_std  # None also after the prior was used, or its time has passed
        self._first_s = math.nan  # time of the first sample, if the device's SOC is awaited
        self.awaits_prior = device_soc_std is not None
        self.estimator, self.slow_fit, self.cells, self.forecaster = estimator, slow_fit, cells, forecaster
        self._has_forecasts = has_forecasts and forecaster is not None
        self._has_cells = False  # of the present block
        self._trace: TraceBlock = np.zeros(0, TRACE)

    @property
    def model(self) -> PackModel:
        """Model of the whole pack."""
        return self.estimator.cell

    def extend_gap(self, wait_s: float) -> None:
        """Extend the gap before the first accepted sample after ``restore``. Later calls have no effect.

        Args:
            wait_s: Time without samples since ``restore`` or the last call [s].
        """
        state = self.estimator.state[0]
        if state["started"] and not state["samples"]:
            self.estimator.extend_gap(wait_s)
            if self.cells:
                self.cells.extend_gap(wait_s)

    def run(self, samples: SampleBlock, cells_v: CellBlock = NO_CELLS, device_soc: Floats = NO_SOC) -> RunResult:
        """Process a block of samples.

        Args:
            samples: Samples, shape (n,), dtype ``SAMPLE``.
            cells_v: Cell voltages of the samples, shape (n, m) [V]; empty if there are none.
            device_soc: SOC that the device reports at the samples, 0..1, shape (n,); empty if there are none.
        """
        self._has_cells = cells_v.size > 0 or (self.cells is not None and self.cells.cells.size > 0)
        if self._trace.size < samples.size:
            self._trace = np.zeros(samples.size, TRACE)
        forecaster, forecasts, start, rows = self.forecaster, list[tuple[ForecastRows, int]](), 0, 0
        while start < samples.size:
            due = forecaster.first_due(samples["time_s"][start:]) if forecaster and self._has_forecasts else None
            end = samples.size if due is None else start + due + 1
            begin, rows = rows, self._run_estimates(samples[start:end], cells_v[start:end], device_soc[start:end], rows)
            if forecaster:
                forecaster.add(self._trace[begin:rows], self.cells.deviations if self.cells else None)
            if forecaster and self._has_forecasts:
                # if the due sample was rejected, the new forecast applies from the last accepted row
                before = rows - begin if due is None else max(rows - begin - 1, 0)
                forecasts.append((forecaster.latest.values, before))
                if due is not None:
                    forecaster.update(float(samples["time_s"][end - 1]))
                    forecasts.append((forecaster.latest.values, rows - begin - before))
            start = end
        if forecaster and not self._has_forecasts:
            forecaster.past.add(forecaster.load)
        return RunResult(self._trace[:rows], tuple(forecasts))

    def _run_estimates(self, samples: SampleBlock, cells_v: CellBlock, device_soc: Floats, rows: int) -> int:
        """Run estimator, single cells and slow fit. Append the estimates to the trace, and return its new length.

        The single cells run before a fit is adopted, so that they see the curves in force at their samples.
        """
        start = 0
        while start < samples.size:
            prior = self._prior_index(samples[start:], device_soc[start:])
            stop = samples.size if prior is None else start + prior + 1
            used, written = self.estimator.run_part(samples[start:stop], self._trace[rows:])
            end, trace = start + used, self._trace[rows : rows + written]
            if self._has_cells and self.cells:  # without cells, the call takes a tenth of a sample's time
                self.cells.run(samples[start:end], cells_v[start:end], trace)
            if self.slow_fit:
                self.slow_fit.advance()
            if written and self._device_soc_std is None:
                self.awaits_prior = False
            if prior is not None and end == stop and self._device_soc_std and self.estimator.state["started"][0]:
                self.estimator.add_prior(float(device_soc[end - 1]), self._device_soc_std)
                self._device_soc_std = None
            start, rows = end, rows + written
        return rows

    def _prior_index(self, samples: SampleBlock, device_soc: Floats) -> int | None:
        """Return the index of the first sample of a new pack with an SOC that the device reports; None if no prior is due."""
        if self._device_soc_std is None:
            return None
        self._first_s = float(samples["time_s"][0]) if math.isnan(self._first_s) else self._first_s
        known = np.flatnonzero(~np.isnan(device_soc))
        if known.size and float(samples["time_s"][known[0]]) - self._first_s <= PRIOR_S:
            return int(known[0])
        if float(samples["time_s"][-1]) - self._first_s > PRIOR_S:
            self._device_soc_std = None
        return None

    def state(self, *parts: str) -> PackState:
        """Return a copy of the state for ``restore``, which later samples leave unchanged.

        Args:
            parts: Parts that the copy contains: ``CHECKPOINT`` with record, curves and cells, ``HISTORY``, ``LOAD``; default: all.
        """
        parts, fit, forecaster = parts or (CHECKPOINT, HISTORY, LOAD), self.slow_fit, self.forecaster
        return PackState(
            record=self.estimator.record.copy() if CHECKPOINT in parts else {},
            curves=curve_arrays(fit.fit) if CHECKPOINT in parts and fit else {},
            cells=self.cells.saved_state if CHECKPOINT in parts and self.cells else {},
            history=history_arrays(fit.history, fit.saved_fit) if HISTORY in parts and fit else {},
            load=load_arrays(forecaster.load, forecaster.past) if LOAD in parts and forecaster else {},
            declared=DeclaredValues.of(self.model),
        )

    def restore(self, state: PackState, gap_s: float) -> dict[str, str]:
        """Restore the state of an earlier run, before the first sample. A part that is refused begins empty.

        The curves come first, because the record is relative to them. The history follows the record, because its
        continuation depends on whether the record was restored.

        Args:
            state: State to restore.
            gap_s: Time without samples since the state was saved [s]; infinite if unknown.

        Returns:
            Outcomes by the names of the parts; those of refused parts begin with ``REFUSED``.
        """
        outcomes: dict[str, str] = {}
        state = self._with_present_capacity(state, outcomes)
        curves = _try_convert(CURVES, lambda: fit_from_arrays(state.curves), outcomes)
        if self.slow_fit:
            saved = (
                _try_convert(HISTORY, lambda: history_from_arrays(state.history), outcomes) if state.history else None
            )
            self.slow_fit.load(*(saved or (History(), None)), curves)
        elif curves:
            use_fitted_curves(self.estimator, curves)
        is_restored = self._restore_record(state, gap_s, outcomes)
        if state.curves and (self.slow_fit is None or curves is None):
            # Without a slow fit the resistances are converted to the curves of the cell file. If the saved curves are damaged,
            # this is impossible, and the resistances start with the std of the cell file again.
            self.estimator.return_to_cell_file()
        if self.slow_fit:
            self._resume_history(
                self.slow_fit, gap_s if is_restored else math.inf, curves, outcomes, restored=is_restored
            )
            if state.history:
                outcomes.setdefault(HISTORY, f"restored: {self.slow_fit.history.rows.size} rows")
        if self.cells and is_restored and (reason := self.cells.restore(state.cells, gap_s)):
            outcomes[CELLS] = f"{REFUSED}{reason}"
        if forecaster := self.forecaster:
            forecaster.deviations = self.cells.deviations if self.cells else None
            if state.load:
                _try_convert(LOAD, lambda: restore_load(forecaster.load, forecaster.past, state.load), outcomes)
                outcomes.setdefault(LOAD, f"restored: {forecaster.load.seconds} s")
        return outcomes

    def _with_present_capacity(self, state: PackState, outcomes: dict[str, str]) -> PackState:
        """Return a state relative to the present declared capacity; without a record if it cannot be converted."""
        before, declared = state.declared, DeclaredValues.of(self.model)
        if before is None or declared is None or before == declared:
            return state
        converted = _try_convert(
            CHECKPOINT, lambda: with_capacity(state, before, declared, self.estimator.cell_file_settings), outcomes
        )
        if converted is None:
            return PackState(load=state.load, reasons=outcomes)
        outcomes[CAPACITY] = (
            f"corrected from {before.capacity_ah:g} to {declared.capacity_ah:g} Ah; what is restored keeps its values in Ah and ohm"
        )
        return converted

    def _restore_record(self, state: PackState, gap_s: float, outcomes: dict[str, str]) -> bool:
        """Restore the estimator's record. Return False without a valid one."""
        if CHECKPOINT in state.reasons:
            return False
        if reason := restore_state(self.estimator, state.record_fields, gap_s):
            outcomes[CHECKPOINT] = f"{REFUSED}{reason}"
            return False
        soc, self._device_soc_std = self.estimator.soc, None
        outcomes[CHECKPOINT] = "restored" if math.isnan(soc) else f"restored: SOC {soc:.4f}"
        if CAPACITY in outcomes:
            outcomes[CAPACITY] += (
                f": SOC {soc:.4f}, capacity {relative_capacity(self.estimator.record[0]).value:.3f} of the declared one, and all totals"
            )
        return True

    def _resume_history(
        self, slow_fit: SlowFit, gap_s: float, curves: PackFit | None, outcomes: dict[str, str], *, restored: bool
    ) -> None:
        """Continue the history. One that cannot be continued is refused, together with its rows in the record."""
        try:
            slow_fit.resume(gap_s, restored=restored)
        except Exception as error:  # noqa: BLE001 - a damaged file must not end the service at each start
            outcomes[HISTORY] = _refusal(error)
            slow_fit.load(History(), None, curves)
            self.estimator.discard_rows()
            slow_fit.resume(gap_s, restored=restored)


def _try_convert(name: str, convert: Callable[[], T], outcomes: dict[str, str]) -> T | None:
    """Return the result of ``convert``; None with an outcome if the arrays of a part are damaged."""
    try:
        return convert()
    except Exception as error:  # noqa: BLE001 - a damaged file must not end the service at each start
        outcomes[name] = _refusal(error)
        return None


def _refusal(error: Exception) -> str:
    """Return the outcome of a part whose arrays are damaged."""
    kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
    return f"{REFUSED}{kind}{error}"


def new_pack(
    settings: Settings,
    model: PackModel,
    *,
    submit: Submit = run_now,
    on_failure: Callable[[BaseException], None] = lambda _: None,
    has_forecasts: bool = True,
) -> Pack:
    """Return a new pack, after compiling or loading the kernels of its estimator.

    Args:
        settings: The pack's settings.
        model: Model of the whole pack.
        submit: Runs a fit. By default the fit runs at once, and the samples wait for it.
        on_failure: Called with the exception of a failed fit.
        has_forecasts: False: no forecasts at intervals.

    Raises:
        UserError: The cut-off voltage is not below the voltage of the full pack.
    """

    def slow_fit(estimator: Estimator, interval_s: float) -> SlowFit:
        return SlowFit(estimator, submit=submit, interval_s=interval_s, on_failure=on_failure)

    return assemble(compiled_estimator(settings, model), settings, slow_fit, has_forecasts=has_forecasts)


def assemble(
    estimator: Estimator,
    settings: Settings,
    new_fit: Callable[[Estimator, float], SlowFit],
    *,
    has_forecasts: bool = True,
    has_load: bool = True,
) -> Pack:
    """Return the pack of an estimator. A fuel cell, and a pack without the identifier, has neither slow fit nor forecasts.

    Args:
        estimator: Estimator of the pack.
        settings: The pack's settings.
        new_fit: Returns the slow fit of an estimator with a maximum interval between two fits [s].
        has_forecasts: False: no forecasts at intervals.
        has_load: False: the load is not observed, so that there is no forecaster.

    Raises:
        UserError: The cut-off voltage is not below the voltage of the full pack.
    """
    slow_fit = forecaster = None
    if estimator.has_filter and settings.identifier.pack_model:
        slow_fit = new_fit(estimator, settings.identifier.fit_interval_s or FIT_INTERVAL_S)
    if has_load and estimator.has_filter:
        cell = estimator.cell.battery("the identifier is of batteries")
        forecaster = Forecaster(estimator, cutoff_v=forecast_end_v(settings, cell), limits=power_limits(settings, cell))
    device_soc_std = settings.pack.device_soc_std if estimator.has_filter else None
    return Pack(
        estimator,
        slow_fit,
        CellEstimator(estimator),
        forecaster,
        has_forecasts=has_forecasts,
        device_soc_std=device_soc_std,
    )
