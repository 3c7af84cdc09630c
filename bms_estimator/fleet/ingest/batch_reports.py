"""Reports about batches that were rejected, or whose samples were dropped: to their sender, to the log, and as dead letters."""

import asyncio
import itertools
import time
from collections import Counter

import nats.errors
import structlog
from nats.aio.client import Client
from pydantic import BaseModel, ConfigDict

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.connection import RETRYABLE_ERRORS, error_text
from bms_estimator.fleet.nats.dead_letters import DeadLetter, one_line
from bms_estimator.fleet.nats.stream_reader import StoredMessage
from bms_estimator.fleet.packs.pack_registry import UNKNOWN_PACK

LOG_INTERVAL_S = 60.0
"""Minimum interval between two log lines about a pack [s]."""
MAX_LOGGED_PACKS = 10_000
"""Maximum number of packs whose last log time is stored, and of unknown packs that are counted."""
SHOWN_PACKS = 10
"""Maximum number of unknown packs that a log line names."""
ATTEMPTS = 5
"""Maximum number of attempts to store a dead letter."""
RETRY_S = 1.0
"""Retry interval [s]."""
WORKER = "ingest"
"""Value of ``DeadLetter.worker`` for rejected batches."""

log = structlog.get_logger(__name__)


class BatchReport(BaseModel):
    """Report about a batch, published on ``subjects.ingest_report``."""

    model_config = ConfigDict(frozen=True)

    pack: str
    sequence: int
    """Sequence number of the batch in the stream ``TELEMETRY``. The server's acknowledgment to the sender has it, too."""
    stored: int
    """Number of samples that were stored."""
    dropped: int
    """Number of samples that were dropped."""
    error: str
    """Reason and remedy."""


class BatchReports:
    """Reporter of rejected batches and dropped samples.

    Args:
        nc: Connection to the tenant's NATS account.

    Attributes:
        counters: Numbers of batches and samples by outcome.
    """

    def __init__(self, nc: Client) -> None:
        self._nc, self.counters = nc, Counter[str]()
        self._logged: dict[str, float] = {}  # time of the last log line by pack, in the order of time
        self._unknown, self._unknown_batches = dict[str, None](), 0  # packs, in the order of their batches

    async def reject(self, message: StoredMessage, pack: str, reason: str, stored: int = 0) -> None:
        """Report a batch of which ``stored`` samples are stored and the others are not, and store it as a dead letter."""
        self.counters["rejected_batches"] += 1
        reason = one_line(reason)
        await self.report(BatchReport(pack=pack, sequence=message.sequence, stored=stored, dropped=0, error=reason))
        letter = DeadLetter(pack, message.sequence, reason, WORKER, message.data, subjects.telemetry(pack))
        await self._store(letter)

    async def reject_unknown(self, message: StoredMessage, pack: str) -> None:
        """Publish a report of a batch whose pack is not in the table of packs. ``log_unknown`` logs it later."""
        self.counters["rejected_batches"] += 1
        self._unknown_batches += 1
        if len(self._unknown) < MAX_LOGGED_PACKS:
            self._unknown[pack] = None
        await self._publish(BatchReport(pack=pack, sequence=message.sequence, stored=0, dropped=0, error=UNKNOWN_PACK))

    def log_unknown(self) -> None:
        """Log one line for all batches of unknown packs since the last call."""
        if self._unknown_batches:
            names = ", ".join(itertools.islice(self._unknown, SHOWN_PACKS))
            log.warning(
                "batches of packs that are not in the table of packs",
                batches=self._unknown_batches,
                packs=len(self._unknown),
                first=names,
            )
        self._unknown, self._unknown_batches = {}, 0

    async def report(self, report: BatchReport) -> None:
        """Publish a report, and log it unless another one of the pack was logged less than ``LOG_INTERVAL_S`` ago."""
        now_s = time.monotonic()
        if now_s - self._logged.get(report.pack, -LOG_INTERVAL_S) >= LOG_INTERVAL_S:
            self._logged.pop(report.pack, None)
            self._logged[report.pack] = now_s
            if len(self._logged) > MAX_LOGGED_PACKS:
                del self._logged[next(iter(self._logged))]
            log.warning("samples of a batch are not stored", **report.model_dump())
        await self._publish(report)

    async def _publish(self, report: BatchReport) -> None:
        try:
            await self._nc.publish(subjects.ingest_report(report.pack), report.model_dump_json().encode())
        except nats.errors.Error as error:
            log.warning("a report cannot be published", pack=report.pack, reason=error_text(error))

    async def _store(self, letter: DeadLetter) -> None:
        """Store a dead letter. After ``ATTEMPTS`` failures it is lost, so that other batches do not wait."""
        for _ in range(ATTEMPTS):
            try:
                await self._nc.jetstream().publish(letter.subject, letter.data, headers=letter.headers())
            except RETRYABLE_ERRORS as error:
                reason = error_text(error)
                await asyncio.sleep(RETRY_S)
            else:
                return
        log.error("a rejected batch cannot be stored as a dead letter", pack=letter.pack, reason=reason)
