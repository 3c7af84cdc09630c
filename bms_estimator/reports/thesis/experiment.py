"""Claims of chapters 4 to 7 of the thesis about its recordings, tested on other captures.

The captures are real, or the simulated pack is measured by two sensor chains. A claim holds if the error is at most the printed
value on more than half of the captures. For the SOC and the RC products the thesis prints no value that could be a limit. Their
limits, and the limit 1 of the ratio between the dynamic and the static model, are chosen here.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bms_estimator.calibration.elements.initial_elements import initial_elements
from bms_estimator.model.arrays import Floats, SampleBlock
from bms_estimator.model.cell import CellModel
from bms_estimator.model.errors import UserError
from bms_estimator.reports.thesis import printed_values
from bms_estimator.reports.thesis.procedure import Capture, Kind, Procedure, kind_of
from bms_estimator.reports.thesis.report_items import Reproduction
from bms_estimator.reports.thesis.simulated_experiment import SensorChain, captures, experiments, pack
from bms_estimator.reports.thesis.simulation import element

PRODUCTS_PERCENT = 20.0
"""Maximum error of the products R_ts C_ts and R_tl C_tl [%], about ten times the 1.9 % of Table 7. Theorem 4.1.2 claims that
the products are exact."""
SOC_PERCENT = 5.0
"""Maximum error of the interpolated SOC [%]. Coulomb counting would keep an initial error of this size. Section 7.1 of
the thesis claims that interpolation in the OCV curve is more accurate."""
MIDDLE_SOC = 0.5
"""SOC at which the RC products are compared."""


@dataclass(frozen=True)
class Result:
    """Result of a claim on one capture.

    Attributes:
        capture: Name of the capture.
        value: Measured value, in the claim's unit.
        limit: Limit of the value.
    """

    capture: str
    value: float
    limit: float

    @property
    def is_met(self) -> bool:
        """True if the claim holds for the capture."""
        return self.value <= self.limit


@dataclass(frozen=True)
class Claim:
    """Claim of the thesis, and the results on other captures.

    Attributes:
        key: Name of the claim in the tables, such as "constant loads, mean".
        location: Table or figure of the thesis.
        criterion: Condition that more than half of the captures must meet.
        results: Results of each capture that the claim can be tested on.
    """

    key: str
    location: str
    criterion: str
    results: tuple[Result, ...]

    @property
    def captures_met(self) -> int:
        """Number of captures on which the criterion is met."""
        return sum(result.is_met for result in self.results)

    @property
    def verdict(self) -> Reproduction:
        """Verdict on the claim; NO_DATA if no capture can test it."""
        if not self.results:
            return Reproduction.NO_DATA
        return Reproduction.CLAIM_HOLDS if 2 * self.captures_met > len(self.results) else Reproduction.CLAIM_FAILS

    @property
    def span(self) -> str:
        """Range of the measured values."""
        if not self.results:
            return "-"
        values = [result.value for result in self.results]
        ends = [f"{end:.3g}" for end in (min(values), max(values))]
        return ends[0] if ends[0] == ends[1] else " to ".join(ends)

    @property
    def sentence(self) -> str:
        """Criterion and result in a sentence."""
        criterion = f"{self.key[0].upper()}{self.key[1:]}: {self.criterion}"
        if not self.results:
            return f"{criterion}: none of the captures can test it."
        return f"{criterion}: met on {self.captures_met} of {len(self.results)} captures (values {self.span}); required: more than half."


def _constant_load_test(
    measure: Callable[[Procedure, str], float], limit: float
) -> Callable[[Procedure], list[Result]]:
    """Return a test that compares the measure with the limit on each capture of a constant load."""
    return lambda p: [Result(c.name, measure(p, c.name), limit) for c in p.validating if c.kind is Kind.CONSTANT]


def _step_load_test(measure: Callable[[Procedure, str], float], limit: float) -> Callable[[Procedure], list[Result]]:
    """Return a test that compares the measure with the limit on each capture of a load in steps."""
    return lambda p: [Result(c.name, measure(p, c.name), limit) for c in p.validating if c.kind is Kind.STEPS]


def _mean_percent(p: Procedure, name: str) -> float:
    return p.dynamic[name].mean_percent


def _max_percent(p: Procedure, name: str) -> float:
    return p.dynamic[name].max_percent


def _dynamic_over_static(p: Procedure, limit: float) -> list[Result]:
    return [Result(c.name, p.dynamic[c.name].mean_percent / p.static[c.name].mean_percent, limit) for c in p.validating]


def _soc_difference(p: Procedure) -> list[Result]:
    return [
        Result(
            c.name,
            100.0 * float(np.sqrt(np.mean((p.interpolate_soc(c.name)[0] - p.dynamic[c.name].soc) ** 2))),
            SOC_PERCENT,
        )
        for c in p.validating
    ]


def products(p: Procedure) -> Iterator[tuple[str, float, float]]:
    """Yield a label, the estimated value and the value measured in the rests [s] for each relaxation test and RC product."""
    for test, capture in zip(p.tests, p.captures_of(Kind.RELAXATION), strict=True):
        try:
            measured = initial_elements(capture.samples, test, p.cell.cell.capacity_ah)
        except UserError:  # without a rest after a discharge, there is nothing to compare with
            continue
        for name, measured_s in (("R_ts C_ts", measured.tau_ts_s), ("R_tl C_tl", measured.tau_tl_s)):
            estimated_s = float(element(name, p.adaptive.average, np.array([MIDDLE_SOC]))[0])
            yield f"{capture.name}, {name}", estimated_s, measured_s


def _products(p: Procedure) -> list[Result]:
    return [
        Result(name, 100.0 * abs(estimated_s / measured_s - 1.0), PRODUCTS_PERCENT)
        for name, estimated_s, measured_s in products(p)
    ]


PRINTED_RATIO = printed_values.TABLE_13["dynamic"] / printed_values.TABLE_13["static"]
"""Printed ratio of the mean errors of the dynamic and the static model."""
LARGEST_CONSTANT = max(printed_values.TABLE_11[load] for load in printed_values.CURRENTS_A)
"""Largest printed mean error under a constant load [%]."""
LARGEST_STEPS = max(printed_values.TABLE_11[load] for load in ("constant steps", "variable steps"))
"""Largest printed mean error under steps [%]."""

CLAIMS: dict[str, tuple[str, str, Callable[[Procedure], list[Result]]]] = {
    "constant loads, mean": (
        "Table 11",
        f"mean error at most {LARGEST_CONSTANT:g} %, the largest printed for a constant load",
        _constant_load_test(_mean_percent, LARGEST_CONSTANT),
    ),
    "constant loads, largest": (
        "Figure 33",
        f"largest error at most {printed_values.MAX_CONSTANT:g} %",
        _constant_load_test(_max_percent, printed_values.MAX_CONSTANT),
    ),
    "steps, mean": (
        "Table 11",
        f"mean error at most {LARGEST_STEPS:g} %, the larger of the two printed for steps",
        _step_load_test(_mean_percent, LARGEST_STEPS),
    ),
    "steps, largest": (
        "Figure 38",
        f"largest error at most {printed_values.MAX_STEPS:g} %",
        _step_load_test(_max_percent, printed_values.MAX_STEPS),
    ),
    "dynamic against static, ratio": (
        "Table 13",
        f"mean error of the dynamic model divided by that of the static one at most {PRINTED_RATIO:.4f}, as printed",
        lambda p: _dynamic_over_static(p, PRINTED_RATIO),
    ),
    "dynamic against static, order": (
        "Table 13",
        "mean error of the dynamic model divided by that of the static one at most 1",
        lambda p: _dynamic_over_static(p, 1.0),
    ),
    "SOC by interpolation": (
        "Figure 41",
        f"SOC by interpolation in E_o within {SOC_PERCENT:g} % RMS of the cycler's count",
        _soc_difference,
    ),
    "RC products": (
        "Figure 29",
        f"R_ts C_ts and R_tl C_tl within {PRODUCTS_PERCENT:g} % of the time constants of the relaxation test's rests",
        _products,
    ),
}
"""Location, criterion and test on one cell, by key of the claim."""


def claim(key: str, procedures: Sequence[Procedure]) -> Claim:
    """Test a claim on the captures of one or more cells. A relaxation test shared by two cells counts twice."""
    location, criterion, test = CLAIMS[key]
    return Claim(key, location, criterion, tuple(result for p in procedures for result in test(p)))


FINE = SensorChain(bits=16)
"""Sensor chain of the dSpace board of the thesis, with 16 bits."""
COARSE = SensorChain(bits=10)
"""Sensor chain of an Arduino, with 10 bits."""


@dataclass(frozen=True)
class RecordedCaptures:
    """Real captures.

    Attributes:
        cell: Cell file with capacity, limits and bounds.
        samples: Name and samples of each capture.
        voltage_step_v: Resolution of the voltage [V].
    """

    cell: CellModel
    samples: tuple[tuple[str, SampleBlock], ...]
    voltage_step_v: float


class Experiment:
    """Experimental procedure on one pack.

    Args:
        recorded: Real captures; None for the simulated pack.
    """

    def __init__(self, recorded: RecordedCaptures | None = None) -> None:
        self.recorded = recorded

    @cached_property
    def _true_captures(self) -> list[Capture]:
        return experiments()

    @cached_property
    def procedure(self) -> Procedure:
        """Procedure on the real captures, or on the simulated pack measured with 16 bits."""
        if self.recorded is None:
            return Procedure(pack(), captures(self._true_captures, FINE), FINE.voltage_step_v)
        cell = self.recorded.cell
        captures_with_kind = [
            Capture(name, kind_of(name, samples, cell.cell.capacity_ah), samples)
            for name, samples in self.recorded.samples
        ]
        return Procedure(cell, captures_with_kind, self.recorded.voltage_step_v)

    @cached_property
    def coarse_procedure(self) -> Procedure | None:
        """Procedure on the simulated pack measured with 10 bits; None for real captures."""
        if self.recorded is not None:
            return None
        return Procedure(pack(), captures(self._true_captures, COARSE), COARSE.voltage_step_v)

    def verdict_on_claims(self, *keys: str) -> tuple[Reproduction, str]:
        """Return the common verdict on the claims ``keys`` of ``CLAIMS``, and its reason.

        No claim is tested on the simulated pack, because the pack has exactly the form of the model.
        """
        if self.recorded is None:
            return Reproduction.NO_DATA, ""
        claims = [claim(key, [self.procedure]) for key in keys]
        reason = "".join(f"{tested.sentence} " for tested in claims)
        verdicts = {tested.verdict for tested in claims} - {Reproduction.NO_DATA}
        if not verdicts:
            return Reproduction.NO_DATA, reason
        return (Reproduction.CLAIM_FAILS if Reproduction.CLAIM_FAILS in verdicts else Reproduction.CLAIM_HOLDS), reason

    @property
    def truth(self) -> Floats | None:
        """True a1..a21 of the simulated pack at index 1..21; None for real captures."""
        return pack().a if self.recorded is None else None

    @property
    def data_source(self) -> str:
        """Description of the data source."""
        if self.recorded is None:
            return "the simulated 6S pack"
        return f"{len(self.recorded.samples)} captures of {self.recorded.cell.cell.name}"

    @property
    def data_note(self) -> str:
        """Sentence on the data, and the reason why the printed numbers cannot be reproduced."""
        return f"The thesis's recordings are not published. Its procedure was run on {self.data_source}."
