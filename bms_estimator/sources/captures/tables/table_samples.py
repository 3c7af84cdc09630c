"""Samples and cell voltages of the rows of a table."""

import numpy as np

from bms_estimator.model.sample import MAX_C, MIN_C, NO_CELLS, SAMPLE, CellBlock, SampleBlock, remove_implausible
from bms_estimator.sources.captures.tables.layout import Layout, RawBlock, Role


def to_samples(raw: RawBlock, layout: Layout) -> SampleBlock:
    """Return samples in SI units. The current has the sign of the table."""
    with np.errstate(over="ignore"):  # infinite results are dropped like other invalid values
        values = {role: raw[role] * column.unit.factor + column.unit.offset for role, column in layout.columns.items()}
    samples = np.zeros(values[Role.TIME].size, dtype=SAMPLE)
    samples["time_s"], samples["voltage_v"] = values[Role.TIME] + values.get(Role.CLOCK, 0.0), values[Role.VOLTAGE]
    samples["current_a"] = values[Role.CURRENT]
    if Role.CHARGE_CURRENT in values:
        discharge_a, charge_a = np.abs(values[Role.CURRENT]), np.abs(values[Role.CHARGE_CURRENT])
        samples["current_a"] = np.nan_to_num(discharge_a) - np.nan_to_num(charge_a)
    samples["temperature_c"] = values.get(Role.TEMPERATURE, np.nan)
    samples["temperature_min_c"] = values.get(Role.TEMPERATURE_MIN, samples["temperature_c"])
    samples["temperature_max_c"] = values.get(Role.TEMPERATURE_MAX, samples["temperature_c"])
    if Role.STATUS in values:
        samples["status"] = np.nan_to_num(values[Role.STATUS]).clip(0.0, np.iinfo(np.uint32).max)
    return samples


def remove_implausible_temperatures(samples: SampleBlock) -> int:
    """Replace implausible temperatures with NaN in place; return the number of samples with an implausible ``temperature_c``."""
    for name in ("temperature_min_c", "temperature_max_c"):
        remove_implausible(samples[name], MIN_C, MAX_C)
    return remove_implausible(samples["temperature_c"], MIN_C, MAX_C)


def cell_voltages(raw: RawBlock, layout: Layout) -> CellBlock:
    """Return the cell voltages of a block, shape (n, m) [V]; empty for a table without them."""
    cells = layout.cells
    return np.column_stack([raw[cell] for cell in cells]) if cells else NO_CELLS
