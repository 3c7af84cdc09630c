"""Restore of a pack at the start: state from the checkpoint, history and fit from the history file."""

import math

import structlog

from bms_estimator.checkpoint.checkpoint_file import REJECTED, CheckpointContent, CheckpointFile
from bms_estimator.checkpoint.history_file import HistoryFile, RejectedHistoryError
from bms_estimator.checkpoint.run_file import RunCounters, SavedRun
from bms_estimator.estimator import Estimator
from bms_estimator.estimator.restore import restore_state
from bms_estimator.model.clock import Clock
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model.curve_change import return_to_cell_file
from bms_estimator.pack_model.fit import PackFit
from bms_estimator.pack_model.handover import adopt_curves
from bms_estimator.pack_model.history import History
from bms_estimator.pack_model.saved import fit_of_curves, history_of
from bms_estimator.telemetry.lifetime_totals import new_totals

log = structlog.get_logger(__name__)


def restore_pack(pack: Pack, checkpoint: CheckpointFile | None, history: HistoryFile | None) -> str:
    """Restore a valid checkpoint and a valid history; rejected files are quarantined.

    The curves are adopted first, because the state is relative to them. The history is resumed last, because it depends on
    whether the state was restored.

    Args:
        pack: New pack.
        checkpoint: File of the state; None: the state is not saved.
        history: File of the history; None: the history is not saved.

    Returns:
        Outcome of the checkpoint as text.
    """
    if checkpoint is None:
        return "off"
    estimator, pack_model, cells = pack.estimator, pack.slow_fit, pack.cells
    content = checkpoint.load()
    state_fit = _fit_of_state(content)
    if pack_model:
        rows, fit = _load_history(history)
        pack_model.load(rows, fit, state_fit)
    elif state_fit:
        adopt_curves(estimator.settings_record[0]["filter"], estimator.cell_file_settings, state_fit)
    restored, outcome = _restore_state(estimator, content)
    if content.curves and (pack_model is None or state_fit is None):
        # Without a slow fit the resistances are converted to the curves of the cell file. If the saved curves are damaged, this
        # is impossible, and the resistances start with the std of the cell file again.
        return_to_cell_file(estimator)
    if pack_model:
        gap_s = content.unseen_s if restored else math.inf
        try:
            pack_model.resume(gap_s, restored=restored)
        except Exception as error:  # noqa: BLE001 - a damaged file must not end the service at each start
            _reject_history(history, error)
            pack_model.load(History(), None, state_fit)
            h = estimator.record["history"]
            h["count"] = h["sums"]["duration_s"] = 0  # without the earlier rows of the discarded history
            pack_model.resume(gap_s, restored=restored)
    if cells and restored and (reason := cells.restore(content.cells, content.unseen_s)):
        log.warning("the state of the single cells was dropped", reason=reason)
    if pack.forecaster and cells:
        pack.forecaster.deviations = cells.deviations
    if refused := outcome.startswith(REJECTED):
        outcome = f"{outcome}; {checkpoint.quarantine()}"
    write_log = log.warning if refused else log.info
    write_log("checkpoint", file=str(checkpoint.path), outcome=outcome)
    return outcome


def read_counters(checkpoint: CheckpointFile | None, clock: Clock) -> SavedRun:
    """Return counters and alarms of earlier runs. A damaged file is quarantined."""
    if checkpoint is None:
        return SavedRun(RunCounters(0, new_totals(clock.wall())))
    file = checkpoint.run_file
    saved = file.load()
    if saved.is_damaged:
        log.warning(
            "counters and alarms", file=str(file.path), outcome=f"{REJECTED}{saved.lost_reason}; {file.quarantine()}"
        )
    return saved


def _fit_of_state(content: CheckpointContent) -> PackFit | None:
    """Return the fit to whose curves the state is relative; None without a usable fit."""
    try:
        return fit_of_curves(content.curves)
    except ValueError as error:
        log.warning("the state is restored with the curves of the cell file", reason=str(error))
        return None


def _restore_state(estimator: Estimator, content: CheckpointContent) -> tuple[bool, str]:
    """Restore the state of a checkpoint. Return whether it was restored, and the outcome as text."""
    if content.reason:
        return False, content.reason
    if error := restore_state(estimator, content.state, content.unseen_s):
        return False, f"{REJECTED}{error}"
    return True, f"restored{_soc_text(estimator)}"


def _load_history(file: HistoryFile | None) -> tuple[History, PackFit | None]:
    """Return the saved history and its last fit. A rejected file is quarantined."""
    if file is None:
        return History(), None
    try:
        arrays = file.load()
        if arrays is None:
            return History(), None
        history, fit = history_of(arrays)
    except Exception as error:  # noqa: BLE001 - a damaged file must not end the service at each start
        _reject_history(file, error)
        return History(), None
    log.info("history", file=str(file.path), outcome=f"restored: {history.rows.size} rows")
    return history, fit


def _reject_history(file: HistoryFile | None, error: Exception) -> None:
    """Quarantine the file of a history that cannot be used, and log the reason."""
    if file is not None:
        kind = "" if isinstance(error, RejectedHistoryError | ValueError) else f"{type(error).__name__}: "
        log.warning("history", file=str(file.path), outcome=f"{REJECTED}{kind}{error}; {file.quarantine()}")


def _soc_text(estimator: Estimator) -> str:
    soc = float(estimator.state["soc"][0])
    return "" if math.isnan(soc) else f": SOC {soc:.4f}"
