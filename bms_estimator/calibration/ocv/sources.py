"""Sources of the open-circuit voltage: rests, low-rate curves, and given curves."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bms_estimator.calibration.cleaning.rests import remove_glitches
from bms_estimator.calibration.ocv.overpotential import steady_drop
from bms_estimator.calibration.ocv.points import Points, joined, points_of
from bms_estimator.calibration.ocv.relaxation_test import RelaxationTest, initial_rest_v, relaxation_test
from bms_estimator.calibration.ocv.slow_curve import (
    GRID,
    SlowBranch,
    SlowCurve,
    measured_capacity_ah,
    slow_branches,
    slow_curves,
)
from bms_estimator.calibration.ocv.table_fit import NODES, TableFit, fit_table
from bms_estimator.kernels.cell_model.rc_ladder import HYSTERESIS_J, REFERENCE_C, arrhenius
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import Ladder
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock

STARTS_ALIKE_V = 0.02
"""Captures whose first rests differ by less start at the same SOC: full charges vary by as much, per cell [V]."""
GIVEN_V, GIVEN_COMMON_V = 1e-3, 2e-3
"""Standard deviation of each point of a given curve, and of its common error, per cell [V]."""
REST_SHARE, REST_SHARE_STD = 0.7, 0.3
"""Part of the half difference of slow curves that a rest after a discharge keeps, the other is polarisation; and its
standard deviation: 0.4 and 0.5 seen of an NCA cell, 1.0 of an LFP cell."""
PLATEAU_SHARE, PLATEAU_V, PLATEAU_SOC = 0.9, 0.15, 0.05
"""Hysteresis as a fraction of the half difference for a curve with a plateau: a slope below this per cell and unit of
SOC [V], over this range of SOC. Two coexisting phases keep it (Dreyer et al., Nature Materials 9, 2010, 448).
Drives of an LFP cell at 25, 5 and -15 C show 0.9 to 1.0."""
USUAL_STD = 0.6
"""Relative standard deviation of a hysteresis that is no more than usual."""
MIN_SHARE, SHARE_POINTS, SHARE_K, SHARE_SOC = 0.1, 6, 10.0, (0.1, 0.95)
"""Minimum fraction, number of rests, distance from the curves' temperature [K] and range of SOC with which rests
determine it themselves."""
OTHER_CAPACITY = 0.05
"""A capacity that differs by more from what a slow discharge measured is remarked on, relative."""


@dataclass(frozen=True)
class Recording:
    """A capture: its name and raw samples, dtype ``SAMPLE``."""

    name: str
    samples: SampleBlock


@dataclass(frozen=True)
class ExternalCurve:
    """Curve from another source: soc 0..1, ocv_v [V], hysteresis_v [V] or None; shape (n,) each."""

    name: str
    soc: Floats
    ocv_v: Floats
    hysteresis_v: Floats | None


@dataclass(frozen=True)
class Source:
    """One source of points.

    Attributes:
        name: Name of its captures.
        kind: Recognized kind, such as "38 rests".
        points: Points.
        temperature_c: Mean [C]; NaN where it is not known.
        hysteresis_v: At ``GRID`` [V]; None if unknown.
        notes: Remarks.
        lone: The slow curve that it is, if its other half is missing; what the branches take is still in ``points``.
    """

    name: str
    kind: str
    points: Points
    temperature_c: float
    hysteresis_v: Floats | None
    notes: tuple[str, ...]
    lone: SlowBranch | None = None


@dataclass(frozen=True)
class OcvSources:
    """All of them.

    Attributes:
        capacity_ah: Given, else measured [Ah].
        measured_ah: Capacity by a full slow discharge [Ah]; NaN without one.
        sources: Slow curves, given curves, rests.
        tests: Relaxation tests among ``sources``.
        hysteresis_v: At ``NODES`` and 25 C [V], from the nearest source that shows it, as far as rests keep it; None
            when
            none does.
        hysteresis_std_v: Standard deviation [V].
        usual_hysteresis: It is no source's: ``center_on_typical_hysteresis``.
    """

    capacity_ah: float
    measured_ah: float
    sources: tuple[Source, ...]
    tests: tuple[RelaxationTest, ...]
    hysteresis_v: Floats | None
    hysteresis_std_v: Floats
    usual_hysteresis: bool = False

    @property
    def points(self) -> Points:
        """Points of all sources."""
        return joined([source.points for source in self.sources])


def find_sources(
    recordings: Sequence[Recording],
    curves: Sequence[ExternalCurve],
    *,
    capacity_ah: float | None,
    initial_soc: float = 1.0,
    series_count: int = 1,
) -> OcvSources:
    """Recognize the kind of each capture and extract its points.

    Args:
        recordings: Captures.
        curves: Given curves.
        capacity_ah: Capacity that rests are counted against [Ah]; None: as a whole slow discharge measures it. Slow curves
            are counted against their own.
        initial_soc: SOC at the first sample, 0..1, of those captures that start at the highest voltage.
        series_count: Cells in series.

    Raises:
        UserError: A capture is neither kind, or no capacity is known.
    """
    good = [Recording(one.name, remove_glitches(one.samples, one.name)) for one in recordings]
    branches = {one.name: slow_branches(one.samples, one.name) for one in good}
    every = [branch for found in branches.values() for branch in found]
    measured_ah = measured_capacity_ah(every) / initial_soc if initial_soc > 0.0 else float("nan")
    known_ah = measured_ah if capacity_ah is None else capacity_ah
    if not np.isfinite(known_ah):
        raise UserError(
            "--capacity-ah: not given, and no capture is a slow discharge from full to empty that measures it"
        )
    slow_ah = measured_ah if np.isfinite(measured_ah) else known_ah
    slow = slow_curves(every, slow_ah, initial_soc=initial_soc, series_count=series_count)
    sources = [_of_slow(curve, slow_ah, known_ah) for curve in slow] + [_of_given(one, series_count) for one in curves]
    rests = [one for one in recordings if not branches[one.name]]
    found = _rests(rests, sources, every, known_ah, initial_soc, series_count)
    telling = _informative(sources)
    hysteresis_v, hysteresis_std_v = None, np.zeros(NODES.size)
    if telling is not None and telling.hysteresis_v is not None:
        share = _share(telling, found)
        half_v = telling.hysteresis_v / _colder(telling.temperature_c)
        kept_v = half_v * (_usual_share(telling, series_count) if share is None else share)
        given = telling in sources[len(slow) :] and share is None  # given curves are used as they are
        hysteresis_v = np.interp(NODES, GRID, half_v if given else kept_v)
        hysteresis_std_v = REST_SHARE_STD * np.interp(NODES, GRID, half_v)
        found = [
            (test, _amid_hysteresis(points, kept_v * _colder(test.temperature_c), REST_SHARE_STD))
            for test, points in found
        ]
        if share is not None:
            sources = [
                replace(one, notes=(*one.notes, f"rests keep {share:.2f} of its hysteresis")) if one is telling else one
                for one in sources
            ]
    of_rests = [_of_test(test, points) for test, points in found]
    tests = tuple(test for test, _ in found)
    return OcvSources(known_ah, measured_ah, (*sources, *of_rests), tests, hysteresis_v, hysteresis_std_v)


def _of_slow(curve: SlowCurve, slow_ah: float, capacity_ah: float) -> Source:
    first, *others = curve.branches
    kind = f"{first.label(slow_ah)}, {first.ah[-1]:.3f} Ah"
    name = first.name
    if others:
        kind = f"{first.label(slow_ah)} and charge, {first.ah[-1]:.3f} and {others[0].ah[-1]:.3f} Ah"
        name = first.name if others[0].name == first.name else f"{first.name}, {others[0].name}"
    notes = curve.notes
    if abs(slow_ah / capacity_ah - 1.0) > OTHER_CAPACITY:
        notes = (*notes, f"counted against its own {slow_ah:.3f} Ah, not {capacity_ah:g} Ah")
    lone = None if others else first
    return Source(name, kind, curve.points, first.temperature_c, curve.hysteresis_v, notes, lone)


def _of_given(curve: ExternalCurve, series_count: int) -> Source:
    everywhere = np.full(curve.soc.size, float(series_count))
    points = Points(curve.soc, curve.ocv_v, GIVEN_V * everywhere, common_v=GIVEN_COMMON_V * everywhere)
    hysteresis_v = None
    if curve.hysteresis_v is None:
        points = replace(points, way=np.full(curve.soc.size, -1.0))
    if curve.hysteresis_v is not None:
        hysteresis_v = np.clip(np.interp(GRID, curve.soc, curve.hysteresis_v), 0.0, None)
    return Source(curve.name, f"given curve, {curve.soc.size} points", points, float("nan"), hysteresis_v, ())


def _informative(sources: Sequence[Source]) -> Source | None:
    """Return the source nearest to 25 C that shows hysteresis."""
    telling = [source for source in sources if source.hysteresis_v is not None]
    return min(telling, key=lambda one: _from_reference(one.temperature_c), default=None)


def _from_reference(temperature_c: float) -> float:
    return abs(float(np.nan_to_num(temperature_c, nan=REFERENCE_C)) - REFERENCE_C)


def _colder(temperature_c: float) -> float:
    """Hysteresis at a temperature over that at 25 C; NaN is 25 C."""
    return float(arrhenius(HYSTERESIS_J, float(np.nan_to_num(temperature_c, nan=REFERENCE_C))))


def _share(telling: Source, found: Sequence[tuple[RelaxationTest, Points]]) -> float | None:
    """Part of the hysteresis that rests after discharge keep: the median over them; None when there are too few."""
    low, high = SHARE_SOC
    shares: list[float] = []
    for test, points in found:
        if _from_reference(test.temperature_c) > SHARE_K + _from_reference(telling.temperature_c):
            continue
        size_v = np.interp(
            points.soc, GRID, np.zeros(GRID.size) if telling.hysteresis_v is None else telling.hysteresis_v
        )
        below_v = np.interp(points.soc, telling.points.soc, telling.points.ocv_v) - points.ocv_v
        tells = (points.soc > low) & (points.soc < high) & (points.way < 0.0) & (size_v > 0.0)
        shares += (below_v[tells] / size_v[tells]).tolist()
    return float(np.clip(np.median(shares), MIN_SHARE, 1.0)) if len(shares) >= SHARE_POINTS else None


def _usual_share(telling: Source, series_count: int) -> float:
    """Return the usual share of the hysteresis where no rest shows it."""
    return PLATEAU_SHARE if has_plateau(telling.points.soc, telling.points.ocv_v, series_count) else REST_SHARE


def has_plateau(soc: Floats, ocv_v: Floats, series_count: int) -> bool:
    """Return True if the curve is so flat somewhere that two phases coexist; ``soc`` increasing, voltage in V."""
    edges = np.linspace(*SHARE_SOC, 1 + round(np.ptp(SHARE_SOC) / PLATEAU_SOC))
    slope_v = np.diff(np.interp(edges, soc, ocv_v)) / np.diff(edges)
    return float(slope_v.min()) < PLATEAU_V * series_count


def _rests(
    recordings: Sequence[Recording],
    sources: Sequence[Source],
    branches: Sequence[SlowBranch],
    capacity_ah: float,
    initial_soc: float,
    series_count: int,
) -> list[tuple[RelaxationTest, Points]]:
    """Relaxation tests and their points; a capture that starts lower than the others gets its SOC from their curve."""
    starts = [initial_rest_v(one.samples, one.name, capacity_ah) for one in recordings]
    highest_v = np.nanmax([*starts, *(branch.start_v for branch in branches if not branch.charge), -np.inf])
    low = [start < highest_v - STARTS_ALIKE_V * series_count for start in starts]

    def test(one: Recording, soc: float) -> tuple[RelaxationTest, Points]:
        found = relaxation_test(one.samples, capacity_ah, initial_soc=soc, series_count=series_count, name=one.name)
        return found, points_of(found, series_count)

    found = {one.name: test(one, initial_soc) for one, lower in zip(recordings, low, strict=True) if not lower}
    if any(low):
        curve = fit_table(joined([*(source.points for source in sources), *(points for _, points in found.values())]))
        for one, start_v, lower in zip(recordings, starts, low, strict=True):
            if lower:
                found[one.name] = test(one, _soc_at(curve, start_v))
    return [found[one.name] for one in recordings]


def _soc_at(curve: TableFit, voltage_v: float) -> float:
    grid = np.linspace(0.0, 1.0, 1001)
    return float(np.interp(voltage_v, curve(grid), grid))


def _amid_hysteresis(points: Points, kept_v: Floats, relative_std: float) -> Points:
    """Move points halfway between discharge and charge: ``kept_v`` above those after discharge, with that as their error."""
    size_v = np.interp(points.soc, GRID, kept_v)
    return replace(
        points,
        ocv_v=points.ocv_v - points.way * size_v,
        std_v=np.hypot(points.std_v, np.where(points.way == 0.0, size_v, 0.0)),
        common_v=np.hypot(points.common_v, relative_std * size_v),
    )


def without_branches(found: OcvSources, ladder: Ladder) -> OcvSources:
    """Lone slow curves without what their current takes in the branches: a pair has it twice, with both signs.

    Args:
        found: Result of ``find_sources``.
        ladder: RC ladder with its relative standard deviation, if known.
    """
    return replace(found, sources=tuple(_without_branches(one, ladder) for one in found.sources))


def _without_branches(source: Source, ladder: Ladder) -> Source:
    if source.lone is None:
        return source
    points, first = source.points, 1 if np.isfinite(source.lone.step_v) else 0  # a jump has shown the ohmic part
    temperature_c = np.nan_to_num(points.temperature_c, nan=REFERENCE_C)
    drop_v = steady_drop(ladder, source.lone.current_a, points.soc, temperature_c, first)
    points = replace(
        points,
        ocv_v=points.ocv_v - points.way * drop_v,
        common_v=np.hypot(points.common_v, ladder.std * drop_v),
    )
    note = f"{1e3 * drop_v.mean():.0f} mV, by what such cells have, taken out for {'its' if first else 'ohmic drop and'} branches"
    return replace(source, points=points, lone=None, notes=(*source.notes, note))


def center_on_typical_hysteresis(found: OcvSources, usual_v: Floats) -> OcvSources:
    """Shift sources that do not show hysteresis by half of a typical one, because discharges alone lie below the mean.

    Args:
        found: Result of ``find_sources``.
        usual_v: Hysteresis of similar cells after rests, at ``NODES`` and 25 C [V].
    """
    on_grid_v = np.interp(GRID, NODES, usual_v)
    moved = tuple(
        replace(one, points=_amid_hysteresis(one.points, on_grid_v * _colder(one.temperature_c), USUAL_STD))
        for one in found.sources
    )
    return replace(
        found, sources=moved, hysteresis_v=usual_v, hysteresis_std_v=USUAL_STD * usual_v, usual_hysteresis=True
    )


def _of_test(test: RelaxationTest, points: Points) -> Source:
    notes = () if test.start_soc > 0.9995 else (f"starts at SOC {test.start_soc:.3f}",)
    return Source(test.name, f"{len(test.rests)} rests", points, test.temperature_c, None, notes)
