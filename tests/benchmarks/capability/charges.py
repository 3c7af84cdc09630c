"""Time to full against the end of real and simulated charges, beside the charge to SOC 1 divided by the present current."""

from pathlib import Path

import numpy as np
from rich.table import Table

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, RESISTANCES
from bms_estimator.kernels.forecast.charge import charge_current, time_to_full
from bms_estimator.model.arrays import Floats, SampleBlock
from bms_estimator.model.cell import load_cell
from tests.benchmarks.capability.captures import Capture
from tests.benchmarks.capability.discharges import LG
from tests.benchmarks.recipes import LFP, LFP_CELL, NCR, NCR_CELL, PF, PF_US06, Recipe, charge_ah
from tests.estimator.anchors.chargers import CAPACITY_AH, SERIES, Charged, Meter

CAPTURES = (
    Capture("NCR, C/20 and constant voltage", NCR_CELL, NCR + "cell1_charge_c20", 0.0),
    Capture("LFP 25 C, C/27", LFP_CELL, LFP + "c30_chg_p25", 0.0),
    Capture("LFP 5 C, C/27", LFP_CELL, LFP + "c30_chg_p05", 0.011),
    Capture("LFP -15 C, C/27", LFP_CELL, LFP + "c30_chg_n15", 0.061),
    Capture("PF, C/20", PF_US06, PF + "25_c20"),
    Capture("LG M50, C/3 after 1C", LG, "lgm50/rate_1c_25c"),
    Capture("LG M50, C/3 after C/2", LG, "lgm50/rate_0p5c_25c"),
    Capture("generic nmc: LG M50, C/3 after 1C", Recipe(5.0, generic="nmc"), "lgm50/rate_1c_25c"),
)
SIMULATED = tuple(
    (chemistry, max_c, factor) for chemistry in ("nmc", "lfp") for max_c in (0.2, 0.5, 1.0) for factor in (1.0, 2.0)
)
"""Chemistry of the generic cell, current of the charger as a C-rate, and factor on the resistances of the true cell."""
TAIL_C = 0.05
"""Current at which a simulated charge ends, as a C-rate."""
START_SOC = 0.3
"""SOC at the start of a simulated charge."""
FRACTIONS = np.linspace(0.03, 0.98, 25)
"""Moments of the forecasts, as fractions of the duration of a charge."""
MIN_CHARGE_C = 0.005
"""Minimum current of a charge, as a C-rate."""


def charge_table(folder: Path) -> Table:
    """Return the table of real and simulated charges."""
    table = Table(title="time to full: median relative error; median error in % of the charge's duration")
    for column in ("charge", "duration", "time_to_full_s", "of duration", "charge / current", "of duration"):
        table.add_column(column, justify="left" if column == "charge" else "right")
    for capture in CAPTURES:
        samples = capture.samples
        begin, last = charge_of(samples, capture.capacity_ah)
        table.add_row(capture.name, *texts(moments(capture.estimator(folder), samples, begin, last)))
    for chemistry, max_c, factor in SIMULATED:
        cell = load_cell(chemistry, CAPACITY_AH).pack(SERIES, 1)
        samples = Meter().samples(Charged(chemistry, START_SOC, factor=factor).charge(max_c, tail_c=TAIL_C))
        begin, last = charge_of(samples, CAPACITY_AH)
        estimator = Estimator(cell, initial_soc=START_SOC, voltage_resolution_v=Meter().volt_step)
        name = f"simulated {chemistry}, {max_c}C, {factor:.0f} x the resistance of the file"
        table.add_row(name, *texts(moments(estimator, samples, begin, last)))
    return table


def texts(rows: Floats) -> tuple[str, ...]:
    """Return the cells of a row, from true and both computed times [s]."""
    true_s, duration_s = rows[:, 0], rows[0, 0]
    errors_s = np.abs(rows[:, 1:] - true_s[:, None]).T
    cells = [
        text
        for error_s in errors_s
        for text in (f"{np.nanmedian(error_s / true_s):.1%}", f"{np.nanmedian(error_s / duration_s):.1%}")
    ]
    return f"{duration_s / 3600.0:.1f} h", *cells


def charge_of(samples: SampleBlock, capacity_ah: float) -> tuple[int, int]:
    """Return first and last sample of the charge after the lowest SOC."""
    lowest = int(np.argmax(charge_ah(samples)))
    charging = np.flatnonzero(samples["current_a"][lowest:] < -MIN_CHARGE_C * capacity_ah) + lowest
    return int(charging[0]), int(charging[-1])


def moments(estimator: Estimator, samples: SampleBlock, begin: int, last: int) -> Floats:
    """Return a row for each moment: true time, time by the forecast, charge to SOC 1 over the current [s].

    The voltage and the current at the end of the charge are known, as if they were configured.
    """
    time_s, rows, position = samples["time_s"], [], 0
    full_v, tail_a = float(samples["voltage_v"][begin : last + 1].max()), -float(samples["current_a"][last])
    state, settings = estimator.record[0]["filter"], estimator.settings_record[0]["filter"]
    duration_s, scratch = time_s[last] - time_s[begin], np.empty(RESISTANCES + BRANCHES)
    for moment in np.searchsorted(time_s, time_s[begin] + FRACTIONS * duration_s):
        estimator.run(samples[position:moment])
        position = moment
        charge_a = charge_current(state, settings)
        to_full_s = time_to_full(state, settings, charge_a, full_v, tail_a, scratch) if charge_a < 0.0 else np.nan
        missing_as = (1.0 - estimator.soc) * settings["capacity_as"]
        rows.append((time_s[last] - time_s[moment], to_full_s, missing_as / -samples["current_a"][moment - 1]))
    return np.array(rows)
