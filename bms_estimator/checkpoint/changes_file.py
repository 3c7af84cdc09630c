"""Changes of the estimator's state since its checkpoint: a file of one disk block, so that frequent saves wear no SD card."""

import json
import zlib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import structlog
from numpy.typing import NDArray

from bms_estimator.checkpoint.checksum import add_checksum, verify_checksum
from bms_estimator.checkpoint.identity import fields
from bms_estimator.process.boot_clock import BootTimestamp
from bms_estimator.process.private_file import read_private, write_private

CHANGES_SUFFIX = ".changes"
"""End of the name of the file."""
MAX_FILE_BYTES = 1 << 17
"""Maximum size of the file [bytes]. A normal file has 2 to 4 kB."""
WHOLE_S = 300.0
"""Maximum age of the checkpoint whose changes are saved [s]. A kill loses what the fields of ``_is_slow`` learned since."""
MAX_SOC_CHANGE = 0.05
"""Maximum change of the SOC since the checkpoint. The covariances depend on the slope of the OCV at the SOC."""
MAX_STD_RATIO = 1.1
"""Maximum growth of the SOC's std since the checkpoint. A restart has the std of the checkpoint, which would be too small."""
LEVEL = 9
"""Level of compression by zlib. Level 6 makes the file 1 % larger."""

log = structlog.get_logger(__name__)


class Base(NamedTuple):
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
    """File of the changes since one checkpoint.

    Args:
        path: The file, beside the checkpoint.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._base: Base | None = None

    def set_base(self, base: Base) -> None:
        """Set the checkpoint to which the next changes refer. Its token makes the present file invalid."""
        self._base = base

    def save(self, state: NDArray[np.void], curves: Mapping[str, NDArray[Any]], now: BootTimestamp) -> bool:
        """Write the fields of ``state`` that change fast. Return False if the checkpoint must be saved instead.

        Args:
            state: Shape (1,), dtype ESTIMATOR_STATE.
            curves: Arrays of the fit to whose curves the state is relative.
            now: Present time.

        Raises:
            OSError: The file cannot be written.
        """
        if self._base is None or not _is_small_change(self._base, state, curves, now):
            return False
        changed = state.copy()
        for name, values in fields(changed):
            if _is_slow(name):
                values[...] = 0  # compressed to a few bytes
        changed["filter"]["mean"][0, int(state["filter"]["count"][0]) :] = 0.0  # values of merged hypotheses
        head = json.dumps({"token": self._base.token, **asdict(now)}).encode()
        write_private(self._path, add_checksum(head + b"\n" + zlib.compress(changed.tobytes(), LEVEL)))
        return True

    def load(self, token: str, dtype: np.dtype[Any]) -> Changes | None:
        """Read the changes since a checkpoint; None without any. A damaged file is logged and ignored.

        Args:
            token: Identifier of the checkpoint.
            dtype: Dtype of the checkpoint's state.
        """
        try:
            head, _, packed = verify_checksum(read_private(self._path, MAX_FILE_BYTES)).partition(b"\n")
            values = json.loads(head)
            if values.pop("token") != token:
                return None
            state = np.frombuffer(bytearray(zlib.decompress(packed)), dtype)
            return Changes({n: v for n, v in fields(state) if not _is_slow(n)}, BootTimestamp(**values))
        except FileNotFoundError:
            return None
        except Exception as error:  # noqa: BLE001 - a damaged file may raise anything, and is reported
            log.warning(
                "changes since the checkpoint are damaged and not used", file=str(self._path), reason=str(error)
            )
            return None


def _is_small_change(
    base: Base, state: NDArray[np.void], curves: Mapping[str, NDArray[Any]], now: BootTimestamp
) -> bool:
    """Return True if the slow fields of a recent checkpoint are still valid with the fast fields of ``state``."""
    if not 0.0 <= now.since(base.saved) < WHOLE_S:
        return False
    if curves.keys() != base.curves.keys() or not all(
        np.array_equal(curves[name], base.curves[name]) for name in curves
    ):
        return False
    f, g = base.state[0]["filter"], state[0]["filter"]
    soc_change = abs(state[0]["observer"]["soc"] - base.state[0]["observer"]["soc"])
    has_same_hypotheses = g["seeded_s"] >= f["seeded_s"] and all(
        f[name] == g[name] for name in ("count", "started", "reopened", "exchanged")
    )
    # NaN, without a filter or a SOC, is no change
    return has_same_hypotheses and not (g["soc_std"] > MAX_STD_RATIO * f["soc_std"] or soc_change > MAX_SOC_CHANGE)


def _is_slow(name: str) -> bool:
    """Return True for fields that change slowly, are large, or are computed again for each sample."""
    return name in (
        "filter.covariance",
        "filter.ohm",
        "filter.h",
        "filter.ph",
        "filter.f",
    ) or name.startswith(("checks.good_", "map.", "series_resistance.", "fit."))
