"""A BMS without hardware: measures a signal and answers on a pseudo-terminal when it is asked, faults at will."""

import asyncio
import contextlib
import math
import os
import random
import tty
from collections import deque
from collections.abc import Callable
from enum import Enum
from typing import Self

from bms_estimator.simulation.bms_answers import BMS_ANSWERS, MOST_CELLS, Measured
from bms_estimator.simulation.virtual_converter import Reading

MEASURE_S = 0.05
"""So often it measures [s of its time]."""
SHORTEST_SLEEP_S = 0.005
"""However fast its time runs [s]."""
HEARD_BYTES = 64
"""No question is longer than what is kept of the line."""
MISSING_BYTES = 5
"""Of an answer that broke off."""
SPREAD_V = 0.004
"""Its cells differ by up to this from their mean [V]."""


class BmsFault(Enum):
    """What can happen to an answer."""

    SILENCE = "never sent"
    CORRUPT = "one byte changed"
    SHORT = "its last bytes missing"
    NOISE = "noise before it"


class VirtualBms:
    """A BMS on a pseudo-terminal. Open it as a context manager, then ``run`` it.

    Args:
        protocol: A key of ``BMS_ANSWERS``.
        signal: What is at its terminals, by time [s].
        cells: In series.
        speed: Its seconds per second.
        soc: What it takes for the state of charge, 0..1.
        capacity_ah: What it takes for the capacity.
        seed: Of the differences between the cells, and of noise.

    Raises:
        ValueError: No BMS of this protocol has so many cells.
    """

    def __init__(
        self,
        protocol: str,
        signal: Callable[[float], Reading],
        *,
        cells: int,
        speed: float = 1.0,
        soc: Callable[[], float] = lambda: 0.5,
        capacity_ah: float = 100.0,
        seed: int = 0,
    ) -> None:
        if not 1 <= cells <= MOST_CELLS:
            raise ValueError(f"{cells} cells: a simulated BMS has 1 to {MOST_CELLS}")
        self._answers, self._signal, self._speed = BMS_ANSWERS[protocol], signal, speed
        self._soc, self._capacity_ah = soc, capacity_ah
        self._random = random.Random(seed)
        offsets_v = [self._random.uniform(-SPREAD_V, SPREAD_V) for _ in range(cells)]
        self._offsets_v = [offset_v - math.fsum(offsets_v) / cells for offset_v in offsets_v]
        self._reading = signal(0.0)
        self._heard = b""
        self._faults: deque[BmsFault] = deque()
        self._master = self._slave = -1
        self.path = ""
        """Of the pseudo-terminal."""
        self.time_s = 0.0
        """Of the signal, at the last measurement."""
        self.samples = 0
        """Answers sent."""

    def __enter__(self) -> Self:
        """Open the pseudo-terminal."""
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        return self

    def __exit__(self, *_: object) -> None:
        """Pull the plug: the host's descriptor dies."""
        for descriptor in (self._master, self._slave):
            os.close(descriptor)

    def inject(self, fault: BmsFault, answers: int = 1) -> None:
        """Let ``fault`` happen to the next ``answers`` that have none yet."""
        self._faults.extend([fault] * answers)

    def mend(self) -> None:
        """Let nothing happen to answers any more."""
        self._faults.clear()

    @property
    def measured(self) -> Measured:
        """What it would tell now."""
        cell_v = self._reading.voltage_v / len(self._offsets_v)
        return Measured(
            self._reading.voltage_v,
            self._reading.current_a,
            self._reading.temperature_c,
            [cell_v + offset_v for offset_v in self._offsets_v],
            self._soc(),
            self._capacity_ah,
        )

    async def run(self, seconds: float = math.inf) -> None:
        """Measure and answer for ``seconds`` of its time."""
        loop = asyncio.get_running_loop()
        end_s, offset_s = self.time_s + seconds, loop.time() - self.time_s / self._speed
        loop.add_reader(self._master, self._hear)
        try:
            while self.time_s < end_s:
                now_s = min((loop.time() - offset_s) * self._speed, end_s)
                while self.time_s < now_s:
                    self.time_s = min(self.time_s + MEASURE_S, now_s)
                    self._reading = self._signal(self.time_s)
                await asyncio.sleep(max(MEASURE_S / self._speed, SHORTEST_SLEEP_S))
        finally:
            loop.remove_reader(self._master)

    def _hear(self) -> None:
        """Bytes of the host: each question in them is answered."""
        with contextlib.suppress(BlockingIOError):
            self._heard += os.read(self._master, 4096)
        while found := min(
            ((at, question) for question in self._answers if (at := self._heard.find(question)) >= 0), default=None
        ):
            at, question = found
            self._heard = self._heard[at + len(question) :]
            self._send(self._answers[question](self.measured))
        self._heard = self._heard[-HEARD_BYTES:]

    def _send(self, answer: bytes) -> None:
        """Put an answer on the line, with what faults make of it; a host that does not read loses it."""
        match self._faults.popleft() if self._faults else None:
            case BmsFault.SILENCE:
                return
            case BmsFault.CORRUPT:
                at = len(answer) // 2
                answer = answer[:at] + bytes((answer[at] ^ 0x55,)) + answer[at + 1 :]
            case BmsFault.SHORT:
                answer = answer[:-MISSING_BYTES]
            case BmsFault.NOISE:
                answer = self._random.randbytes(20) + answer
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, answer)
            self.samples += 1
