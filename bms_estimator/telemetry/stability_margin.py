"""Stability margin where it applies."""

from typing import Any

import numpy as np


def applicable_margin(trace: Any, soc_known: Any) -> Any:
    """Return the stability margin of rows of dtype TRACE, NaN where it does not apply.

    It applies if the SOC is known and the model is unstable below an SOC above 0.

    Args:
        trace: One row, or shape (n,).
        soc_known: True where the SOC is known, of the same shape.
    """
    is_limited = np.fmax(trace["delta_1"], trace["delta_2"]) > 0.0
    return np.where(soc_known & is_limited, trace["stability_margin"], np.nan)
