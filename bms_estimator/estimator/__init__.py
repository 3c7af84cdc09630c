"""One object around the kernels: settings, state, ``step`` and ``run``."""

from bms_estimator.estimator.estimator import Estimator

__all__ = ["Estimator"]
