"""Estimator of one pack: kernel settings and state with the methods ``step`` and ``run``."""

import math
from copy import copy
from typing import Self

import numpy as np

from bms_estimator.estimator.anchor_settings import between_limits
from bms_estimator.estimator.fitted_state import FittedState, return_to_cell_file, use_curves, write_fitted_state
from bms_estimator.estimator.settings_records import estimator_settings
from bms_estimator.kernels import step as kernel
from bms_estimator.kernels.accumulators.history import HISTORY_ROW, add_reference, complete_row
from bms_estimator.kernels.kalman_filter.anchors import NO_ANCHOR, apply_prior
from bms_estimator.kernels.kalman_filter.hypotheses import USER_SOC_STD, set_soc, weakest_cell_soc_std
from bms_estimator.kernels.kalman_filter.input_checks import FITTED_FAULTS, UNUSABLE, store_last_good_state
from bms_estimator.kernels.observer.records import OBSERVER_STATE
from bms_estimator.kernels.records import ESTIMATOR_STATE, TRACE
from bms_estimator.kernels.step import SampleOutcome
from bms_estimator.model.arrays import SAMPLE, Records, SampleBlock
from bms_estimator.model.columns import Columns
from bms_estimator.model.pack_model import PackModel
from bms_estimator.settings.observer import (
    BOARD,
    EXACT,
    NO_LIMITS,
    ChargeLimits,
    IdentifierSettings,
    ObserverSettings,
    Sampling,
)
from bms_estimator.settings.pack import Settings

TraceBlock = Records
"""Shape (n,), dtype ``TRACE``: one row for each accepted sample."""
SAMPLE_OUTCOMES = tuple(SampleOutcome)
"""Outcomes by their integer values. Indexing a tuple is faster than ``SampleOutcome(value)``, which takes nearly as long as
the kernel."""
_DROPPED = tuple(name for name in OBSERVER_STATE.names or () if name.startswith("dropped_"))
OBSERVER_COUNTERS = ("samples", "gaps", "time_steps_back", "lock_losses", "gain_rearms", *_DROPPED)
"""Fields of the observer's state that count since start."""
DEFAULT_IDENTIFIER = IdentifierSettings()
"""Default settings of the identifier."""


class Estimator:
    """Estimator of SOC, parameters and stability margin of one pack, sample by sample.

    ``run`` on a block and ``step`` on each of its samples leave the same state to the last bit.

    Args:
        cell: The pack as one two-terminal object (``CellModel.pack``). A fuel cell has no SOC (NaN), and its
            parameters are learned with any ``observer.law``.
        observer: The adaptive observer's settings.
        identifier: Settings of the identifier, the Kalman filter; None: only the adaptive observer runs.
        voltage_resolution_v: One step of the voltage converter, at the pack's terminals [V].
        voltage_noise_v: Standard deviation of a voltage sample [V]; None: half of ``voltage_resolution_v``.
        initial_soc: SOC 0..1 at the first sample; None: from the voltage of the first sample by the OCV.
        sampling: Resolution, period and gain errors of the source; default: those of a board, with exact gains.
        limits: Limits of charger and protection; default: those of the cell file.

    Attributes:
        record: Shape (1,), dtype ``ESTIMATOR_STATE``: the complete state, which can be copied, saved and restored.
        settings_record: Shape (1,), dtype ``ESTIMATOR_SETTINGS``.
        cell_file_settings: Copy of the filter's part of ``settings_record``, dtype ``EKF_SETTINGS``, with the curves of the
            cell file. The slow fit (``bms_estimator.pack_model``) changes the curves in ``settings_record``.
        state: The observer's part of ``record``, shape (1,), dtype ``OBSERVER_STATE``.
        settings: The observer's part of ``settings_record``, shape (1,), dtype ``OBSERVER_SETTINGS``.
    """

    def __init__(
        self,
        cell: PackModel,
        observer: ObserverSettings | None = None,
        *,
        identifier: IdentifierSettings | None = DEFAULT_IDENTIFIER,
        voltage_resolution_v: float = 1e-3,
        voltage_noise_v: float | None = None,
        initial_soc: float | None = None,
        sampling: Sampling = EXACT,
        limits: ChargeLimits = NO_LIMITS,
    ) -> None:
        self.cell = cell.by_kind(lambda battery: between_limits(battery, limits), lambda stack: stack)
        self.settings_record = estimator_settings(
            self.cell,
            observer or ObserverSettings(),
            identifier or IdentifierSettings(enabled=False),
            voltage_resolution_v=voltage_resolution_v,
            voltage_noise_v=voltage_noise_v,
            initial_soc=initial_soc,
            sampling=sampling,
            limits=limits,
        )
        self.settings: Records = self.settings_record["observer"]
        self.cell_file_settings: np.void = self.settings_record[0]["filter"].copy()
        self.record: Records = np.zeros(1, dtype=ESTIMATOR_STATE)
        self.state: Records = self.record["observer"]
        self._trace: TraceBlock = np.zeros(0, dtype=TRACE)

    def bound_to_record(self, record: Records) -> Self:
        """Return an estimator that shares the settings and works on ``record``, shape (1,), dtype ``ESTIMATOR_STATE``."""
        other = copy(self)
        other.record, other.state = record, record["observer"]
        other._trace = np.zeros(0, dtype=TRACE)  # noqa: SLF001 - an instance of this class
        return other

    def copy(self) -> Self:
        """Return an independent copy in the present state, with the present curves."""
        other = self.bound_to_record(self.record.copy())
        other.settings_record = self.settings_record.copy()
        other.settings = other.settings_record["observer"]
        return other

    def step(
        self, time_s: float, current_a: float, voltage_v: float, status: int = 0, temperature_c: float = math.nan
    ) -> SampleOutcome:
        """Process one sample.

        Args:
            time_s: Time stamp [s].
            current_a: Current [A], positive on discharge.
            voltage_v: Terminal voltage [V].
            status: Bits of ``SampleStatus``.
            temperature_c: Temperature of the cell [C]; NaN without a sensor.

        Returns:
            ``SampleOutcome.ACCEPTED``, or the reason for a rejection. The state counts each outcome.
        """
        return SAMPLE_OUTCOMES[
            kernel.step(self.record, self.settings_record, time_s, current_a, voltage_v, status, temperature_c)
        ]

    def run(self, block: SampleBlock) -> TraceBlock:
        """Process a block of samples, dtype ``SAMPLE``.

        Returns:
            One row for each accepted sample. The array is valid until the next call.
        """
        if self._trace.size < block.size:
            self._trace = np.zeros(block.size, dtype=TRACE)
        return self._trace[: self.run_part(block, self._trace)[1]]

    def run_part(self, block: SampleBlock, trace: TraceBlock) -> tuple[int, int]:
        """Process samples until the caller must take history rows or handle an event, or to the end of the block.

        Args:
            block: Samples.
            trace: At least as long as ``block``; a row is written for each accepted sample.

        Returns:
            Number of samples processed, and number of rows written.
        """
        return kernel.run(self.record, self.settings_record, block, trace)

    @property
    def has_filter(self) -> bool:
        """True if the identifier, an extended Kalman filter, is enabled."""
        return bool(self.settings_record["identify"][0])

    @property
    def soc(self) -> float:
        """State of charge after the last accepted sample, 0..1; NaN before the first one, and for a fuel cell."""
        return float(self.state["soc"][0]) if self.state["started"][0] else math.nan

    @property
    def weakest_cell_soc_std(self) -> float:
        """Standard deviation of the weakest cell about ``soc``, which includes the imbalance; NaN without the identifier."""
        if not (self.has_filter and self.state["started"][0]):
            return math.nan
        return float(weakest_cell_soc_std(self.record[0]["filter"], self.settings_record[0]["filter"]))

    def set_soc(self, soc: float) -> None:
        """Set the state of charge. Later voltages may correct it. Call this after the first sample.

        Raises:
            ValueError: ``soc`` is outside 0..1, or the estimator is of a fuel cell, which has no SOC.
        """
        if self.cell.capacity_ah is None:
            raise ValueError("a fuel cell has no SOC")
        if not 0.0 <= soc <= 1.0:
            raise ValueError(f"SOC {soc} is outside 0..1")
        self.state["soc"] = self.state["soc_coulomb"] = soc
        if self.has_filter:
            f, c = self.record[0]["filter"], self.record[0]["checks"]
            set_soc(f, self.settings_record[0]["filter"], soc)
            add_reference(self.record[0]["history"], NO_ANCHOR, soc, USER_SOC_STD)
            c["outliers"] = 0.0  # a wrong SOC may have caused them
            if not c["suspects"] & UNUSABLE:
                # no previous sample: if the sensor freezes now, the SOC before this call must not be restored
                c["last_v"] = 0.0
            store_last_good_state(c, f)

    def add_prior(self, soc: float, std: float) -> None:
        """Correct the SOC of a new pack by the SOC 0..1 that its device reports, with a std, after the first sample."""
        f, c = self.record[0]["filter"], self.record[0]["checks"]
        apply_prior(f, soc, std)
        self.state["soc"] = f["soc"]
        store_last_good_state(c, f)

    def use_curves(self, settings: np.void) -> None:
        """Use the curves of another record of dtype EKF_SETTINGS. R_s in ohm does not change."""
        use_curves(self.record[0]["filter"], self.settings_record["filter"], settings)

    def return_to_cell_file(self) -> None:
        """Use the curves of the cell file again. SOC, capacity and the present resistances do not change."""
        f, c = self.record[0]["filter"], self.record[0]["checks"]
        return_to_cell_file(f, self.settings_record["filter"], self.cell_file_settings)
        if f["started"]:
            store_last_good_state(c, f)

    def adopt(self, state: FittedState) -> None:
        """Replace the filter's state by the results of a fit, whose curves are in use."""
        f = self.record[0]["filter"]
        write_fitted_state(f, self.settings_record[0]["filter"], state)
        if state.soc is not None:
            self.state["soc"] = f["soc"]
        if state.is_exchanged:
            f["exchanged"] = 1  # raises the input diagnostic of an exchange
        checks = self.record[0]["checks"]
        checks["suspects"] = checks["suspects"] & ~FITTED_FAULTS | state.faults
        store_last_good_state(checks, f)

    def load_exact(self, record: Records, settings_record: Records) -> None:
        """Restore copies of ``record`` and ``settings_record``, bit by bit."""
        self.record[...], self.settings_record[...] = record, settings_record

    def schedule(self, event_s: float) -> None:
        """Record history rows, and let ``run_part`` stop at a time on the clock of the history [s]; infinite: never."""
        h = self.record[0]["history"]
        h["enabled"], h["event_s"] = 1, event_s

    def take_rows(self) -> Records:
        """Remove the completed history rows from the record, and return them."""
        h = self.record[0]["history"]
        rows: Records = h["rows"][: int(h["count"])].copy()
        if rows.size:
            h["count"] = 0
            h["rows"] = np.zeros(1, HISTORY_ROW)  # stale rows would depend on the division of the samples into blocks
        return rows

    def discard_rows(self) -> None:
        """Discard all history rows, also the present one."""
        self.record["history"]["count"] = self.record["history"]["sums"]["duration_s"] = 0

    def complete_rows(self) -> Records:
        """Complete the present history row, and return a copy of all rows of the record."""
        h = self.record[0]["history"]
        complete_row(h)
        rows: Records = h["rows"][: int(h["count"])].copy()
        return rows

    def begin_segment(self, elapsed_s: float, segment: float, gap_s: float) -> None:
        """Begin a segment of the history without rows.

        Args:
            elapsed_s: Minimum time on the clock of the history [s].
            segment: Minimum number of the previous segment.
            gap_s: Time since the previous segment [s]; infinite if unknown.
        """
        h = self.record[0]["history"]
        h["elapsed_s"], h["segment"] = max(h["elapsed_s"], elapsed_s), max(h["segment"], segment) + 1
        h["gap_s"] = gap_s
        h["count"] = h["direction"] = h["direction_s"] = h["charge_as"] = h["charge_variance_as2"] = 0
        h["throughput_soc"] = h["row_as"] = h["hysteresis"] = 0.0

    def forget(self) -> None:
        """Return to the cell file and to the state before the first sample, for another pack. ``OBSERVER_COUNTERS`` remain."""
        self.return_to_cell_file()
        counters = {name: self.state[name].copy() for name in OBSERVER_COUNTERS}
        self.record[...] = np.zeros(1, ESTIMATOR_STATE)
        for name, count in counters.items():
            self.state[name] = count

    def resume(self, unseen_s: float) -> None:
        """Prepare for samples with another time base, after a gap without measurements.

        Args:
            unseen_s: Duration of the gap before the next sample [s]; infinite if unknown. The load may have changed in
                the gap.
        """
        # inf: the next time step is not computed from the time of the last sample
        self.state["time_s"], self.record["unseen_s"] = np.inf, unseen_s
        if self.has_filter:
            self.record["filter"]["soc"] = self.state["soc"]
            self.record["filter"]["smallest_a"] = 0.0  # the resolution is measured again

    def extend_gap(self, wait_s: float) -> None:
        """Extend the gap of ``resume`` by a further time without samples [s]."""
        self.record["unseen_s"] += wait_s
        self.record["history"]["gap_s"] += wait_s


def make_estimator(settings: Settings, cell: PackModel) -> Estimator:
    """Create the estimator of a pack.

    Args:
        settings: Settings of the pack.
        cell: Model of the whole pack.
    """
    return Estimator(
        cell,
        settings.observer,
        identifier=settings.identifier,
        voltage_resolution_v=settings.sensor.voltage_resolution_v,
        voltage_noise_v=settings.sensor.voltage_noise_v,
        initial_soc=settings.pack.initial_soc,
        sampling=settings.sampling,
        limits=settings.charge_limits,
    )


def compiled_estimator(settings: Settings, cell: PackModel) -> Estimator:
    """Create the estimator of a pack after compiling or loading all kernels, so that no sample waits for a compilation."""
    make_estimator(settings, cell).run(np.zeros(1, dtype=SAMPLE))
    return make_estimator(settings, cell)


def estimate(
    capture: Columns, cell: PackModel, *, initial_soc: float | None = None, voltage_resolution_v: float = 1e-3
) -> Columns:
    """Estimate a whole capture with default settings.

    For other settings, use ``Columns(Estimator(cell, ...).run(capture.rows))``.

    Args:
        capture: Rows of dtype ``SAMPLE``.
        cell: The pack as one two-terminal object (``CellModel.pack``).
        initial_soc: SOC 0..1 at the first sample; None: from the voltage of the first sample by the OCV.
        voltage_resolution_v: One step of the capture's voltage [V].

    Returns:
        The columns of dtype ``TRACE``, one row for each accepted sample: ``soc`` with ``soc_std``, the circuit elements
        with their standard deviations, and the observer's values. Unknown values are NaN.
    """
    estimator = Estimator(cell, initial_soc=initial_soc, voltage_resolution_v=voltage_resolution_v, sampling=BOARD)
    return Columns(estimator.run(capture.rows), capture.name)
