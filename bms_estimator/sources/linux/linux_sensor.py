"""``kind = "linux"``: a current sensor by its files in sysfs, polled in a thread: a bus that hangs holds up nothing."""

import asyncio
import errno
from collections.abc import AsyncGenerator, Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from bms_estimator.process.disk_thread import DiskThread
from bms_estimator.protocols.base.reading import CONNECTED, sample_json_line
from bms_estimator.settings.linux_source import LinuxSource
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.line_source import SILENT_PERIODS, LineProducer, SourceUnavailableError
from bms_estimator.sources.linux.sysfs import SYS, Channel, JunkError, find_channel, find_chip, read_number

MIN_INTERVAL_S = 0.1
"""Minimum interval between two readings [s]; chips update as often as each 2 ms."""
HUNG_S = 5.0
"""A second is long for a bus, but not for a machine that swaps [s]."""
GONE = (errno.ENOENT, errno.ENODEV, errno.ENXIO)
"""Errors of a chip, or its driver, that was removed."""

T = TypeVar("T")


class _Chip(NamedTuple):
    """Channels that are read for each sample."""

    voltage: Channel
    current: Channel
    temperature: Channel | None
    amperes: float
    """Amperes for one unit of the current's channel [A/A or A/V]."""
    interval_s: float


class LinuxSensor(LineProducer):
    """Polls the files of a chip.

    Args:
        settings: Chip, files, divider and shunt.
        root: Root of sysfs.
        hung_s: Timeout of the bus [s].
    """

    def __init__(self, settings: LinuxSource, root: Path = SYS, hung_s: float = HUNG_S) -> None:
        self._settings, self._root, self._hung_s = settings, root, hung_s
        self._thread = DiskThread("sysfs")
        self._left: asyncio.Future[Any] | None = None  # a call that hung: only one runs at a time
        self._counters = {"read_errors": 0, "value_errors": 0}
        self._fault: str | None = None

    @property
    def name(self) -> str:
        """The chip."""
        return self._settings.described

    @property
    def counters(self) -> Mapping[str, int]:
        """``read_errors``: files that could not be read, ``value_errors``: those that held no number."""
        return self._counters

    @property
    def fault(self) -> str | None:
        """Error of the last reading."""
        return self._fault

    async def iter_lines(self) -> AsyncGenerator[bytes, None]:
        """Yield a line each interval.

        Raises:
            SourceUnavailableError, OSError: The chip or a file of it is not there, or its bus hangs.
        """
        chip = await self._read(self._find)
        yield CONNECTED
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            line = await self._read(lambda: self._sample(chip))
            if line:
                yield line
            due_s = max(due_s + chip.interval_s, loop.time())
            await asyncio.sleep(due_s - loop.time())

    async def _read(self, call: Callable[[], T]) -> T:
        """Run a call that may wait for the bus; return its result."""
        if self._left is not None:
            await self._wait(self._left)
            self._left = None
        future = asyncio.get_running_loop().run_in_executor(self._thread, call)
        try:
            await self._wait(future)
        except SourceUnavailableError:
            future.add_done_callback(lambda late: late.exception())  # no caller waits for it any more
            self._left = future
            raise
        return future.result()

    async def _wait(self, future: asyncio.Future[T]) -> None:
        """Wait for the bus; raises SourceUnavailableError if it hangs."""
        done, _ = await asyncio.wait({future}, timeout=self._hung_s)
        if not done:
            raise SourceUnavailableError(f"the bus has not answered for {self._hung_s:g} s")

    def _find(self) -> _Chip:
        """Find the chip, in the thread."""
        told = self._settings
        voltage, current = (find_channel(name, told.chip, self._root) for name in (told.voltage, told.current))
        temperature = find_channel(told.temperature, told.chip, self._root) if told.temperature else None
        amperes = told.current_scale * self._amperes(current)
        return _Chip(voltage, current, temperature, amperes, told.interval_s or self._own_interval_s())

    def _amperes(self, current: Channel) -> float:
        """Return amperes per unit of the channel, by the shunt.

        Raises:
            SourceUnavailableError: Neither the settings nor the driver define it.
        """
        shunt_ohm = self._settings.shunt_ohm
        if current.kind == "in":
            if shunt_ohm is None:
                raise SourceUnavailableError(f"{current.path}: a voltage; tell by source.shunt_ohm over which shunt")
            return 1.0 / shunt_ohm
        if shunt_ohm is None:
            return 1.0
        taken = current.path.with_name("shunt_resistor")
        try:
            return 1e-6 * read_number(taken) / shunt_ohm
        except (OSError, JunkError) as error:
            raise SourceUnavailableError(
                f"{taken}: {_why(error)}: nobody knows which shunt the driver takes; tell the ratio by "
                "source.current_scale, without source.shunt_ohm"
            ) from None

    def _own_interval_s(self) -> float:
        """Return the chip's own interval, at least 0.1 s, else the default [s].

        Raises:
            SourceUnavailableError: The interval is longer than the estimator accepts without gaps.
        """
        try:
            own_s = 1e-3 * read_number(find_chip(self._settings.chip, self._root) / "update_interval")
        except (OSError, JunkError):
            return self._settings.period_s
        if own_s > SILENT_PERIODS * self._settings.period_s:
            raise SourceUnavailableError(
                f"the chip measures each {own_s:g} s only; say so by source.interval_s = {own_s:g}"
            )
        return max(own_s, MIN_INTERVAL_S)

    def _sample(self, chip: _Chip) -> bytes:
        """Read a line in the thread; empty if voltage or current cannot be read now.

        Raises:
            OSError: The chip is gone.
        """
        told, self._fault = self._settings, None
        voltage, current = self._value(chip.voltage), self._value(chip.current)
        temperature_c = self._value(chip.temperature) if chip.temperature else None
        if voltage is None or current is None:
            return b""
        return sample_json_line(
            told.voltage_scale * voltage + told.voltage_offset_v,
            chip.amperes * current + told.current_offset_a,
            temperature_c=temperature_c,
        )

    def _value(self, channel: Channel) -> float | None:
        """Read a value; None if it cannot be read now, which is counted.

        Raises:
            OSError: The chip is gone.
        """
        try:
            return channel.read()
        except JunkError as error:
            self._counters["value_errors"] += 1
            self._fault = str(error)
        except OSError as error:
            if error.errno in GONE:
                raise
            self._counters["read_errors"] += 1
            self._fault = f"{channel.path}: {_why(error)}"
        return None


def producer(settings: Settings) -> LinuxSensor:
    """Make the line producer of ``[source]``."""
    assert isinstance(settings.source, LinuxSource)  # noqa: S101 - as KINDS has it
    return LinuxSensor(settings.source)


def _why(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
