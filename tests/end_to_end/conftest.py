"""Fixtures of these tests."""

from tests.mosquitto import broker
from tests.simavr_board import firmware

__all__ = ["broker", "firmware"]
