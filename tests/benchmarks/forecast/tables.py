"""Tables of the scores, in Markdown."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product

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
from tests.benchmarks.forecast.measure import COUNT, FORECAST, GIVEN, HALF_HOUR, LEADS_S, PERFECT, POWER
from tests.benchmarks.forecast.scores import Condition, Outcome, Score, lead, said_between, score

METHODS = (FORECAST, COUNT, HALF_HOUR, POWER, PERFECT)
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
    by_forecast = said_between(*BY_FORECAST_MIN)
    of_forecast = [o for o in outcomes if o.method == FORECAST]
    own = [o for o in of_forecast if o.file == OWN]
    judged = [o for o in of_forecast if by_forecast(o)]
    judged_own = [o for o in judged if o.file == OWN]
    yield table("by forecast (median 10 to 80 min)", (o for o in outcomes if by_forecast(o)), method_groups())
    yield table("by load", judged_own, [Group(load, _load(load)) for load in (DRIVE, PULSES, CONSTANT)])
    yield table(
        "by horizon",
        own,
        [Group(f"{a:.0f} to {b:.0f} min", said_between(a, b), target) for a, b, target in HORIZONS_MIN],
    )
    yield table("by temperature", judged, list(temperature_groups()))
    for name in METHODS:
        drives = [o for o in outcomes if o.method == name and o.file == OWN and o.load == DRIVE]
        yield table(f"by time before the cut-off, drives: {name}", drives, list(lead_groups(name)))
    given = [o for o in outcomes if o.method == GIVEN and 300.0 - 1.0 <= o.lead_s <= 4800.0]
    yield table(f"{GIVEN} (cut-off in 5 to 80 min)", given, list(temperature_groups("5 %")))
    constant = [o for o in own if o.load == CONSTANT and o.rate_c >= HALF_C]
    yield table("constant load from C/2, by time before the cut-off", constant, list(constant_groups()))
    yield table("by capture", judged, list(capture_groups(judged)))


def ablation_tables(outcomes: list[Outcome], parts: list[str]) -> Iterator[Table]:
    """Yield a table for each kind of load and cell file, with a row for the forecast without each part."""
    judged = [o for o in outcomes if said_between(*BY_FORECAST_MIN)(o)]
    for load, kind in product((DRIVE, PULSES, CONSTANT), FILES):
        of_kind = (o for o in judged if o.load == load and o.file == kind)
        yield table(f"{load}, {kind}: without", of_kind, [Group(part, _method(part, kind)) for part in parts])


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


def method_groups() -> list[Group]:
    """Return a group for each method with a cell's own file, and one for the forecast with each other kind of file."""
    return [
        Group(FORECAST, _method(FORECAST, OWN), "85-95 % in band, 6 % before"),
        *(Group(name, _method(name, OWN)) for name in METHODS[1:]),
        *(Group(f"{FORECAST}, {kind}", _method(FORECAST, kind)) for kind in (OTHER_TEMPERATURE, GENERIC, SIMULATED)),
    ]


def temperature_groups(target: str = "") -> Iterator[Group]:
    """Yield a group for each temperature, chemistry and kind of cell file."""
    for temperature_c in TEMPERATURES_C:
        target_at = target or ("20 %" if temperature_c == REFERENCE_C else "45 %" if temperature_c == -20.0 else "35 %")
        for kind in FILES:
            name = f"{temperature_c:g} C, {kind}"
            for knows, note, error in ((True, "", target_at), (False, ", not of this temperature", target or "60 %")):
                yield Group(name + note, _oxide(temperature_c, kind, knows=knows), error)
    for kind in FILES:
        yield Group(f"LFP, {kind}", _phosphate(kind), target or "35 %")


def lead_groups(method: str) -> Iterator[Group]:
    """Yield a group for each time before the cut-off."""
    for lead_s in LEADS_S:
        yield Group(f"{lead_s:.0f} s", lead(lead_s), DRIVE_TARGETS.get(lead_s, "") if method == FORECAST else "")


def constant_groups() -> Iterator[Group]:
    """Yield the groups of constant loads."""
    yield Group("1200 s and more", lambda o: o.lead_s >= LEADS_S[2] - 1.0, "5 %")
    yield Group("600 s", lead(600.0), "10 %")
    yield Group("300 s", lead(300.0))


def capture_groups(outcomes: list[Outcome]) -> Iterator[Group]:
    """Yield a group for each capture and kind of cell file."""
    for capture, kind in dict.fromkeys((o.capture, o.file) for o in outcomes):
        yield Group(f"{capture}, {kind}", _capture(capture, kind))


def _method(method: str, kind: str) -> Condition:
    return lambda o: o.method == method and o.file == kind


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
