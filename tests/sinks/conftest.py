"""Fixtures of these tests."""

from tests.mosquitto import broker
from tests.serial_line import line

__all__ = ["broker", "line"]
