"""The edge: a pack's raw samples on their way to a fleet's server, by MQTT, in blocks.

``take`` gathers; ``BlockStore`` keeps blocks until a worker has confirmed them; this module sends them and receives
the confirmations. How a broker is reached is the same as for estimates.
"""

import asyncio
import contextlib
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Self

import structlog
from pydantic import ValidationError

from bms_estimator.edge import subjects
from bms_estimator.edge.batching import MAX_SAMPLES, Batcher
from bms_estimator.edge.block_store import BlockStore
from bms_estimator.edge.block_table import EDGE_TABLES
from bms_estimator.edge.sample_clock import SampleClock
from bms_estimator.model.clock import Clock, since_boot
from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads import EdgeHealth
from bms_estimator.model.sample import SampleBlock
from bms_estimator.mqtt.broker_config import brokers, check
from bms_estimator.mqtt.connection import Connect, Connection, ConnectOptions
from bms_estimator.mqtt.delivery_stats import DeliveryStats
from bms_estimator.mqtt.denied_topics import DeniedTopics
from bms_estimator.mqtt.protocol_negotiation import BrokerConnector
from bms_estimator.mqtt.queue_sender import QueueSender
from bms_estimator.mqtt.reconnect_loop import ReconnectLoop
from bms_estimator.process.backoff import FIRST_DELAY_S
from bms_estimator.settings.edge import EdgeSettings
from bms_estimator.settings.mqtt import MqttSettings
from bms_estimator.store.database import RETRY_S, Database

MIB = 1 << 20
OVERDUE = 1.5
"""Age at which a block is sent though no sample has completed it, in block lengths."""
HANDOVER_S = 2.0
"""Time that unsent blocks may take at the end [s]."""
PARTING_S = 1.0
"""Timeout of a disconnect from the server [s]."""

log = structlog.get_logger(__name__)


class BlockSender:
    """Sends samples of one pack.

    Args:
        settings: Destination and storage of the blocks.
        pack: Name of the pack.
        folder: Folder of the blocks, in ``<pack>.edge.sqlite``.
        connect: Makes a connection; over TCP when left out.
        clock: Clock; its wall time dates samples.
        steady: A clock that never steps and continues during suspend [s].
        most_samples: Maximum number of samples of a block.
        first_delay_s: Delay before a lost broker, or a temporary rejection, is retried [s].
        retry_s: Delay before a failed disk is retried [s].
        handover_s: Time for sending the remaining blocks at the end [s].

    Attributes:
        delivery: What became of the blocks.
        unread: Messages on the workers' topic that could not be read.

    Raises:
        UserError: A URL or a file of ``settings`` cannot be used.
    """

    def __init__(
        self,
        settings: EdgeSettings,
        pack: str,
        folder: Path,
        *,
        connect: Connect | None = None,
        clock: Clock | None = None,
        steady: Callable[[], float] = since_boot,
        most_samples: int = MAX_SAMPLES,
        first_delay_s: float = FIRST_DELAY_S,
        retry_s: float = RETRY_S,
        handover_s: float = HANDOVER_S,
    ) -> None:
        self._clock, self._steady, self._handover_s = clock or Clock(), steady, handover_s
        self._block_s, self._gathering = settings.block_s, Batcher(settings.block_s, most_samples)
        self._database = Database(folder / f"{pack}.edge.sqlite", tables=EDGE_TABLES, sync_s=0.0, retry_s=retry_s)
        self._hear_topic = _topic(subjects.awaits(pack))
        most_bytes = int(settings.store_mib * MIB)
        self.store = BlockStore(self._database, _topic(subjects.raw(pack)), most_bytes, wall=self._clock.wall)
        self.delivery, self.unread = DeliveryStats(), 0
        self._refusals = DeniedTopics(self.delivery, lambda: None, first_delay_s)
        self._sending = QueueSender(self.store, self.delivery, self._refusals, first_delay_s)
        for warning in check_edge(settings):
            log.warning("a secret that is none", reason=warning)
        mqtt = _mqtt(settings)
        hello = ConnectOptions(f"bms-edge-{pack}-{secrets.token_hex(4)}", None, self._lose)
        self._link = ReconnectLoop(
            brokers(mqtt), hello, connect or BrokerConnector(mqtt), self._serve, self.delivery, first_delay_s
        )
        self._times: SampleClock | None = None
        self._overdue: asyncio.TimerHandle | None = None
        self._task: asyncio.Task[None] | None = None
        self._stack = contextlib.AsyncExitStack()

    def take(self, samples: SampleBlock) -> None:
        """Take samples that have just arrived, with times by the source's clock; returns at once."""
        if self._times is None:
            raise RuntimeError("an edge takes samples within its context")
        if self._task is not None and self._task.done():
            self._task.result()  # only an internal error ends the task: raise it
        wall_s = self._clock.wall()
        self._times.go_on_from(
            self.store.last_s
        )  # a store may be later than our clock, where workers have had a later one
        placed = samples.copy()
        placed["time_s"] = self._times.place(samples["time_s"], wall_s, self._steady())
        ended = self._gathering.add(placed, wall_s)
        for block in ended:
            self.store.put(block)
        if ended or self._overdue is None:
            self._watch_open_block()

    def health(self) -> EdgeHealth:
        """Return counters of the blocks."""
        store = self.store
        return EdgeHealth(
            blocks_kept=store.kept,
            blocks_unsent=store.waiting,
            blocks_dropped=store.dropped,
            trouble=self.delivery.trouble,
        )

    async def __aenter__(self) -> Self:
        """Start reaching for the server."""
        await self._stack.enter_async_context(self._database)
        await self._stack.enter_async_context(self.store)
        self._times = SampleClock(self.store.last_s)
        self._task = asyncio.create_task(self._link.run(), name="edge")
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Send the block that is open, too; the next run sends the rest."""
        self._end_block()
        if self._task is not None:
            self._link.closing.set()
            done, _ = await asyncio.wait([self._task], timeout=self._handover_s + PARTING_S)
            if not done:
                self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
        await self._stack.aclose()

    def _watch_open_block(self) -> None:
        """See to it that the open block, if there is one, does not wait for a source that is silent."""
        if self._overdue is not None:
            self._overdue.cancel()
        due_s = OVERDUE * self._block_s
        open_ = len(self._gathering) > 0
        self._overdue = asyncio.get_running_loop().call_later(due_s, self._end_block) if open_ else None

    def _end_block(self) -> None:
        for block in self._gathering.cut():
            self.store.put(block)
        self._watch_open_block()

    async def _serve(self, connection: Connection) -> None:
        """Send and receive until the connection is lost or the edge closes."""
        self._refusals.begin()
        try:
            refused = await connection.subscribe(None, [self._hear_topic])
            for topic, why in refused.items():
                self._refusals.deny(topic, f"not allowed to read it: {why}")
            async with asyncio.TaskGroup() as tasks:
                others = [
                    tasks.create_task(self._receive(connection)),
                    tasks.create_task(self._sending.send(connection)),
                ]
                await self._link.closing.wait()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(self._handover_s):
                        await self._sending.wait_until_empty()
                for task in others:
                    task.cancel()
        finally:
            self._refusals.end()

    async def _receive(self, connection: Connection) -> None:
        while True:
            message = await connection.receive()
            try:
                awaits = subjects.BlockRequest.model_validate_json(message.payload)
            except ValidationError:
                self._lose("unreadable", message.topic)
            else:
                self.store.on_request(awaits)

    def _lose(self, kind: str, topic: str) -> None:
        """Count a message that is not a worker's answer."""
        if not self.unread:
            log.warning("what came from a worker cannot be read", reason=kind, topic=topic[:100])
        self.unread += 1


def _topic(subject: str) -> str:
    return subject.replace(".", "/")


def check_edge(settings: EdgeSettings) -> list[str]:
    """Check that addresses, password and certificates can be used.

    Returns:
        A sentence for each secret that every user of this machine can read.

    Raises:
        UserError: One of them cannot be used.
    """
    try:
        return [warning.replace("mqtt.", "edge.", 1) for warning in check(_mqtt(settings))]
    except UserError as error:
        raise UserError(str(error).replace("mqtt.", "edge.")) from None


def _mqtt(settings: EdgeSettings) -> MqttSettings:
    """Return the connection options that all servers share."""
    doors = ("url", "username", "password_file", "ca_file", "cert_file", "key_file")
    return MqttSettings(**{name: getattr(settings, name) for name in doors})
