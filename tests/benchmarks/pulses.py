"""R_s beside what pulses of the same captures show.

A pulse is a step of the current by more than C/5 that is held before and behind it; it shows the jump of the voltage over
that of the current, over two rows where there are more than two a second behind it: logged current and voltage may be one row apart.
Nine pulses around are taken together (median), since one alone is off by up to 16 %. Judged from 15 min on.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from scipy.ndimage import median_filter

from bms_estimator.estimator import Estimator
from bms_estimator.model.arrays import Floats
from bms_estimator.model.sample import SampleBlock
from tests.benchmarks.recipes import FROM_START, GROUPS, WRONG, Group, cell_file, chosen, load

MIN_C, HELD_SHARE = 0.2, 0.1
MAX_STEP_S, SLOW_S = 1.6, 0.5
AROUND = 9
AFTER_S = 900.0


def pulse_table(folder: Path, wanted: list[str]) -> Table:
    """Print the table for every group without foreign captures or sensor errors."""
    table = Table(title="R_s against pulses: ratio of the medians; within 10 %, inside 2 std [% of pulses]")
    for column in ("group", "pulses", "step s", "pulse mOhm", "ratio", "within 10 %", "inside", "std %"):
        table.add_column(column, justify="left" if column == "group" else "right")
    for group in chosen(GROUPS, wanted):
        sensors_right = group.gain == group.capacity == 1.0 and group.offset_a == 0.0
        if sensors_right and group.cut != FROM_START and not group.charging:
            table.add_row(group.name, *cells_of(group, folder))
    return table


def cells_of(group: Group, folder: Path) -> Iterator[str]:
    """Yield the cells of one table row."""
    cell, shown, said, std, step_s = cell_file(group.recipe, folder), [], [], [], 0.0
    for name, capacity_ah, initial_soc in group.captures:
        samples = load(name, capacity_ah, initial_soc)[0]
        rows, ohm = pulses(samples, capacity_ah)
        if not rows.size:
            continue
        trace = Estimator(cell, initial_soc=initial_soc + WRONG[0]).run(samples)
        shown.append(median_filter(ohm, AROUND, mode="nearest"))
        time_s = samples["time_s"][rows]
        said.append(np.interp(time_s, trace["time_s"], trace["r_s_ohm"]))
        std.append(np.interp(time_s, trace["time_s"], trace["r_s_std_ohm"]))
        step_s = float(np.median(np.diff(samples["time_s"])))
    if sum(map(len, shown)) < AROUND:
        yield "none"
        return
    pulse, r_s, r_s_std = np.concatenate(shown), np.concatenate(said), np.concatenate(std)
    yield f"{pulse.size}"
    yield f"{step_s:.1f}"
    yield f"{1e3 * np.median(pulse):.1f}"
    yield f"{np.median(r_s / pulse):.2f}"
    yield f"{100 * np.mean(np.abs(r_s / pulse - 1.0) < 0.1):.0f}"
    yield f"{100 * np.mean(np.abs(r_s - pulse) < 2.0 * r_s_std):.0f}"
    yield f"{100 * np.median(r_s_std / r_s):.0f}"


def pulses(samples: SampleBlock, capacity_ah: float) -> tuple[NDArray[np.intp], Floats]:
    """Return the row before each pulse, and its resistance [ohm]."""
    time_s, current_a, voltage_v = (samples[n] for n in ("time_s", "current_a", "voltage_v"))
    change_a, step_s = np.diff(current_a), np.diff(time_s)
    inner = np.arange(1, change_a.size - 2)
    most_a = HELD_SHARE * np.abs(change_a[inner])
    held = (np.abs(change_a[inner - 1]) < most_a) & (np.abs(change_a[inner + 1]) < most_a)
    large = np.abs(change_a[inner]) > MIN_C * capacity_ah
    soon = (step_s[inner] > 0.0) & (step_s[inner] < MAX_STEP_S) & (time_s[inner] > time_s[0] + AFTER_S)
    rows = inner[held & large & soon]
    over = np.where(step_s[rows + 1] > SLOW_S, 1, 2)
    ohm = -(voltage_v[rows + over] - voltage_v[rows]) / (current_a[rows + over] - current_a[rows])
    return rows, ohm
