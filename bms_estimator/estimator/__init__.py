"""One object around the kernels: settings, state, ``step`` and ``run``."""

from bms_estimator.estimator.estimator import Estimator, estimate

__all__ = ["Estimator", "estimate"]
