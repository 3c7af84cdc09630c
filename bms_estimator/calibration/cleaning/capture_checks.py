"""Checks of a capture against the cell file that it is used with, and its SOC at the first sample."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from bms_estimator.calibration.cleaning.clean_capture import REST_C_RATE, SOC_SLACK, CleanCapture, true_runs
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv, r_s, soc_from_ocv
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, generic_cells, load_cell
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.model.charge_count import MIN_GAP_PERIODS, smaller_current_a

FULL_SOC = 0.97
"""Minimum SOC from the voltage of the first rest at which the cell counts as full. Rested full cells of one type differ by some
30 mV, and cells rest 20 to 50 mV below the voltage at the end of their charge."""
MAX_RANGE = 0.3
"""Maximum width of the range of SOCs that fit a voltage, if the voltage determines the SOC. With generic cells the width is
about 0.2 without a plateau, and 0.6 on the plateau of LFP."""
CURVE_STD_V = 0.005
"""Standard deviation of an OCV curve without an error column, per cell [V]."""
SAME_START_V = 0.02
"""Maximum difference of the first rests of captures that start at the same SOC, per cell [V]. Full charges vary by as
much."""
MAX_EXCESS = 0.1
"""Maximum discharged charge above the initial charge that the voltage indicates, as a fraction of the capacity. A larger excess
shows that the OCV curve is of another chemistry."""
MAX_MEDIAN_DIFFERENCE_V = 0.15
"""Maximum difference between the median voltage of a capture and the OCV at SOC 0.5 of a cell of its chemistry [V]."""


class StartOrigin(Enum):
    """Origin of the SOC at the first sample."""

    GIVEN = auto()
    FULL = auto()
    VOLTAGE = auto()
    UNKNOWN = auto()


@dataclass(frozen=True)
class StartSoc:
    """SOC at the first sample of a capture.

    Attributes:
        soc: SOC 0..1; NaN if the voltage does not determine it.
        origin: Origin of ``soc``.
        full_v: Minimum voltage of a full cell at rest, or at the beginning of a slow discharge [V].
        reason: Voltage of the first rest and the SOCs that it allows, as text.
    """

    soc: float = 1.0
    origin: StartOrigin = StartOrigin.GIVEN
    full_v: float = math.inf
    reason: str = ""

    @property
    def is_exact(self) -> bool:
        """True if the SOC was given, or the cell is full."""
        return self.origin in (StartOrigin.GIVEN, StartOrigin.FULL)


def starts_of(captures: Sequence[CleanCapture], cell: CellModel, initial_soc: float | None = None) -> list[StartSoc]:
    """Return the SOC at the first sample of each capture.

    Args:
        captures: Captures of one cell.
        cell: Cell whose OCV gives the SOC of a rest.
        initial_soc: SOC 0..1 of the captures that start at the highest voltage; None: their voltages determine it.
    """
    highest_v = max(capture.start_v for capture in captures) - SAME_START_V * cell.cell.series_count
    return [_start_of(capture, cell, initial_soc if capture.start_v >= highest_v else None) for capture in captures]


def initial_soc(capture: CleanCapture, cell: CellModel) -> float:
    """Return the SOC whose OCV is the voltage of the first rest or, without a rest, the first voltage plus i R_s."""
    return soc_from_ocv(_open_circuit_v(capture, cell), *ocv_grid(cell))


def undetermined_start(capture: CleanCapture, cell: CellModel) -> str | None:
    """Return the SOCs that the voltage of the first rest allows, as text; None if it determines the SOC."""
    low, high = _soc_range(capture, cell)
    return _range_text(capture, low, high) if high - low > MAX_RANGE else None


def _start_of(capture: CleanCapture, cell: CellModel, given: float | None) -> StartSoc:
    """Return the given SOC or, if None, the SOC from the first voltage."""
    low, high = _soc_range(capture, cell)
    soc, full_v = initial_soc(capture, cell), ocv(FULL_SOC, *ocv_grid(cell))
    reason = _range_text(capture, low, high)
    if given is not None:
        return StartSoc(given, StartOrigin.GIVEN, full_v, reason)
    if soc >= FULL_SOC or _is_full_of_another_chemistry(capture, cell, soc):
        return StartSoc(1.0, StartOrigin.FULL, min(full_v, capture.start_v), reason)
    if high - low > MAX_RANGE:
        return StartSoc(math.nan, StartOrigin.UNKNOWN, full_v, reason)
    return StartSoc(soc, StartOrigin.VOLTAGE, full_v, reason)


def _is_full_of_another_chemistry(capture: CleanCapture, cell: CellModel, soc: float) -> bool:
    """Return True if the capture draws more charge than ``soc`` allows, and its voltages fit a full generic cell."""
    capacity_ah, series = cell.cell.capacity_ah, cell.cell.series_count
    if capture.discharged_ah.max() < (soc + MAX_EXCESS) * capacity_ah:
        return False
    median_v = float(np.median(capture.voltage_v))
    grids = [ocv_grid(load_cell(name, capacity_ah).pack(series, 1)) for name in generic_cells()]
    return any(
        soc_from_ocv(capture.start_v, *grid) >= FULL_SOC
        and abs(median_v - ocv(0.5, *grid)) < MAX_MEDIAN_DIFFERENCE_V * series
        for grid in grids
    )


def _open_circuit_v(capture: CleanCapture, cell: CellModel) -> float:
    current_a = 0.0 if capture.resting_samples else float(capture.current_a[0])
    return capture.start_v + current_a * r_s(0.5, cell.a)


def _soc_range(capture: CleanCapture, cell: CellModel) -> tuple[float, float]:
    """Return the lowest and the highest SOC whose OCV agrees with the first voltage within the OCV's error and hysteresis."""
    grid_v = ocv_grid(cell)[0]
    soc = np.linspace(0.0, 1.0, grid_v.size)
    tolerance_v = np.full(soc.size, CURVE_STD_V * cell.cell.series_count)
    if isinstance(cell.ocv, TableOcv):
        if cell.ocv.error_v is not None:
            tolerance_v = np.interp(soc, cell.ocv.soc, cell.ocv.error_v)
        if cell.ocv.hysteresis_v is not None:
            tolerance_v += np.interp(soc, cell.ocv.soc, cell.ocv.hysteresis_v)
    allowed = soc[np.abs(grid_v - _open_circuit_v(capture, cell)) <= tolerance_v]
    nearest = initial_soc(capture, cell)
    return min(nearest, float(allowed.min(initial=1.0))), max(nearest, float(allowed.max(initial=0.0)))


def _range_text(capture: CleanCapture, low: float, high: float) -> str:
    begins = "its first rest" if capture.resting_samples else "its first sample"
    return f"{begins} at {capture.start_v:.3f} V fits SOC {low:.2f} to {high:.2f}"


MIN_PEAK_C_RATE = 0.1
"""Minimum peak C-rate of a capture that determines resistances [1/h]. A capture with a smaller one is useful only to
`ocv`."""
STEP_FRACTION = 0.1
"""Minimum change of current between two samples of a current step, as a fraction of the capture's largest current."""
MAX_STEP_S = 3.0
"""Maximum time between the two samples of a current step [s]. Later samples include relaxation beside the ohmic
step."""
MIN_STEPS = 5
"""Minimum number of current steps whose median determines the sign of the current."""
LONG_REST_S = 300.0
"""Duration of a rest after which the voltage is near the OCV [s]."""
MAX_SOC_DEVIATION = 0.1
"""Maximum deviation of the SOC from a rested voltage from the counted SOC. It is an error only if
``MAX_VOLTAGE_DEVIATION_V`` is exceeded as well; both together are more than errors of the model explain."""
MAX_VOLTAGE_DEVIATION_V = 0.1
"""Maximum deviation of a rested voltage from the OCV at the counted SOC, per cell [V]."""
MIN_GAP_CHARGE = 0.01
"""Minimum charge that the smaller of the currents before and after a gap would draw over it, as a fraction of the capacity."""
MIN_DURATION_S = 30.0
"""Minimum duration of a capture [s]."""
MIN_RESPONSE_V = 1e-3
"""Minimum change of a real cell's voltage at a current step of 1 C, per cell [V]. Most cells change by 20 to 100 mV."""
MIN_SOC_CHANGE = 0.05
"""Minimum change of SOC over which the trend of the voltage shows the sign of the current."""


def capture_contradictions(capture: CleanCapture, cell: CellModel, initial_soc: float) -> list[str]:
    """Return one line on the first contradiction, with a remedy, or an empty list.

    Later contradictions are usually consequences of the first.

    Args:
        capture: The capture.
        cell: Cell of the cell file.
        initial_soc: SOC at the first sample, 0..1.
    """
    contradiction = (
        _too_short(capture)
        or _no_excitation(capture, cell)
        or _wrong_sign(capture, cell)
        or _unresponsive_voltage(capture, cell)
        or _gap_with_charge(capture, cell)
        or _wrong_capacity(capture, cell, initial_soc)
    )
    return [f"{capture.name}: {contradiction}"] if contradiction else []


def without_excitation(capture: CleanCapture, cell: CellModel) -> bool:
    """Return True if the current is too small to determine the resistances."""
    return _no_excitation(capture, cell) is not None


def step_resistance(capture: CleanCapture) -> float | None:
    """Return the median of -dV/dI over the current steps [ohm]; negative for a wrong sign, None for too few steps."""
    change_a = np.diff(capture.current_a)
    largest_a = float(np.abs(capture.current_a).max(initial=0.0))
    steps = (np.abs(change_a) > STEP_FRACTION * largest_a) & (np.diff(capture.time_s) <= MAX_STEP_S)
    steps &= ~(capture.mismatched[:-1] | capture.mismatched[1:])
    if steps.sum() < MIN_STEPS:
        return None
    return float(np.median(-np.diff(capture.voltage_v)[steps] / change_a[steps]))


def soc_outside(capture: CleanCapture, cell: CellModel, initial_soc: float) -> str | None:
    """Return a message if SOC, counted from ``initial_soc``, leaves 0..1; None if it stays within."""
    capacity_ah = cell.cell.capacity_ah
    soc = initial_soc - capture.discharged_ah / capacity_ah
    slack = 2.0 * SOC_SLACK
    if soc.min() >= -slack and soc.max() <= 1.0 + slack:
        return None
    return (
        f"SOC runs from {soc.min():.3f} to {soc.max():.3f}, outside 0..1: from {initial_soc:.3f} at the start "
        f"({capture.start_v:.3f} V), {np.ptp(capture.discharged_ah):.3f} Ah were moved with a capacity of "
        f"{capacity_ah:g} Ah; give {_start_remedy(capture, cell)}the right capacity (--capacity-ah), or the OCV of this cell"
    )


def _start_remedy(capture: CleanCapture, cell: CellModel) -> str:
    """Return the remedy for a first rest on a plateau of the OCV, which does not determine the SOC; otherwise an empty text."""
    undetermined = undetermined_start(capture, cell)
    return f"the SOC at the start (--soc), because {undetermined}; or " if undetermined else ""


def _too_short(capture: CleanCapture) -> str | None:
    if capture.time_s[-1] >= MIN_DURATION_S:
        return None
    return f"it lasts {capture.time_s[-1]:.3g} s, at least {MIN_DURATION_S:g} s are needed: check that time_s is in seconds"


def _no_excitation(capture: CleanCapture, cell: CellModel) -> str | None:
    largest_a = float(np.abs(capture.current_a).max())
    min_a = MIN_PEAK_C_RATE * cell.cell.capacity_ah
    if largest_a >= min_a:
        return None
    return (
        f"no excitation: the current never exceeds {largest_a:.4f} A in {capture.time_s[-1] / 3600.0:.2f} h, and at least "
        f"{min_a:.4f} A ({MIN_PEAK_C_RATE:g} C) is needed; record a load with steps and rests"
    )


def _wrong_sign(capture: CleanCapture, cell: CellModel) -> str | None:
    """Return a message if the voltage shows the wrong sign of the current, by its steps or by the trend over SOC."""
    ohm = step_resistance(capture)
    if ohm is not None and ohm < 0.0:
        return (
            f"the current's sign is wrong: at its steps the voltage rises with the current, by {-1e3 * ohm:.1f} mV per "
            "ampere (median); discharge must be positive (--current-sign)"
        )
    soc = -capture.discharged_ah / cell.cell.capacity_ah
    if ohm is None and np.ptp(soc) > MIN_SOC_CHANGE and np.cov(soc, capture.voltage_v)[0, 1] < 0.0:
        return (
            f"the current's sign is wrong: {capture.discharged_ah[-1]:.3f} Ah drawn while the voltage went from "
            f"{capture.voltage_v[0]:.3f} to {capture.voltage_v[-1]:.3f} V; discharge must be positive (--current-sign)"
        )
    return None


def _unresponsive_voltage(capture: CleanCapture, cell: CellModel) -> str | None:
    ohm, min_ohm = step_resistance(capture), MIN_RESPONSE_V * cell.cell.series_count / cell.cell.capacity_ah
    if np.ptp(capture.voltage_v) == 0.0:
        response = "is constant"
    elif ohm is not None and ohm < min_ohm:
        response = f"changes by {1e3 * ohm:.3f} mV per ampere at the current's steps (median)"
    else:
        return None
    return f"the voltage {response}, so it does not belong to this current; check the column for repeated old values"


def _gap_with_charge(capture: CleanCapture, cell: CellModel) -> str | None:
    """Return a message on the first gap over which an unknown charge flowed.

    A current that ended or changed its sign in the gap counts as no charge. If charge flowed nevertheless, the voltages of
    later rests contradict the counted SOC.
    """
    step_s = np.diff(capture.time_s)
    charge_ah = np.abs(smaller_current_a(capture.current_a)) * step_s / 3600.0
    gaps = (step_s > MIN_GAP_PERIODS * np.median(step_s)) & (charge_ah > MIN_GAP_CHARGE * cell.cell.capacity_ah)
    if not gaps.any():
        return None
    j = int(np.argmax(gaps))
    return (
        f"a gap of {step_s[j]:.0f} s at {capture.time_s[j]:.0f} s, under {capture.current_a[j]:.3f} A: the charge drawn in it "
        f"is unknown (up to {charge_ah[j]:.3f} Ah); cut the capture there and give its parts"
    )


def _wrong_capacity(capture: CleanCapture, cell: CellModel, initial_soc: float) -> str | None:
    """Return a message if the counted SOC leaves 0..1 or contradicts the voltage of a long rest."""
    capacity_ah, grid = cell.cell.capacity_ah, ocv_grid(cell)
    outside = soc_outside(capture, cell, initial_soc)
    if outside:
        return outside
    soc = initial_soc - capture.discharged_ah / capacity_ah
    for j in ends_of_long_rests(capture.time_s, capture.current_a, capacity_ah):
        rested_v = float(capture.voltage_v[j])
        expected_v, rested_soc = ocv(soc[j], *grid), soc_from_ocv(rested_v, *grid)
        if (
            abs(rested_v - expected_v) > MAX_VOLTAGE_DEVIATION_V * cell.cell.series_count
            and abs(rested_soc - soc[j]) > MAX_SOC_DEVIATION
        ):
            return (
                f"charge and voltage disagree: after {capture.discharged_ah[j]:.3f} Ah, at rest at {capture.time_s[j]:.0f} s, "
                f"SOC is {soc[j]:.3f} by the charge and a capacity of {capacity_ah:g} Ah, but {rested_soc:.3f} by "
                f"{rested_v:.3f} V; give {_start_remedy(capture, cell)}the right capacity, or find this cell's OCV with `ocv`"
            )
    return None


def ends_of_long_rests(time_s: Floats, current_a: Floats, capacity_ah: float) -> list[int]:
    """Return the index of the last sample of each rest longer than ``LONG_REST_S``."""
    resting = np.abs(current_a) < REST_C_RATE * capacity_ah
    return [end - 1 for first, end in true_runs(resting) if time_s[end - 1] - time_s[first] > LONG_REST_S]
