"""Estimator with the learned state of a pack's checkpoint."""

from bms_estimator.checkpoint.checkpoint_file import CheckpointContent, CheckpointFile
from bms_estimator.estimator import Estimator
from bms_estimator.estimator.estimator import new_estimator
from bms_estimator.estimator.restore import restore_state
from bms_estimator.model.errors import UserError
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.pack_model.handover import adopt_curves
from bms_estimator.pack_model.saved import fit_of_curves
from bms_estimator.settings.pack import Settings


def learned_estimator(file: CheckpointFile, settings: Settings, model: PackModel) -> Estimator:
    """Return an estimator with the state and the fit of a checkpoint.

    Args:
        file: Checkpoint of the pack.
        settings: Settings of the pack.
        model: Model of the whole pack.

    Raises:
        UserError: There is no valid checkpoint, or the service ran without the identifier.
    """
    return estimator_of(load_valid(file, settings), file, settings, model)


def load_valid(file: CheckpointFile, settings: Settings) -> CheckpointContent:
    """Return the content of a checkpoint. The file remains unchanged.

    Raises:
        UserError: There is no valid checkpoint.
    """
    content = file.load()
    if content.reason:
        raise UserError(
            f"{file.path}: no checkpoint to read: {content.reason}; the pack's service saves a checkpoint every "
            f"{settings.state.checkpoint_s:g} s"
        )
    return content


def estimator_of(content: CheckpointContent, file: CheckpointFile, settings: Settings, model: PackModel) -> Estimator:
    """Return an estimator with the state and the fit of a checkpoint's content, as it was when it was saved.

    Args:
        content: Content of ``file``.
        file: Checkpoint of the pack, for the errors.
        settings: Settings of the pack.
        model: Model of the whole pack.

    Raises:
        UserError: The state is invalid, or the service ran without the identifier.
    """
    estimator = new_estimator(settings, model)
    try:
        fit = fit_of_curves(content.curves)
    except ValueError as error:
        raise UserError(f"{file.path}: nothing was learned: {error}") from error
    if fit:
        adopt_curves(estimator.settings_record[0]["filter"], estimator.cell_file_settings, fit)
    reason = restore_state(estimator, content.state, unseen_s=0.0)
    if reason or not estimator.record[0]["filter"]["started"]:
        raise UserError(f"{file.path}: nothing was learned: {reason or 'the identifier was off'}")
    return estimator
