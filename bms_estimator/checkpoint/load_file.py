"""Restore of the load that was seen, from its file beside the checkpoint."""

import structlog

from bms_estimator.checkpoint.history_file import HistoryFile, RejectedHistoryError
from bms_estimator.forecast.load_history import LoadHistory
from bms_estimator.forecast.saved_load import restore_load

log = structlog.get_logger(__name__)


def restore_seen_load(file: HistoryFile, load: LoadHistory) -> None:
    """Restore the load of a file. A file that cannot be used is reported and left, and the load stays empty.

    Args:
        file: File of the load.
        load: Load of a new forecaster.
    """
    try:
        arrays = file.load()
        if arrays is None:
            return
        restore_load(load, arrays)
    except (RejectedHistoryError, ValueError) as error:
        log.warning("the load that was seen is not restored", file=str(file.path), reason=str(error))
        return
    log.info("load restored", file=str(file.path), seconds=load.seconds)
