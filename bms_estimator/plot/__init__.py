"""Plots of captures, estimates and cells with matplotlib (extra ``report``).

Each function draws on one ``Axes``, which it returns. Without ``ax`` it creates a figure with pyplot. Lines with many
samples are thinned; the extremes stay visible.
"""

from bms_estimator.plot.cell_curves import (
    current,
    element,
    ocv,
    ocv_residuals,
    rc_product,
    soc,
    temperature,
    voltage,
    voltage_error,
)

__all__ = [
    "current",
    "element",
    "ocv",
    "ocv_residuals",
    "rc_product",
    "soc",
    "temperature",
    "voltage",
    "voltage_error",
]
