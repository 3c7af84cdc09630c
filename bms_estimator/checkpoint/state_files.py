"""All files of a pack's state: checkpoint, history with its last fit, observed load, and counters with alarms."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import structlog

from bms_estimator.checkpoint.arrays_file import HISTORY_SUFFIX, LOAD_SUFFIX, ArraysFile, RejectedFileError
from bms_estimator.checkpoint.checkpoint_file import CheckpointFile
from bms_estimator.checkpoint.run_file import RunFile, SavedRun
from bms_estimator.model.cell import CellModel, with_capacity
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import PackModel
from bms_estimator.pack.pack import Pack, new_pack
from bms_estimator.pack.state import CHECKPOINT, CURVES, HISTORY, LOAD, REFUSED, Arrays, PackState
from bms_estimator.process.boot_clock import BootTimestamp, boot_timestamp
from bms_estimator.process.disk_thread import DiskThread
from bms_estimator.settings.pack import Settings

log = structlog.get_logger(__name__)


class SavedPack(NamedTuple):
    """Pack as it was at its last save."""

    name: str
    pack: Pack
    age_s: float | None = None
    """Time since the save [s]; infinite if unknown; None: the pack was not saved, but is at the end of a capture."""
    load_reason: str = ""
    """Reason for which the observed load is unknown; empty if it was restored or none was saved."""


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
        self.run_file = RunFile(folder, settings.pack.name, lambda: now().wall_s)
        self.thread = DiskThread("checkpoint")

    def newest(self) -> "StateFiles":
        """Return the files of the pack's last run, whose declared capacity may be another one; without any, these files."""
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
        off = "" if pack.estimator.record[0]["filter"]["started"] else "the identifier was off"
        if reason := refused.get(CURVES) or refused.get(CHECKPOINT) or off:
            raise UserError(f"{path}: nothing was learned: {reason}")
        return SavedPack(self._settings.pack.name, pack, state.gap_s, refused.get(LOAD, "").removeprefix(REFUSED))

    def read_counters(self) -> SavedRun:
        """Return counters and alarms of earlier runs. A damaged file is quarantined."""
        saved = self.run_file.load()
        if saved.is_damaged:
            outcome = f"{REFUSED}{saved.lost_reason}; {self.run_file.quarantine()}"
            log.warning("counters and alarms", file=str(self.run_file.path), outcome=outcome)
        return saved
