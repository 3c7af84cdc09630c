"""Contradictions between a capture and its alleged cell."""

import numpy as np

from bms_estimator.calibration.cleaning.clean_capture import CleanCapture
from bms_estimator.calibration.cleaning.rests import REST_CURRENT_C, SOC_SLACK, true_runs
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv, soc_from_ocv
from bms_estimator.model.cell import CellModel

MIN_CURRENT_C = 0.1
"""Maximum C-rate of a capture without information on resistances [1/h]; such a capture is for `ocv`."""
STEP_SHARE = 0.1
"""Change of current between two samples that counts as a step, of the capture's largest current."""
STEP_S = 3.0
"""Two samples further apart do not show the ohmic step [s]."""
MIN_STEPS = 5
"""Fewer steps do not show the sign."""
LONG_REST_S = 300.0
"""Length of a rest after which the voltage is near the OCV [s]."""
SOC_OFF, VOLTAGE_OFF_V = 0.1, 0.1
"""A rested voltage this far off the OCV at the counted SOC, in SOC and per cell in volts, cannot be the model's error."""
GAP_STEPS, GAP_CHARGE = 10.0, 0.01
"""A step is a gap with unknown charge if it is this many times the median one and the current at its start would draw
this fraction of the capacity."""
MIN_S = 30.0
"""Minimum duration of a capture [s]."""
MIN_ANSWER_V = 1e-3
"""Minimum change of a real cell's voltage at current steps of 1 C, per cell [V]: most have 20 to 100 mV."""
MIN_SWEEP = 0.05
"""SOC that must have moved for the sign to show in the voltage's trend."""


def capture_contradictions(load: CleanCapture, cell: CellModel, start: float) -> list[str]:
    """One line with what to do; empty where all is well. The first one found explains the others.

    Args:
        load: The capture.
        cell: The alleged cell.
        start: SOC at the first sample, 0..1.
    """
    found = _short(load) or _no_excitation(load, cell) or _sign(load, cell) or _answer(load, cell) or _gap(load, cell)
    found = found or _capacity(load, cell, start)
    return [f"{load.name}: {found}"] if found else []


def without_excitation(load: CleanCapture, cell: CellModel) -> bool:
    """Return True if the current is too small to determine the resistances."""
    return _no_excitation(load, cell) is not None


def step_resistance(load: CleanCapture) -> float | None:
    """Median of -dV/dI over the steps of current [ohm], negative under a wrong sign; None with too few steps."""
    change_a = np.diff(load.current_a)
    largest_a = float(np.abs(load.current_a).max(initial=0.0))
    steps = (np.abs(change_a) > STEP_SHARE * largest_a) & (np.diff(load.time_s) <= STEP_S)
    if steps.sum() < MIN_STEPS:
        return None
    return float(np.median(-np.diff(load.voltage_v)[steps] / change_a[steps]))


def soc_outside(load: CleanCapture, capacity_ah: float, start: float) -> str | None:
    """Return how far SOC, counted from ``start``, leaves 0..1; None if it stays within."""
    soc = start - load.discharged_ah / capacity_ah
    if soc.min() >= -2.0 * SOC_SLACK and soc.max() <= 1.0 + 2.0 * SOC_SLACK:
        return None
    return (
        f"SOC runs from {soc.min():.3f} to {soc.max():.3f}, outside 0..1: from {start:.3f} at the start "
        f"({load.start_v:.3f} V), {np.ptp(load.discharged_ah):.3f} Ah were moved with a capacity of "
        f"{capacity_ah:g} Ah; give the right capacity, or the OCV of this cell"
    )


def _short(load: CleanCapture) -> str | None:
    if load.time_s[-1] >= MIN_S:
        return None
    return f"it lasts {load.time_s[-1]:.3g} s, which tells nothing of a battery: is time_s in seconds?"


def _no_excitation(load: CleanCapture, cell: CellModel) -> str | None:
    largest_a = float(np.abs(load.current_a).max())
    least_a = MIN_CURRENT_C * cell.cell.capacity_ah
    if largest_a >= least_a:
        return None
    return (
        f"no excitation: the current never exceeds {largest_a:.4f} A in {load.time_s[-1] / 3600.0:.2f} h, and at least "
        f"{least_a:.4f} A ({MIN_CURRENT_C:g} C) is needed; record a load with steps and rests"
    )


def _sign(load: CleanCapture, cell: CellModel) -> str | None:
    ohm = step_resistance(load)
    if ohm is not None and ohm < 0.0:
        return (
            f"the current's sign is wrong: at its steps the voltage rises with the current, by {-1e3 * ohm:.1f} mV per "
            "ampere (median); discharge must be positive (--current-sign)"
        )
    soc = -load.discharged_ah / cell.cell.capacity_ah
    if ohm is None and np.ptp(soc) > MIN_SWEEP and np.cov(soc, load.voltage_v)[0, 1] < 0.0:
        return (
            f"the current's sign is wrong: {load.discharged_ah[-1]:.3f} Ah drawn while the voltage went from "
            f"{load.voltage_v[0]:.3f} to {load.voltage_v[-1]:.3f} V; discharge must be positive (--current-sign)"
        )
    return None


def _answer(load: CleanCapture, cell: CellModel) -> str | None:
    ohm, least_ohm = step_resistance(load), MIN_ANSWER_V * cell.cell.series_count / cell.cell.capacity_ah
    if np.ptp(load.voltage_v) == 0.0:
        moves = "does not move"
    elif ohm is not None and ohm < least_ohm:
        moves = f"moves by {1e3 * ohm:.3f} mV per ampere at the current's steps (median)"
    else:
        return None
    return f"the voltage {moves}: it is not this current's; check the column, and that no old value was repeated"


def _gap(load: CleanCapture, cell: CellModel) -> str | None:
    step_s = np.diff(load.time_s)
    charge_ah = np.abs(load.current_a[:-1]) * step_s / 3600.0
    gaps = (step_s > GAP_STEPS * np.median(step_s)) & (charge_ah > GAP_CHARGE * cell.cell.capacity_ah)
    if not gaps.any():
        return None
    j = int(np.argmax(gaps))
    return (
        f"a gap of {step_s[j]:.0f} s at {load.time_s[j]:.0f} s, under {load.current_a[j]:.3f} A: the charge drawn in it "
        f"is unknown (up to {charge_ah[j]:.3f} Ah); cut the capture there and give its parts"
    )


def _capacity(load: CleanCapture, cell: CellModel, start: float) -> str | None:
    capacity_ah, grid = cell.cell.capacity_ah, ocv_grid(cell)
    outside = soc_outside(load, capacity_ah, start)
    if outside:
        return outside
    soc = start - load.discharged_ah / capacity_ah
    for j in _ends_of_long_rests(load, capacity_ah):
        rested_v = float(load.voltage_v[j])
        expected_v, seen = ocv(soc[j], *grid), soc_from_ocv(rested_v, *grid)
        if abs(rested_v - expected_v) > VOLTAGE_OFF_V * cell.cell.series_count and abs(seen - soc[j]) > SOC_OFF:
            return (
                f"charge and voltage disagree: after {load.discharged_ah[j]:.3f} Ah, at rest at {load.time_s[j]:.0f} s, "
                f"SOC is {soc[j]:.3f} by the charge and a capacity of {capacity_ah:g} Ah, but {seen:.3f} by "
                f"{rested_v:.3f} V; give the right capacity, or find this cell's OCV with `ocv`"
            )
    return None


def _ends_of_long_rests(load: CleanCapture, capacity_ah: float) -> list[int]:
    """Last sample of each rest longer than ``LONG_REST_S``."""
    resting = np.abs(load.current_a) < REST_CURRENT_C * capacity_ah
    return [end - 1 for first, end in true_runs(resting) if load.time_s[end - 1] - load.time_s[first] > LONG_REST_S]
