"""Interface of sources of samples: serial ports, captures, tables; and the base class of sources of lines."""

import asyncio
import contextlib
import math
import time
from abc import ABC, abstractmethod
from collections.abc import (
    AsyncGenerator,
    AsyncIterator,
    Callable,
    Mapping,
)
from typing import NamedTuple, Protocol, Self

import structlog

from bms_estimator.model.arrays import NO_PROBES, NO_SOC, CellBlock, Floats, ProbeBlock, SampleBlock
from bms_estimator.model.clock import since_boot
from bms_estimator.protocols.base.reading import CONNECTED
from bms_estimator.protocols.registry import make_protocol
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.fault_log import FaultLog, SilenceLog

Chunk = tuple[float, bytes]
"""Arrival time [s since 1970] and bytes of one read."""
FIRST_RETRY_S = 0.5
"""First retry delay of a missing or lost device; it doubles with each attempt [s]."""
MAX_RETRY_S = 10.0
"""Maximum retry delay of a missing or lost device [s]."""


class SourceHealth(NamedTuple):
    """Health of a source."""

    task_idle_s: float
    """Time since its task last checked the connection or tried to open it [s]."""
    block_age_s: float
    """Time since the bytes of the latest block were read [s]."""
    queued_reads: int
    """Number of chunks that are waiting to be decoded."""


class ReadTap(Protocol):
    """Receives a copy of each chunk before it is decoded, for example to record it. It must neither block nor raise."""

    @property
    def missed_reads(self) -> int:
        """Number of chunks that the receiver could not store."""

    def write(self, arrival_s: float, data: bytes) -> None:
        """Receive one chunk."""


class ReceivedSamples(NamedTuple):
    """Block of samples, and the cell voltages and temperature probes that were measured with it."""

    samples: SampleBlock
    """Samples, shape (n,), dtype SAMPLE."""
    cells_v: CellBlock
    """Cell voltages of the samples, shape (n, m) [V]; ``NO_CELLS`` if none are measured."""
    probes: ProbeBlock = NO_PROBES
    """Temperature probes of the samples, shape (n, m); ``NO_PROBES`` without a list of them."""
    device_soc: Floats = NO_SOC
    """SOC that the device reports with each sample, 0..1, NaN without one, shape (n,); ``NO_SOC`` if it reports none."""
    device_capacity_ah: float = math.nan
    """Capacity from which the device computes its SOC [Ah]; NaN: not reported."""


class Source(Protocol):
    """Async iterator of samples, with fault counters.

    The iterator of a device never ends by itself. The iterator of a capture or a table ends with the last sample.
    """

    @property
    def counters(self) -> Mapping[str, int]:
        """Counts since start: ``frames_received``, ``frames_lost``, ``crc_errors``, ``reconnects`` and faults by kind."""

    @property
    def silence_reason(self) -> str | None:
        """Reason why no samples arrive, as text; None while they arrive."""

    @property
    def board(self) -> Mapping[str, str]:
        """Properties from the board's hello message; empty without one."""

    @property
    def clock_ppm(self) -> float | None:
        """Rate error of the board's clock relative to the host's [1e-6]; None if unknown."""

    @property
    def clock_fault(self) -> str:
        """Description of a fault of the device's clock; empty without one."""

    @property
    def conflict(self) -> str:
        """Description of a second publisher of the samples, a sentence; empty without one."""

    def __aiter__(self) -> AsyncIterator[ReceivedSamples]:
        """Yield blocks of samples; none of them is empty."""

    async def __aenter__(self) -> Self:
        """Open the source."""

    async def __aexit__(self, *_: object) -> None:
        """Close the source."""


CHECK_INTERVAL_S = 1.0
"""Interval between two checks for silence and faults [s]."""
SILENT_PERIODS = 3.0
"""Number of sample periods without a sample after which a source counts as silent."""
RECONNECT_GRACE_S = 30.0
"""Additional time after a reconnection before a silent source is reported [s].

The device behind a broker loses its connection at a restart of the broker, too, and reconnects later."""
NO_SAMPLE_YET = "connected, no sample yet"
"""Reason for silence after a connection, unless the producer or the decoder reports a fault."""

log = structlog.get_logger(__name__)


class SourceUnavailableError(Exception):
    """The source cannot be reached, or its connection was lost. The message gives the reason; a retry may succeed."""


class LineProducer(ABC):
    """Producer of samples from a device that is not on a serial port. It does all I/O of the source.

    It yields samples as lines of JSON, like a board that prints text, so that one reader serves both.
    """

    conflict: str = ""
    """Description of a second publisher of the samples, a sentence; empty without one."""
    first_invalid: str = ""
    """Description of the first value since start that is no number; empty without one."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the source, the prefix of its log and error texts."""

    @abstractmethod
    def iter_lines(self) -> AsyncGenerator[bytes, None]:
        """Connect, yield ``CONNECTED``, then yield lines of ``sample_json_line`` as they arrive.

        ``LineSource`` calls this method again, after a pause, when the iterator has ended or raised. The iterator must
        not block the event loop.

        Raises:
            SourceUnavailableError, OSError: The source cannot be reached, or its connection was lost.
        """

    @property
    def counters(self) -> Mapping[str, int]:
        """Number of faults since start, by kind."""
        return {}

    @property
    def fault(self) -> str | None:
        """Reason why a connected source yields no line; None if unknown."""
        return None

    @property
    def board(self) -> Mapping[str, str]:
        """Properties that the device reported, such as its serial number; empty without any."""
        return {}


class LineSource:
    """Source of sample blocks from a line producer, which is restarted whenever it ends.

    Every line passes through ``decoder.feed(arrival_s, line)``. A capture of these calls therefore replays bit-identically.

    Args:
        producer: Connects to the device and yields its lines.
        sensor: Sign of the current; ``protocol`` must be ``text``.
        period_s: Expected sample period [s].
        tap: Receives each line with its arrival time, before the line is decoded.
        wall: Wall clock [s since 1970].
        monotonic: Monotonic clock [s].
        first_retry_s: First delay before a missing or lost device is retried [s]. Each attempt doubles the delay.
        check_interval_s: Interval between two checks for silence and faults [s].
    """

    def __init__(
        self,
        producer: LineProducer,
        sensor: SensorSettings,
        *,
        period_s: float = 1.0,
        tap: ReadTap | None = None,
        wall: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = since_boot,
        first_retry_s: float = FIRST_RETRY_S,
        check_interval_s: float = CHECK_INTERVAL_S,
    ) -> None:
        self._producer, self._decoder, self._tap = producer, make_protocol(sensor), tap
        self._monotonic, self._wall_offset_s = monotonic, wall() - monotonic()
        self._check_interval_s, self._silence_limit_s = (
            check_interval_s,
            SILENT_PERIODS * max(period_s, check_interval_s),
        )
        self._first_retry_s, self._retry_s = first_retry_s, 0.0
        self._lines: asyncio.Queue[Chunk | None] = asyncio.Queue()
        self._silence_reason: str | None = "not opened yet"
        self._connections, self._connected = 0, False
        self._last_check_s = self._last_sample_s = monotonic()
        self._block_arrival_s = math.nan  # arrival time of the last block's line
        self._fault_log, self._silence_log = FaultLog(), SilenceLog()
        self._produce_task: asyncio.Task[None] | None = None
        self._watch_task: asyncio.Task[None] | None = None

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters of decoder and producer, ``reconnects``, and ``missed_reads`` of the tap."""
        counters = {**self._decoder.counters, **self._producer.counters, "reconnects": max(self._connections - 1, 0)}
        return counters if self._tap is None else counters | {"missed_reads": self._tap.missed_reads}

    @property
    def silence_reason(self) -> str | None:
        """Reason why no samples arrive; None while they arrive."""
        if self._silence_reason == NO_SAMPLE_YET:
            return f"{self._producer.name}: {self._producer.fault or self._decoder.fault or NO_SAMPLE_YET}"
        return self._silence_reason

    @property
    def board(self) -> Mapping[str, str]:
        """Properties that the device reported, such as its serial number; empty without any."""
        return self._producer.board

    @property
    def clock_ppm(self) -> float | None:
        """Rate error of the device's clock [1e-6]; None if unknown."""
        return self._decoder.clock_ppm

    @property
    def clock_fault(self) -> str:
        """Description of a fault of the device's clock; empty without one."""
        return self._decoder.clock_fault

    @property
    def conflict(self) -> str:
        """Description of a second publisher of the samples, a sentence; empty without one."""
        return self._producer.conflict

    store_current_zero: None = None
    """Function that sets the zero of the current; None: lines have no such command."""
    relay: None = None
    """Function that switches a relay; None: no relay."""

    def health(self) -> SourceHealth:
        """Return the health of the task that runs the producer."""
        now_s = self._monotonic()
        return SourceHealth(
            task_idle_s=now_s - self._last_check_s,
            block_age_s=self._wall_offset_s + now_s - self._block_arrival_s,
            queued_reads=self._lines.qsize(),
        )

    async def __aenter__(self) -> Self:
        """Start producing lines; the device may still be missing."""
        self._produce_task = asyncio.create_task(self._produce(), name=self._producer.name)
        self._produce_task.add_done_callback(lambda _: self._lines.put_nowait(None))  # None ends the iteration
        self._watch_task = asyncio.create_task(self._watch(), name=f"watch {self._producer.name}")
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stop producing lines."""
        tasks: set[asyncio.Task[None]] = {task for task in (self._watch_task, self._produce_task) if task is not None}
        while tasks:  # a producer may call wait_for, which may swallow a cancellation in Python 3.11
            for task in tasks:
                task.cancel()
            _done, tasks = await asyncio.wait(tasks, timeout=CHECK_INTERVAL_S)

    async def __aiter__(self) -> AsyncIterator[ReceivedSamples]:
        """Yield blocks as lines arrive. A line goes to the tap when its block is requested."""
        while (chunk := await self._lines.get()) is not None:
            block = self._decode(*chunk)
            if block.size:
                self._block_arrival_s = chunk[0]
                self._silence_reason, self._retry_s = None, self._first_retry_s
                self._silence_log.on_samples(self._last_sample_s)
                decoder = self._decoder
                yield ReceivedSamples(
                    block, decoder.cells, decoder.probes, decoder.device_soc, decoder.device_capacity_ah
                )
        if self._produce_task is not None and not self._produce_task.cancelled():
            self._produce_task.result()

    def _decode(self, arrival_s: float, line: bytes) -> SampleBlock:
        if self._tap is not None:
            self._tap.write(arrival_s, line)
        block = self._decoder.feed(arrival_s, line)
        if block.size:
            self._last_sample_s = self._monotonic()
        return block

    async def _produce(self) -> None:
        """Run the producer, and restart it whenever it ends or loses its device.

        Any other exception ends this task, and ``__aiter__`` raises it.
        """
        while True:
            await self._pause()
            reason = "the source ended"
            try:
                async with contextlib.aclosing(self._producer.iter_lines()) as lines:
                    async for line in lines:
                        self._on_line(line)
            except (SourceUnavailableError, OSError) as error:
                reason = str(error)
            self._connected = False
            self._report(f"{self._producer.name}: {reason}; trying again")

    async def _pause(self) -> None:
        """Wait before the next attempt. Each delay is longer than the previous one, until a sample arrives."""
        wait_s, self._retry_s = self._retry_s, min(max(2.0 * self._retry_s, self._first_retry_s), MAX_RETRY_S)
        await asyncio.sleep(wait_s)

    def _on_line(self, line: bytes) -> None:
        if line != CONNECTED:
            self._lines.put_nowait((self._wall_offset_s + self._monotonic(), line))
            return
        self._connections += 1
        self._connected = True
        # a time in the future defers the report of a silence
        self._last_sample_s = self._monotonic() + (RECONNECT_GRACE_S if self._connections > 1 else 0.0)
        self._silence_reason = NO_SAMPLE_YET
        log.info("connected", source=self._producer.name)

    async def _watch(self) -> None:
        """Report a silent source, and log faults, at each check interval."""
        while True:
            self._last_check_s = now_s = self._monotonic()
            if self._connected and now_s - self._last_sample_s >= self._silence_limit_s:
                reason = self._producer.fault or self._decoder.fault or "connected, but silent"
                self._report(f"{self._producer.name}: {reason}")
            self._fault_log.check(self.counters, now_s, self._producer.first_invalid)
            await asyncio.sleep(self._check_interval_s)

    def _report(self, reason: str) -> None:
        """Set the reason why no samples arrive, and log it if it is new since the last samples."""
        self._silence_log.report(reason, self._monotonic())
        self._silence_reason = reason
