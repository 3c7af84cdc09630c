"""Checkpoints: the estimator's state on disk, taken up again only when it belongs to the same pack and is sane."""

import hashlib
import io
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator import Estimator
from bms_estimator.kernels.estimator_state import ESTIMATOR_STATE
from bms_estimator.kernels.identifier_state import IDENTIFIER_COUNTERS, IDENTIFIER_STATE
from bms_estimator.kernels.state import OBSERVER_STATE
from bms_estimator.model.cell import CellModel
from bms_estimator.model.settings import Settings
from bms_estimator.service.moment import Moment, moment

FORMAT = 4
"""Raise it to make all older checkpoints invalid."""
LONGEST_FILE = 1 << 20
"""A checkpoint has some kilobytes; a longer file is none [bytes]."""
REFUSED = "refused: "
"""A reason that begins so tells why a file that was found is not taken up."""

_DROPPED = tuple(name for name in OBSERVER_STATE.names or () if name.startswith("dropped_"))
COUNTERS = ("samples", "gaps", "time_steps_back", "lock_losses", "gain_rearms", *_DROPPED)
"""Fields of the state that count since start."""
_SEEN = tuple(name for name in IDENTIFIER_STATE.names or () if name.startswith("seen_"))


def pack_identity(settings: Settings, cell: CellModel) -> str:
    """Hash of all that gives the state its meaning: pack, cell, sensor, observer, identifier, the record's layout."""
    digest = hashlib.sha256()
    sensor = {"current_sign", "voltage_resolution_v", "voltage_noise_v"}
    digest.update(
        settings.model_dump_json(
            include={"pack": True, "sensor": sensor, "observer": True, "identifier": True}
        ).encode()
    )
    for part in (cell.model_dump_json(), str(ESTIMATOR_STATE)):
        digest.update(b"\0" + part.encode())
    return digest.hexdigest()


@dataclass(frozen=True)
class Restored:
    """What a checkpoint file held."""

    state: NDArray[np.void] | None
    """Shape (1,), dtype ESTIMATOR_STATE; None when it was refused."""
    unseen_s: float
    """Since it was saved [s]; infinite when nobody knows."""
    restarts: int
    """Starts that found a checkpoint, this one included."""
    reason: str
    """What was taken up, or why not."""


class CheckpointFile:
    """One pack's checkpoint.

    Args:
        path: The file; its folder must exist.
        identity: ``pack_identity``.
        now: The present moment.
    """

    def __init__(self, path: Path, identity: str, now: Callable[[], Moment] = moment) -> None:
        self.path = path
        self._identity, self._now = identity, now
        self.thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="checkpoint")
        """Where to call ``save``: a call that nobody waits for any more still ends before the next one begins."""

    def save(self, state: NDArray[np.void], restarts: int) -> None:
        """Write atomically: after a power cut there is the old file or the new one.

        Raises:
            OSError: The file cannot be written.
        """
        content = io.BytesIO()
        fields: dict[str, Any] = asdict(self._now()) | {"identity": self._identity, "restarts": restarts}
        np.savez(content, format=FORMAT, state=state, **fields)
        new = self.path.with_suffix(".new")
        with new.open("wb") as file:
            file.write(content.getvalue())
            file.flush()
            os.fsync(file.fileno())
        new.replace(self.path)
        folder = os.open(self.path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def load(self, cell: CellModel) -> Restored:
        """Read and check; what is wrong is a reason, not an exception. A file that is refused is set aside.

        One set aside earlier is taken up again when it is good: a setting that was wrong for a while costs nothing.
        """
        found = self._load(self.path, cell)
        if found.state is not None:
            return found
        refused = found.reason.startswith(REFUSED)
        aside, new = self.path.with_suffix(".refused.npz"), self.path.with_suffix(".new")
        earlier = self._load(aside, cell)
        try:
            if refused:
                self.path.replace(new)
            if earlier.state is not None:
                aside.replace(self.path)
            if refused:
                new.replace(aside)
        except OSError as error:
            return replace(found, reason=f"{found.reason}; it cannot be set aside: {error}")
        if earlier.state is not None:
            return replace(earlier, reason=f"{earlier.reason}, set aside earlier")
        return replace(found, reason=f"{found.reason}; set aside as {aside.name}") if refused else found

    def _load(self, path: Path, cell: CellModel) -> Restored:
        try:
            with np.load(io.BytesIO(_read(path)), allow_pickle=False) as file:
                return self._checked(file, cell)
        except FileNotFoundError:
            return Restored(None, 0.0, 0, "none found")
        except _RefusedError as error:
            return Restored(None, 0.0, 0, f"{REFUSED}{error}")
        except Exception as error:  # noqa: BLE001 - a damaged file may raise anything, and is reported
            return Restored(None, 0.0, 0, f"{REFUSED}unreadable ({type(error).__name__}: {error})")

    def _checked(self, file: Mapping[str, np.ndarray], cell: CellModel) -> Restored:
        if int(file["format"]) != FORMAT:
            raise _RefusedError(f"format {int(file['format'])}, this version reads {FORMAT}")
        if str(file["identity"]) != self._identity:
            raise _RefusedError("it belongs to another pack, cell or setting")
        state, restarts = file["state"], int(file["restarts"]) + 1
        insane = _insane(state, cell)
        if insane:
            return Restored(None, 0.0, restarts, f"{REFUSED}{insane}")
        saved = Moment(float(file["wall_s"]), bool(file["synchronised"]), float(file["boot_s"]), str(file["boot"]))
        return Restored(
            state,
            self._now().since(saved),
            restarts,
            f"restored: SOC {float(state['observer']['soc'][0]):.4f}",
        )


class _RefusedError(Exception):
    """Why a checkpoint is not taken up."""


def _read(path: Path) -> bytes:
    if path.stat().st_size > LONGEST_FILE:
        raise _RefusedError("file too long")
    return path.read_bytes()


def _insane(state: NDArray[np.void], cell: CellModel) -> str:
    """Why a state cannot be used; empty when it can."""
    if state.dtype != ESTIMATOR_STATE or state.shape != (1,):
        return f"state has dtype of {state.dtype.itemsize} bytes and shape {state.shape}"
    for part in ("observer", "identifier", "map"):
        for name in ESTIMATOR_STATE[part].names or ():
            if not np.isfinite(state[part][name]).all():
                return f"{name} of the {part} is not finite"
    s = state[0]["observer"]
    if not s["started"]:
        return "no sample was taken"
    ranges = {
        "soc": (0.0, 1.0),
        "v_ts": (-cell.cell.voltage_max_v, cell.cell.voltage_max_v),
        "v_tl": (-cell.cell.voltage_max_v, cell.cell.voltage_max_v),
        "k": (0.0, np.inf),
    }
    for name, (low, high) in ranges.items():
        if not low <= s[name] <= high:
            return f"{name} = {s[name]} is outside {low}..{high}"
    variances = np.diagonal(state[0]["identifier"]["covariance"])
    for name, good in (("a parameter a1..a15", s["a"][1:16] > 0.0), ("a variance", variances >= 0.0)):
        if not good.all():
            return f"{name} is not positive"
    return ""


def resume(estimator: Estimator, state: NDArray[np.void], unseen_s: float) -> None:
    """Go on from a checkpoint's state, saved ``unseen_s`` ago, on the board's new clock. The counters count from this start."""
    estimator.record[...] = state
    estimator.resume(unseen_s)
    for name in COUNTERS:
        estimator.state[name] = 0
    for name in (*IDENTIFIER_COUNTERS, *_SEEN):
        estimator.record["identifier"][name] = 0
