"""Thread that fits the pack's model, so that a fit delays neither samples nor messages."""

import math
from collections.abc import Callable
from concurrent.futures import Executor, Future

import structlog

from bms_estimator.model.clock import Clock
from bms_estimator.pack_model.fit import PackFit
from bms_estimator.process.disk_thread import DiskThread
from bms_estimator.telemetry.pack_model import FitTimes

LOG_S = 3600.0
"""Minimum interval between two log lines for each kind of exception [s]; all failures are counted."""

log = structlog.get_logger(__name__)


class FitThread:
    """Runs the fits of one pack one after the other, and logs their failures.

    Args:
        clock: The clocks.
        executor: Runs the fits; default: a daemon thread, so that the service can exit during a fit.

    Attributes:
        times: End and duration of the last fit, failed or not.
    """

    def __init__(self, clock: Clock, executor: Executor | None = None) -> None:
        self._clock, self._executor = clock, executor or DiskThread("fit")  # for its daemon thread
        self._logged_s: dict[str, float] = {}
        self.times = FitTimes(None, None)

    def submit(self, call: Callable[[], PackFit]) -> "Future[PackFit]":
        """Queue a fit, and return its future."""
        return self._executor.submit(self._measure, call)

    def log_failure(self, error: BaseException) -> None:
        """Log the exception of a fit, once in ``LOG_S`` for each kind."""
        kind, now_s = type(error).__name__, self._clock.monotonic()
        if now_s - self._logged_s.get(kind, -math.inf) >= LOG_S:
            self._logged_s[kind] = now_s
            log.warning("the fit of the pack's model failed; the previous fit stays", kind=kind, exc_info=error)

    def _measure(self, call: Callable[[], PackFit]) -> PackFit:
        started_s = self._clock.monotonic()
        try:
            return call()
        finally:
            self.times = FitTimes(self._clock.wall(), self._clock.monotonic() - started_s)
