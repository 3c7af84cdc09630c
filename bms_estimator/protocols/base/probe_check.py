"""Check of temperature probes: which of them are faulty, and the temperatures of a sample. It does no I/O."""

import math
from collections import deque
from collections.abc import Sequence
from statistics import median
from typing import NamedTuple

import numpy as np

from bms_estimator.model.arrays import MAX_C, MIN_C, NO_PROBES, PROBE, Floats, ProbeBlock, SampleBlock, SampleStatus

STEP_K = 30.0
"""Change of a probe that is accepted at once [K]. The delays of the alarms suppress single glitches of this size."""
NEAR_K = 10.0
"""Maximum accepted change from the last credible reading to one of ``OPEN_OR_SHORT_C`` [K]."""
RATE_K_PER_S = 20.0
"""Maximum rate of a probe [K/s]. In thermal runaway a probe on a cell rises by several K/s."""
HOT_C = 45.0
"""Temperature above which a fall is checked [C]. It is the usual limit of charging; cells are seldom hotter."""
SUSTAINED_S = 10.0
"""Time above ``HOT_C`` after which a fall is checked [s], the default delay of ``over_temperature``. Glitches are shorter."""
COOLING_K_PER_S = 0.5
"""Maximum rate at which a hot probe cools [K/s]. A cell of 70 J/K loses 5 W to forced air, and cools by less than 0.1 K/s. The
margin is for probes on busbars and transistors."""
COOLING_TOLERANCE_K = 5.0
"""Maximum fall beyond ``COOLING_K_PER_S`` [K], for noise and resolution."""
MAX_DEVIATION_K = 30.0
"""Maximum difference of a sound probe from the median of all probes [K]. The project's choice, twice the usual difference
between the cells of a pack."""
_FIELDS = ("temperature_c", "temperature_min_c", "temperature_max_c")
"""Fields of a sample for the temperatures of ``CheckedProbes``, in their order."""
OPEN_OR_SHORT_C = (-40.0, -30.0, 127.0)
"""Plausible readings that devices report for an open or shorted probe [C]; 255, -273 and 3276.7 are implausible anyway."""
OPEN_OR_SHORT_TOLERANCE_K = 0.2
"""Maximum deviation from a reading of ``OPEN_OR_SHORT_C`` [K], caused by conversion from kelvin."""


class CheckedProbes(NamedTuple):
    """Temperatures of a sample [C], NaN without a credible probe."""

    mean_c: float
    lowest_c: float
    highest_c: float
    faulty: tuple[bool, ...]
    """True for each faulty probe."""


class ProbeCheck:
    """Check of the probes of one device, in the order of its samples.

    A faulty probe is excluded from mean and extremes, with one exception on the safe side: the highest temperature includes a
    hot probe that is far above the others. If the probes differ and the majority does not show which one is wrong, all count.

    Attributes:
        faults: Number of times that a probe became faulty.
    """

    def __init__(self) -> None:
        self._probes: list[_Probe] = []
        self.faults = 0

    def apply(self, block: SampleBlock, rows_c: Sequence[Sequence[float]]) -> ProbeBlock:
        """Set the temperatures of samples, and the bit ``PROBE_FAULT`` of their status. Return the probes of each sample.

        Args:
            block: Samples with their times and the other bits of their status; changed in place.
            rows_c: Readings of the probes for each sample.
        """
        checked = [self.check(time_s, row_c) for time_s, row_c in zip(block["time_s"].tolist(), rows_c, strict=True)]
        for name, field in zip(CheckedProbes._fields, _FIELDS, strict=False):
            block[field] = [getattr(each, name) for each in checked]
        faults = [SampleStatus.PROBE_FAULT if any(each.faulty) else 0 for each in checked]
        block["status"] |= np.array(faults, dtype=block["status"].dtype)
        return probe_block(
            [list(zip(row_c, each.faulty, strict=True)) for row_c, each in zip(rows_c, checked, strict=True)]
        )

    def apply_to_single_probe(self, block: SampleBlock) -> None:
        """Check the only probe of a device, as ``apply`` does. A block of ordinary readings is checked without a loop.

        Args:
            block: Samples with the readings of the probe as their temperatures; changed in place.
        """
        self._probes = self._probes or [_Probe()]
        if not self._probes[0].accepts_all(block["time_s"], block["temperature_c"]):
            self.apply(block, block["temperature_c"][:, None].tolist())

    def check(self, time_s: float, readings_c: Sequence[float]) -> CheckedProbes:
        """Check the readings of a sample.

        Args:
            time_s: Time of the sample [s].
            readings_c: Reading of each probe [C], always in the same order; NaN: absent.
        """
        self._probes += [_Probe() for _ in range(len(readings_c) - len(self._probes))]
        credible = {
            n: reading_c for n, reading_c in enumerate(readings_c) if self._probes[n].is_credible(time_s, reading_c)
        }
        outliers, suspects = _find_outliers(credible)
        typical_c = [reading_c for n, reading_c in credible.items() if n not in outliers]
        faulty = tuple(
            n in suspects or (n not in credible and not math.isnan(reading_c)) for n, reading_c in enumerate(readings_c)
        )
        for probe, is_faulty in zip(self._probes, faulty, strict=False):
            self.faults += is_faulty and not probe.was_faulty
            probe.was_faulty = is_faulty
        if not typical_c:
            return CheckedProbes(math.nan, math.nan, math.nan, faulty)
        lowest_c, highest_c = min(typical_c), max(credible.values())
        mean_c = min(max(sum(typical_c) / len(typical_c), lowest_c), highest_c)  # a rounded mean may lie outside
        return CheckedProbes(mean_c, lowest_c, highest_c, faulty)


def probe_block(rows: Sequence[Sequence[tuple[float, bool]]]) -> ProbeBlock:
    """Return the probes of samples. Rows with fewer probes are filled up with absent ones."""
    probes = max(map(len, rows), default=0)
    if probes == 0:
        return NO_PROBES
    return np.array([[*row, *[(math.nan, False)] * (probes - len(row))] for row in rows], dtype=PROBE)


class _Probe:
    """One temperature probe.

    Attributes:
        credible_c: Last credible reading [C]; NaN without one.
        was_faulty: True if the probe was faulty in the last sample.
    """

    def __init__(self) -> None:
        self.credible_c, self.was_faulty = math.nan, False
        self._credible_s = 0.0
        self._doubted_c = math.nan  # previous reading if it was not credible
        self._hot_c, self._hot_s = -math.inf, 0.0  # last temperature above ``HOT_C`` that was sustained, and its time
        self._begin_s = 0.0  # time of the first credible reading
        # (end, reading) of readings that ended in the last ``SUSTAINED_S``, each lower than all later ones
        self._lowest = deque[tuple[float, float]]()

    def accepts_all(self, times_s: Floats, readings_c: Floats) -> bool:
        """Accept readings if each is credible and not hot, or absent; otherwise return False and change nothing."""
        rows = np.flatnonzero(~np.isnan(readings_c))
        if rows.size:
            present_c = readings_c[rows]
            range_c = np.append(present_c, self.credible_c) if not math.isnan(self.credible_c) else present_c
            coldest_c = self._hot_c - COOLING_K_PER_S * (float(times_s[rows[0]]) - self._hot_s) - COOLING_TOLERANCE_K
            lowest_c = max(coldest_c, max(OPEN_OR_SHORT_C[:2]) + OPEN_OR_SHORT_TOLERANCE_K)
            if present_c.min() <= lowest_c or present_c.max() > HOT_C or np.ptp(range_c) > STEP_K:
                return False
            if math.isnan(self.credible_c):
                self._begin_s = float(times_s[rows[0]])
            self.credible_c, self._credible_s = float(present_c[-1]), float(times_s[rows[-1]])
            self._doubted_c = math.nan
            self._lowest.clear()
        self.was_faulty = False
        return True

    def is_credible(self, time_s: float, reading_c: float) -> bool:
        """Return True if a reading is possible. An impossible change needs confirmation by the next reading."""
        cooled_c = self._hot_c - COOLING_K_PER_S * (time_s - self._hot_s)
        possible = self._is_possible(time_s, reading_c) and reading_c >= cooled_c - COOLING_TOLERANCE_K
        if possible:
            self._update_sustained(time_s, reading_c, cooled_c)
            self.credible_c, self._credible_s, self._doubted_c = reading_c, time_s, math.nan
        elif not math.isnan(reading_c):
            self._doubted_c = reading_c
        return possible

    def _update_sustained(self, time_s: float, reading_c: float, cooled_c: float) -> None:
        """Update the sustained temperature. Since the last one, the probe can have cooled to ``cooled_c`` [C] at the lowest.

        A reading counts until the next one, so that a source with a long period has a sustained temperature, too.
        """
        if math.isnan(self.credible_c):
            self._begin_s = time_s
        else:
            while self._lowest and self._lowest[-1][1] >= self.credible_c:
                self._lowest.pop()
            self._lowest.append((time_s, self.credible_c))
        while self._lowest and self._lowest[0][0] < time_s - SUSTAINED_S:
            self._lowest.popleft()
        lowest_c = min(reading_c, self._lowest[0][1] if self._lowest else reading_c)
        if time_s - self._begin_s >= SUSTAINED_S and lowest_c > max(HOT_C, cooled_c):
            self._hot_c, self._hot_s = lowest_c, time_s

    def _is_possible(self, time_s: float, reading_c: float) -> bool:
        change_k = reading_c - self.credible_c
        if not MIN_C <= reading_c <= MAX_C:
            return False
        if any(abs(reading_c - each) <= OPEN_OR_SHORT_TOLERANCE_K for each in OPEN_OR_SHORT_C):
            return abs(change_k) <= NEAR_K
        if math.isnan(change_k) or abs(change_k) <= STEP_K:
            return True
        if not math.isnan(self._doubted_c):  # count only the part of the change that the previous reading confirms
            confirmed_k = math.copysign(1.0, change_k) * (self._doubted_c - self.credible_c)
            if confirmed_k < 0.0:
                return False
            change_k = min(abs(change_k), confirmed_k)
        return abs(change_k) <= STEP_K + RATE_K_PER_S * max(time_s - self._credible_s, 0.0)


def _find_outliers(readings_c: dict[int, float]) -> tuple[set[int], set[int]]:
    """Return the indices of the outliers, and of all suspected probes.

    If the majority does not show which probe is wrong, there is no outlier, and the lowest and the highest are suspected.
    """
    if not readings_c or max(readings_c.values()) - min(readings_c.values()) <= MAX_DEVIATION_K:
        return set(), set()
    middle_c = median(readings_c.values())
    outliers = {n for n, reading_c in readings_c.items() if abs(reading_c - middle_c) > MAX_DEVIATION_K}
    if outliers and 2 * len(outliers) < len(readings_c):
        return outliers, outliers
    by_temperature = sorted(readings_c, key=readings_c.__getitem__)
    return set(), {by_temperature[0], by_temperature[-1]}
