"""Simulated /sys with the files of hwmon and iio drivers."""

from pathlib import Path

I2C_BUS = "devices/platform/soc/fe804000.i2c/i2c-1"


def hwmon(root: Path, name: str = "ina226", place: str = "1-0040", number: int = 3, **files: object) -> Path:
    """Create an hwmon chip with file names of the kernel's Documentation/hwmon/ina2xx.rst. Return its folder."""
    folder = root / I2C_BUS / place / "hwmon" / f"hwmon{number}"
    return _chip(root / "class" / "hwmon" / folder.name, folder, name, files)


def iio(root: Path, name: str = "ads1115", place: str = "1-0048", number: int = 0, **files: object) -> Path:
    """Create an iio chip with file names of the kernel's Documentation/ABI/testing/sysfs-bus-iio. Return its folder."""
    folder = root / I2C_BUS / place / f"iio:device{number}"
    return _chip(root / "bus" / "iio" / "devices" / folder.name, folder, name, files)


def _chip(link: Path, folder: Path, name: str, files: dict[str, object]) -> Path:
    """Create a chip's folder with its files, and the link of its class. Return the folder."""
    folder.mkdir(parents=True)
    for file, content in {"name": name, **files}.items():
        (folder / file).write_text(f"{content}\n")
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(folder)
    return folder
