"""Check whether the checkpoints of refused partitions have become readable."""

from collections.abc import Iterable

import structlog

from bms_estimator.fleet.nats.connection import error_text
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CheckpointStore
from bms_estimator.fleet.worker.checkpoint.format_versions import UnreadableFormatError
from bms_estimator.fleet.worker.membership import Membership
from bms_estimator.fleet.worker.retry import RETRYABLE_ERRORS

log = structlog.get_logger(__name__)


async def check_refused(numbers: Iterable[int], members: Membership, checkpoints: CheckpointStore) -> None:
    """Accept the refused partitions whose checkpoints another worker has written in a readable format since."""
    for number in numbers:
        try:
            await checkpoints.claims.check_format(number)
        except UnreadableFormatError as error:
            members.refused[number] = error.found
        except RETRYABLE_ERRORS as error:
            log.warning("a refused partition cannot be checked", partition=number, reason=error_text(error))
        else:
            log.info("the checkpoint of a refused partition has become readable", partition=number)
            del members.refused[number]
