"""Fixtures of these tests."""

from tests.simavr_board import firmware

__all__ = ["firmware"]
