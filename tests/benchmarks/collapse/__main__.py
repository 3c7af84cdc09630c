"""Study of the alarm before the cut-off voltage: signals alone and together, as curves of warnings against false alarms.

Each real capture is counted twice, with two cut-off voltages. Simulated days of use mostly stop above the cut-off; they and
the simulated discharges to the cut-off are marked as simulated. An alarm is false if no cut-off follows within 15 min. Hours
are hours of use: with load in the last 15 min, until the cut-off.
"""

import argparse
import math
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.settings.alarm_limits import COLLAPSE_CLEAR_FRACTION
from tests.benchmarks.collapse.curve import Point, best, curve
from tests.benchmarks.collapse.drives import Recording, captures, simulations
from tests.benchmarks.collapse.signals import Discharge, discharges
from tests.benchmarks.forecast.captures import OWN, cases, other_cases

RATES = (1.0, 2.0, 4.0, 8.0, 15.0)
"""Numbers of false alarms in 100 h for which the best point of each curve is printed."""
PROBABILITIES = np.r_[0.02, 0.05, 0.1:0.98:23j]
"""Limits of a probability."""


@dataclass(frozen=True)
class Signal:
    """Signal of a coming cut-off; a larger value is more urgent.

    Attributes:
        name: Name in the table.
        values: Function of rows of dtype ``SIGNALS`` that returns the signal, shape (n,).
        limits: Limits of the alarm.
        clear_fraction: Clear level as a fraction of the limit.
    """

    name: str
    values: Callable[[np.ndarray], Floats]
    limits: Floats
    clear_fraction: float = 1.0


def forecast(name: str, field: str, condition: Callable[[np.ndarray], np.ndarray] | None = None) -> Signal:
    """Return the signal of a probability of the forecast, which is 0 where ``condition`` is false."""

    def values(rows: np.ndarray) -> Floats:
        return rows[field] if condition is None else np.where(condition(rows), rows[field], 0.0)

    return Signal(name, values, PROBABILITIES, COLLAPSE_CLEAR_FRACTION)


FIVE = "within_5min"
SIGNALS: tuple[Signal, ...] = (
    forecast("P(120 s)", "within_2min"),
    forecast("P(300 s)", FIVE),
    forecast("P(900 s)", "within_15min"),
    Signal("lowest voltage of 10 min", lambda rows: -rows["lowest_v"], -np.linspace(0.02, 0.6, 30)),
    Signal("dV/dt extrapolated", lambda rows: -rows["extrapolated_s"], -np.geomspace(3.0, 600.0, 30)),
    Signal("rate of k", lambda rows: rows["gain_rate"], np.geomspace(1e-3, 1.0, 30)),
    Signal("tracking error", lambda rows: rows["error_v"], np.geomspace(0.003, 0.1, 30)),
    Signal("stability margin", lambda rows: -rows["margin"], -np.linspace(0.0, 0.5, 51)),
    Signal("SOC", lambda rows: -rows["soc"], -np.linspace(0.01, 0.5, 50)),
    forecast("P(300 s), lowest < 0.2 V", FIVE, lambda rows: rows["lowest_v"] < 0.2),
    forecast("P(300 s), lowest < 0.3 V", FIVE, lambda rows: rows["lowest_v"] < 0.3),
    forecast("P(300 s), dV/dt < 300 s", FIVE, lambda rows: rows["extrapolated_s"] < 300.0),
    forecast("P(300 s), k rises", FIVE, lambda rows: rows["gain_rate"] > 1e-3),
    forecast("P(300 s), margin < 0.2", FIVE, lambda rows: rows["margin"] < 0.2),
)
"""Signals alone, and the probability within 5 min together with a condition on another signal."""
CHOSEN = "P(300 s)"
"""Signal of the alarm ``collapse_risk``."""
PLOTTED = (CHOSEN, "P(120 s)", "lowest voltage of 10 min", "stability margin", "dV/dt extrapolated", "rate of k")
"""Signals in the plot."""


def main() -> None:
    """Print the tables, and draw the plot if its path is given."""
    parser = argparse.ArgumentParser(prog="make collapse", description=__doc__)
    parser.add_argument("words", nargs="*", help="parts of the names of captures; default: all")
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="other captures, FOLDER/cell/capture.csv.gz")
    parser.add_argument("--plot", type=Path, metavar="PATH", help="file of the plot, .png or .svg")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = list(evaluate(recordings(options, Path(folder))))
    report(found)
    if options.plot:
        draw(found, options.plot)


def recordings(options: argparse.Namespace, folder: Path) -> Iterator[Recording]:
    """Yield the chosen captures, and without a choice the simulated days."""
    if options.data:
        yield from captures(other_cases(options.data, options.words, None), folder)
        return
    yield from captures((case for case in cases(options.words) if case.file == OWN), folder)
    if not options.words:
        yield from simulations()


def evaluate(chosen: Iterator[Recording]) -> Iterator[Discharge]:
    """Yield the discharges of all recordings with each cut-off voltage, and report each to stderr."""
    for recording in chosen:
        for cutoff_v in recording.cutoff_v:
            found = list(discharges(recording, cutoff_v))
            hours = sum(each.use_h for each in found)
            cutoffs = sum(math.isfinite(each.cutoff_s) for each in found)
            sys.stderr.write(f"{recording.name}, {cutoff_v:.2f} V: {hours:.1f} h of use, {cutoffs} cut-offs\n")
            yield from found


def report(found: Sequence[Discharge]) -> None:
    """Print the tables of real and of all discharges, and the curve of the alarm."""
    real = [each for each in found if not each.is_simulated]
    groups = {"real captures": real}
    if len(real) < len(found):
        groups |= {"simulated": [each for each in found if each.is_simulated], "all": list(found)}
    for title, members in groups.items():
        hours, cutoffs = sum(each.use_h for each in members), sum(math.isfinite(each.cutoff_s) for each in members)
        sys.stdout.write(f"\n{title}: {hours:.0f} h of use, {cutoffs} cut-offs\n\n")
        if not cutoffs:
            sys.stdout.write("no cut-off\n")
            continue
        sys.stdout.writelines(f"| {' | '.join(line)} |\n" for line in comparison(members))
        sys.stdout.write(f"\n{CHOSEN}, {title}\n\n")
        sys.stdout.writelines(f"| {' | '.join(line)} |\n" for line in operating_points(members))


def comparison(found: Sequence[Discharge]) -> Iterator[list[str]]:
    """Yield the lines of the table of all signals: fraction warned at least 60 s ahead / raised at all, median lead."""
    yield ["signal", *(f"at most {rate:g} false in 100 h" for rate in RATES)]
    yield ["---"] * (len(RATES) + 1)
    for signal in SIGNALS:
        points = points_of(signal, found)
        yield [signal.name, *(cell(best(points, rate)) for rate in RATES)]


def cell(chosen: Point | None) -> str:
    """Return the cell of a point in the table."""
    if chosen is None:
        return "-"
    lead = "" if math.isnan(chosen.median_lead_s) else f", {chosen.median_lead_s:.0f} s"
    return f"{chosen.ahead:.2f} / {chosen.raised:.2f}{lead}"


def operating_points(found: Sequence[Discharge]) -> Iterator[list[str]]:
    """Yield the lines of the table of all limits of the alarm."""
    yield ["limit", "false in 100 h", "raised", "60 s ahead", "median lead [s]"]
    yield ["---"] * 5
    signal = next(each for each in SIGNALS if each.name == CHOSEN)
    for each in points_of(signal, found):
        yield [
            f"{each.limit:.2f}",
            f"{each.false_in_100_h:.1f}",
            f"{each.raised:.2f}",
            f"{each.ahead:.2f}",
            f"{each.median_lead_s:.0f}",
        ]


def points_of(signal: Signal, found: Sequence[Discharge]) -> list[Point]:
    """Return the curve of a signal."""
    series = [signal.values(each.rows) for each in found]
    return curve(found, series, signal.limits, signal.clear_fraction * signal.limits)


def draw(found: Sequence[Discharge], path: Path) -> None:
    """Draw the fraction of cut-offs warned at least 60 s ahead over the rate of false alarms."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - only for the plot

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    ax = figure.subplots()
    for signal in (each for each in SIGNALS if each.name in PLOTTED):
        points = points_of(signal, found)
        ax.plot(
            [each.false_in_100_h for each in points],
            [100.0 * each.ahead for each in points],
            marker=".",
            linewidth=2.0 if signal.name == CHOSEN else 1.0,
            label=signal.name,
        )
    ax.set_xscale("symlog", linthresh=1.0)
    ax.set_xlim(0.0, 200.0)
    ax.set_xlabel("false alarms in 100 h of use")
    ax.set_ylabel("cut-offs warned 60 s ahead [%]")
    ax.grid(alpha=0.3)
    ax.legend(fontsize="small")
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()
