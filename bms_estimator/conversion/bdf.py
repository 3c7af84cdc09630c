"""Samples in the Battery Data Format (BDF) of the Battery Data Alliance, version 1.2.0 of its ontology.

The header has the preferred labels of the format, such as ``Voltage / V``, which its specification requires in files.
"""

import numpy as np

from bms_estimator.model.arrays import Records, structured_array
from bms_estimator.model.sample import SampleBlock

EARLIEST_UNIX_TIME_S = 1e9
"""Earliest time that counts as a Unix time [s]: September 2001. Smaller times count from the start of the capture."""
TIME_DIGITS = 6
"""Number of decimals of the test time [s], because differences of Unix times have rounding errors."""
SUFFIXES = (".bdf", ".bdf.gz", ".bdf.csv", ".bdf.csv.gz", ".bdf.parquet")
"""File name suffixes of the format."""


def is_bdf_name(name: str) -> bool:
    """Return True if a file name has a suffix of the Battery Data Format."""
    return name.lower().endswith(SUFFIXES)


def bdf_rows(block: SampleBlock, first_s: float, *, with_temperature: bool) -> Records:
    """Return samples with the columns of the Battery Data Format.

    Args:
        block: Samples, rows of dtype ``SAMPLE``.
        first_s: Time of the capture's first sample [s], at which the test time is 0. If it is a Unix time, the result has a
            column of Unix times.
        with_temperature: True for a column of temperatures.

    Returns:
        Structured array of floats. The current is positive on charge.
    """
    columns = {
        "Test Time / s": np.round(block["time_s"] - first_s, TIME_DIGITS),
        "Voltage / V": block["voltage_v"],
        "Current / A": 0.0 - block["current_a"],  # 0.0 - 0.0 is 0.0, whereas -0.0 would be written as "-0"
    }
    if first_s >= EARLIEST_UNIX_TIME_S:
        columns["Unix Time / s"] = block["time_s"]
    if with_temperature:
        columns["Surface Temperature / degC"] = block["temperature_c"]
    return structured_array(columns)
