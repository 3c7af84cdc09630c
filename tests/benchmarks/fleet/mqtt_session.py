"""MQTT 3.1.1 session of one simulated edge over TLS, small enough for thousands in a process.

Subscription, acknowledgments, keepalive, timeouts and reconnects are those of ``edge.block_sender``. Blocks are stored in memory.
"""

import asyncio
import contextlib
import random
import ssl
import struct
import time
from asyncio import sslproto
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, cast

import numpy as np

from bms_estimator.edge import subjects
from bms_estimator.edge.block import Block, encode
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.model.sample import SAMPLE, SampleBlock
from bms_estimator.mqtt.client import DEFAULT_TIMEOUTS
from bms_estimator.mqtt.reconnect_loop import MIN_CONNECTION_S
from tests.benchmarks.fleet.mqtt_packets import Packet, next_packet, packet, text

sslproto.SSLProtocol.max_size = 16 << 10  # type: ignore[attr-defined] # asyncio would allocate 256 KiB for each connection

BLOCK_SAMPLES = 60
"""Number of samples of a block, at 1 Hz."""


class Delays(Protocol):
    """Delays before the reconnects of a session. Those of the real edge are a ``process.backoff.Backoff``."""

    def next_s(self) -> float:
        """Return the next delay [s]."""

    def reset(self) -> None:
        """Restart with the first delay after a success."""


@dataclass
class Options:
    """Options of all sessions of a process.

    Attributes:
        port: MQTT port of the server on the loopback interface.
        tls: TLS context of the client.
        persistent: Ask for a session that survives disconnects, and subscribe at QoS 1. The real edge does neither.
        block_s: Interval between two blocks [s].
        delays: Creates the delays of a session.
        attempts: Limits the number of simultaneous connection attempts of the process.
    """

    port: int
    tls: ssl.SSLContext
    persistent: bool
    block_s: float
    delays: Callable[[], Delays]
    attempts: asyncio.Semaphore


@dataclass
class Totals:
    """Totals of all sessions of a process."""

    counts: Counter[str] = field(default_factory=Counter)
    """Numbers of ``ready`` sessions, of ``connections``, of blocks by what happened to them, and of failures by kind."""
    acknowledge_s: list[float] = field(default_factory=list)
    """Times between sending and acknowledgment of blocks [s]."""


class Session(asyncio.Protocol):
    """Session that connects, sends a block at each interval, and reconnects until it is cancelled.

    Args:
        pack: Name of the pack, also the client identifier.
        token: Password.
        source: Local IP address. Each address has its own ports.
        options: Options of all sessions.
        totals: Totals that are updated.
    """

    def __init__(self, pack: str, token: str, source: str, options: Options, totals: Totals) -> None:
        self._pack, self._token, self._source, self._options, self._totals = pack, token, source, options, totals
        self._topic = subjects.raw(pack).replace(".", "/").encode()
        self._requests = subjects.block_request(pack).replace(".", "/").encode()
        self._delays = options.delays()
        self._phase_s = random.uniform(0.0, options.block_s)
        self._created_ns = time.time_ns()
        self._last_number = 0  # of the newest block
        self._in_flight = dict[
            int, float
        ]()  # monotonic time of sending by block number, which is also the packet identifier
        self._unacknowledged = set[int]()
        self._transport: asyncio.Transport | None = None
        self._received = bytearray()
        self._ready: asyncio.Future[None] | None = None
        self._lost = asyncio.Event()
        self._awaits_ping = self._is_finished = False

    async def run(self, delay_s: float) -> None:
        """Connect after a delay, and stay connected until cancelled."""
        await asyncio.sleep(delay_s)
        sending = asyncio.create_task(self._make_blocks())
        try:
            while True:
                async with self._options.attempts:
                    is_connected = await self._connect()
                if is_connected and await self._stay_connected():
                    self._delays.reset()
                await asyncio.sleep(self._delays.next_s())
        finally:
            sending.cancel()
            if self._transport is not None:
                self._transport.abort()

    def finish(self) -> None:
        """Make no further blocks."""
        self._is_finished = True

    def drop(self) -> None:
        """Lose the connection."""
        if self._transport is not None:
            self._transport.abort()

    async def _connect(self) -> bool:
        """Connect and subscribe. Return False after a failure."""
        loop = asyncio.get_running_loop()
        self._received.clear()
        self._ready, self._awaits_ping = loop.create_future(), False
        self._lost.clear()
        try:
            async with asyncio.timeout(DEFAULT_TIMEOUTS.connect_s):
                await loop.create_connection(
                    lambda: self,
                    "127.0.0.1",
                    self._options.port,
                    ssl=self._options.tls,
                    ssl_handshake_timeout=DEFAULT_TIMEOUTS.connect_s,
                    local_addr=(self._source, 0),
                )
                self._send(self._connect_packet())
                await self._ready
        except (OSError, TimeoutError) as error:  # ssl.SSLError is an OSError
            self._totals.counts["timeout" if isinstance(error, TimeoutError) else "refused"] += 1
            self.drop()
            return False
        self._totals.counts["ready"] += 1
        self._totals.counts["connections"] += 1
        return True

    async def _stay_connected(self) -> bool:
        """Send the stored blocks, and wait until the connection is lost. Return True if it lasted ``MIN_CONNECTION_S``."""
        loop = asyncio.get_running_loop()
        since_s = loop.time()
        for number in sorted(self._unacknowledged):
            self._publish(number)
        pinging = asyncio.create_task(self._ping())
        await self._lost.wait()
        pinging.cancel()
        self._totals.counts["ready"] -= 1
        return loop.time() - since_s >= MIN_CONNECTION_S

    async def _make_blocks(self) -> None:
        await asyncio.sleep(self._phase_s)
        self._created_ns = time.time_ns() - BLOCK_SAMPLES * 10**9
        while not self._is_finished:
            self._last_number += 1
            self._unacknowledged.add(self._last_number)
            self._totals.counts["blocks"] += 1
            if self._is_ready:
                self._publish(self._last_number)
            await asyncio.sleep(self._options.block_s)

    async def _ping(self) -> None:
        while True:
            await asyncio.sleep(DEFAULT_TIMEOUTS.keepalive_s)
            oldest_s = min(self._in_flight.values(), default=time.monotonic())
            if self._awaits_ping or time.monotonic() - oldest_s > DEFAULT_TIMEOUTS.acknowledge_s:
                self._totals.counts["no answer"] += 1
                self.drop()
            self._awaits_ping = True
            self._send(bytes([Packet.PINGREQ, 0]))

    @property
    def _is_ready(self) -> bool:
        return self._ready is not None and self._ready.done() and not self._lost.is_set()

    def _publish(self, number: int) -> None:
        data = block(self._created_ns, number, arrival_s=self._created_ns / 1e9 + BLOCK_SAMPLES * number)
        self._totals.counts["sent"] += 1
        self._in_flight[number] = time.monotonic()
        self._send(packet(Packet.PUBLISH | 0x02, text(self._topic) + struct.pack(">H", number) + data))

    def _connect_packet(self) -> bytes:
        flags = 0xC0 | (0x00 if self._options.persistent else 0x02)  # user name, password, clean session
        header = text(b"MQTT") + struct.pack(">BBH", 4, flags, DEFAULT_TIMEOUTS.keepalive_s)
        return packet(Packet.CONNECT, header + b"".join(map(text, (self._id, self._id, self._token.encode()))))

    @property
    def _id(self) -> bytes:
        return self._pack.encode()

    def _send(self, data: bytes) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write(data)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Store the transport, after the TLS handshake."""
        self._transport = cast("asyncio.Transport", transport)

    def connection_lost(self, exc: Exception | None) -> None:
        """End the attempt or the session."""
        if self._ready is not None and not self._ready.done():
            self._ready.set_exception(ConnectionError(str(exc)))
            self._ready.exception()  # an attempt that has timed out does not await it
        self._transport = None
        self._in_flight.clear()
        self._lost.set()

    def data_received(self, data: bytes) -> None:
        """Process the complete packets."""
        self._received += data
        while received := next_packet(self._received):
            self._process(*received)

    def _process(self, kind: int, body: bytes) -> None:
        if kind == Packet.CONNACK:
            if body[1]:
                self.drop()
                return
            qos = int(self._options.persistent)
            self._send(packet(Packet.SUBSCRIBE, b"\0\1" + text(self._requests) + bytes([qos])))
        elif kind == Packet.SUBACK:
            if self._ready is not None and not self._ready.done():
                self._ready.set_result(None)
        elif kind == Packet.PINGRESP:
            self._awaits_ping = False
        elif kind == Packet.PUBACK:
            self._acknowledge(int.from_bytes(body, "big"))
        elif kind & 0xF0 == Packet.PUBLISH:
            self._receive(kind, body)

    def _acknowledge(self, number: int) -> None:
        sent_s = self._in_flight.pop(number, None)
        if sent_s is not None and number in self._unacknowledged:
            self._unacknowledged.discard(number)
            self._totals.counts["acknowledged"] += 1
            self._totals.acknowledge_s.append(time.monotonic() - sent_s)

    def _receive(self, kind: int, body: bytes) -> None:
        """Acknowledge a worker's reply, and send the blocks that it requests."""
        payload = 2 + int.from_bytes(body[:2], "big")
        if kind & 0x06:
            self._send(packet(Packet.PUBACK, body[payload : payload + 2]))
            payload += 2
        with contextlib.suppress(ValueError):
            request = BlockRequest.model_validate_json(body[payload:])
            if request.resend and request.store == self._created_ns:
                self._totals.counts["requested"] += 1
                for number in range(request.number, self._last_number + 1):
                    self._publish(number)


_SAMPLES = np.zeros(BLOCK_SAMPLES, SAMPLE)
_SAMPLES["voltage_v"], _SAMPLES["temperature_c"], _SAMPLES["current_a"] = 3.7, 25.0, 0.5


def block(created_ns: int, number: int, arrival_s: float) -> bytes:
    """Return block ``number`` of a store, encoded."""
    samples: SampleBlock = _SAMPLES.copy()
    samples["time_s"] = BLOCK_SAMPLES * (number - 1.0) + np.arange(1.0, BLOCK_SAMPLES + 1.0)
    return encode(Block(store_created_ns=created_ns, number=number, oldest=1, arrival_s=arrival_s, samples=samples))
