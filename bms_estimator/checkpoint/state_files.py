"""All files of a pack's state: checkpoint, history with its last fit, observed load, and counters with alarms.

A state is restored only if it is valid and belongs to the pack. Each ``pack_identity`` has its own checkpoint with named
fields. Therefore no state is lost if settings are edited or a version with other fields is installed.
"""

import contextlib
import math
import os
import re
import secrets
import shlex
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import structlog
from numpy.typing import NDArray

from bms_estimator.checkpoint.arrays_file import (
    HISTORY_SUFFIX,
    LOAD_SUFFIX,
    ArraysFile,
    RejectedFileError,
    read_arrays,
    reject_damaged,
    set_aside,
    write_arrays,
)
from bms_estimator.checkpoint.changes_file import CHANGES_SUFFIXES, BaseCheckpoint, ChangesFile
from bms_estimator.checkpoint.identity import observer_identity, pack_identity, without_observer
from bms_estimator.checkpoint.run_file import PackDescription, RunFile, SavedRun
from bms_estimator.kernels.kalman_filter.records import SCRATCH
from bms_estimator.model.arrays import fields
from bms_estimator.model.cell import CellModel, with_capacity
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import PackModel
from bms_estimator.pack.pack import Pack, new_pack
from bms_estimator.pack.state import (
    CHECKPOINT,
    CURVES,
    HISTORY,
    LOAD,
    REFUSED,
    Arrays,
    DeclaredValues,
    PackState,
)
from bms_estimator.process.boot_timestamp import BootTimestamp, boot_timestamp
from bms_estimator.process.stderr_writer import DaemonThreadExecutor
from bms_estimator.settings.pack import Settings

FORMAT = 8
"""Version of the file's layout. Increment it when a field changes its meaning, and migrate files of the previous
version."""
FORMER_FORMAT = 7
"""Version of files that also contain counters and alarms. ``RunFile`` migrates these."""
DAY_S = 86400.0
MAX_FILE_BYTES = 1 << 20
"""Maximum size of a checkpoint file [bytes]. A file of the former format has about 112 kB."""
MAX_FILES = 8
"""Maximum number of checkpoint files of one pack; older ones are deleted."""
MAX_LATER_FILES = 4
"""Maximum number of quarantined files of later formats, which serve a return to the later version."""
_CELLS = "cells."
"""Prefix of the names of the arrays of single cells in the file."""
_CURVES = "fit."
"""Prefix of the names of the fit's arrays in the file."""


class CheckpointFile:
    """One pack's checkpoint, ``<pack.name>-<identity>.npz``.

    Args:
        folder: Folder of the file.
        settings: The pack's settings.
        cell: Model of the whole pack.
        now: Clock that also identifies the boot.
    """

    def __init__(
        self, folder: Path, settings: Settings, cell: PackModel, now: Callable[[], BootTimestamp] = boot_timestamp
    ) -> None:
        self._name, self._now = settings.pack.name, now
        self._identity, self._observer = pack_identity(settings, cell), observer_identity(settings, cell)
        self._declared = DeclaredValues.of(cell)
        self._longest_days = settings.state.longest_days
        self._is_later = False  # the file has a later format
        self.path = folder / f"{self._name}-{self._identity[:8]}.npz"
        self._changes = ChangesFile(self.path)
        self.disk_free_mib: float | None = None
        """Free space on the disk at the last write [MiB]."""

    def save(
        self,
        state: NDArray[np.void],
        curves: Mapping[str, NDArray[Any]] | None = None,
        cells: Mapping[str, NDArray[Any]] | None = None,
        *,
        whole: bool = False,
    ) -> None:
        """Write the file, or only its changes, atomically: after a power cut either the old or the new state exists.

        A missing folder is created.

        Args:
            state: Shape (1,), dtype ESTIMATOR_STATE.
            curves: Arrays of the fit to whose curves the state is relative; None or empty: those of the cell file.
            cells: State of the estimators of single cells; None or empty without cell voltages.
            whole: True: write the whole file.

        Raises:
            OSError: The file cannot be written.
        """
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        disk = os.statvfs(self.path.parent)
        self.disk_free_mib = disk.f_bavail * disk.f_frsize / 2**20
        now, curves = self._now(), curves or {}
        state = state.copy()
        state["filter"][SCRATCH] = 0.0
        if not whole and self.path.exists() and self._changes.save(state, curves, now):
            return
        token = secrets.token_hex(8)
        content: dict[str, Any] = {
            "format": FORMAT,
            "identity": self._identity,
            "observer": self._observer,
            "token": token,
            "state": state,
            **asdict(now),
            **(self._declared._asdict() if self._declared else {}),
        }
        content |= {f"{_CURVES}{name}": array for name, array in curves.items()}
        content |= {f"{_CELLS}{name}": array for name, array in (cells or {}).items()}
        write_arrays(self.path, content)
        self._changes.set_base(BaseCheckpoint(token, state, curves, now))
        self._remove_oldest()

    def load(self) -> PackState:
        """Read the state of estimator and single cells. An error is returned in the result's ``reasons``."""
        try:
            with reject_damaged():
                return self._validate(read_arrays(self.path, MAX_FILE_BYTES))
        except FileNotFoundError:
            return PackState(reasons={CHECKPOINT: "none found"})
        except RejectedFileError as error:
            return PackState(reasons={CHECKPOINT: f"{REFUSED}{error}"})

    @property
    def saved_ns(self) -> int:
        """Time of the last save [ns since 1970]; 0 without a file."""
        paths = [self.path, *(self.path.with_suffix(suffix) for suffix in CHANGES_SUFFIXES)]
        return max((path.lstat().st_mtime_ns for path in paths if path.exists()), default=0)

    def other_declared(self) -> Iterator[tuple[Path, DeclaredValues]]:
        """Yield the pack's other checkpoints with a declared capacity. Damaged files are ignored."""
        for path in self._other_paths():
            with contextlib.suppress(Exception):  # a damaged file may raise anything
                file = read_arrays(path, MAX_FILE_BYTES)
                declared = DeclaredValues(*(float(file[name]) for name in DeclaredValues._fields))
                if all(0.0 < value < math.inf for value in declared):
                    yield path, declared

    def quarantine(self) -> str:
        """Rename a rejected file, so that the next save does not overwrite it. Return a description for the user.

        A file of a later format is valid. It gets a separate name, so that the later version can use it after a
        re-upgrade. The user must rename it back: it is not loaded automatically, because this version meanwhile writes
        newer files.
        """
        quarantined = self.path.with_name(f"{self._name}.refused.npz")
        if self._is_later:
            paths = [self.path.with_name(f"{self._name}.later-{n}.npz") for n in range(1, MAX_LATER_FILES + 1)]
            unused_paths = (path for path in paths if not path.exists())
            quarantined = next(unused_paths, paths[-1])  # without an unused name the last file is overwritten
        outcome = set_aside(self.path, quarantined)
        if not self._is_later or self.path.exists():
            return outcome
        command = shlex.join(["mv", str(quarantined.resolve()), str(self.path.resolve())])
        return f"{outcome}; once the version that wrote it is installed again, stop the service and `{command}`"

    def _validate(self, file: Mapping[str, NDArray[Any]]) -> PackState:
        """Return the content of a file.

        Raises:
            RejectedFileError: The file has another format or identity, or is too old.
        """
        version = int(file["format"])
        self._is_later = version > FORMAT
        if version not in (FORMER_FORMAT, FORMAT):
            raise RejectedFileError(f"format {version}, this version reads {FORMAT}")
        if str(file["identity"]) != self._identity:
            raise RejectedFileError("it belongs to another pack or cell")
        state = dict(fields(file["state"]))
        saved = BootTimestamp(
            float(file["wall_s"]), bool(file["synchronised"]), float(file["boot_s"]), str(file["boot"])
        )
        if version == FORMAT and (changes := self._changes.load(str(file["token"]), file["state"].dtype)):
            state, saved = state | changes.state, changes.saved
        gap_s = self._now().since(saved)
        if self._longest_days is not None and self._longest_days * DAY_S < gap_s < math.inf:
            days = f"{gap_s / DAY_S:.1f} days old"
            raise RejectedFileError(f"it is {days}, state.longest_days is {self._longest_days:g}")
        if str(file["observer"]) != self._observer:
            state = without_observer(state)
        return PackState(
            state, _with_prefix(file, _CURVES), _with_prefix(file, _CELLS), gap_s=gap_s, declared=self._declared
        )

    def _remove_oldest(self) -> None:
        """Remove the pack's oldest files beyond ``MAX_FILES``, because each configured cell leaves a file."""
        others = self._other_paths()
        others.sort(key=lambda path: path.lstat().st_mtime, reverse=True)
        for path in others[MAX_FILES - 1 :]:
            path.unlink(missing_ok=True)
            for suffix in (HISTORY_SUFFIX, LOAD_SUFFIX, *CHANGES_SUFFIXES):
                path.with_suffix(suffix).unlink(missing_ok=True)

    def _other_paths(self) -> list[Path]:
        """Return the pack's checkpoints with other identities."""
        ours = re.compile(rf"{re.escape(self._name)}-[0-9a-f]{{8}}\.npz")
        folder = self.path.parent.iterdir() if self.path.parent.is_dir() else ()
        return [path for path in folder if ours.fullmatch(path.name) and path != self.path]


def _with_prefix(file: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    """Return the arrays whose names begin with ``prefix``, without it."""
    return {name.removeprefix(prefix): v for name, v in file.items() if name.startswith(prefix)}


log = structlog.get_logger(__name__)


class SavedPack(NamedTuple):
    """Pack as it was at its last save."""

    name: str
    pack: Pack
    age_s: float | None = None
    """Time since the save [s]; infinite if unknown; None: the pack was not saved, but is at the end of a capture."""
    load_reason: str = ""
    """Reason why the observed load is unknown; empty if it was restored or none was saved."""


class StateFiles:
    """Files of the state of one pack.

    Args:
        folder: Folder of the files.
        settings: The pack's settings.
        model: Model of the whole pack.
        now: Clock that also identifies the boot.

    Attributes:
        checkpoint: State of estimator and single cells.
        history: History and last fit.
        load: Observed load.
        run_file: Counters and alarms.
        thread: Thread for all writes. A call that timed out still finishes before the next one.
    """

    def __init__(
        self, folder: Path, settings: Settings, model: PackModel, now: Callable[[], BootTimestamp] = boot_timestamp
    ) -> None:
        self._settings, self._model, self._now = settings, model, now
        self.checkpoint = CheckpointFile(folder, settings, model, now)
        self.history = ArraysFile(folder, settings, model, HISTORY_SUFFIX)
        self.load = ArraysFile(folder, settings, model, LOAD_SUFFIX)
        self.run_file = RunFile(folder, settings.pack.name, lambda: now().wall_s, PackDescription.of(settings))
        self.thread = DaemonThreadExecutor("checkpoint")

    def newest(self) -> "StateFiles":
        """Return the files of the pack's last run, perhaps with another declared capacity. Without any, return these files."""
        newest = self
        if isinstance(self._model, CellModel):
            for path, declared in self.checkpoint.other_declared():
                r_s = self._model.r_s.model_copy(update={"offset_ohm": declared.r_s_ohm})
                model = with_capacity(self._model, declared.capacity_ah).model_copy(update={"r_s": r_s})
                other = StateFiles(path.parent, self._settings, model, self._now)
                if other.checkpoint.path == path and other.checkpoint.saved_ns > newest.checkpoint.saved_ns:
                    newest = other
        return newest

    def read(self) -> PackState:
        """Return the saved state of the pack. The files remain unchanged."""
        state = self.checkpoint.load()
        reasons, arrays = dict(state.reasons), dict[str, Arrays]()
        for name, file in ((HISTORY, self.history), (LOAD, self.load)):
            try:
                arrays[name] = file.load()
            except RejectedFileError as error:
                reasons[name] = f"{REFUSED}{error}"
        return replace(state, history=arrays.get(HISTORY, {}), load=arrays.get(LOAD, {}), reasons=reasons)

    def save(self, state: PackState, *, whole: bool = False) -> None:
        """Write each part that ``state``, from ``Pack.state``, contains.

        Args:
            state: State of the pack.
            whole: True: write the whole checkpoint, not only its changes.

        Raises:
            OSError: A file cannot be written.
        """
        if isinstance(state.record, np.ndarray):
            self.checkpoint.save(state.record, state.curves, state.cells, whole=whole)
        for arrays, file in ((state.history, self.history), (state.load, self.load)):
            if arrays:
                file.save(arrays)

    def restore(self, pack: Pack) -> str:
        """Restore a new pack, quarantine each refused file, and log the outcomes.

        Returns:
            Outcome of the checkpoint as text.
        """
        source = self.newest()
        state = source.read()
        outcomes = {**state.reasons, **pack.restore(state, state.gap_s)}
        files: dict[str, CheckpointFile | ArraysFile] = {
            CHECKPOINT: source.checkpoint,
            HISTORY: source.history,
            LOAD: source.load,
        }
        for name, outcome in outcomes.items():
            file = files.get(name)
            if file and outcome.startswith(REFUSED):
                outcomes[name] = f"{outcome}; {file.quarantine()}"
            (log.warning if outcome.startswith(REFUSED) else log.info)(
                name, outcome=outcomes[name], **({"file": str(file.path)} if file else {})
            )
        return outcomes[CHECKPOINT]

    def saved_pack(self) -> SavedPack:
        """Return the pack as it was at its last save. The files remain unchanged.

        Raises:
            UserError: There is no valid checkpoint, or the service ran without the identifier.
        """
        state, pack = self.newest().read(), new_pack(self._settings, self._model)
        path = self.checkpoint.path
        if reason := state.reasons.get(CHECKPOINT):
            raise UserError(
                f"{path}: no checkpoint to read: {reason}; the pack's service saves a checkpoint every "
                f"{self._settings.state.checkpoint_s:g} s"
            )
        outcomes = {**state.reasons, **pack.restore(state, 0.0)}
        refused = {name: outcome for name, outcome in outcomes.items() if outcome.startswith(REFUSED)}
        not_identified = "" if pack.estimator.record[0]["filter"]["started"] else "the identifier was off"
        if reason := refused.get(CURVES) or refused.get(CHECKPOINT) or not_identified:
            raise UserError(f"{path}: nothing was learned: {reason}")
        return SavedPack(self._settings.pack.name, pack, state.gap_s, refused.get(LOAD, "").removeprefix(REFUSED))

    def read_counters(self) -> SavedRun:
        """Return counters and alarms of earlier runs. A damaged file is quarantined."""
        saved = self.run_file.load()
        if saved.is_damaged:
            outcome = f"{REFUSED}{saved.lost_reason}; {self.run_file.quarantine()}"
            log.warning("counters and alarms", file=str(self.run_file.path), outcome=outcome)
        return saved
