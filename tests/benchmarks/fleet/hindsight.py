"""Interval coverage of SOC estimates, relative to later estimates and to the true SOC, for docs/fleet/questions.md.

An estimate is covered if it differs by at most 2 std from the reference. The command `fleet ask honest` has no true SOC: its
reference is a later estimate with a smaller std.

The captures last only a few hours. Therefore a slot of six minutes replaces an hour of the fleet. The estimator starts at
the points of a capture at which `make anywhere` starts. Each run counts as a pack. Columns of the table:

- judged: number of comparisons of an estimate with a later estimate
- hindsight: fraction of these comparisons in which the estimate covers the later estimate
- truth, there: fraction of the estimates which cover the true SOC, among the estimates with a more certain later estimate
- truth, all: fraction of all estimates that cover the true SOC
- offset: mean of error over std of the estimates of "truth, there". Later estimates share this error and cannot show it
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.fleet.hour_row import Hour
from bms_estimator.fleet.queries.duckdb_queries import LIMITS, Limits, run_query
from bms_estimator.fleet.queries.parquet_files import write
from bms_estimator.fleet.worker.hour_summary import add, begin, row
from bms_estimator.kernels.accumulators.hour import HOUR_SUMS
from bms_estimator.model.arrays import Floats, SampleBlock
from bms_estimator.model.cell import CellModel
from bms_estimator.settings.pack import PackSettings
from tests.benchmarks.recipes import GROUPS, Group, chosen, runs

SLOT_S = 360.0
"""Duration of a slot [s]."""
MIN_SAMPLED_FRACTION = 0.97
"""Minimum fraction of a slot with samples. A slot may lack 11 s; an hour of the fleet may lack 10 s."""
LATER_SLOTS = (1, 3, 6, 12, 24)
"""Distances of the later estimates with which `honest` compares [slots]."""
STORE_ID = 10**9
"""Identifier of the edge's block store: its creation time [ns since 1970]."""


def limits(slot_s: float = SLOT_S) -> Limits:
    """Return the limits with slots in place of hours."""
    return replace(LIMITS, min_seen_s=MIN_SAMPLED_FRACTION * slot_s)


class SlotEstimate(NamedTuple):
    """Estimate at the end of a slot, with its true error."""

    hour: Hour
    """Summary of the slot, in the form of the summary of an hour."""
    error: float
    """Estimated minus true SOC."""


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
    """Return the cells of a group's table row."""
    packs = [slots(f"p{n}", *run) for n, run in enumerate(runs(group, folder))]
    hours = folder / group.name.replace("/", " ")
    write(hours, [estimate.hour for pack in packs for estimate in pack])
    records = run_query(hours, "honest", limits=limits()).records
    if not records:
        return ["0"]
    errors_there = np.array([x for pack in packs for x in normalized_errors(pack)])
    all_errors = np.array(
        [estimate.error / (estimate.hour.soc_mean_std or np.nan) for pack in packs for estimate in pack]
    )
    judgements, within, inside_all = (
        records[0]["judgements"],
        records[0]["within_2_std"],
        np.mean(np.abs(all_errors) <= 2.0),
    )
    columns_there = (
        (f"{100 * np.mean(np.abs(errors_there) <= 2.0):.0f}", f"{errors_there.mean():+.1f}")
        if errors_there.size
        else ("", "")
    )
    return [str(judgements), f"{100 * within:.0f}", columns_there[0], f"{100 * inside_all:.0f}", columns_there[1]]


def normalized_errors(pack: list[SlotEstimate]) -> list[float]:
    """Return error over standard deviation of the estimates that have a more certain later estimate."""
    std = np.array([estimate.hour.soc_mean_std or np.nan for estimate in pack])
    return [
        estimate.error / std[n]
        for n, estimate in enumerate(pack)
        if any(n + k < std.size and std[n + k] ** 2 < LIMITS.max_variance_ratio * std[n] ** 2 for k in LATER_SLOTS)
    ]


def slots(
    pack: str, cell: CellModel, samples: SampleBlock, truth: Floats, start_soc: float, slot_s: float = SLOT_S
) -> list[SlotEstimate]:
    """Return the estimates at intervals of ``slot_s`` [s], and the errors of their SOC."""
    estimator, sums, estimates = Estimator(cell, initial_soc=start_soc), np.zeros(1, HOUR_SUMS), list[SlotEstimate]()
    slot_of_sample = ((samples["time_s"] - samples["time_s"][0]) // slot_s).astype(int)
    for slot in range(slot_of_sample[-1]):  # without the last one, which is incomplete
        first, end = np.searchsorted(slot_of_sample, [slot, slot + 1])
        if first == end:
            continue
        begin(sums, estimator.record[0])
        add(sums, estimator.run(samples[first:end]), end - first, STORE_ID, estimator)
        hour = row(PackSettings(name=pack, cell=cell.cell.name[:30]), slot, sums, estimator)
        if hour.soc is not None and hour.soc_mean_std:
            estimates.append(SlotEstimate(hour, hour.soc - float(truth[end - 1])))
    return estimates


if __name__ == "__main__":
    main()
