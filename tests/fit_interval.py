"""Interval between slow fits, which take most of the time of a test over simulated days."""

import contextlib
from collections.abc import Iterator

import pytest

from bms_estimator.pack_model import slow_fit as slow_fit_module


@contextlib.contextmanager
def fits_every(interval_s: float) -> Iterator[None]:
    """Let a ``SlowFit`` with this ``interval_s`` [s] fit a young history no more often than an old one.

    Each fit uses the whole history, so that fewer fits have nearly the same final result.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(slow_fit_module, "MIN_INTERVAL_S", interval_s)
        yield
