"""Observer step in C, compiled from uas_step.c. It works on the same records as the kernels."""

import ctypes
import subprocess
from pathlib import Path

import numpy as np

from bms_estimator.kernels.cell_model.chen_mora import INVERSE_ERROR_V, OCV_POINTS
from bms_estimator.kernels.current_check import (
    CURRENT_CHECK,
    FOLLOWED_FRACTION,
    MAX_WAITING,
    MAX_WRAPPED_FRACTION,
    NEAR_FRACTION,
    RC_HIDING_S,
    STEPS_A,
    UINT16_VALUES,
)
from bms_estimator.kernels.observer.mittag_leffler import SERIES_LIMIT, SERIES_TERMS, TABLE_POINTS
from bms_estimator.kernels.observer.records import OBSERVER_SETTINGS, OBSERVER_STATE
from bms_estimator.kernels.records import TRACE
from bms_estimator.model.arrays import SAMPLE, Records, SampleStatus

SOURCE = Path(__file__).with_name("uas_step.c")
COMPILER = [
    "cc",
    "-O3",
    "-ffp-contract=off",
    "-std=gnu11",
    "-Wall",
    "-Wextra",
    "-Werror",
    "-fPIC",
    "-shared",
]
"""C compiler with options that optimize for this processor, as numba does. Like numba it fuses no multiplication with an
addition, so that both compute the same numbers."""
C_TYPES = {"f8": "double", "i8": "int64_t", "u4": "uint32_t"}


class ObserverInC:
    """``kernels.step.run`` in C, for the observer alone.

    Args:
        folder: Folder in which the library is built.

    Raises:
        FileNotFoundError: There is no C compiler.
    """

    def __init__(self, folder: Path) -> None:
        (folder / "records.h").write_text(header())
        library = folder / "uas_step.so"
        subprocess.run([*COMPILER, "-I", folder, "-o", library, SOURCE, "-lm"], check=True)
        self._run = ctypes.CDLL(str(library)).run
        self._run.restype = ctypes.c_int64
        self._run.argtypes = [ctypes.c_void_p] * 5 + [ctypes.c_int64]

    def run(self, record: Records, settings: Records, samples: Records, trace: Records) -> int:
        """Run a block as ``kernels.step.run`` does. ``record`` is a record of ESTIMATOR_STATE, ``settings`` of its settings."""
        state, check = record["observer"], record["current_check"]
        pointers = [array.ctypes.data for array in (state, settings["observer"], check, samples, trace)]
        return int(self._run(*pointers, samples.size))


def header() -> str:
    """Return the text of records.h: constants, and the record types as C structures with the alignment of numpy."""
    constants = {
        "OCV_POINTS": OCV_POINTS,
        "INVERSE_ERROR_V": INVERSE_ERROR_V,
        "SERIES_TERMS": SERIES_TERMS,
        "SERIES_LIMIT": SERIES_LIMIT,
        "TABLE_POINTS": TABLE_POINTS,
        "FOLLOWED_FRACTION": FOLLOWED_FRACTION,
        "MAX_WAITING": MAX_WAITING,
        "RC_HIDING_S": RC_HIDING_S,
        "NEAR_FRACTION": NEAR_FRACTION,
        "UINT16_VALUES": UINT16_VALUES,
        "STEPS_A": str(STEPS_A).translate(str.maketrans("()", "{}")),
        "MAX_WRAPPED_FRACTION": MAX_WRAPPED_FRACTION,
        "HELD_BITS": int(SampleStatus.VOLTAGE_HELD | SampleStatus.CURRENT_HELD),
    }
    records = {
        "settings_t": OBSERVER_SETTINGS,
        "state_t": OBSERVER_STATE,
        "check_t": CURRENT_CHECK,
        "sample_t": SAMPLE,
        "trace_t": TRACE,
    }
    lines = [f"#define {name} {value}" for name, value in constants.items()]
    return "\n".join(lines + [structure(name, record) for name, record in records.items()]) + "\n"


def structure(name: str, record: np.dtype[np.void]) -> str:
    """Return a record type in C, with a static assertion of its size."""
    members = []
    for field in record.names or ():
        base, shape = record[field].subdtype or (record[field], ())
        members.append(f"    {C_TYPES[base.str[1:]]} {field}{''.join(f'[{n}]' for n in shape)};")
    body = "\n".join(members)
    check = f'_Static_assert(sizeof({name}) == {record.itemsize}, "{name}");'
    return f"typedef struct {{\n{body}\n}} {name};\n{check}"
