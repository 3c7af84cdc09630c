"""Hysteresis of the open-circuit voltage: the fraction that remains in a rest, and the mean of discharge and charge."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bms_estimator.calibration.ocv.chen_mora_fit import Points
from bms_estimator.calibration.ocv.relaxation_test import RelaxationTest
from bms_estimator.calibration.ocv.slow_curve import GRID
from bms_estimator.calibration.ocv.source import OcvSources, Source
from bms_estimator.calibration.ocv.table_fit import NODES
from bms_estimator.kernels.cell_model.rc_ladder import HYSTERESIS_ACTIVATION_ENERGY, REFERENCE_C, arrhenius
from bms_estimator.model.arrays import Floats

RESTED_FRACTION = 0.7
"""Fraction of the half difference of low-rate curves that is hysteresis and remains in a rest after a discharge. The
remainder is polarization. Measured fractions are 0.4 and 0.5 for an NCA cell, 1.0 for an LFP cell."""
RESTED_FRACTION_STD = 0.3
"""Std of ``RESTED_FRACTION``."""
PLATEAU_RESTED_FRACTION = 0.9
"""Fraction of the hysteresis that remains in a rest, for a curve with a plateau. Two coexisting phases preserve the
hysteresis (Dreyer et al., Nature Materials 9, 2010, 448). Drives of an LFP cell at 25, 5 and -15 C show 0.9 to 1.0."""
PLATEAU_V = 0.15
"""Maximum slope dOCV/dSOC of a plateau, per cell [V]."""
PLATEAU_SOC = 0.05
"""SOC interval over which the slope of a plateau is computed."""
TYPICAL_HYSTERESIS_STD = 0.6
"""Relative std of a hysteresis that is taken from typical cells."""
MIN_RESTED_FRACTION = 0.1
"""Lower limit of the remaining fraction that is measured by rests."""
MIN_FRACTION_POINTS = 6
"""Minimum number of rests that determine the remaining fraction."""
MAX_FRACTION_DISTANCE_K = 10.0
"""Maximum distance from 25 C of rests that determine the remaining fraction, in addition to the distance of the low-rate
curves [K]."""
FRACTION_SOC = (0.1, 0.95)
"""SOC range of rests that determine the remaining fraction, and of a plateau."""


def find_hysteresis_source(sources: Sequence[Source]) -> Source | None:
    """Return the source nearest to 25 C that shows hysteresis."""
    with_hysteresis = [source for source in sources if source.hysteresis_v is not None]
    return min(with_hysteresis, key=lambda source: _distance_from_reference(source.temperature_c), default=None)


def _distance_from_reference(temperature_c: float) -> float:
    return abs(float(np.nan_to_num(temperature_c, nan=REFERENCE_C)) - REFERENCE_C)


def hysteresis_factor(temperature_c: float) -> float:
    """Return the hysteresis at a temperature relative to that at 25 C; 1 for NaN."""
    return float(arrhenius(HYSTERESIS_ACTIVATION_ENERGY, float(np.nan_to_num(temperature_c, nan=REFERENCE_C))))


def measured_rested_fraction(
    hysteresis_source: Source, tests_with_points: Sequence[tuple[RelaxationTest, Points]]
) -> float | None:
    """Return the median fraction of the hysteresis that remains in rests after discharge; None for too few rests."""
    low, high = FRACTION_SOC
    fractions: list[float] = []
    for test, points in tests_with_points:
        if _distance_from_reference(test.temperature_c) > MAX_FRACTION_DISTANCE_K + _distance_from_reference(
            hysteresis_source.temperature_c
        ):
            continue
        hysteresis_v = np.interp(
            points.soc,
            GRID,
            np.zeros(GRID.size) if hysteresis_source.hysteresis_v is None else hysteresis_source.hysteresis_v,
        )
        drop_v = np.interp(points.soc, hysteresis_source.points.soc, hysteresis_source.points.ocv_v) - points.ocv_v
        usable = (points.soc > low) & (points.soc < high) & (points.direction < 0.0) & (hysteresis_v > 0.0)
        fractions += (drop_v[usable] / hysteresis_v[usable]).tolist()
    return (
        float(np.clip(np.median(fractions), MIN_RESTED_FRACTION, 1.0))
        if len(fractions) >= MIN_FRACTION_POINTS
        else None
    )


def typical_rested_fraction(hysteresis_source: Source, series_count: int) -> float:
    """Return the typical fraction of the hysteresis that remains in a rest."""
    return (
        PLATEAU_RESTED_FRACTION
        if has_plateau(hysteresis_source.points.soc, hysteresis_source.points.ocv_v, series_count)
        else RESTED_FRACTION
    )


def has_plateau(soc: Floats, ocv_v: Floats, series_count: int) -> bool:
    """Return True if the curve has a plateau, where two phases coexist.

    Args:
        soc: Shape (n,), increasing.
        ocv_v: Shape (n,), open-circuit voltage [V].
        series_count: Cells in series.
    """
    edges = np.linspace(*FRACTION_SOC, 1 + round(np.ptp(FRACTION_SOC) / PLATEAU_SOC))
    slope_v = np.diff(np.interp(edges, soc, ocv_v)) / np.diff(edges)
    return float(slope_v.min()) < PLATEAU_V * series_count


def center_points(points: Points, hysteresis_at_rest_v: Floats, relative_std: float) -> Points:
    """Move points to the mean of discharge and charge by a hysteresis with the error ``relative_std``."""
    hysteresis_v = np.interp(points.soc, GRID, hysteresis_at_rest_v)
    return replace(
        points,
        ocv_v=points.ocv_v - points.direction * hysteresis_v,
        std_v=np.hypot(points.std_v, np.where(points.direction == 0.0, hysteresis_v, 0.0)),
        systematic_std_v=np.hypot(points.systematic_std_v, relative_std * hysteresis_v),
    )


def center_on_typical_hysteresis(found: OcvSources, typical_v: Floats) -> OcvSources:
    """Move sources without measured hysteresis to the mean of discharge and charge by a typical hysteresis.

    Args:
        found: Result of ``find_sources``.
        typical_v: Hysteresis of similar cells after rests, at ``NODES`` and 25 C [V].
    """
    on_grid_v = np.interp(GRID, NODES, typical_v)
    moved = tuple(
        replace(
            source,
            points=center_points(
                source.points, on_grid_v * hysteresis_factor(source.temperature_c), TYPICAL_HYSTERESIS_STD
            ),
        )
        for source in found.sources
    )
    return replace(
        found,
        sources=moved,
        hysteresis_v=typical_v,
        hysteresis_std_v=TYPICAL_HYSTERESIS_STD * typical_v,
        has_typical_hysteresis=True,
    )
