"""Source of points of the open-circuit voltage, and its inputs."""

from dataclasses import dataclass

from bms_estimator.calibration.cleaning.capture_checks import StartSoc
from bms_estimator.calibration.ocv.chen_mora_fit import Points, join_points
from bms_estimator.calibration.ocv.relaxation_test import RelaxationTest
from bms_estimator.calibration.ocv.slow_branch import SlowBranch
from bms_estimator.model.arrays import Floats, SampleBlock


@dataclass(frozen=True)
class Recording:
    """Capture with the SOC at its start.

    Attributes:
        name: Name for messages.
        samples: Raw samples, dtype ``SAMPLE``.
        start: SOC at the first sample; None: full for the captures that start at the highest voltage, otherwise from the OCV
            curve of the other sources.
    """

    name: str
    samples: SampleBlock
    start: StartSoc | None = None


@dataclass(frozen=True)
class ExternalCurve:
    """Given OCV curve.

    Attributes:
        name: Name for messages.
        soc: Shape (n,), increasing, 0..1.
        ocv_v: Shape (n,), open-circuit voltage [V].
        hysteresis_v: Shape (n,), hysteresis [V]; None if unknown.
        std_v: Shape (n,), std of ``ocv_v`` [V]; None if unknown.
        per_kelvin_v: Shape (n,), temperature coefficient of ``ocv_v`` [V/K]; None if unknown.
    """

    name: str
    soc: Floats
    ocv_v: Floats
    hysteresis_v: Floats | None
    std_v: Floats | None = None
    per_kelvin_v: Floats | None = None


@dataclass(frozen=True)
class Source:
    """One source of points.

    Attributes:
        name: Names of the captures.
        kind: Recognized kind, such as "38 rests".
        points: Points of the open-circuit voltage.
        temperature_c: Mean temperature [C]; NaN if unknown.
        hysteresis_v: Hysteresis at ``GRID`` [V]; None if unknown.
        notes: Remarks.
        unpaired: Low-rate curve of an unpaired source whose ``points`` contain the overpotential of the RC pairs;
            otherwise None.
    """

    name: str
    kind: str
    points: Points
    temperature_c: float
    hysteresis_v: Floats | None
    notes: tuple[str, ...]
    unpaired: SlowBranch | None = None


@dataclass(frozen=True)
class OcvSources:
    """All sources of the open-circuit voltage of a cell.

    Attributes:
        capacity_ah: Given capacity, otherwise ``measured_ah`` [Ah].
        measured_ah: Capacity from a full low-rate discharge [Ah]; NaN without such a discharge.
        sources: Low-rate curves, given curves, and rests.
        tests: Relaxation tests among ``sources``.
        hysteresis_v: Hysteresis of a rested cell at ``NODES`` and 25 C [V], from the source nearest to 25 C that shows
            hysteresis; None without such a source.
        hysteresis_std_v: Standard deviation of ``hysteresis_v`` [V].
        has_typical_hysteresis: True if ``hysteresis_v`` comes from typical cells (``center_on_typical_hysteresis``).
    """

    capacity_ah: float
    measured_ah: float
    sources: tuple[Source, ...]
    tests: tuple[RelaxationTest, ...]
    hysteresis_v: Floats | None
    hysteresis_std_v: Floats
    has_typical_hysteresis: bool = False

    @property
    def points(self) -> Points:
        """Points of all sources."""
        return join_points([source.points for source in self.sources])
