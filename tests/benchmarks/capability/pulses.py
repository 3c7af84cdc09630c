"""Available power against constant currents of real captures.

The voltage at which a current of ten seconds or a minute ended is taken as the limit. Then the true available power is that
current times the lowest voltage, whatever the real limits of the cell are.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.table import Table

from bms_estimator.forecast.available_power import DURATIONS_S, QUANTILE_STDS
from bms_estimator.kernels.forecast.power import available_power, new_scratch
from bms_estimator.model.arrays import Floats, SampleBlock
from tests.benchmarks.capability.captures import Capture
from tests.benchmarks.recipes import LEAF, NCR, NCR_CELL, PF, PF_25, PF_US06, Recipe

CAPTURES = (
    *(
        Capture(f"PF {t} C", PF_US06, PF + f"{file}_hppc")
        for t, file in ((25, "25"), (10, "10"), (0, "0"), (-10, "n10"))
    ),
    *(
        Capture(f"PF {t} C, file of 25 C", PF_25, PF + f"{file}_hppc")
        for t, file in ((10, "10"), (0, "0"), (-10, "n10"))
    ),
    Capture("NCR, pulses", NCR_CELL, NCR + "cell1_hppc"),
    Capture("NCR, random steps", NCR_CELL, NCR + "cell1_random_steps", 0.98),
    Capture("Leaf (its own file)", LEAF, "leaf/hppc_25c_from_full"),
    *(
        Capture(f"generic nca: PF {t} C", Recipe(2.9, generic="nca"), PF + f"{file}_hppc")
        for t, file in ((25, "25"), (-10, "n10"))
    ),
    Capture("generic lmo: Leaf", Recipe(30.5, generic="lmo"), "leaf/hppc_25c_from_full"),
)
MIN_STEP_A = 0.1
"""Minimum change of the current at the beginning of a pulse [A]."""
MIN_CURRENT_C = 0.2
"""Minimum current of a pulse, as a C-rate. With a smaller one the error of the OCV decides."""
MAX_GAP_S = 5.0
"""Maximum time from the last sample before a pulse to its first sample [s]."""
MAX_FACTOR = 5.0
"""Largest current of the search, as a multiple of the current of the pulse."""
MIN_PULSES = 5
"""Minimum number of pulses in a row of the table."""


def pulse_table(folder: Path) -> Table:
    """Return the table of the captures, one row for each duration."""
    table = Table(title="available power")
    for column in (
        "capture",
        "duration",
        "pulses",
        "median error",
        "largest third",
        "promise held",
        "promise below true",
    ):
        table.add_column(column, justify="left" if column == "capture" else "right")
    for capture in CAPTURES:
        for duration_s in DURATIONS_S:
            rows = np.array(list(errors(capture, duration_s, folder)))
            if len(rows) >= MIN_PULSES:
                table.add_row(capture.name, f"{duration_s:.0f} s", str(len(rows)), *texts(rows))
    return table


def texts(rows: Floats) -> tuple[str, str, str, str]:
    """Return the cells of a row: median error of all pulses and of those with the largest currents, share of pulses in which the
    promise held, and its median distance from the truth."""
    current_a, median_error, promise_error = rows.T
    large = current_a >= np.quantile(current_a, 2.0 / 3.0)
    return (
        f"{np.median(np.abs(median_error)):.1%}",
        f"{np.median(np.abs(median_error[large])):.1%}",
        f"{np.mean(promise_error <= 0.0):.0%}",
        f"{-np.median(promise_error):.0%}",
    )


def errors(capture: Capture, duration_s: float, folder: Path) -> Iterator[tuple[float, float, float]]:
    """Yield current [A], and relative error of the median and of the promised power, of each pulse."""
    samples, estimator, scratch, position = capture.samples, capture.estimator(folder), new_scratch(), 0
    state, settings = estimator.record[0]["filter"], estimator.settings_record[0]["filter"]
    for first, last in pulses(samples, duration_s, MIN_CURRENT_C * capture.capacity_ah):
        estimator.run(samples[position:first])
        position = first
        current_a = float(samples["current_a"][first + 1 : last + 1].mean())
        elapsed_s = float(samples["time_s"][last] - samples["time_s"][first])
        limit_v = float(samples["voltage_v"][last])
        lowest_v = float(samples["voltage_v"][last if current_a > 0.0 else first])
        median_w, promised_w = (
            available_power(state, settings, elapsed_s, limit_v, MAX_FACTOR * current_a, stds, scratch)
            for stds in (0.0, QUANTILE_STDS)
        )
        true_w = abs(current_a) * lowest_v
        yield abs(current_a), median_w / true_w - 1.0, promised_w / true_w - 1.0


def pulses(samples: SampleBlock, duration_s: float, min_a: float) -> Iterator[tuple[int, int]]:
    """Yield first and last sample of each constant current of at least ``min_a`` that lasts for ``duration_s``."""
    time_s, current_a = samples["time_s"], samples["current_a"]
    steps = np.append(np.flatnonzero(np.abs(np.diff(current_a)) > MIN_STEP_A) + 1, samples.size)
    for first, end in itertools.pairwise(steps):
        last = first + int(np.searchsorted(time_s[first:end], time_s[first] + duration_s, side="right")) - 1
        lasts = last > first + 1 and time_s[last] - time_s[first] > 0.9 * duration_s
        if lasts and abs(current_a[last]) >= min_a and time_s[first] - time_s[first - 1] <= MAX_GAP_S:
            yield int(first), last
