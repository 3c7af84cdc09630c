"""Changes of the estimator's state since its checkpoint, in two files of one disk block each, which are written in turn.

Frequent saves thus wear an SD card little: overwriting a block changes neither the folder nor the file's length. A power
failure damages at most the block that is being written, and the other one has the state before it.
"""

import json
import os
import zlib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import structlog
from numpy.typing import NDArray

from bms_estimator.checkpoint.run_file import CHECKSUM_BYTES, add_checksum, verify_checksum
from bms_estimator.model.arrays import fields
from bms_estimator.process.boot_timestamp import BootTimestamp
from bms_estimator.process.state_folder import read_private, write_private

CHANGES_SUFFIXES = ".changes-0", ".changes-1"
"""Suffixes of the two files."""
BLOCK_BYTES = 4096
"""Size of a file [bytes], a block of ext4. Changes of up to five hypotheses take 2 to 3.5 kB. If they do not fit, the whole
checkpoint is saved."""
MAX_BASE_AGE_S = 300.0
"""Maximum age of the checkpoint whose changes are saved [s]. A kill loses what the omitted fields have learned since then."""
MAX_SOC_CHANGE = 0.1
"""Maximum change of the SOC since the checkpoint. The covariances depend on the slope of the OCV at the SOC."""
MAX_STD_RATIO = 1.1
"""Maximum growth of the SOC's std since the checkpoint. A restart uses the checkpoint's covariance, which would be too small."""
ZLIB_LEVEL = 9
"""Compression level. Level 6 makes the file 1 % larger."""

log = structlog.get_logger(__name__)


class BaseCheckpoint(NamedTuple):
    """Saved checkpoint to which changes refer."""

    token: str
    """Random identifier of the checkpoint."""
    state: NDArray[np.void]
    """Shape (1,), dtype ESTIMATOR_STATE."""
    curves: Mapping[str, NDArray[Any]]
    """Arrays of the fit to whose curves the state is relative."""
    saved: BootTimestamp


class Changes(NamedTuple):
    """Changed fields of a state, and the time at which they were saved."""

    state: dict[str, NDArray[Any]]
    saved: BootTimestamp


class ChangesFile:
    """Files of the changes since one checkpoint.

    Args:
        checkpoint: Path of the checkpoint.
    """

    def __init__(self, checkpoint: Path) -> None:
        self._paths = [checkpoint.with_suffix(suffix) for suffix in CHANGES_SUFFIXES]
        self._base: BaseCheckpoint | None = None
        self._saves = 0

    def set_base(self, base: BaseCheckpoint) -> None:
        """Set the checkpoint to which the next changes refer. Its token makes the present files invalid."""
        self._base = base

    def save(self, state: NDArray[np.void], curves: Mapping[str, NDArray[Any]], now: BootTimestamp) -> bool:
        """Write the changed fields of ``state``. Return False if the checkpoint must be saved instead.

        Args:
            state: Shape (1,), dtype ESTIMATOR_STATE.
            curves: Arrays of the fit to whose curves the state is relative.
            now: Present time.
        """
        if self._base is None or not _is_small_change(self._base, state, curves, now):
            return False
        changed = state.copy()
        for name, values in fields(changed):
            if _is_omitted(name):
                values[...] = 0  # compressed to a few bytes
        changed["filter"]["mean"][0, int(state["filter"]["count"][0]) :] = 0.0  # values of merged hypotheses
        self._saves += 1
        head = json.dumps({"token": self._base.token, "saves": self._saves, **asdict(now)}).encode()
        body = head + b"\n" + zlib.compress(changed.tobytes(), ZLIB_LEVEL)
        block = add_checksum(body.ljust(BLOCK_BYTES - CHECKSUM_BYTES, b"\0"))
        if len(block) > BLOCK_BYTES:
            return False
        try:
            _overwrite(self._paths[self._saves % 2], block)
        except OSError:
            return False  # the save of the checkpoint reports what is wrong with the disk
        return True

    def load(self, token: str, dtype: np.dtype[Any]) -> Changes | None:
        """Read the newest changes since a checkpoint; None if there are none. A damaged file is logged and ignored.

        Args:
            token: Identifier of the checkpoint.
            dtype: Dtype of the checkpoint's state.
        """
        newest, newest_saves = None, 0
        for path in self._paths:
            try:
                head, _, packed = verify_checksum(read_private(path, BLOCK_BYTES)).partition(b"\n")
                values = json.loads(head)
                saves = values.pop("saves")
                if values.pop("token") == token and saves > newest_saves:
                    state = np.frombuffer(bytearray(zlib.decompressobj().decompress(packed)), dtype)
                    changed = {name: value for name, value in fields(state) if not _is_omitted(name)}
                    newest, newest_saves = Changes(changed, BootTimestamp(**values)), saves
            except FileNotFoundError:
                continue
            except Exception as error:  # noqa: BLE001 - a damaged file may raise anything, and is reported
                log.warning("changes since the checkpoint are damaged and not used", file=str(path), reason=str(error))
        return newest


def _overwrite(path: Path, block: bytes) -> None:
    """Overwrite a file of one block in place, and sync it to disk.

    Raises:
        OSError: The file cannot be written.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        write_private(path, block)
        return
    with open(descriptor, "wb", buffering=0) as file:  # noqa: PTH123 - a descriptor has no Path
        file.write(block)
        os.fdatasync(file.fileno())


def _is_small_change(
    base: BaseCheckpoint, state: NDArray[np.void], curves: Mapping[str, NDArray[Any]], now: BootTimestamp
) -> bool:
    """Return True if the omitted fields of a recent checkpoint are still valid with the other fields of ``state``."""
    if not 0.0 <= now.since(base.saved) < MAX_BASE_AGE_S:
        return False
    if curves.keys() != base.curves.keys() or not all(
        np.array_equal(curves[name], base.curves[name]) for name in curves
    ):
        return False
    saved, present = base.state[0]["filter"], state[0]["filter"]
    soc_change = abs(state[0]["observer"]["soc"] - base.state[0]["observer"]["soc"])
    has_same_hypotheses = present["seeded_s"] >= saved["seeded_s"] and all(
        saved[name] == present[name] for name in ("count", "started", "reopened", "exchanged")
    )
    has_grown = present["soc_std"] > MAX_STD_RATIO * saved["soc_std"]
    return has_same_hypotheses and not (has_grown or soc_change > MAX_SOC_CHANGE)  # NaN is no change


def _is_omitted(name: str) -> bool:
    """Return True for fields that are not saved, because they change slowly or are large."""
    return name == "filter.covariance" or name.startswith(("checks.good_", "map.", "series_resistance.", "fit."))
