"""Preparation before a worker connects, so that nothing delays it later."""

import subprocess
import sys

from bms_estimator.fleet.worker import kernel_warm_up
from bms_estimator.fleet.worker.kernel_warm_up import load_fleet_kernels

KINDS = """
from bms_estimator.fleet.worker.kernel_warm_up import load_fleet_kernels
from bms_estimator.kernels import packed_record
from bms_estimator.kernels.accumulators import charge_energy, hour, publish_window
load_fleet_kernels()
kernels = packed_record.pack, packed_record.unpack, charge_energy.accumulate_charge_energy, hour.accumulate_hour, publish_window.accumulate_window
print([len(kernel.signatures) for kernel in kernels])
"""


def test_a_block_and_the_row_of_an_hour_go_through_it(monkeypatch) -> None:
    made = []
    take = kernel_warm_up.Partition.take
    monkeypatch.setattr(kernel_warm_up.Partition, "take", lambda *args: made.append(take(*args)) or made[-1])
    load_fleet_kernels()
    assert all(each.state and each.parameters for each in made)
    assert len(made[-1].hours) == 1


def test_each_kernel_is_there_for_one_kind_of_arguments() -> None:
    """In a separate process, because others here may have called them with other arrays."""
    done = subprocess.run([sys.executable, "-c", KINDS], check=True, capture_output=True, text=True)
    assert done.stdout == "[1, 1, 1, 1, 1]\n"
