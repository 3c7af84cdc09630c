"""Arrays: samples of a battery, the input of the estimator, and the array and record types of kernels and their callers.

Sources yield samples in blocks, numpy structured arrays of dtype ``SAMPLE``. A block contains the samples of one chunk
from a serial line, or some thousand rows of a file.
"""

import hashlib
import math
from collections.abc import Iterator, Mapping
from enum import IntFlag
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
"""Array of floats."""
Masks = NDArray[np.bool_]
"""Array of conditions."""
Record = Any
"""Element of a structured array in a kernel. Its type is Any, because only numba resolves its fields."""
Records = NDArray[np.void]
"""Structured array."""


def exp(exponents: Floats) -> Floats:
    """Return e^x of each value by the C library, as kernels compute it. The last bit of ``np.exp`` depends on the CPU."""
    return np.array([math.exp(x) for x in exponents.flat]).reshape(exponents.shape)


def structured_array(columns: Mapping[str, Floats]) -> Records:
    """Return columns of equal length as the fields of a structured array of floats."""
    rows = np.empty(len(next(iter(columns.values()))), dtype=[(name, "f8") for name in columns])
    for name, values in columns.items():
        rows[name] = values
    return rows


def fields(record: Records, prefix: str = "") -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield name and view of each field of a structured array, recursively as ``part.field``."""
    for name in record.dtype.names or ():
        if record[name].dtype.names:
            yield from fields(record[name], f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", record[name]


SAMPLE = np.dtype(
    [
        ("time_s", "f8"),  # time on the source's clock; it decreases only after a fault
        ("current_a", "f8"),  # positive on discharge
        ("voltage_v", "f8"),  # voltage at the pack's terminals
        ("temperature_c", "f8"),  # mean of the credible probes; NaN without a sensor
        ("temperature_min_c", "f8"),  # lowest credible probe; with one probe equal to temperature_c
        ("temperature_max_c", "f8"),  # highest credible probe
        ("status", "u4"),  # bits of SampleStatus
    ],
    align=True,
)
"""Sample of a battery."""

CurrentSign = Literal["discharge_positive", "charge_positive"]
"""Direction of the current that a device reports as positive."""

SampleBlock = NDArray[np.void]
"""Shape (n,), dtype ``SAMPLE``."""

CellBlock = NDArray[np.float64]
"""Shape (n, m): voltages of m cells for each of a block's n samples [V], NaN if not reported."""

NO_CELLS: CellBlock = np.empty((0, 0))
"""Empty ``CellBlock``, used for blocks of any length without cell voltages."""

PROBE = np.dtype([("temperature_c", "f8"), ("faulty", "?")])
"""Reading of a temperature probe [C], NaN if absent, and whether the probe is faulty."""

ProbeBlock = NDArray[np.void]
"""Shape (n, m), dtype ``PROBE``: m temperature probes for each of a block's n samples."""

NO_PROBES: ProbeBlock = np.empty((0, 0), dtype=PROBE)
"""Empty ``ProbeBlock``, used for blocks of any length without a list of probes."""
NO_SOC: NDArray[np.float64] = np.empty(0)
"""Empty array, used for blocks of any length without an SOC that the device reports."""

MIN_C = -60.0
"""Lowest plausible temperature of a pack or stack [C]."""
MAX_C = 200.0
"""Highest plausible temperature of a pack or stack [C]."""
MIN_CELL_V = -5.0
"""Lowest plausible voltage of a single cell, which may be reversed [V]."""
MAX_CELL_V = 10.0
"""Highest plausible voltage of a single cell [V]."""


class SampleStatus(IntFlag):
    """Status bits of a sample."""

    VOLTAGE_SATURATED = 1
    CURRENT_SATURATED = 2
    OVERRUN = 4
    RESET = 8
    GAP = 16
    VOLTAGE_HELD = 32
    """The voltage repeats an earlier measurement. Current and temperature are new."""
    CURRENT_HELD = 64
    """The current repeats an earlier measurement. Voltage and temperature are new."""
    WRONG_CLOCK = 128
    """The time is the arrival time, because the device's clock is wrong."""
    PROBE_FAULT = 256
    """A temperature probe is faulty."""


def fill_temperature(samples: SampleBlock, temperature_c: float | None) -> None:
    """Set the temperature of samples that have none to ``temperature_c`` [°C], in place; None leaves them without one."""
    names = ("temperature_c", "temperature_min_c", "temperature_max_c")
    if temperature_c is not None and not any(np.isfinite(samples[name]).any() for name in names):
        for name in names:
            samples[name] = temperature_c


def capture_digest(samples: SampleBlock) -> str:
    """Return a digest of times, currents and voltages, by which a capture is recognized in any file format."""
    digest = hashlib.sha256()
    for name in ("time_s", "current_a", "voltage_v"):
        digest.update(np.ascontiguousarray(samples[name]).tobytes())
    return digest.hexdigest()[:16]


def remove_implausible(values: NDArray[np.float64], low: float, high: float) -> int:
    """Replace values outside ``low``..``high`` with NaN in place; return their number."""
    implausible = (values < low) | (values > high)
    values[implausible] = np.nan
    return int(np.count_nonzero(implausible))
