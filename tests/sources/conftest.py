"""Fixtures of these tests."""

from tests.serial_line import line

__all__ = ["line"]
