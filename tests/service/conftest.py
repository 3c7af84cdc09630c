"""Fixtures of these tests."""

from tests.full_disk import disk_without_files, full_disk
from tests.mosquitto import broker
from tests.serial_line import line

__all__ = ["broker", "disk_without_files", "full_disk", "line"]
