"""Usable capacity and remaining energy against charge and energy drawn until the cut-off voltage in real captures."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.table import Table

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.forecast.available_power import cell_power_limits, unknown_values
from bms_estimator.forecast.capability import projected_pack, write_capability
from bms_estimator.forecast.load_history import LoadHistory
from bms_estimator.kernels.cell_model.rc_ladder import GRID
from bms_estimator.kernels.forecast.draws import DRAW
from bms_estimator.kernels.forecast.mean_discharge import discharge_to_cutoff
from bms_estimator.kernels.forecast.projected_pack import FAST_RESISTANCES, growth_factor
from bms_estimator.model.arrays import Floats, SampleBlock
from tests.benchmarks.capability.captures import Capture
from tests.benchmarks.recipes import LFP, LFP_CELL, NCR, NCR_CELL, PF, PF_25, PF_CYCLE, PF_US06, Recipe, charge_ah

LG = Recipe(5.0, ("lgm50/rate_0p1c_25c",))
CAPTURES = (
    Capture("PF 25 C, US06", PF_CYCLE, PF + "25_us06"),
    Capture("PF 25 C, mixed cycle", PF_US06, PF + "25_cycle1"),
    Capture("PF 10 C, US06", PF_US06, PF + "10_us06"),
    Capture("PF 0 C, US06", PF_US06, PF + "0_us06"),
    Capture("PF 0 C, mixed cycle", PF_US06, PF + "0_cycle1"),
    Capture("PF -10 C, US06", PF_US06, PF + "n10_us06"),
    Capture("PF 0 C, US06, file of 25 C", PF_25, PF + "0_us06"),
    Capture("PF -10 C, US06, file of 25 C", PF_25, PF + "n10_us06"),
    Capture("NCR, C/4", NCR_CELL, NCR + "cell1_discharge_c4"),
    Capture("NCR, 1.5C", NCR_CELL, NCR + "cell1_discharge_1c5"),
    Capture("NCR, random steps", NCR_CELL, NCR + "cell1_random_steps", 0.98),
    Capture("NCR, dynamic stress test", NCR_CELL, NCR + "cell1_dst"),
    Capture("LFP 25 C (its own file)", LFP_CELL, LFP + "dyn_p25"),
    Capture("LFP 5 C (its own file)", LFP_CELL, LFP + "dyn_p05"),
    Capture("LFP -15 C (its own file)", LFP_CELL, LFP + "dyn_n15"),
    Capture("LG M50, C/2", LG, "lgm50/rate_0p5c_25c"),
    Capture("LG M50, 1C", LG, "lgm50/rate_1c_25c"),
    Capture("generic nca: PF 25 C, US06", Recipe(2.9, generic="nca"), PF + "25_us06"),
    Capture("generic nca: PF -10 C, US06", Recipe(2.9, generic="nca"), PF + "n10_us06"),
)
PARTS = ("growth of R towards empty", "SOC gradient in the particles", "peaks of the load")
"""Parts of the model whose effect on the usable capacity is measured."""
CUTOFF_V, LFP_CUTOFF_V, MAX_LFP_V = 2.6, 2.2, 3.4
"""Cut-off voltage of oxide and of LFP cells, and maximum median voltage of a capture of an LFP cell [V]."""
LOWEST_QUANTILE, MARGIN_V = 1e-4, 0.01
"""Quantile of the voltages of a capture below which the cut-off must not be, and margin [V]: some captures end earlier."""
FIRST, STEP, LAST = 0.05, 0.01, 0.005
"""Charge drawn before the first moment, between moments, and from the last moment to the cut-off, as fractions of the
capacity."""


def discharge_table(folder: Path) -> Table:
    """Return the table of the captures."""
    table = Table(title="usable capacity and remaining energy: median absolute and median error, in % of the capacity")
    columns = "capture", "cut-off", "SOC there", "usable_capacity_ah", "median", "charge to SOC 0", "median"
    for column in (*columns, "remaining_energy_wh", "median"):
        table.add_column(column, justify="left" if column == "capture" else "right")
    without_parts: list[Floats] = []
    for capture in CAPTURES:
        samples = capture.samples
        cutoff_v = cutoff_voltage(samples)
        rows = moments(capture, samples, cutoff_v, folder)
        rated_wh = capture.capacity_ah * float(np.median(samples["voltage_v"]))
        errors = 100.0 * np.column_stack(
            [(rows[:, 1:3] - rows[:, :1]) / capture.capacity_ah, (rows[:, 5] - rows[:, 4]) / rated_wh]
        )
        cells = [text for error in errors.T for text in (f"{np.median(np.abs(error)):.1f}", f"{np.median(error):+.1f}")]
        table.add_row(capture.name, f"{cutoff_v:.2f} V", f"{rows[-1, 3]:.2f}", *cells)
        charge_errors = 100.0 * (rows[:, [1, *range(6, rows.shape[1])]] - rows[:, :1]) / capture.capacity_ah
        without_parts.append(np.median(np.abs(charge_errors), axis=0))
    means = zip(("nothing", *PARTS), np.mean(without_parts, axis=0), strict=True)
    table.caption = "mean of the errors of usable_capacity_ah without " + ", ".join(f"{n}: {e:.2f}" for n, e in means)
    return table


def cutoff_voltage(samples: SampleBlock) -> float:
    """Return the cut-off voltage of a capture [V]."""
    voltage_v = samples["voltage_v"]
    usual_v = LFP_CUTOFF_V if np.median(voltage_v) < MAX_LFP_V else CUTOFF_V
    return max(usual_v, float(np.quantile(voltage_v, LOWEST_QUANTILE)) + MARGIN_V)


def moments(capture: Capture, samples: SampleBlock, cutoff_v: float, folder: Path) -> Floats:
    """Return a row for each moment: charge until the cut-off, usable capacity, charge to SOC 0 [Ah], SOC, energy until the
    cut-off, true and computed [Wh], and usable capacity without parts of the model [Ah]."""
    drawn_ah, capacity_ah = charge_ah(samples), capture.capacity_ah
    drawn_wh = np.append(0.0, np.cumsum(np.diff(drawn_ah) * samples["voltage_v"][:-1]))
    end = int(np.argmax((samples["voltage_v"] <= cutoff_v) & (samples["current_a"] > 0.0)))
    moments_ah = np.arange(FIRST, drawn_ah[end] / capacity_ah - LAST, STEP) * capacity_ah
    estimator, rows, position = capture.estimator(folder), [], 0
    settings = estimator.cell_file_settings
    load, limits = (
        LoadHistory(float(settings["capacity_as"]), float(settings["unmeasured_s"])),
        cell_power_limits(estimator.cell),
    )
    for moment in np.unique(np.searchsorted(drawn_ah[:end], moments_ah)):
        load.add(estimator.run(samples[position:moment]))
        position, values = moment, unknown_values()
        largest_a = float(load.max_a.max(initial=0.0))
        write_capability(values, estimator, cutoff_v, limits, largest_a)
        rows.append(
            (
                drawn_ah[end] - drawn_ah[moment],
                values["usable_capacity_ah"][0],
                estimator.soc * estimator.cell.cell.capacity_ah,
                estimator.soc,
                drawn_wh[end] - drawn_wh[moment],
                values["remaining_energy_wh"][0],
                *usable_without_parts(estimator, cutoff_v, largest_a),
            )
        )
    return np.array(rows)


def usable_without_parts(estimator: Estimator, cutoff_v: float, largest_a: float) -> Iterator[float]:
    """Yield the usable capacity without each of ``PARTS`` [Ah]."""
    state, settings, draw = estimator.record[0]["filter"], estimator.settings_record[0]["filter"], np.zeros(1, DRAW)
    for part, peak_a in zip(PARTS, (largest_a, largest_a, 0.0), strict=True):
        pack = projected_pack(estimator, cutoff_v, peak_a)
        if part == PARTS[0]:
            growth = [growth_factor(state, pack["soc"][0], soc) for soc in np.linspace(0.0, 1.0, GRID)]
            pack["ohm"][0, :FAST_RESISTANCES] /= growth
        elif part == PARTS[1]:
            pack["surface_soc"] = 0.0
        yield discharge_to_cutoff(pack[0], state, settings, peak_a, draw[0])[0] / 3600.0
