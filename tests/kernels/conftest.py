"""Fixtures of these tests."""

from tests.full_disk import disk_without_files, full_disk

__all__ = ["disk_without_files", "full_disk"]
