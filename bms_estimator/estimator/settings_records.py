"""Conversion of typed settings, and of a fuel cell's file, to the settings records of the kernels.

Numbers in parentheses are equations of the thesis.
"""

import math

import numpy as np

from bms_estimator.estimator.anchor_settings import anchor_settings
from bms_estimator.estimator.filter_settings import (
    LEAK_S,
    RATE_HZ,
    REACH,
    filter_settings,
    learning_settings,
    max_ohm,
    unmeasured_s,
)
from bms_estimator.kernels.cell_model.chen_mora import OCV_POINTS, PARAMETERS, emf, r_s, r_tl, r_ts
from bms_estimator.kernels.cell_model.current_interpolation import MAX_STEP_PERIODS
from bms_estimator.kernels.cell_model.fuel_cell import NAMES
from bms_estimator.kernels.observer.learning_law import Model
from bms_estimator.kernels.observer.mittag_leffler import decay_table, series_coefficients
from bms_estimator.kernels.observer.observer import Nussbaum
from bms_estimator.kernels.observer.records import LEARNING_SETTINGS, OBSERVER_SETTINGS
from bms_estimator.kernels.records import ESTIMATOR_SETTINGS
from bms_estimator.model.arrays import Floats, Records, exp
from bms_estimator.model.cell import CellModel, Rated
from bms_estimator.model.cell_sections import ChenMoraOcv
from bms_estimator.model.monotone_cubic import MonotoneCubic
from bms_estimator.model.pack_model import FuelCellModel, PackModel
from bms_estimator.settings.observer import (
    EXACT,
    NO_LIMITS,
    SCHEME_2_EPSILON,
    SCHEME_2_LAMBDA,
    ChargeLimits,
    IdentifierSettings,
    ObserverSettings,
    Sampling,
)

MEMORY_S = 60.0
"""Time constant with which the learning law of a stack discounts data [s]. Water and gas supply change within a minute."""
SETTLE_S = 5.0
"""Settling time of double layer and oxygen supply after an unmeasured gap [s]."""
MAX_FACTORS = {
    "r_ohm": 4.0,
    "tafel_slope_v": 1.5,
    "activation_v": 1.3,
    "c_dl_farad": 4.0,
    "concentration_v": 4.0,
    "limiting_current_a": 2.0,
    "internal_current_a": 4.0,
}
"""Maximum ratio of each parameter to its value in the file. The minimum ratio is the inverse. A factor of 1.3 on the
activation loss at 1 A corresponds to a factor of about 8 on the exchange current."""


def fuel_cell_settings(cell: FuelCellModel, observer_record: np.void) -> Records:
    """Return the learning law's settings record.

    The output error is not injected as a voltage offset, because a constant voltage error indicates the exchange current.

    Args:
        cell: The stack as one two-terminal object.
        observer_record: Record of dtype ``OBSERVER_SETTINGS``.

    Returns:
        Shape (1,), dtype ``LEARNING_SETTINGS``.
    """
    record = np.zeros(1, dtype=LEARNING_SETTINGS)
    q, n = record[0], len(NAMES)
    q["enabled"], q["model"], q["count"], q["file"] = 1, Model.FUEL_CELL, n, cell.a
    q["upper"][:n] = [math.log(MAX_FACTORS[name]) for name in NAMES]
    q["lower"] = -q["upper"]
    q["told_v"], q["cells"] = observer_record["epsilon_v"], cell.cell.series_count
    q["leak_v2s"][:n] = LEAK_S * float(q["told_v"]) ** 2 / q["upper"][:n] ** 2
    q["memory_s"], q["offset_s"], q["settle_s"] = MEMORY_S, math.inf, SETTLE_S
    q["rate"], q["reach"] = RATE_HZ, REACH
    q["soc_floor"] = -math.inf  # a fuel cell has no SOC
    return record


DEAD_ZONE_STEPS = 2.0
"""Default dead zone in steps of the voltage converter: half a step of rounding, half a step of noise, and a safety factor
of 2."""
LOCK_FRACTION = 0.02
"""Default error above which the observer loses the lock, as a fraction of the nominal voltage."""
MIN_LOCK_STEPS = 10.0
"""Minimum of the default error above which the observer loses the lock, in steps of the voltage converter."""
CONVERGED_ERROR = 2.0
"""Default error below which the observer counts as converged, in multiples of the larger of dead zone and converter step."""
GAP_S = 5.0
"""Duration of a step above which it counts as a gap [s]; for a slow source, ``MAX_STEP_PERIODS`` of its periods."""
MAX_UNCHECKED_C = 0.5
"""Maximum change of the current that is not checked by the voltage, as a C-rate. The charge of a wrong sample is small."""
MAX_UNCHECKED_DROP_V = 0.01
"""Maximum ohmic drop of one cell that is not checked by the voltage [V]."""
MAX_UNCHECKED_STEPS = 3.0
"""Maximum ohmic drop that is not checked by the voltage, in steps of the voltage converter."""
IMPROVED_INDICES = range(1, 13)
"""Indices of the a_i that the improved method adapts (Algorithm 1 of the thesis). a13..a15 follow from (4.2)."""


def ocv_grid(cell: CellModel) -> tuple[Floats, Floats]:
    """Return the open-circuit voltage and its slope dOCV/dSOC [V] at ``OCV_POINTS`` evenly spaced SOCs 0..1."""
    soc = np.linspace(0.0, 1.0, OCV_POINTS)
    if isinstance(cell.ocv, ChenMoraOcv):
        a = cell.a
        slope = a[16] * a[17] * exp(-a[17] * soc) + a[19] - 2.0 * a[20] * soc + 3.0 * a[21] * soc**2
        return np.array([emf(x, a) for x in soc]), slope
    curve = MonotoneCubic(cell.ocv.soc, cell.ocv.ocv_v)
    return curve(soc), curve.derivative(soc)


def estimator_settings(
    cell: PackModel,
    observer: ObserverSettings,
    identifier: IdentifierSettings,
    *,
    voltage_resolution_v: float,
    voltage_noise_v: float | None,
    initial_soc: float | None,
    sampling: Sampling = EXACT,
    limits: ChargeLimits = NO_LIMITS,
) -> Records:
    """Return the settings record of the whole estimator.

    Args:
        cell: The pack as one two-terminal object.
        observer: Section ``[observer]``.
        identifier: Section ``[identifier]``.
        voltage_resolution_v: One step of the voltage converter, at the pack's terminals [V].
        voltage_noise_v: Standard deviation of a voltage sample [V]; None: half of ``voltage_resolution_v``.
        initial_soc: SOC 0..1 at the first sample; None: from the voltage of the first sample by the OCV.
        sampling: Resolution, period and gain errors of the source.
        limits: Limits of charger and protection.

    Returns:
        Shape (1,), dtype ``ESTIMATOR_SETTINGS``.
    """
    record = np.zeros(1, dtype=ESTIMATOR_SETTINGS)
    p = record[0]
    if isinstance(cell, FuelCellModel):
        gain_and_limits(p["observer"], cell.cell, observer, voltage_resolution_v)
        _period_limits(p["observer"], sampling)
        p["learning"] = fuel_cell_settings(cell, p["observer"])[0]
        return record
    p["observer"] = observer_settings(cell, observer, voltage_resolution_v, initial_soc)[0]
    _period_limits(p["observer"], sampling)
    p["learning"] = learning_settings(cell, observer, p["observer"])[0]
    p["identify"] = identifier.enabled
    # only these laws have the form (3.18); (3.16) and (3.17) have no limit that the identifier could set
    p["sets_targets"] = observer.law in ("improved", "scheme-3")
    # the identifier estimates R_s itself
    p["series_resistance"] = observer.law == "improved" and not identifier.enabled
    p["map_memory_s"] = identifier.map_memory_h * 3600.0
    p["configured"][1:] = cell.a[1:PARAMETERS]
    for i in range(1, PARAMETERS):
        p["lower"][i], p["upper"][i] = cell.bounds(i).lower, cell.bounds(i).upper
    grid = p["observer"]["ocv_v"], p["observer"]["ocv_slope_v"]
    p["filter"] = filter_settings(cell, grid, identifier, voltage_resolution_v, voltage_noise_v, sampling)[0]
    p["anchors"] = anchor_settings(cell, grid[0], max_ohm(p["filter"]), limits, voltage_resolution_v)[0]
    return record


def observer_settings(
    cell: CellModel, observer: ObserverSettings, voltage_resolution_v: float, initial_soc: float | None
) -> Records:
    """Return the observer's settings record.

    Args:
        cell: The pack as one two-terminal object.
        observer: Section ``[observer]``.
        voltage_resolution_v: One step of the voltage converter, at the pack's terminals [V].
        initial_soc: SOC 0..1 at the first sample; None: from the voltage of the first sample by the OCV.

    Returns:
        Shape (1,), dtype ``OBSERVER_SETTINGS``.
    """
    record = np.zeros(1, dtype=OBSERVER_SETTINGS)
    p = record[0]
    gain_and_limits(p, cell.cell, observer, voltage_resolution_v)
    p["capacity_as"] = cell.cell.capacity_ah * 3600.0
    p["ocv_v"], p["ocv_slope_v"] = ocv_grid(cell)
    p["check_ohm"] = r_s(0.5, cell.a)
    p["check_slow_ohm"] = r_ts(0.5, cell.a) + r_tl(0.5, cell.a)
    p["check_v"] = max(
        p["check_ohm"] * MAX_UNCHECKED_C * cell.cell.capacity_ah,
        MAX_UNCHECKED_DROP_V * cell.cell.series_count,
        MAX_UNCHECKED_STEPS * voltage_resolution_v,
    )
    _adaptation(p, cell, observer)
    # the improved method has the output (4.1), which does not contain R_s
    p["output_r_s"] = 0.0 if observer.law == "improved" else 1.0
    p["margin_guard"] = observer.margin_guard
    p["soc_initial"] = np.nan if initial_soc is None else initial_soc
    return record


def gain_and_limits(p: np.void, cell: Rated, observer: ObserverSettings, voltage_resolution_v: float) -> None:
    """Write the settings that batteries and fuel cells share: gain, dead zone, lock, and limits of a sample.

    Args:
        p: Record of dtype ``OBSERVER_SETTINGS``; written.
        cell: The pack's ratings.
        observer: Section ``[observer]``.
        voltage_resolution_v: One step of the voltage converter, at the pack's terminals [V].
    """
    p["nussbaum"] = Nussbaum[observer.nussbaum.replace("-", "_").upper()]
    p["alpha"] = observer.alpha
    p["gain_scale"] = observer.lambda_ ** (1.0 / observer.alpha)
    p["ml_series"] = series_coefficients(observer.alpha)
    p["ml_decay"], p["ml_decay_slope"] = decay_table(observer.alpha)
    p["k0"] = observer.k0
    p["gain_limit"] = observer.gain_limit
    p["rearm_gain"] = -np.inf if observer.rearm_gain is None else observer.rearm_gain  # -inf: k is never reset
    dead_zone_v = DEAD_ZONE_STEPS * voltage_resolution_v if observer.dead_zone_v is None else observer.dead_zone_v
    p["dead_zone_v"] = dead_zone_v
    p["epsilon_v"] = observer.epsilon_v or CONVERGED_ERROR * max(dead_zone_v, voltage_resolution_v)
    lock_error_v = max(LOCK_FRACTION * cell.nominal_voltage_v, MIN_LOCK_STEPS * voltage_resolution_v)
    p["lock_error_v"] = observer.lock_error_v or lock_error_v
    p["lock_time_s"] = observer.lock_time_s
    p["voltage_min_v"] = cell.voltage_min_v
    p["voltage_max_v"] = cell.voltage_max_v
    p["current_max_a"] = cell.current_max_a


def _period_limits(p: np.void, sampling: Sampling) -> None:
    """Write the limits of a regular sample period to ``p``, a record of dtype ``OBSERVER_SETTINGS``."""
    p["gap_s"] = max(GAP_S, MAX_STEP_PERIODS * sampling.period_s)
    p["unmeasured_s"] = unmeasured_s(sampling)


def _adaptation(p: np.void, cell: CellModel, observer: ObserverSettings) -> None:
    """Write the adaptive law (3.16), (3.17) or (3.18) as a' = drive e^2 + rate (target - a), with the output error e."""
    a = cell.a
    initial, target, rate, drive = (np.zeros(PARAMETERS) for _ in range(4))
    initial[1:] = target[1:] = a[1:PARAMETERS]
    adapted = IMPROVED_INDICES if observer.law == "improved" else range(1, PARAMETERS)
    for i in adapted:
        drive[i] = 1.0
        if observer.law in ("improved", "scheme-3"):  # (3.18)
            bounds = cell.bounds(i)
            target[i], rate[i] = bounds.limit, bounds.rate
            initial[i] = bounds.limit if bounds.initial is None else bounds.initial
        elif observer.law == "scheme-2" and a[i] <= SCHEME_2_EPSILON:  # (3.17) for i in the set q of the thesis
            rate[i] = SCHEME_2_LAMBDA
    p["a_initial"], p["target"], p["rate"], p["drive"] = initial, target, rate, drive
