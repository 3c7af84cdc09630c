"""Sensors with a kernel driver: folders of sysfs, found by the chip's name, and their values in SI units.

hwmon: ``in*_input`` [mV], ``curr*_input`` [mA], ``temp*_input`` [millidegC], ``shunt_resistor`` [uohm], ``update_interval``
[ms], as the kernel's Documentation/hwmon/sysfs-interface.rst and ina2xx.rst have them. iio: a channel is ``<name>_raw``,
``<name>_scale`` and perhaps ``<name>_offset``, (raw + offset) * scale in mV, mA or millidegC, as sysfs-bus-iio has it.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from bms_estimator.model.decimal_text import number
from bms_estimator.sources.line_source import SourceUnavailableError

SYS = Path("/sys")
MAX_BYTES = 4096
"""A page: no file of sysfs holds more."""


class JunkError(Exception):
    """The content of a file is not a number; the message names it."""


class Channel(NamedTuple):
    """One value of a chip."""

    path: Path
    """Path of a hwmon file; for an iio channel its prefix."""

    @property
    def kind(self) -> str:
        """``in``, ``curr`` or ``temp``."""
        name = self.path.name.removeprefix("in_") if _is_iio(self.path) else self.path.name
        words = {"in": "in", "voltage": "in", "curr": "curr", "temp": "temp"}
        return next((kind for word, kind in words.items() if name.startswith(word)), "")

    def read(self) -> float:
        """Return the present value [V, A, C].

        Raises:
            OSError: It cannot be read now.
            JunkError: It is no number.
        """
        if not _is_iio(self.path):
            return 1e-3 * read_number(self.path)
        raw, scale = (read_number(_beside(self.path, part)) for part in ("raw", "scale"))
        offset = _beside(self.path, "offset")
        return 1e-3 * (raw + (read_number(offset) if offset.exists() else 0.0)) * scale


def read_number(path: Path) -> float:
    """Read the number in a sysfs file.

    Raises:
        OSError: It cannot be read now.
        JunkError: It is not a number.
    """
    with path.open("rb") as file:
        text = file.read(MAX_BYTES)
    try:
        return number(text.decode("ascii"))
    except ValueError:  # UnicodeDecodeError is one
        raise JunkError(f"{path}: no number: {text[:40]!r}") from None


def find_chip(chip: str, root: Path = SYS) -> Path:
    """Folder of a chip of hwmon or iio.

    Args:
        chip: Name (``ina226``), its place on the bus (``1-0040``), or the folder itself.
        root: Root of sysfs.

    Raises:
        SourceUnavailableError: No chip, or more than one, has this name.
    """
    if chip.startswith("/"):
        if not Path(chip).is_dir():
            raise SourceUnavailableError(f"{chip}: no such folder; is the driver loaded?")
        return Path(chip)
    chips = list(_chips(root))
    found = [path for path, name in chips if chip == name or chip in path.resolve().parts]
    if len(found) > 1:
        places = ", ".join(map(_place, found))
        raise SourceUnavailableError(f"{chip}: there are {len(found)} ({places}); name one by its place on the bus")
    if not found:
        there = ", ".join(sorted({name for _, name in chips})) or "none at all"
        raise SourceUnavailableError(f"{chip}: no such chip in hwmon or iio; there: {there}. Is its driver loaded?")
    return found[0]


def find_channel(name: str, chip: str, root: Path = SYS) -> Channel:
    """Find a channel.

    Args:
        name: As ``LinuxSource.voltage``: a file or iio channel of the chip, ``other_chip/name``, or a path.
        chip: The chip.
        root: Root of sysfs.

    Raises:
        SourceUnavailableError: No such channel.
    """
    folder, _, file = name.rpartition("/")
    channel = Channel(find_chip(folder or chip, root) / file)
    needed = _beside(channel.path, "raw") if _is_iio(channel.path) else channel.path
    if not needed.exists():
        raise SourceUnavailableError(
            f"{needed}: no such file; the chip has {', '.join(_readable(needed.parent)) or 'none'}"
        )
    if not channel.kind:
        raise SourceUnavailableError(f"{channel.path}: neither a voltage, a current nor a temperature")
    return channel


def _chips(root: Path) -> Iterator[tuple[Path, str]]:
    """Folder and name of each chip."""
    for pattern in ("class/hwmon/*", "bus/iio/devices/iio:device*"):
        for path in sorted(root.glob(pattern)):
            try:
                yield path, (path / "name").read_text(encoding="ascii").strip()
            except (OSError, UnicodeDecodeError):  # it went this moment, or has none
                continue


def _place(chip: Path) -> str:
    """Return a chip's location on its bus: in sysfs the folder of the device, above that of its driver's class."""
    folder = chip.resolve().parent
    return folder.parent.name if folder.name == "hwmon" else folder.name


def _is_iio(path: Path) -> bool:
    return not path.name.endswith("_input")


def _beside(channel: Path, part: str) -> Path:
    """Return a file of an iio channel; channels of one kind may share it: ``in_voltage_scale`` for ``in_voltage0_raw``."""
    own = channel.with_name(f"{channel.name}_{part}")
    if part == "raw" or own.exists():
        return own
    return channel.with_name(f"{channel.name.rstrip('0123456789')}_{part}")


def _readable(folder: Path) -> list[str]:
    files = sorted(path.name for path in folder.glob("*")) if folder.is_dir() else []
    return [name.removesuffix("_raw") for name in files if name.endswith(("_input", "_raw"))]
