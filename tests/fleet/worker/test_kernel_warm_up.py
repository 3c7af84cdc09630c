"""Kernel warm-up before a worker connects."""

import subprocess
import sys

COUNT_SIGNATURES_SCRIPT = """
from bms_estimator.fleet.worker.kernel_warm_up import load_fleet_kernels
from bms_estimator.kernels import packed_record
from bms_estimator.kernels.accumulators import hour, publish_window
from bms_estimator.kernels.cells.step import run_cells
load_fleet_kernels()
kernels = [packed_record.pack, packed_record.unpack, run_cells]
kernels += [publish_window.accumulate_charge_energy, hour.accumulate_hour, publish_window.accumulate_window]
print([len(kernel.signatures) for kernel in kernels])
"""


def test_each_kernel_is_compiled_for_one_signature() -> None:
    """A separate process counts them, because other tests may have called the kernels with other array types."""
    assert subprocess.check_output([sys.executable, "-c", COUNT_SIGNATURES_SCRIPT], text=True) == "[1, 1, 1, 1, 1, 1]\n"
