"""Tables of the scores, in Markdown."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from rich import box
from rich.table import Table

from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from tests.benchmarks.forecast.captures import (
    CONSTANT,
    DRIVE,
    GENERIC,
    OTHER_TEMPERATURE,
    OWN,
    PULSES,
    SIMULATED,
)
from tests.benchmarks.forecast.scores import Condition, Outcome, Score, lead, said_between, score

LEADS_S = (3600.0, 1800.0, 1200.0, 600.0, 300.0, 120.0)
"""Times before the cut-off at which the forecasts are judged [s]."""
BY_FORECAST_MIN = (10.0, 80.0)
"""Range of the median of the forecasts that are judged by what they say [min]."""
HORIZONS_MIN = ((40.0, 80.0, "20 %"), (20.0, 40.0, "35 %"), (10.0, 20.0, "45 %"), (5.0, 10.0, ""), (0.0, 5.0, ""))
"""Ranges of the median of the forecast [min], each with the error to reach."""
TEMPERATURES_C = (40.0, 25.0, 10.0, 0.0, -10.0, -20.0)
"""Temperatures by which captures are grouped [C]."""
FILES = (OWN, OTHER_TEMPERATURE, GENERIC, SIMULATED)
DRIVE_TARGETS = {3600.0: "20 %", 1800.0: "40 %", 1200.0: "40 %", 600.0: "50 %"}
"""Error to reach in drives at each time before the cut-off [s]."""
HALF_C = 0.45
"""C-rate from which on a constant load is judged; the capacity of a cell file is not exactly its C-rate's."""
COLUMNS = (
    "forecasts",
    "captures",
    "median error",
    "in 90 % band",
    "before 5 %",
    "interval score",
    "its mean",
    "pinball loss",
)


@dataclass(frozen=True)
class Group:
    """Group of outcomes: a row of a table."""

    name: str
    holds: Condition
    target: str = ""


def tables(outcomes: list[Outcome]) -> Iterator[Table]:
    """Yield all tables that have a row."""
    own = [o for o in outcomes if o.file == OWN]
    judged = [o for o in outcomes if said_between(*BY_FORECAST_MIN)(o)]
    judged_own = [o for o in judged if o.file == OWN]
    drives = [o for o in own if o.load == DRIVE]
    constant = [o for o in own if o.load == CONSTANT and o.rate_c >= HALF_C]
    by_horizon = [Group(f"{a:.0f} to {b:.0f} min", said_between(a, b), target) for a, b, target in HORIZONS_MIN]
    yield table("by cell file (median 10 to 80 min)", judged, [Group(kind, _file(kind)) for kind in FILES])
    yield table("by load", judged_own, [Group(load, _load(load)) for load in (DRIVE, PULSES, CONSTANT)])
    yield table("by horizon", own, by_horizon)
    yield table("by temperature", judged, list(temperature_groups()))
    yield table("by time before the cut-off, drives", drives, list(lead_groups()))
    yield table("constant load from C/2, by time before the cut-off", constant, list(constant_groups()))
    yield table("by capture", judged, list(capture_groups(judged)))


def table(title: str, outcomes: Iterable[Outcome], groups: list[Group]) -> Table:
    """Return a table with a row for each group that has outcomes."""
    found = list(outcomes)
    made = Table("", *COLUMNS, title=title, box=box.MARKDOWN)
    has_target = any(group.target for group in groups)
    if has_target:
        made.add_column("target")
    for group in groups:
        of_group = [o for o in found if group.holds(o)]
        scores = score(of_group)
        if scores is not None:
            captures = len({o.capture for o in of_group})
            made.add_row(group.name, *cells(scores, captures), *([group.target] if has_target else []))
    return made


def cells(scores: Score, captures: int) -> Iterator[str]:
    """Yield the cells of a row."""
    yield f"{scores.count}"
    yield f"{captures}"
    yield from (f"{100 * x:.0f} %" for x in (scores.error, scores.inside, scores.early))
    yield from (f"{x:.2f}" for x in (scores.interval, scores.mean_interval))
    yield f"{scores.pinball:.3f}"


def temperature_groups() -> Iterator[Group]:
    """Yield a group for each temperature, chemistry and kind of cell file."""
    for temperature_c in TEMPERATURES_C:
        target_at = "20 %" if temperature_c == REFERENCE_C else "45 %" if temperature_c == -20.0 else "35 %"
        for kind in FILES:
            name = f"{temperature_c:g} C, {kind}"
            for knows, note, error in ((True, "", target_at), (False, ", not of this temperature", "60 %")):
                yield Group(name + note, _oxide(temperature_c, kind, knows=knows), error)
    for kind in FILES:
        yield Group(f"LFP, {kind}", _phosphate(kind), "35 %")


def lead_groups() -> Iterator[Group]:
    """Yield a group for each time before the cut-off."""
    for lead_s in LEADS_S:
        yield Group(f"{lead_s:.0f} s", lead(lead_s), DRIVE_TARGETS.get(lead_s, ""))


def constant_groups() -> Iterator[Group]:
    """Yield the groups of constant loads."""
    yield Group("1200 s and more", lambda o: o.truth_s >= LEADS_S[2] - 1.0, "5 %")
    yield Group("600 s", lead(600.0), "10 %")
    yield Group("300 s", lead(300.0))


def capture_groups(outcomes: list[Outcome]) -> Iterator[Group]:
    """Yield a group for each capture and kind of cell file."""
    for capture, kind in dict.fromkeys((o.capture, o.file) for o in outcomes):
        yield Group(f"{capture}, {kind}", _capture(capture, kind))


def _file(kind: str) -> Condition:
    return lambda o: o.file == kind


def _load(load: str) -> Condition:
    return lambda o: o.load == load


def _capture(capture: str, kind: str) -> Condition:
    return lambda o: o.capture == capture and o.file == kind


def _phosphate(kind: str) -> Condition:
    return lambda o: o.is_phosphate and o.file == kind


def _oxide(temperature_c: float, kind: str, *, knows: bool) -> Condition:
    def holds(o: Outcome) -> bool:
        nearest_c = min(TEMPERATURES_C, key=lambda c: abs(c - o.temperature_c))
        return not o.is_phosphate and o.file == kind and o.knows_temperature == knows and nearest_c == temperature_c

    return holds
