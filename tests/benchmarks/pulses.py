"""Comparison of the estimated R_s with the resistance of current steps in the captures.

A pulse is a step of the current by more than C/5 between two constant currents. Its resistance is the change of the voltage
divided by the change of the current. With more than two rows a second the change is over two rows, because logged current and
voltage may be one row apart. A running median over nine pulses is used, because a single pulse has errors of up to 16 %.
Results are compared from 15 min after the start on.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from scipy.ndimage import median_filter

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import Floats, SampleBlock
from tests.benchmarks.recipes import FROM_START, GROUPS, SOC_ERRORS, Group, cell_file, chosen, load

MIN_C = 0.2
"""Minimum change of the current in a pulse [C-rate]."""
MAX_CHANGE_AROUND = 0.1
"""Maximum change of the current in the rows before and after a pulse, as a fraction of the pulse."""
MAX_STEP_S = 1.6
"""Maximum time between the two rows of a pulse [s]."""
SLOW_S = 0.5
"""Row interval above which the change is over a single row [s]."""
MEDIAN_PULSES = 9
"""Number of pulses of the running median."""
SETTLE_S = 900.0
"""Time after the start that is not compared [s]."""


def pulse_table(folder: Path, wanted: list[str]) -> Table:
    """Return the table of every matching group without sensor errors and without charges."""
    table = Table(title="R_s against pulses: ratio of the medians; within 10 %, inside 2 std [% of pulses]")
    for column in ("group", "pulses", "step s", "pulse mOhm", "ratio", "within 10 %", "inside", "std %"):
        table.add_column(column, justify="left" if column == "group" else "right")
    for group in chosen(GROUPS, wanted):
        is_sensor_exact = group.gain == group.capacity_ratio == 1.0 and group.offset_a == 0.0
        if is_sensor_exact and group.cut != FROM_START and not group.charging:
            table.add_row(group.name, *table_cells(group, folder))
    return table


def table_cells(group: Group, folder: Path) -> Iterator[str]:
    """Yield the cells of one table row."""
    cell, pulse_ohm, estimated_ohm, std, step_s = cell_file(group.recipe, folder), [], [], [], 0.0
    for name, capacity_ah, initial_soc in group.captures:
        samples = load(name, capacity_ah, initial_soc)[0]
        rows, ohm = find_pulses(samples, capacity_ah)
        if not rows.size:
            continue
        trace = Estimator(cell, initial_soc=initial_soc + SOC_ERRORS[0]).run(samples)
        pulse_ohm.append(median_filter(ohm, MEDIAN_PULSES, mode="nearest"))
        time_s = samples["time_s"][rows]
        estimated_ohm.append(np.interp(time_s, trace["time_s"], trace["r_s_ohm"]))
        std.append(np.interp(time_s, trace["time_s"], trace["r_s_std_ohm"]))
        step_s = float(np.median(np.diff(samples["time_s"])))
    if sum(map(len, pulse_ohm)) < MEDIAN_PULSES:
        yield "none"
        return
    pulse, r_s, r_s_std = np.concatenate(pulse_ohm), np.concatenate(estimated_ohm), np.concatenate(std)
    yield f"{pulse.size}"
    yield f"{step_s:.1f}"
    yield f"{1e3 * np.median(pulse):.1f}"
    yield f"{np.median(r_s / pulse):.2f}"
    yield f"{100 * np.mean(np.abs(r_s / pulse - 1.0) < 0.1):.0f}"
    yield f"{100 * np.mean(np.abs(r_s - pulse) < 2.0 * r_s_std):.0f}"
    yield f"{100 * np.median(r_s_std / r_s):.0f}"


def find_pulses(samples: SampleBlock, capacity_ah: float) -> tuple[NDArray[np.intp], Floats]:
    """Return the row before each pulse, and its resistance [ohm]."""
    time_s, current_a, voltage_v = (samples[n] for n in ("time_s", "current_a", "voltage_v"))
    change_a, step_s = np.diff(current_a), np.diff(time_s)
    inner = np.arange(1, change_a.size - 2)
    max_change_a = MAX_CHANGE_AROUND * np.abs(change_a[inner])
    is_constant_around = (np.abs(change_a[inner - 1]) < max_change_a) & (np.abs(change_a[inner + 1]) < max_change_a)
    is_large = np.abs(change_a[inner]) > MIN_C * capacity_ah
    is_valid_time = (step_s[inner] > 0.0) & (step_s[inner] < MAX_STEP_S) & (time_s[inner] > time_s[0] + SETTLE_S)
    rows = inner[is_constant_around & is_large & is_valid_time]
    row_count = np.where(step_s[rows + 1] > SLOW_S, 1, 2)  # number of rows from before to after the change
    ohm = -(voltage_v[rows + row_count] - voltage_v[rows]) / (current_a[rows + row_count] - current_a[rows])
    return rows, ohm
