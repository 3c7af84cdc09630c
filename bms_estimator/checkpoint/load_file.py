"""Restore of the observed load, from its file beside the checkpoint."""

from bms_estimator.checkpoint.history_file import HistoryFile, RejectedHistoryError
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.forecast.saved_load import restore_load


def restore_seen_load(file: HistoryFile, forecaster: Forecaster) -> str:
    """Restore the load of a file, if there is one. The file remains unchanged.

    Args:
        file: File of the load.
        forecaster: New forecaster.

    Returns:
        Reason for which the file cannot be used, in which case the load stays empty; an empty text without such a reason.
    """
    try:
        arrays = file.load()
        if arrays is not None:
            restore_load(forecaster.load, forecaster.past, arrays)
    except (RejectedHistoryError, ValueError) as error:
        return str(error)
    return ""
