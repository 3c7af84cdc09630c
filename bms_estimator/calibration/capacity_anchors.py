"""Anchors of a capacity measurement: rests whose voltage gives the SOC, with the charge counted until their end."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from bms_estimator.calibration.cleaning.capture_checks import MIN_GAP_CHARGE
from bms_estimator.calibration.cleaning.clean_capture import remove_glitches, resting_samples, true_runs
from bms_estimator.calibration.ocv.chen_mora_fit import COLD_V, LONG_REST_S, RELAXED_V, relaxation_excess
from bms_estimator.calibration.ocv.relaxation_test import Rest, find_rests
from bms_estimator.kernels.cell_model.chen_mora import ocv, soc_from_ocv
from bms_estimator.kernels.cell_model.open_loop import hysteresis
from bms_estimator.kernels.cell_model.rc_ladder import HYSTERESIS_ACTIVATION_ENERGY, REFERENCE_C, arrhenius, on_grid
from bms_estimator.kernels.kalman_filter.hypotheses import HYST_STD
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.charge_count import MIN_GAP_PERIODS, step_charges_as
from bms_estimator.model.columns import Columns

MAX_ANCHOR_SOC_STD = 0.1
"""Maximum std of an anchor's SOC."""
OFFSET_ITERATIONS = 3
"""Number of iterations that subtract hysteresis and temperature effect from a rest's voltage. Few are enough, because both
change slowly with SOC."""
SLOPE_SOC = 0.02
"""Half of the SOC interval over which the slope of the OCV at a rest is computed."""
HYSTERESIS_STD = 0.3
"""Std of the hysteresis state h (-1 after a discharge, 1 after a charge) with a known direction of the current. The std
covers the error of the amplitude, which has the opposite sign after a charge."""


@dataclass(frozen=True)
class Anchor:
    """A rest whose voltage gives the SOC.

    Attributes:
        capture: Name of the capture.
        part: Number of the continuous part, over all captures.
        time_s: Time of the rest's end, on the capture's clock [s].
        rest: The detected rest.
        soc: SOC from the rest's voltage.
        slope_v: Slope dOCV/dSOC at ``soc`` [V].
        voltage_std_v: Standard deviation of the rest's OCV without the error of the curve, independent of other anchors [V].
        curve_std_v: Standard deviation of the OCV curve at ``soc``, correlated between anchors [V].
        counted_ah: Net charge drawn since the part began [Ah].
        throughput_ah: Sum of charge and discharge since the part began [Ah].
    """

    capture: str
    part: int
    time_s: float
    rest: Rest
    soc: float
    slope_v: float
    voltage_std_v: float
    curve_std_v: float
    counted_ah: float
    throughput_ah: float

    @property
    def soc_std(self) -> float:
        """Standard deviation of ``soc``, with the error of the curve."""
        return float(np.hypot(self.voltage_std_v, self.curve_std_v) / self.slope_v)

    @property
    def location(self) -> str:
        """Capture and time of the rest for messages."""
        return f"{self.capture}: rest until {self.time_s:.0f} s"


class _SocOfRest(NamedTuple):
    """SOC from the voltage of a rest; each field as in ``Anchor``."""

    soc: float
    slope_v: float
    voltage_std_v: float
    curve_std_v: float


@dataclass
class AnchorSearch:
    """Search for anchors in captures.

    Attributes:
        settings: Record of dtype ``EKF_SETTINGS`` with the OCV curve and its errors.
        anchors: Anchors so far.
        rejected: Reasons why other rests were rejected, one line each.
    """

    settings: np.void
    anchors: list[Anchor] = field(default_factory=list)
    rejected: list[str] = field(default_factory=list)
    _part: int = 0  # number of the present part

    def add_capture(self, capture: Columns) -> None:
        """Search the continuous parts of a capture."""
        good = remove_glitches(capture.rows, capture.name)
        for first, end in continuous_parts(good, self.settings["capacity_as"] / 3600.0):
            self._add_part(capture.name, good[first:end])
            self._part += 1

    def _add_part(self, name: str, good: SampleBlock) -> None:
        """Add the rests of a continuous part."""
        capacity_ah = self.settings["capacity_as"] / 3600.0
        step_ah = step_charges_as(good["time_s"], good["current_a"]) / 3600.0
        counted_ah, throughput_ah = np.r_[0.0, np.cumsum(step_ah)], np.r_[0.0, np.cumsum(np.abs(step_ah))]
        soc = -counted_ah / capacity_ah
        resting = resting_samples(good, capacity_ah)
        rests, reasons = find_rests(good, soc, resting, int(self.settings["series"]))
        self.rejected += [f"{name}: {line}" for line in reasons]
        # The hysteresis state h at the beginning of the part is unknown: 1 after a charge, -1 after a discharge. Its std
        # HYST_STD decays by half the difference between both courses.
        hysteresis_soc = float(self.settings["hysteresis_soc"])
        after_charge, after_discharge = (
            hysteresis(good["time_s"], soc, hysteresis_soc, first) for first in (1.0, -1.0)
        )
        ends = {float(good["time_s"][first]): last - 1 for first, last in true_runs(resting)}
        for rest in rests:
            end = ends[rest.start_s]
            mean = 0.5 * (after_charge[end] + after_discharge[end])
            std = math.hypot(HYSTERESIS_STD, 0.5 * HYST_STD * (after_charge[end] - after_discharge[end]))
            anchor = Anchor(
                name,
                self._part,
                rest.start_s + rest.duration_s,
                rest,
                *_soc_of_rest(rest, self.settings, mean, std),
                counted_ah=float(counted_ah[end]),
                throughput_ah=float(throughput_ah[end]),
            )
            self._add(anchor)

    def _add(self, anchor: Anchor) -> None:
        """Add an anchor, or the reason why its SOC is too inexact."""
        if anchor.soc_std <= MAX_ANCHOR_SOC_STD:
            self.anchors.append(anchor)
            return
        self.rejected.append(
            f"{anchor.location}: {anchor.rest.ocv_v:.4f} V determines SOC to +-{anchor.soc_std:.2f} only, because the curve "
            f"has a slope of {anchor.slope_v:.3f} V and an error of {1e3 * anchor.curve_std_v:.0f} mV"
        )


def find_anchors(captures: Sequence[Columns], settings: np.void) -> AnchorSearch:
    """Return the finished search for anchors in captures.

    Args:
        captures: Captures of one cell.
        settings: Record of dtype ``EKF_SETTINGS`` with the OCV curve and its errors.

    Raises:
        UserError: A capture has too few good samples.
    """
    search = AnchorSearch(settings)
    for capture in captures:
        search.add_capture(capture)
    return search


def continuous_parts(good: SampleBlock, capacity_ah: float) -> list[tuple[int, int]]:
    """Split a capture at gaps with unknown charge. Each part is (first index, index after the last)."""
    step_s = np.diff(good["time_s"])
    if not step_s.size:
        return [(0, good.size)]
    charge_ah = np.abs(good["current_a"][:-1]) * step_s / 3600.0
    gap = np.r_[(step_s > MIN_GAP_PERIODS * np.median(step_s)) & (charge_ah > MIN_GAP_CHARGE * capacity_ah), True]
    edges = np.r_[0, np.flatnonzero(gap) + 1]
    return [(int(first), int(end)) for first, end in itertools.pairwise(edges) if end - first > 1]


def _soc_of_rest(rest: Rest, settings: np.void, hysteresis_mean: float, hysteresis_std: float) -> _SocOfRest:
    """Return the SOC from the voltage of a rest, with mean and std of the hysteresis state h at 25 °C."""
    curve = settings["ocv_v"], settings["ocv_slope_v"]
    temperature_c = float(np.nan_to_num(rest.temperature_c, nan=REFERENCE_C))
    amplitude = arrhenius(HYSTERESIS_ACTIVATION_ENERGY, temperature_c)  # of the hysteresis, relative to 25 °C
    soc = soc_from_ocv(rest.ocv_v, *curve)
    for _ in range(OFFSET_ITERATIONS):
        hysteresis_v = amplitude * hysteresis_mean * on_grid(soc, settings["hysteresis_v"])
        temperature_v = (temperature_c - REFERENCE_C) * on_grid(soc, settings["per_kelvin_v"])
        soc = soc_from_ocv(rest.ocv_v - (hysteresis_v + temperature_v), *curve)
    cold_v = (
        COLD_V * float(relaxation_excess(np.array([rest.temperature_c]))[0]) * min(1.0, LONG_REST_S / rest.duration_s)
    )
    unrelaxed_v = settings["series"] * (RELAXED_V + cold_v)
    hysteresis_std_v = amplitude * hysteresis_std * on_grid(soc, settings["hysteresis_v"])
    return _SocOfRest(
        soc=soc,
        slope_v=float((ocv(soc + SLOPE_SOC, *curve) - ocv(soc - SLOPE_SOC, *curve)) / (2.0 * SLOPE_SOC)),
        voltage_std_v=float(np.sqrt(rest.std_v**2 + unrelaxed_v**2 + hysteresis_std_v**2)),
        curve_std_v=float(on_grid(soc, settings["curve_error_v"])),
    )
