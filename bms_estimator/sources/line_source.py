"""Sources other than serial lines: a ``LineProducer`` for each kind, and the common rest."""

import asyncio
import contextlib
import math
import time
from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping
from typing import Self

import structlog

from bms_estimator.model.clock import since_boot
from bms_estimator.model.sample import CellBlock, SampleBlock
from bms_estimator.process.backoff import FIRST_RETRY_S, MAX_RETRY_S
from bms_estimator.protocols.base.reading import CONNECTED
from bms_estimator.protocols.registry import make_protocol
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.fault_log import FaultLog
from bms_estimator.sources.source import Chunk, ReadTap, SourceHealth

LOOK_S = 1.0
"""Interval of the check for samples [s]."""
SILENT_PERIODS = 3.0
"""Number of expected sample periods without a sample that counts as a fault."""

log = structlog.get_logger(__name__)


class SourceUnavailableError(Exception):
    """The source cannot be reached, or was lost; the message gives the reason. It may become available later."""


class LineProducer(ABC):
    """I/O part of a source other than a serial line."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the source, with which messages begin."""

    @abstractmethod
    def iter_lines(self) -> AsyncGenerator[bytes, None]:
        """Connect; then ``CONNECTED``, and lines of ``sample_json_line`` as they arrive.

        Called again, after a pause, when it has ended or raised. It never blocks the event loop, and is closed at the end.

        Raises:
            SourceUnavailableError, OSError: It cannot be reached, or was lost.
        """

    @property
    def counters(self) -> Mapping[str, int]:
        """Faults by kind since start: values that could not be read or used."""
        return {}

    @property
    def fault(self) -> str | None:
        """Reason why no line arrives although it is connected; None if unknown."""
        return None

    @property
    def board(self) -> Mapping[str, str]:
        """Hello of the device."""
        return {}


class LineSource:
    """Async source of SAMPLE blocks from a producer, which is restarted whenever it ends.

    All lines pass ``decoder.feed(arrival_s, line)``, so a capture of these calls replays bit-identically.

    Args:
        producer: Produces the lines.
        sensor: Sign of the current; ``protocol`` must be ``text``.
        period_s: Expected sample period [s].
        tap: Receives each (arrival time, line) of the decoder.
        wall: Wall clock [s since 1970].
        monotonic: Monotonic clock [s].
        first_retry_s: Delay before a missing or lost device is retried; doubles with each attempt [s].
        look_s: Interval of the check for samples [s].
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
        look_s: float = LOOK_S,
    ) -> None:
        self._producer, self._decoder, self._tap = producer, make_protocol(sensor), tap
        self._monotonic, self._epoch_s = monotonic, wall() - monotonic()
        self._look_s, self._silent_s = look_s, SILENT_PERIODS * max(period_s, look_s)
        self._first_retry_s, self._retry_s = first_retry_s, 0.0
        self._lines: asyncio.Queue[Chunk | None] = asyncio.Queue()
        self._message: str | None = "not opened yet"
        self._said = ""
        self._openings, self._connected = 0, False
        self._tended_s = self._heard_s = monotonic()
        self._arrived_s = math.nan  # of the last block's line, on the clock of the arrivals
        self._faults = FaultLog()
        self._task: asyncio.Task[None] | None = None
        self._watcher: asyncio.Task[None] | None = None

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters of decoder and producer, ``reconnects``, and ``missed_reads`` of the tap."""
        counters = {**self._decoder.counters, **self._producer.counters, "reconnects": max(self._openings - 1, 0)}
        return counters if self._tap is None else counters | {"missed_reads": self._tap.missed_reads}

    @property
    def message(self) -> str | None:
        """Reason why no samples arrive; None when they do."""
        return self._message

    @property
    def board(self) -> Mapping[str, str]:
        """Hello of the device."""
        return self._producer.board

    @property
    def cells(self) -> CellBlock:
        """Cell voltages of the last block."""
        return self._decoder.cells

    @property
    def clock_ppm(self) -> float | None:
        """Rate error of the clock, which is unknown."""
        return self._decoder.clock_ppm

    current_zero: None = None
    """Function that sets the zero of the current; None: lines have no such command."""
    relay: None = None
    """Function that switches a relay; None: no relay."""

    def pulse(self) -> SourceHealth:
        """Health of the task that produces lines."""
        now_s = self._monotonic()
        return SourceHealth(now_s - self._tended_s, self._epoch_s + now_s - self._arrived_s, self._lines.qsize())

    async def __aenter__(self) -> Self:
        """Start producing lines; the device may still be missing."""
        self._task = asyncio.create_task(self._produce(), name=self._producer.name)
        self._task.add_done_callback(lambda _: self._lines.put_nowait(None))
        self._watcher = asyncio.create_task(self._watch(), name=f"watch {self._producer.name}")
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stop producing lines."""
        tasks: set[asyncio.Task[None]] = {task for task in (self._watcher, self._task) if task is not None}
        while tasks:  # wait_for of Python 3.11, in what a producer calls, may swallow that it is to end
            for task in tasks:
                task.cancel()
            _done, tasks = await asyncio.wait(tasks, timeout=LOOK_S)

    async def __aiter__(self) -> AsyncIterator[SampleBlock]:
        """Blocks as lines arrive. The tap receives the lines of yielded blocks."""
        while (read := await self._lines.get()) is not None:
            block = self._decode(*read)
            if block.size:
                self._arrived_s = read[0]
                self._message, self._said, self._retry_s = None, "", self._first_retry_s
                yield block
        if self._task is not None and not self._task.cancelled():
            self._task.result()

    def _decode(self, arrival_s: float, line: bytes) -> SampleBlock:
        if self._tap is not None:
            self._tap.write(arrival_s, line)
        block = self._decoder.feed(arrival_s, line)
        if block.size:
            self._heard_s = self._monotonic()
        return block

    async def _produce(self) -> None:
        """Produce lines and restart after an error. Only an internal error ends it and is raised to the reader."""
        while True:
            await self._pause()
            reason = "it ended"
            try:
                async with contextlib.aclosing(self._producer.iter_lines()) as lines:
                    async for line in lines:
                        self._take(line)
            except (SourceUnavailableError, OSError) as error:
                reason = str(error)
            self._connected = False
            self._report(f"{self._producer.name}: {reason}; trying again")

    async def _pause(self) -> None:
        """Each one is longer until a sample arrives."""
        wait_s, self._retry_s = self._retry_s, min(max(2.0 * self._retry_s, self._first_retry_s), MAX_RETRY_S)
        await asyncio.sleep(wait_s)

    def _take(self, line: bytes) -> None:
        if line != CONNECTED:
            self._lines.put_nowait((self._epoch_s + self._monotonic(), line))
            return
        self._openings += 1
        self._connected, self._heard_s = True, self._monotonic()
        self._message = f"{self._producer.name}: connected, nothing has come yet"
        log.info("connected", source=self._producer.name)

    async def _watch(self) -> None:
        """Report why nothing arrives, and log faults."""
        while True:
            self._tended_s = now_s = self._monotonic()
            if self._connected and now_s - self._heard_s >= self._silent_s:
                why = self._producer.fault or self._decoder.fault or "connected, but silent"
                self._report(f"{self._producer.name}: {why}")
            self._faults.check(self.counters, now_s)
            await asyncio.sleep(self._look_s)

    def _report(self, message: str) -> None:
        """Report why no samples arrive; in the log once for each reason, until samples arrive."""
        if message != self._said:
            log.warning("no samples", reason=message)
        self._message = self._said = message
