"""Checkpoints: the estimator's state on disk, restored only if it is valid and belongs to the same pack.

Each meaning of a state (``pack_identity``) has its own file with named fields. Edited settings and versions with
other fields therefore lose nothing.
"""

import io
import json
import math
import os
import re
import shlex
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import structlog
from numpy.typing import NDArray

from bms_estimator.checkpoint.identity import fields, observer_identity, pack_identity, without_observer
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.model.payloads import Totals
from bms_estimator.process.boot_clock import BootTimestamp, boot_timestamp
from bms_estimator.process.disk_thread import DiskThread
from bms_estimator.process.private_file import UnsafeFileError, read_private, write_private
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.charge_energy import ChargeEnergy
from bms_estimator.telemetry.lifetime_totals import new_totals

FORMAT = 7
"""Version of the file's layout. Raise it when a field changes its meaning, and migrate files of the version before."""
DAY_S = 86400.0
MAX_FILE = 1 << 20
"""Maximum size of a checkpoint file [bytes]; usual ones have about 100 kB."""
KEPT = 8
"""Number of checkpoint files of one pack; older ones are deleted."""
REFUSED = "refused: "
"""Prefix of the reason for rejecting a file."""
LATER = 4
"""Number of stored files of later formats, for a return to their version."""
_OF_LEDGER = "restarts", "total", "clean", "alarms"
"""Field names of the counters in the file."""
MOST = 1e15
"""Maximum plausible count: 30,000 years at 1,000 samples a second."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class RunCounters:
    """Counters of the runs that wrote a checkpoint.

    Attributes:
        restarts: Starts that found a checkpoint.
        total: Totals over restarts.
        clean: The last of them has ended by itself; False while it runs.
        alarms: Alarms over restarts, as ``AlarmEvaluator.kept``.
    """

    restarts: int
    total: Totals
    clean: bool = False
    alarms: str = ""


@dataclass(frozen=True)
class CheckpointContent:
    """Content of a checkpoint file."""

    state: Mapping[str, NDArray[Any]]
    """Fields of ESTIMATOR_STATE by their names, as ``fields`` gives them; empty when it was refused."""
    unseen_s: float
    """Time since it was saved [s]; infinite if unknown."""
    ledger: RunCounters
    """Counters with this start added; zero if the file was of another pack, or could not be read."""
    reason: str
    """Reason for the rejection; empty when it may be."""


class CheckpointFile:
    """One pack's checkpoint, ``<pack.name>-<identity>.npz``.

    Args:
        folder: Location; must exist.
        settings: The pack's settings.
        cell: The pack as one object.
        now: The present moment.
    """

    def __init__(
        self, folder: Path, settings: Settings, cell: PackModel, now: Callable[[], BootTimestamp] = boot_timestamp
    ) -> None:
        self._name, self._now = settings.pack.name, now
        self._identity, self._observer = pack_identity(settings, cell), observer_identity(settings, cell)
        self._longest_days = settings.state.longest_days
        self._content: dict[str, Any] = {}  # of the file, as far as it is no ledger
        self._later = False  # the file is of a later format
        self.path = folder / f"{self._name}-{self._identity[:8]}.npz"
        self.disk_free_mib: float | None = None
        """Free space of the file's disk at the last write [MiB]."""
        self.thread = DiskThread("checkpoint")
        """Thread for ``save`` and ``update_counters``: an abandoned call still ends before the next one begins."""
        self.saved: tuple[int, float] | None = None
        """Samples and SOC of the state that was saved last; None: none was by this run."""

    def save(self, state: NDArray[np.void], ledger: RunCounters) -> None:
        """Write atomically: after a power cut there is the old file or the new one. A missing folder is created.

        Args:
            state: Shape (1,), dtype ESTIMATOR_STATE.
            ledger: Counters of this and earlier runs.

        Raises:
            OSError: The file cannot be written.
        """
        content = {"identity": self._identity, "observer": self._observer, "state": state, **asdict(self._now())}
        self._write(content, ledger)

    def update_counters(self, ledger: RunCounters) -> None:
        """Update the counters of the runs in the file, if there is one; the state keeps its age.

        Raises:
            OSError: The file cannot be written.
        """
        if self._content:
            self._write(self._content, ledger)

    def _write(self, content: dict[str, Any], ledger: RunCounters) -> None:
        packed = io.BytesIO()
        total = ledger.total.model_dump_json()
        told: dict[str, Any] = {
            "restarts": ledger.restarts,
            "total": total,
            "clean": ledger.clean,
            "alarms": ledger.alarms,
        }
        np.savez(packed, format=FORMAT, **told, **content)
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        disk = os.statvfs(self.path.parent)
        self.disk_free_mib = disk.f_bavail * disk.f_frsize / 2**20
        write_private(self.path, packed.getbuffer())
        self._content = content
        self._remove_oldest()

    def load(self) -> CheckpointContent:
        """Read the file. An error becomes the result's reason, not an exception."""
        new = RunCounters(0, new_totals(self._now().wall_s))
        try:
            with np.load(io.BytesIO(read_private(self.path, MAX_FILE)), allow_pickle=False) as file:
                return self._checked(file)
        except FileNotFoundError:
            return CheckpointContent({}, 0.0, new, "none found")
        except _RefusedError as error:
            return CheckpointContent({}, 0.0, error.ledger or new, f"{REFUSED}{error}")
        except UnsafeFileError as error:
            return CheckpointContent({}, 0.0, new, f"{REFUSED}{error}")
        except Exception as error:  # noqa: BLE001 - a damaged file may raise anything, and is reported
            return CheckpointContent({}, 0.0, new, f"{REFUSED}damaged, perhaps by a power cut ({type(error).__name__})")

    def quarantine(self) -> str:
        """Move a rejected file out of the way of the next save. Returns a description for people.

        A file of a later format is valid and replaces none, so that each version finds its own file after a
        downgrade. It is not restored automatically: this version's later files are newer, though it may have learned
        less.
        """
        aside = self.path.with_name(f"{self._name}.refused.npz")
        if self._later:
            places = [self.path.with_name(f"{self._name}.later-{n}.npz") for n in range(1, LATER + 1)]
            aside = next((place for place in places if not place.exists()), places[-1])
        self._content = {}
        try:
            self.path.replace(aside)
        except OSError as error:
            return f"it cannot be set aside: {error}"
        back = shlex.join(["mv", str(aside.resolve()), str(self.path.resolve())])
        later = (
            f"; once the version that wrote it is installed again, stop the service and `{back}`" if self._later else ""
        )
        return f"set aside as {aside.name}{later}"

    def _checked(self, found: Mapping[str, NDArray[Any]]) -> CheckpointContent:
        now_s, version = self._now().wall_s, int(found["format"])
        ours = str(found.get("identity", "")) == self._identity
        self._later = version > FORMAT
        if version != FORMAT:
            ledger = _ledger(found, now_s) if ours and self._later else None
            raise _RefusedError(f"format {version}, this version reads {FORMAT}", ledger)
        if not ours:
            raise _RefusedError("it belongs to another pack or cell")
        file = dict(found)
        state = dict(fields(file["state"]))
        saved = BootTimestamp(
            float(file["wall_s"]), bool(file["synchronised"]), float(file["boot_s"]), str(file["boot"])
        )
        unseen_s, ledger = self._now().since(saved), _ledger(file, now_s)
        if self._longest_days is not None and self._longest_days * DAY_S < unseen_s < math.inf:
            days = f"{unseen_s / DAY_S:.1f} days old"
            raise _RefusedError(f"it is {days}, state.longest_days is {self._longest_days:g}", ledger)
        self._content = {name: v for name, v in file.items() if name not in ("format", *_OF_LEDGER)}
        self._content |= {"identity": self._identity}
        if str(file["observer"]) != self._observer:
            state = without_observer(state)
        return CheckpointContent(state, unseen_s, ledger, "")

    def _remove_oldest(self) -> None:
        """Remove the oldest files of the pack: trying settings leaves one file for each."""
        ours = re.compile(rf"{re.escape(self._name)}-[0-9a-f]{{8}}\.npz")
        others = [path for path in self.path.parent.iterdir() if ours.fullmatch(path.name) and path != self.path]
        others.sort(key=lambda path: path.lstat().st_mtime, reverse=True)
        for path in others[KEPT - 1 :]:
            path.unlink(missing_ok=True)


class _RefusedError(Exception):
    """Reason for rejecting a checkpoint, and counters that continue anyway."""

    def __init__(self, reason: str, ledger: RunCounters | None = None) -> None:
        super().__init__(reason)
        self.ledger = ledger


def _ledger(file: Mapping[str, NDArray[Any]], now_s: float) -> RunCounters:
    """Return a file's run counters with this start added. Invalid counters restart from zero at ``now_s``."""
    try:
        return _believable(file)
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        log.warning("the checkpoint's counters cannot be: counting begins anew", reason=str(error))
        return RunCounters(1, new_totals(now_s))


def _believable(file: Mapping[str, NDArray[Any]]) -> RunCounters:
    """Read the run counters of a file; a counter that the file lacks is 0.

    Raises:
        ArithmeticError, LookupError, TypeError, ValueError: It is damaged, or no counter can be so.
    """
    told = json.loads(str(file["total"]))
    total = Totals.model_validate({name: told[name] for name in Totals.model_fields if name in told})
    datetime.fromisoformat(total.since)
    restarts, crashes = int(file["restarts"]) + 1, total.crashes + (not file["clean"])
    counted = {"restarts": restarts, "crashes": crashes, "unseen_s": total.unseen_s, **total.samples}
    counted |= ChargeEnergy.of(total)._asdict()
    wrong = [f"{name} = {value}" for name, value in counted.items() if not 0 <= value <= MOST]
    if wrong:
        raise ValueError(", ".join(wrong))
    return RunCounters(restarts, total.model_copy(update={"crashes": crashes}), alarms=str(file.get("alarms", "")))
