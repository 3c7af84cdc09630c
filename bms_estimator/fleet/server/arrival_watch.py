"""Packs of a tenant without a recent hourly summary, and packs with an alarm of a faulty cell in the last one.

A worker publishes the summary of an hour when the pack's next hour begins.
"""

import re

from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.metrics.states import Problems
from bms_estimator.fleet.nats.bucket_reader import BucketReader
from bms_estimator.fleet.nats.stream_reader import read_stream

SILENT_S = 3.0 * 3600.0
"""Time without a summary after which a pack counts as silent [s], about that of the query ``silent``."""


ALARMS = re.compile(rb'"alarms":"[^"]*(weak_cell|cell_short)')
"""Part of a summary with an alarm of a faulty cell. Other alarms are also raised in healthy packs."""


class ArrivalWatch:
    """Watch over the arrival of summaries; times are of one monotonic clock [s].

    A pack without a summary counts from the start of the watch, or from its addition to the table.

    Args:
        nc: Connection to the tenant's NATS account.
    """

    def __init__(self, nc: Client) -> None:
        self._nc, self._table = nc, BucketReader(nc, subjects.PACKS_BUCKET)
        self._last_s: dict[str, float] = {}  # by pack of the table
        self._with_alarms = set[str]()
        self._next_sequence: int | None = None  # in the stream ``HOURS``

    async def problems(self, now_s: float) -> Problems:
        """Read the changes since the last call, and return the present numbers.

        Raises:
            StreamError: The server does not respond or rejects a request.
            nats.errors.Error: An error of the connection.
        """

        def set_row(pack: str, row: bytes | None) -> None:
            if row is None:
                self._last_s.pop(pack, None)
                self._with_alarms.discard(pack)
            else:
                self._last_s.setdefault(pack, now_s)

        await self._table.read(set_row)
        if self._next_sequence is None:
            state = (await self._nc.jetstream().stream_info(subjects.HOURS_STREAM)).state
            self._next_sequence = state.last_seq + 1
        rows = read_stream(self._nc, subjects.HOURS_STREAM, subjects.hours(), first=self._next_sequence)
        async for batch in rows:
            for message in batch:
                pack = message.subject.rpartition(".")[2]
                if pack in self._last_s:
                    self._last_s[pack] = now_s
                    (self._with_alarms.add if ALARMS.search(message.data) else self._with_alarms.discard)(pack)
            self._next_sequence = batch[-1].sequence + 1
        return Problems(sum(now_s - last_s > SILENT_S for last_s in self._last_s.values()), len(self._with_alarms))
