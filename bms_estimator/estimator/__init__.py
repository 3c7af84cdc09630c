"""Estimator class around the kernels, and the conversion of settings and results."""

from bms_estimator.estimator.estimator import Estimator, estimate

__all__ = ["Estimator", "estimate"]
