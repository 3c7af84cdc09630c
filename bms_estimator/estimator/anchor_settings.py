"""Ends of charge and discharge: settings record of the anchors, and generic curves between the voltages of these ends."""

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.cell_model.chen_mora import OCV_POINTS
from bms_estimator.kernels.kalman_filter.anchors import ANCHOR_SETTINGS, FULL_STD
from bms_estimator.kernels.kalman_filter.ekf import INDEPENDENT_R_STD
from bms_estimator.model.cell import CellModel
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.model.monotone_cubic import MonotoneCubic
from bms_estimator.settings.observer import ChargeLimits

VOLTAGE_ERROR = 0.005
"""Relative error of the voltage of charger and source. A BMS seldom measures the voltage of a pack more accurately."""
NEARLY_FULL_SOC = 0.995
"""SOC whose OCV limits the default full voltage. On a steep curve, ``VOLTAGE_ERROR`` alone would give too high a voltage:
chargers of LFP cells end between 3.5 and 3.65 V, within 0.4 % of SOC."""
TAIL_C = 0.05
"""Default tail current, as a C-rate. At C/20 the overpotential is about 10 mV, which is 1 % of SOC in oxide cells."""
MAX_END_C = 0.125
"""Maximum current at which a charge may end with the default tail current, as a C-rate. Chargers end at C/50 to C/10."""
MAX_STEEP_END_C = 0.25
"""``MAX_END_C`` of a cell in which the overpotential of this current hides less than ``FULL_STD``, because the curve is steep
when full. The voltage of such a cell is constant for less than ``AT_FULL_S`` if a charge with C/5 ends at C/10."""
MAX_END_RATIO = 1.5
"""Maximum current at which a charge may end, in multiples of a configured tail current."""
TRICKLE_C = 0.01
"""Minimum charge current, as a C-rate. It exceeds the std of a current sensor's offset (``Noise.offset_c``). It is not C/50,
because an LG M50 charges another 0.8 % between C/50 and C/100."""
CUTOFF_MARGIN = 0.02
"""Relative margin of the cut-off voltage. Near empty the voltage falls by about 50 mV between two samples of a slow source, which
is less than 0.2 % of SOC."""
MIN_FULL_SOC = 0.98
"""Minimum SOC of the OCV curve at the full voltage for a correction of the filter: 2 std of the anchor below 1."""
MAX_EMPTY_SOC = 0.05
"""Maximum SOC of the OCV curve at the cut-off voltage for a correction of the filter: 1.5 std of the anchor at 25 C."""
MIN_USED_SOC = 0.5
"""Minimum SOC range of a generic curve between the configured voltages. In a smaller range, one of them is probably wrong."""


def between_limits(pack: CellModel, limits: ChargeLimits) -> CellModel:
    """Return a generic model with SOC 0 and 1 at the configured voltages of protection and charger.

    The declared capacity is that between these voltages. The file of a measured cell remains unchanged, because its capacity is
    that between its own end voltages.
    """
    ocv, ladder = pack.ocv, pack.ladder
    if ladder is None or ladder.std <= INDEPENDENT_R_STD or not isinstance(ocv, TableOcv):
        return pack
    curve = MonotoneCubic(ocv.soc, ocv.ocv_v)(np.linspace(0.0, 1.0, OCV_POINTS))
    low, high = soc_at_cutoff(curve, limits), soc_at_full(curve, limits)
    if high - low < MIN_USED_SOC or high - low == 1.0:
        return pack
    soc = np.array([0.0, *(s for s in (np.array(ocv.soc) - low) / (high - low) if 0.0 < s < 1.0), 1.0])
    generic_soc = low + (high - low) * soc
    columns = {
        name: tuple(np.interp(generic_soc, ocv.soc, column).tolist())
        for name in ("error_v", "hysteresis_v", "per_kelvin_v")
        if (column := getattr(ocv, name)) is not None
    }
    new_ocv = ocv.model_copy(
        update={
            "soc": tuple(soc.tolist()),
            "ocv_v": tuple(MonotoneCubic(ocv.soc, ocv.ocv_v)(generic_soc).tolist()),
            **columns,
        }
    )
    ladder_soc = np.linspace(0.0, 1.0, len(ladder.soc))
    generic_soc = low + (high - low) * ladder_soc
    rows = {
        name: tuple(tuple(np.interp(generic_soc, ladder.soc, row).tolist()) for row in getattr(ladder, name))
        for name in ("weak_ohm", "strong_ohm")
    }
    new_ladder = ladder.model_copy(update={"soc": tuple(ladder_soc.tolist()), **rows})
    return pack.model_copy(update={"ocv": new_ocv, "ladder": new_ladder})


def anchor_settings(
    pack: CellModel, ocv_v: NDArray[np.float64], max_ohm: float, limits: ChargeLimits, voltage_resolution_v: float
) -> NDArray[np.void]:
    """Return the settings record of the anchors.

    Args:
        pack: The pack as one two-terminal object.
        ocv_v: Open-circuit voltage from ``settings_records.ocv_grid`` [V].
        max_ohm: Total resistance at SOC 1 plus two std [ohm].
        limits: Limits of charger and protection.
        voltage_resolution_v: One step of the voltage converter, at the pack's terminals [V].

    Returns:
        Shape (1,), dtype ``ANCHOR_SETTINGS``.
    """
    record = np.zeros(1, dtype=ANCHOR_SETTINGS)
    p, one_c_a = record[0], pack.cell.capacity_ah
    full_v, max_v = limits.full_voltage_v, np.inf
    if full_v is None:
        full_v, max_v = ocv_v[-1], np.interp(NEARLY_FULL_SOC, _soc_grid(ocv_v), ocv_v)
    p["charger_v"] = full_v
    p["full_v"] = min((1.0 - VOLTAGE_ERROR) * full_v, max_v) - voltage_resolution_v
    p["corrects_full"] = soc_at_full(ocv_v, limits) >= MIN_FULL_SOC
    if limits.tail_current_a is None:
        steep_v = MAX_STEEP_END_C * one_c_a * max_ohm
        is_steep = ocv_v[-1] - np.interp(1.0 - FULL_STD, _soc_grid(ocv_v), ocv_v) >= steep_v
        p["tail_a"], p["small_a"] = TAIL_C * one_c_a, (MAX_STEEP_END_C if is_steep else MAX_END_C) * one_c_a
    else:
        p["tail_a"], p["small_a"] = limits.tail_current_a, MAX_END_RATIO * limits.tail_current_a
    p["trickle_a"] = min(TRICKLE_C * one_c_a, 0.5 * p["tail_a"])
    cutoff_v = ocv_v[0] if limits.cutoff_voltage_v is None else limits.cutoff_voltage_v
    p["cutoff_v"] = (1.0 + CUTOFF_MARGIN) * cutoff_v + voltage_resolution_v
    p["corrects_empty"] = soc_at_cutoff(ocv_v, limits) <= MAX_EMPTY_SOC
    return record


def soc_at_full(ocv_v: NDArray[np.float64], limits: ChargeLimits) -> float:
    """Return the SOC of the OCV curve at the full voltage."""
    return 1.0 if limits.full_voltage_v is None else float(np.interp(limits.full_voltage_v, ocv_v, _soc_grid(ocv_v)))


def soc_at_cutoff(ocv_v: NDArray[np.float64], limits: ChargeLimits) -> float:
    """Return the SOC of the OCV curve at the cut-off voltage."""
    cutoff_v = limits.cutoff_voltage_v
    return 0.0 if cutoff_v is None else float(np.interp(cutoff_v, ocv_v, _soc_grid(ocv_v)))


def _soc_grid(ocv_v: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linspace(0.0, 1.0, ocv_v.size)
