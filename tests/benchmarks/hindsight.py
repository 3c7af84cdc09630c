"""Share of SOCs within 2 std by hindsight (`fleet ask honest`) and in truth, on real captures:
docs/fleet/questions.md.

Captures last hours, so six minutes stand for an hour. Each is entered as `make anywhere` does; each run is a pack.

- hindsight: share within 2 std as `honest` has it
- truth, there: the same against the truth, of the SOCs that hindsight can judge: a later one is surer
- truth, all: of all
- offset: mean of error over std there: what all have in common, and hindsight cannot see
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from bms_estimator.edge.block import Block
from bms_estimator.estimator import Estimator
from bms_estimator.fleet.queries.duckdb_queries import LIMITS, Limits, run_query
from bms_estimator.fleet.queries.parquet_files import write
from bms_estimator.fleet.worker.hour_summary import HOUR_SUMS, Hour, add, begin, row
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.sample import SampleBlock
from bms_estimator.settings.pack import PackSettings
from tests.benchmarks.recipes import GROUPS, Group, chosen, runs

SLOT_S = 360.0
LATER = (1, 3, 6, 12, 24)
"""Distance from which `honest` looks back."""
STORE = 10**9


def limits(slot_s: float = SLOT_S) -> Limits:
    """Return the limits with slots in place of hours."""
    return replace(LIMITS, least_seen_s=0.97 * slot_s)


class Known(NamedTuple):
    """Estimate at the end of a slot, with its true error."""

    hour: Hour
    error: float


def main() -> None:
    """Print the table of the groups whose name contains an argument, or all."""
    table = Table(title="share within 2 std in %")
    for column in ("group", "judged", "hindsight", "truth, there", "truth, all", "offset"):
        table.add_column(column, justify="left" if column == "group" else "right")
    with tempfile.TemporaryDirectory() as folder:
        for group in chosen(GROUPS, sys.argv[1:]):
            table.add_row(group.name, *_outcome(group, Path(folder)))
    Console(width=100).print(table)


def _outcome(group: Group, folder: Path) -> list[str]:
    packs = [slots(f"p{n}", *run) for n, run in enumerate(runs(group, folder))]
    hours = folder / group.name.replace("/", " ")
    write(hours, [known.hour for pack in packs for known in pack])
    found = run_query(hours, "honest", limits=limits()).records
    if not found:
        return ["0"]
    there = np.array([x for pack in packs for x in judged(pack)])
    every = np.array([known.error / (known.hour.soc_mean_std or np.nan) for pack in packs for known in pack])
    judgements, within, of_all = found[0]["judgements"], found[0]["within_2_std"], np.mean(np.abs(every) <= 2.0)
    same = (f"{100 * np.mean(np.abs(there) <= 2.0):.0f}", f"{there.mean():+.1f}") if there.size else ("", "")
    return [str(judgements), f"{100 * within:.0f}", same[0], f"{100 * of_all:.0f}", same[1]]


def judged(pack: list[Known]) -> list[float]:
    """Return error over standard deviation of the estimates that have a more certain later one."""
    std = np.array([known.hour.soc_mean_std or np.nan for known in pack])
    return [
        known.error / std[n]
        for n, known in enumerate(pack)
        if any(n + k < std.size and std[n + k] ** 2 < LIMITS.surer * std[n] ** 2 for k in LATER)
    ]


def slots(
    pack: str, cell: CellModel, seen: SampleBlock, truth: Floats, start_soc: float, slot_s: float = SLOT_S
) -> list[Known]:
    """Return the estimates at intervals of ``slot_s`` [s], and the errors of their SOC."""
    estimator, sums, known = Estimator(cell, initial_soc=start_soc), np.zeros(1, HOUR_SUMS), list[Known]()
    number = ((seen["time_s"] - seen["time_s"][0]) // slot_s).astype(int)
    for slot in range(number[-1]):
        first, end = np.searchsorted(number, [slot, slot + 1])
        if first == end:
            continue
        begin(sums, estimator.record[0])
        add(sums, estimator.run(seen[first:end]), Block(STORE, 1, 1, 0.0, seen[first:end]), estimator)
        hour = row(PackSettings(name=pack, cell=cell.cell.name[:30]), slot, sums, estimator)
        if hour.soc is not None and hour.soc_mean_std:
            known.append(Known(hour, hour.soc - float(truth[end - 1])))
    return known


if __name__ == "__main__":
    main()
