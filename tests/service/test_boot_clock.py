"""Duration of the gap in the samples at a restart of the service or of the machine."""

import ctypes
import math
from dataclasses import replace
from pathlib import Path

import pytest

from bms_estimator.checkpoint.state_files import CheckpointFile
from bms_estimator.estimator.estimator import compiled_estimator
from bms_estimator.model.cell import load_cell
from bms_estimator.process.boot_timestamp import BootTimestamp, boot_timestamp, is_clock_synchronized
from bms_estimator.settings.pack import Settings

CELL, SETTINGS = load_cell("chen_mora"), Settings()
TIME_ERROR = 5
"""Result of ntp_gettime while the clock is not synchronized."""
SAVED = BootTimestamp(wall_s=1_700_000_000.0, synchronised=True, boot_s=5000.0, boot="one")


@pytest.mark.parametrize(
    ("changes", "unseen_s"),
    [
        ({"boot_s": 5007.0, "wall_s": 1_800_000_000.0}, 7.0),  # the wall clock was set meanwhile
        ({"boot_s": 5007.0, "synchronised": False}, 7.0),
        ({"boot": "two", "boot_s": 20.0, "wall_s": 1_700_003_600.0}, 3600.0),  # after a reboot
        ({"boot": "two", "boot_s": 20.0, "wall_s": 1_700_000_005.0, "synchronised": False}, math.inf),
        ({"boot": "two", "boot_s": 20.0, "wall_s": 1_600_000_000.0}, math.inf),  # before the checkpoint
        ({"boot": "", "boot_s": 5007.0, "synchronised": False}, math.inf),  # the boot is unknown
    ],
)
def test_the_age_of_a_checkpoint_is_read_from_a_clock_that_can_be_trusted_and_is_infinite_without_one(
    tmp_path: Path, changes: dict[str, float | str | bool], unseen_s: float
) -> None:
    estimator = compiled_estimator(SETTINGS, CELL)
    estimator.step(0.0, 0.1, 3.8)
    CheckpointFile(tmp_path, SETTINGS, CELL, lambda: SAVED).save(estimator.record)
    later = replace(SAVED, **changes)
    assert CheckpointFile(tmp_path, SETTINGS, CELL, lambda: later).load().gap_s == unseen_s


def test_after_a_reboot_the_age_is_infinite_if_the_wall_clock_was_not_synchronized_before() -> None:
    later = replace(SAVED, boot="two", wall_s=SAVED.wall_s + 5.0)
    assert later.since(replace(SAVED, synchronised=False)) == math.inf


def test_the_wall_clock_is_trusted_if_the_kernel_reports_synchronisation() -> None:
    """Compare with ntp_gettime of the C library, which reports it in another way."""
    assert is_clock_synchronized() == (ctypes.CDLL(None).ntp_gettime(ctypes.create_string_buffer(128)) != TIME_ERROR)


def test_the_boot_time_is_read_from_the_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("BMS_BOOT_ID", raising=False)
    first, second = boot_timestamp(), boot_timestamp()
    assert first.boot == second.boot
    assert len(first.boot) == 32
    assert 0.0 <= second.since(first) < math.inf
    monkeypatch.setenv("BMS_BOOT_ID", "0123")
    assert boot_timestamp().boot == "0123"
