"""Sensors with a kernel driver: their folders in sysfs, by chip name, and their values in SI units.

hwmon: ``in*_input`` [mV], ``curr*_input`` [mA], ``temp*_input`` [millidegC], ``shunt_resistor`` [uohm], ``update_interval``
[ms], see Documentation/hwmon/sysfs-interface.rst and ina2xx.rst of the kernel. iio: a channel is ``<name>_raw``,
``<name>_scale`` and optionally ``<name>_offset``; (raw + offset) * scale is in mV, mA or millidegC, see sysfs-bus-iio.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from bms_estimator.model.decimal_text import number
from bms_estimator.sources.line_source import SourceUnavailableError

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
