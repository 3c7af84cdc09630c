"""Check how much of the stream is filled by blocks that no checkpoint includes."""

from collections.abc import Iterable

import structlog
from nats.aio.client import Client

from bms_estimator.fleet.nats.connection import error_text
from bms_estimator.fleet.nats.unsaved_blocks import unsaved_share, unsaved_warning
from bms_estimator.fleet.worker.retry import RETRYABLE_ERRORS

log = structlog.get_logger(__name__)


class UnsavedCheck:
    """Check of the partitions of one worker.

    Args:
        nc: Connection to the tenant's NATS account.

    Attributes:
        warning: Present warning; empty without one.
    """

    def __init__(self, nc: Client) -> None:
        self._nc, self.warning = nc, ""

    async def run(self, partitions: Iterable[int]) -> None:
        """Check the given partitions, and log a new warning."""
        if not self._nc.is_connected:
            return
        try:
            warning = unsaved_warning(await unsaved_share(self._nc, partitions))
        except RETRYABLE_ERRORS as error:
            log.warning("the stream cannot be checked", reason=error_text(error))
            return
        if warning and not self.warning:
            log.warning("the stream fills with blocks that no checkpoint includes", reason=warning)
        self.warning = warning
