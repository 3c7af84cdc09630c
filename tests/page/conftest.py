"""Fixtures of these tests."""

from tests.mosquitto import broker

__all__ = ["broker"]
