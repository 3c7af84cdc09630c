"""Curves of one cell over SOC and temperature, from the filter's settings record."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.cell_model.rc_ladder import (
    GAS_CONSTANT,
    GRID,
    REFERENCE_C,
    RESISTANCES,
)
from bms_estimator.model.arrays import Floats

SOC_GRID = np.linspace(0.0, 1.0, GRID)
"""SOC grid of resistances, hysteresis and OCV error. Shape (GRID,)."""
MIN_END_SLOPE_V, MAX_END_SLOPE_V = 1.0, 8.0
"""Limits of the slope with which the OCV is extrapolated beyond SOC 0 and 1 [V per unit SOC]. They are assumed, because the
slope at the end of a measured table is uncertain."""
ZERO_C_K = 273.15
"""Temperature 0 C in kelvin."""
SECANT_HALF_WIDTH_SOC = 0.01
"""Half width of the secant that gives the slope of the OCV [SOC]: the secant covers the SOC range of a row (``ROW_SOC``)."""
DIRECTION_STD_FRACTION = 0.5
"""Std of the direction-dependent error, as a fraction of the OCV's std. The direction-dependent error is the part of the OCV's error that
differs between charge, rest and discharge."""
DIRECTION_STD_RANGE_V = 2e-3, 6e-3
"""Limits of the std of the direction-dependent error [V]. The lower one is assumed for cells whose file was fitted to their own
captures, and the upper one for generic cells."""


class CellCurves:
    """OCV, resistances, hysteresis and prior errors of one cell.

    Args:
        settings: Record of dtype EKF_SETTINGS of the pack.
    """

    def __init__(self, settings: np.void) -> None:
        series = float(settings["series"])
        self.series = series
        self.capacity_as = float(settings["capacity_as"])
        self.one_c_a = self.capacity_as / 3600.0
        self._soc = np.linspace(0.0, 1.0, settings["ocv_v"].size)
        self._ocv_v = settings["ocv_v"] / series
        slope_v = settings["ocv_slope_v"] / series
        # the outermost points of an interpolated table have one-sided slopes
        self._low_slope_v, self._high_slope_v = np.clip(slope_v[[1, -2]], MIN_END_SLOPE_V, MAX_END_SLOPE_V)
        self.gain_std = float(settings["voltage_gain_std"])
        """Relative std of the voltage sensor's gain."""
        gain_v = self.gain_std * self.ocv(SOC_GRID)
        self.ocv_std_v = np.sqrt(np.maximum((settings["curve_error_v"] / series) ** 2 - gain_v**2, 0.0))
        """Std of the cell file's OCV at ``SOC_GRID`` [V], without the error of the voltage sensor."""
        self.hysteresis_v = settings["hysteresis_v"] / series
        self.per_kelvin_v = settings["per_kelvin_v"] / series
        self._parts_ohm = np.hstack([settings["weak_ohm"], settings["strong_ohm"]]) / series
        self.r_std, self.capacity_std = float(settings["r_std"]), float(settings["capacity_std"])
        self.direction_std_v = float(
            np.clip(DIRECTION_STD_FRACTION * np.median(self.ocv_std_v), *DIRECTION_STD_RANGE_V)
        )
        """Std of the direction-dependent error [V]."""
        self.charge_error = float(settings["charge_error"])
        """Std of the SOC counted over a charge throughput of 1."""
        self.aged_soc = float(settings["aged_soc"])
        """Charge throughput of the std ``Aging.use_std`` [SOC]: 500 full cycles."""
        self.event_probability, self.event_s = float(settings["event_probability"]), float(settings["event_s"])
        """Probability that a long gap hides a charge or an exchange of the pack, and the time constant with which the
        probability grows with the gap's duration [s]."""
        self.offset_s = float(settings["offset_s"])
        """Correlation time of the drifting part of the current sensor's offset [s]."""
        self.offset_std_a = float(settings["offset_c"]) * self.one_c_a
        self.table = np.column_stack([self._parts_ohm, self.hysteresis_v, self.per_kelvin_v])
        """Curves over ``SOC_GRID`` for the kernels, see ``pack_voltage.FILE_HYSTERESIS``."""

    def ocv(self, soc: Floats) -> Floats:
        """Return the OCV at 25 C [V], with linear extrapolation beyond SOC 0 and 1."""
        inside = np.interp(np.clip(soc, 0.0, 1.0), self._soc, self._ocv_v)
        below, above = np.minimum(soc, 0.0), np.maximum(soc - 1.0, 0.0)
        return np.asarray(inside + self._low_slope_v * below + self._high_slope_v * above)

    def soc(self, ocv_v: Floats) -> Floats:
        """Return the SOC, 0..1, at an OCV at 25 C [V]."""
        return np.interp(ocv_v, self._ocv_v, self._soc)

    def slope(self, soc: Floats, half_width: float = SECANT_HALF_WIDTH_SOC) -> Floats:
        """Return the slope of the OCV as a secant over ``soc`` +- ``half_width`` [V per unit SOC]."""
        return np.asarray((self.ocv(soc + half_width) - self.ocv(soc - half_width)) / (2.0 * half_width))

    def resistances(self, soc: Floats, weak: Floats, strong: Floats) -> Floats:
        """Return the resistances at each SOC, shape (n, RESISTANCES) [ohm].

        Args:
            soc: SOCs.
            weak: Arrhenius factor of the part of the resistances with the low activation energy.
            strong: Arrhenius factor of the part with the high activation energy.
        """
        position = NodePosition.of(soc, GRID)
        i, (low, high) = position.below, position.weights
        parts_ohm = low[:, None] * self._parts_ohm[i] + high[:, None] * self._parts_ohm[i + 1]
        return np.asarray(weak[:, None] * parts_ohm[:, :RESISTANCES] + strong[:, None] * parts_ohm[:, RESISTANCES:])


def arrhenius(energy_j: float, temperature_c: Floats) -> Floats:
    """Return the Arrhenius factor on a resistance with an activation energy [J/mol]; 1 at 25 C."""
    inverse_k = 1.0 / (temperature_c + ZERO_C_K) - 1.0 / (REFERENCE_C + ZERO_C_K)
    return np.asarray(np.exp(energy_j / GAS_CONSTANT * inverse_k))


@dataclass(frozen=True)
class NodePosition:
    """Position of SOCs between evenly spaced nodes of a piecewise linear function over SOC 0..1."""

    below: NDArray[np.intp]
    """Index of the node below each SOC."""
    fraction: Floats
    """Distance from that node, as a fraction of the distance to the next."""

    @classmethod
    def of(cls, soc: Floats, nodes: int) -> "NodePosition":
        """Return the position of each SOC. An SOC beyond 0..1 gets the position of the nearest end."""
        position = np.clip(soc, 0.0, 1.0) * (nodes - 1)
        below = np.minimum(position.astype(np.intp), nodes - 2)
        return cls(below, position - below)

    @property
    def weights(self) -> tuple[Floats, Floats]:
        """Derivatives of the function with respect to its values at the nodes below and above."""
        return 1.0 - self.fraction, self.fraction

    def interpolate(self, values: Floats, offset: NDArray[np.intp] | int = 0) -> Floats:
        """Return the function with the given values at its nodes. The first node is ``values[offset]``."""
        at, (low, high) = self.below + offset, self.weights
        return np.asarray(low * values[at] + high * values[at + 1])
