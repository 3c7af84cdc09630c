"""Sources of the open-circuit voltage: rests, low-rate curves, and given curves."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bms_estimator.calibration.cleaning.capture_checks import SAME_START_V, StartSoc
from bms_estimator.calibration.cleaning.clean_capture import remove_glitches
from bms_estimator.calibration.ocv.chen_mora_fit import Points, join_points, points_of
from bms_estimator.calibration.ocv.hysteresis import (
    RESTED_FRACTION_STD,
    center_points,
    find_hysteresis_source,
    has_plateau,
    hysteresis_factor,
    measured_rested_fraction,
    typical_rested_fraction,
)
from bms_estimator.calibration.ocv.overpotential import steady_drop
from bms_estimator.calibration.ocv.relaxation_test import RelaxationTest, initial_rest_v, relaxation_test
from bms_estimator.calibration.ocv.slow_branch import SlowBranch, measured_capacity_ah, slow_branches
from bms_estimator.calibration.ocv.slow_curve import GRID, SlowCurve, slow_curves
from bms_estimator.calibration.ocv.source import ExternalCurve, OcvSources, Recording, Source
from bms_estimator.calibration.ocv.table_fit import NODES, TableFit, fit_table
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.model.cell_sections import Ladder
from bms_estimator.model.errors import UserError

GIVEN_V = 1e-3
"""Std of each point of a given curve, per cell [V]."""
GIVEN_SYSTEMATIC_V = 2e-3
"""Std of the systematic error of a given curve, per cell [V]."""
PLATEAU_SYSTEMATIC_V = 0.01
"""Std of the systematic error of a given curve with a plateau, per cell [V]. Such a curve is mostly a quasi-OCV: the mean of a
slow charge and a slow discharge, or one of both. On the plateau it deviates from the rested OCV by part of the hysteresis and
of the overpotential, and a millivolt is 1 % of SOC."""
MAX_CAPACITY_DIFFERENCE = 0.05
"""Relative difference between the given and the measured capacity above which a source has a remark."""


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
        capacity_ah: Capacity that the SOC of rests is counted against [Ah]; None: the capacity from a full low-rate
            discharge. The SOC of low-rate curves is counted against the measured capacity if there is one.
        initial_soc: SOC at the first sample, 0..1, of the captures without a ``start`` that start at the highest voltage.
        series_count: Cells in series.

    Raises:
        UserError: A capture is neither a relaxation test nor a low-rate curve, or no capacity is given or measured.
    """
    branches = {
        each.name: slow_branches(
            remove_glitches(each.samples, each.name), each.name, each.start or StartSoc(initial_soc)
        )
        for each in recordings
    }
    all_branches = [branch for branches_of_capture in branches.values() for branch in branches_of_capture]
    measured_ah = measured_capacity_ah(all_branches)
    used_ah = measured_ah if capacity_ah is None else capacity_ah
    if not np.isfinite(used_ah):
        raise UserError(
            "--capacity-ah: not given, and no capture is a slow discharge from full to empty that measures it"
        )
    slow_ah = measured_ah if np.isfinite(measured_ah) else used_ah
    slow = slow_curves(all_branches, slow_ah, series_count=series_count)
    sources = [_slow_curve_source(curve, slow_ah, used_ah) for curve in slow] + [
        _given_curve_source(curve, series_count) for curve in curves
    ]
    rest_recordings = [recording for recording in recordings if not branches[recording.name]]
    tests_with_points = _tests_with_points(rest_recordings, sources, all_branches, used_ah, initial_soc, series_count)
    hysteresis_source = find_hysteresis_source(sources)
    hysteresis_v, hysteresis_std_v = None, np.zeros(NODES.size)
    if hysteresis_source is not None and hysteresis_source.hysteresis_v is not None:
        rested_fraction = measured_rested_fraction(hysteresis_source, tests_with_points)
        half_difference_v = hysteresis_source.hysteresis_v / hysteresis_factor(hysteresis_source.temperature_c)
        hysteresis_at_rest_v = half_difference_v * (
            typical_rested_fraction(hysteresis_source, series_count) if rested_fraction is None else rested_fraction
        )
        # the hysteresis of a given curve is used unchanged, unless rests measure its fraction
        is_unchanged = hysteresis_source in sources[len(slow) :] and rested_fraction is None
        hysteresis_v = np.interp(NODES, GRID, half_difference_v if is_unchanged else hysteresis_at_rest_v)
        hysteresis_std_v = RESTED_FRACTION_STD * np.interp(NODES, GRID, half_difference_v)
        tests_with_points = [
            (
                test,
                center_points(
                    points, hysteresis_at_rest_v * hysteresis_factor(test.temperature_c), RESTED_FRACTION_STD
                ),
            )
            for test, points in tests_with_points
        ]
        if rested_fraction is not None:
            sources = [
                replace(source, notes=(*source.notes, f"rests keep {rested_fraction:.2f} of its hysteresis"))
                if source is hysteresis_source
                else source
                for source in sources
            ]
    rest_sources = [_relaxation_source(test, points) for test, points in tests_with_points]
    tests = tuple(test for test, _ in tests_with_points)
    return OcvSources(used_ah, measured_ah, (*sources, *rest_sources), tests, hysteresis_v, hysteresis_std_v)


def _slow_curve_source(curve: SlowCurve, slow_ah: float, capacity_ah: float) -> Source:
    """Return a low-rate curve as a source.

    Args:
        curve: Paired or unpaired low-rate curve.
        slow_ah: Capacity that the curve's SOC is counted against [Ah].
        capacity_ah: Given capacity [Ah].
    """
    first, *others = curve.branches
    kind = f"{first.label(slow_ah)}, {first.ah[-1]:.3f} Ah"
    name = first.name
    if others:
        kind = f"{first.label(slow_ah)} and charge, {first.ah[-1]:.3f} and {others[0].ah[-1]:.3f} Ah"
        name = first.name if others[0].name == first.name else f"{first.name}, {others[0].name}"
    notes = curve.notes
    if abs(slow_ah / capacity_ah - 1.0) > MAX_CAPACITY_DIFFERENCE:
        notes = (*notes, f"counted against its own {slow_ah:.3f} Ah, not {capacity_ah:g} Ah")
    unpaired = None if others else first
    return Source(name, kind, curve.points, first.temperature_c, curve.hysteresis_v, notes, unpaired)


def _given_curve_source(curve: ExternalCurve, series_count: int) -> Source:
    """Return a given curve as a source."""
    series_counts = np.full(curve.soc.size, float(series_count))
    is_flat = has_plateau(curve.soc, curve.ocv_v, series_count)
    systematic_v = (PLATEAU_SYSTEMATIC_V if is_flat else GIVEN_SYSTEMATIC_V) * series_counts
    if curve.std_v is not None:
        systematic_v = curve.std_v
    points = Points(curve.soc, curve.ocv_v, GIVEN_V * series_counts, systematic_std_v=systematic_v)
    hysteresis_v = None
    if curve.hysteresis_v is None:
        points = replace(points, direction=np.full(curve.soc.size, -1.0))
    if curve.hysteresis_v is not None:
        hysteresis_v = np.clip(np.interp(GRID, curve.soc, curve.hysteresis_v), 0.0, None)
    return Source(curve.name, f"given curve, {curve.soc.size} points", points, float("nan"), hysteresis_v, ())


def _tests_with_points(
    recordings: Sequence[Recording],
    sources: Sequence[Source],
    branches: Sequence[SlowBranch],
    capacity_ah: float,
    initial_soc: float,
    series_count: int,
) -> list[tuple[RelaxationTest, Points]]:
    """Return the relaxation tests and their points.

    The initial SOC of a capture is read from the curve of the others if the capture starts at a lower voltage, or if its SOC was
    read from another cell's curve.
    """
    start_volts = [initial_rest_v(recording.samples, recording.name, capacity_ah) for recording in recordings]
    highest_v = np.nanmax([*start_volts, *(branch.start_v for branch in branches if not branch.charge), -np.inf])
    starts = [
        _known_soc(recording, None if start_v < highest_v - SAME_START_V * series_count else initial_soc)
        for recording, start_v in zip(recordings, start_volts, strict=True)
    ]
    if not sources and all(start is None for start in starts):  # without a curve, another cell's curve gives the SOCs
        starts = [recording.start.soc if recording.start else initial_soc for recording in recordings]

    def evaluate(recording: Recording, soc: float) -> tuple[RelaxationTest, Points]:
        test = relaxation_test(
            recording.samples, capacity_ah, initial_soc=soc, series_count=series_count, name=recording.name
        )
        return test, points_of(test, series_count)

    tests_with_points = {
        recording.name: evaluate(recording, soc)
        for recording, soc in zip(recordings, starts, strict=True)
        if soc is not None
    }
    if None in starts:
        curve = fit_table(
            join_points([*(source.points for source in sources), *(points for _, points in tests_with_points.values())])
        )
        for recording, start_v, soc in zip(recordings, start_volts, starts, strict=True):
            if soc is None:
                tests_with_points[recording.name] = evaluate(recording, _soc_at(curve, start_v))
    return [tests_with_points[recording.name] for recording in recordings]


def _known_soc(recording: Recording, otherwise: float | None) -> float | None:
    """Return the SOC at the first sample if it is exact; for a recording without a start, ``otherwise``."""
    if recording.start is None:
        return otherwise
    return recording.start.soc if recording.start.is_exact else None


def _soc_at(curve: TableFit, voltage_v: float) -> float:
    grid = np.linspace(0.0, 1.0, 1001)
    return float(np.interp(voltage_v, curve(grid), grid))


def subtract_rc_overpotential(found: OcvSources, ladder: Ladder) -> OcvSources:
    """Subtract the steady overpotential of the RC pairs from unpaired low-rate curves. In a pair it cancels.

    Args:
        found: Result of ``find_sources``.
        ladder: RC ladder with its relative standard deviation, if known.
    """
    return replace(found, sources=tuple(_without_rc_overpotential(source, ladder) for source in found.sources))


def _without_rc_overpotential(source: Source, ladder: Ladder) -> Source:
    """Return the source without the steady voltage drop of the RC pairs, if its curve is unpaired."""
    if source.unpaired is None:
        return source
    points = source.points
    first = 1 if np.isfinite(source.unpaired.step_v) else 0  # a measured ohmic jump was already subtracted
    temperature_c = np.nan_to_num(points.temperature_c, nan=REFERENCE_C)
    drop_v = steady_drop(ladder, source.unpaired.current_a, points.soc, temperature_c, first)
    points = replace(
        points,
        ocv_v=points.ocv_v - points.direction * drop_v,
        systematic_std_v=np.hypot(points.systematic_std_v, ladder.std * drop_v),
    )
    removed = "the RC pairs" if first else "series resistance and RC pairs"
    note = f"{1e3 * drop_v.mean():.0f} mV subtracted for {removed}, as typical of such cells"
    return replace(source, points=points, unpaired=None, notes=(*source.notes, note))


def _relaxation_source(test: RelaxationTest, points: Points) -> Source:
    notes = () if test.start_soc > 0.9995 else (f"starts at SOC {test.start_soc:.3f}",)
    return Source(test.name, f"{len(test.rests)} rests", points, test.temperature_c, None, notes)
