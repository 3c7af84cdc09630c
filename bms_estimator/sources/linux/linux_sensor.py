"""``kind = "linux"``: a current sensor with a kernel driver, polled through its sysfs files.

A thread reads the files, so that a hung bus does not block the event loop. A chip is found by its name, and its values are
converted to SI units. hwmon: ``in*_input`` [mV], ``curr*_input`` [mA], ``temp*_input`` [millidegC], ``shunt_resistor`` [uohm], ``update_interval``
[ms], see Documentation/hwmon/sysfs-interface.rst and ina2xx.rst of the kernel. iio: a channel is ``<name>_raw``,
``<name>_scale`` and optionally ``<name>_offset``; (raw + offset) * scale is in mV, mA or millidegC, see sysfs-bus-iio.
"""

import asyncio
import errno
from collections.abc import AsyncGenerator, Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from bms_estimator.model.decimal_text import number
from bms_estimator.process.stderr_writer import DaemonThreadExecutor
from bms_estimator.protocols.base.reading import CONNECTED, sample_json_line
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sources.source import LinuxSource
from bms_estimator.sources.source import SILENT_PERIODS, LineProducer, SourceUnavailableError

SYS = Path("/sys")
MAX_BYTES = 4096
"""Maximum size of a sysfs file, one page [bytes]."""
MAX_SHOWN_BYTES = 40
"""Maximum number of bytes of an invalid number that are shown."""


class NotANumberError(Exception):
    """The content of a sysfs file is not a number. The message names the file."""


class Channel(NamedTuple):
    """One value of a chip."""

    path: Path
    """Path of a hwmon file; of an iio channel the path without ``_raw``."""

    @property
    def kind(self) -> str:
        """``in``, ``curr`` or ``temp``; empty if the name begins with none of them."""
        name = self.path.name.removeprefix("in_") if _is_iio(self.path) else self.path.name
        words = {"in": "in", "voltage": "in", "curr": "curr", "temp": "temp"}
        return next((kind for word, kind in words.items() if name.startswith(word)), "")

    def read(self) -> float:
        """Return the present value [V, A, C].

        Raises:
            OSError: The file cannot be read now.
            NotANumberError: The content of its file is not a number.
        """
        if not _is_iio(self.path):
            return 1e-3 * read_number(self.path)
        raw, scale = (read_number(_iio_file(self.path, part)) for part in ("raw", "scale"))
        offset = _iio_file(self.path, "offset")
        return 1e-3 * (raw + (read_number(offset) if offset.exists() else 0.0)) * scale


def read_number(path: Path) -> float:
    """Read the number in a sysfs file.

    Raises:
        OSError: The file cannot be read now.
        NotANumberError: The content of the file is not a number.
    """
    with path.open("rb") as file:
        text = file.read(MAX_BYTES)
    try:
        return number(text.decode("ascii"))
    except ValueError:  # UnicodeDecodeError is a subclass
        raise NotANumberError(f"{path}: no number: {text[:MAX_SHOWN_BYTES]!r}") from None


def find_chip(chip: str, root: Path = SYS) -> Path:
    """Return the folder of a hwmon or iio chip.

    Args:
        chip: Name (``ina226``), bus address (``1-0040``), or path of the folder.
        root: Root of sysfs.

    Raises:
        SourceUnavailableError: No chip, or more than one, has this name.
    """
    if chip.startswith("/"):
        if not Path(chip).is_dir():
            raise SourceUnavailableError(f"{chip}: no such folder; is the driver loaded?")
        return Path(chip)
    chips = list(_chips(root))
    matches = [path for path, name in chips if chip == name or chip in path.resolve().parts]
    if len(matches) > 1:
        addresses = ", ".join(map(_bus_address, matches))
        raise SourceUnavailableError(
            f"{chip}: {len(matches)} chips have this name ({addresses}); set the bus address of one of them"
        )
    if not matches:
        present = ", ".join(sorted({name for _, name in chips})) or "none at all"
        raise SourceUnavailableError(f"{chip}: no such chip in hwmon or iio; present: {present}. Is its driver loaded?")
    return matches[0]


def find_channel(name: str, chip: str, root: Path = SYS) -> Channel:
    """Find a channel.

    Args:
        name: File or iio channel of the chip, ``other_chip/name`` for another chip, or a path.
        chip: The chip.
        root: Root of sysfs.

    Raises:
        SourceUnavailableError: The chip has no such channel.
    """
    folder, _, file = name.rpartition("/")
    channel = Channel(find_chip(folder or chip, root) / file)
    required_file = _iio_file(channel.path, "raw") if _is_iio(channel.path) else channel.path
    if not required_file.exists():
        raise SourceUnavailableError(
            f"{required_file}: no such file; the chip has {', '.join(_channel_names(required_file.parent)) or 'none'}"
        )
    if not channel.kind:
        raise SourceUnavailableError(f"{channel.path}: neither a voltage, a current nor a temperature")
    return channel


def _chips(root: Path) -> Iterator[tuple[Path, str]]:
    """Yield folder and name of each chip."""
    for pattern in ("class/hwmon/*", "bus/iio/devices/iio:device*"):
        for path in sorted(root.glob(pattern)):
            try:
                yield path, (path / "name").read_text(encoding="ascii").strip()
            except (OSError, UnicodeDecodeError):  # the chip was just removed, or has no name
                continue


def _bus_address(chip: Path) -> str:
    """Return the bus address of a chip, e.g. ``1-0040`` for ``.../1-0040/hwmon/hwmon3`` or ``.../1-0040/iio:device0``."""
    folder = chip.resolve().parent
    return folder.parent.name if folder.name == "hwmon" else folder.name


def _is_iio(path: Path) -> bool:
    """Return True for an iio channel. Names of hwmon files end in ``_input``."""
    return not path.name.endswith("_input")


def _iio_file(channel: Path, part: str) -> Path:
    """Return a file of an iio channel.

    Channels of one kind may share scale and offset: ``in_voltage_scale`` belongs to ``in_voltage0_raw``.
    """
    channel_file = channel.with_name(f"{channel.name}_{part}")
    if part == "raw" or channel_file.exists():
        return channel_file
    return channel.with_name(f"{channel.name.rstrip('0123456789')}_{part}")


def _channel_names(folder: Path) -> list[str]:
    files = sorted(path.name for path in folder.glob("*")) if folder.is_dir() else []
    return [name.removesuffix("_raw") for name in files if name.endswith(("_input", "_raw"))]


MIN_INTERVAL_S = 0.1
"""Minimum interval between two readings [s]. Some chips update every 2 ms."""
READ_TIMEOUT_S = 5.0
"""Timeout of a reading [s]. A bus answers within a second, but a machine that swaps may take longer."""
REMOVED_ERRORS = (errno.ENOENT, errno.ENODEV, errno.ENXIO)
"""Errors that show that the chip or its driver was removed."""

T = TypeVar("T")


class _Channels(NamedTuple):
    """Channels that are read for each sample."""

    voltage: Channel
    current: Channel
    temperatures: tuple[Channel, ...]
    amperes_per_unit: float
    """Current per unit of the current channel: [A/A], or [A/V] if the channel is a voltage over a shunt."""
    interval_s: float
    """Time between two samples [s]."""


class LinuxSensor(LineProducer):
    """Producer of samples as lines of JSON, which polls the sysfs files of a chip.

    Args:
        settings: Chip, files, divider and shunt.
        root: Root of sysfs.
        read_timeout_s: Timeout of a reading [s].
    """

    def __init__(self, settings: LinuxSource, root: Path = SYS, read_timeout_s: float = READ_TIMEOUT_S) -> None:
        self._settings, self._root, self._read_timeout_s = settings, root, read_timeout_s
        self._thread = DaemonThreadExecutor("sysfs")
        self._hung_call: asyncio.Future[Any] | None = None  # the thread runs one call at a time, so this must end first
        self._counters = {"read_errors": 0, "value_errors": 0}
        self._fault: str | None = None

    @property
    def name(self) -> str:
        """Chip and files of the sensor."""
        return self._settings.short_description

    @property
    def counters(self) -> Mapping[str, int]:
        """Number of faults since start.

        ``read_errors`` counts files that could not be read, ``value_errors`` files without a number.
        """
        return self._counters

    @property
    def fault(self) -> str | None:
        """Error of the last reading."""
        return self._fault

    async def iter_lines(self) -> AsyncGenerator[bytes, None]:
        """Yield one line in each interval.

        Raises:
            SourceUnavailableError, OSError: The chip or one of its files is missing, or its bus hangs.
        """
        channels = await self._read(self._find_channels)
        yield CONNECTED
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            line = await self._read(lambda: self._sample(channels))
            if line:
                yield line
            due_s = max(due_s + channels.interval_s, loop.time())
            await asyncio.sleep(due_s - loop.time())

    async def _read(self, call: Callable[[], T]) -> T:
        """Run a call that may wait for the bus; return its result."""
        if self._hung_call is not None:
            await self._wait(self._hung_call)
            self._hung_call = None
        future = asyncio.get_running_loop().run_in_executor(self._thread, call)
        try:
            await self._wait(future)
        except SourceUnavailableError:
            # asyncio logs an exception that is never retrieved, and no caller waits for this call any more
            future.add_done_callback(lambda call: call.exception())
            self._hung_call = future
            raise
        return future.result()

    async def _wait(self, future: asyncio.Future[T]) -> None:
        """Wait for a call.

        Raises:
            SourceUnavailableError: The bus has not answered in time.
        """
        done, _ = await asyncio.wait({future}, timeout=self._read_timeout_s)
        if not done:
            raise SourceUnavailableError(f"the bus has not answered for {self._read_timeout_s:g} s")

    def _find_channels(self) -> _Channels:
        """Find the channels of the chip; runs in the thread."""
        settings = self._settings
        voltage, current = (
            find_channel(name, settings.chip, self._root) for name in (settings.voltage, settings.current)
        )
        temperatures = tuple(find_channel(name, settings.chip, self._root) for name in settings.temperature)
        amperes_per_unit = settings.current_scale * self._amperes_per_unit(current)
        return _Channels(
            voltage, current, temperatures, amperes_per_unit, settings.interval_s or self._chip_interval_s()
        )

    def _amperes_per_unit(self, current: Channel) -> float:
        """Return the current per unit of the channel, from the shunt.

        Raises:
            SourceUnavailableError: Neither the settings nor the driver define the shunt.
        """
        shunt_ohm = self._settings.shunt_ohm
        if current.kind == "in":
            if shunt_ohm is None:
                raise SourceUnavailableError(
                    f"{current.path}: a voltage; set source.shunt_ohm to the resistance of its shunt"
                )
            return 1.0 / shunt_ohm
        if shunt_ohm is None:
            return 1.0
        driver_shunt = current.path.with_name("shunt_resistor")
        try:
            return 1e-6 * read_number(driver_shunt) / shunt_ohm
        except (OSError, NotANumberError) as error:
            raise SourceUnavailableError(
                f"{driver_shunt}: {_reason(error)}: the shunt that the driver assumes is unknown; set the ratio in "
                "source.current_scale instead of source.shunt_ohm"
            ) from None

    def _chip_interval_s(self) -> float:
        """Return the update interval of the chip, at least 0.1 s [s].

        If the driver reports none, this is ``period_s``, the default sample period, because ``interval_s`` is not set.

        Raises:
            SourceUnavailableError: The interval is longer than the estimator accepts without gaps.
        """
        try:
            chip_interval_s = 1e-3 * read_number(find_chip(self._settings.chip, self._root) / "update_interval")
        except (OSError, NotANumberError):
            return self._settings.period_s
        if chip_interval_s > SILENT_PERIODS * self._settings.period_s:
            raise SourceUnavailableError(
                f"the chip measures only every {chip_interval_s:g} s; set source.interval_s = {chip_interval_s:g}"
            )
        return max(chip_interval_s, MIN_INTERVAL_S)

    def _sample(self, channels: _Channels) -> bytes:
        """Return the line of a sample; empty if voltage or current cannot be read now. Runs in the thread.

        Raises:
            OSError: The chip is gone.
        """
        settings, self._fault = self._settings, None
        voltage, current = self._value(channels.voltage), self._value(channels.current)
        temperatures_c = [self._value(channel) for channel in channels.temperatures]
        if voltage is None or current is None:
            return b""
        return sample_json_line(
            settings.voltage_scale * voltage + settings.voltage_offset_v,
            channels.amperes_per_unit * current + settings.current_offset_a,
            temperatures_c=temperatures_c,
        )

    def _value(self, channel: Channel) -> float | None:
        """Read a value. If that fails now, count the fault and return None.

        Raises:
            OSError: The chip is gone.
        """
        try:
            return channel.read()
        except NotANumberError as error:
            self._counters["value_errors"] += 1
            self._fault = str(error)
        except OSError as error:
            if error.errno in REMOVED_ERRORS:
                raise
            self._counters["read_errors"] += 1
            self._fault = f"{channel.path}: {_reason(error)}"
        return None


def producer(settings: Settings) -> LinuxSensor:
    """Make the line producer of ``[source]``."""
    assert isinstance(settings.source, LinuxSource)  # noqa: S101 - KINDS maps kind = "linux" to LinuxSource
    return LinuxSensor(settings.source)


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
