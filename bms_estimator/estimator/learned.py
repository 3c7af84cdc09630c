"""What the filter has learned, read from the estimator's records."""

import math
from typing import NamedTuple

import numpy as np

from bms_estimator.kernels.ekf_state import LN_Q, OFFSET
from bms_estimator.kernels.element_map import ELEMENT_NAMES
from bms_estimator.kernels.equivalent import C_TL, C_TS, R_S, R_TL, R_TS
from bms_estimator.kernels.identification import LEAST_BINS


class Learned(NamedTuple):
    """A value with its standard deviation, both in the unit of its name, and for how long no data told of it."""

    value: float
    std: float
    unlearned_s: float

    @property
    def relative_std(self) -> float:
        """Standard deviation over value; infinite where it is unknown."""
        return self.std / abs(self.value) if math.isfinite(self.std) and self.value else math.inf


def present_elements(record: np.void) -> dict[str, Learned]:
    """The elements at the present SOC by name: ``ELEMENT_NAMES``, in ohm and farad.

    Args:
        record: Of dtype ESTIMATOR_STATE, after a sample, identifying.
    """
    elements, ages = record["elements"], record["unlearned_s"]
    order = R_TS, R_TL, C_TS, C_TL, R_S
    values = elements["value"][list(order)]
    stds = values * np.sqrt(elements["ln_variance"][list(order)])
    return {name: Learned(*map(float, one)) for name, *one in zip(ELEMENT_NAMES, values, stds, ages, strict=True)}


def fitted_parameter(record: np.void, index: int) -> Learned | None:
    """a_index, 1..15, of the fit over SOC; None where its element was seen in fewer than ``LEAST_BINS`` bins.

    Args:
        record: Of dtype ESTIMATOR_STATE.
        index: 1..15.
    """
    element = (index - 1) // 3
    fit = record["fit"]
    if fit["bins"][element] < LEAST_BINS:
        return None
    return Learned(float(fit["a"][index]), float(fit["std"][index]), float(record["unlearned_s"][element]))


def relative_capacity(record: np.void) -> Learned:
    """True over declared capacity."""
    ln_q, std = _bias(record, LN_Q)
    return Learned(math.exp(ln_q), math.exp(ln_q) * std, 0.0)


def current_offset(record: np.void) -> Learned:
    """Measured less true current [A]."""
    return Learned(*_bias(record, OFFSET), 0.0)


def _bias(record: np.void, j: int) -> tuple[float, float]:
    """Mean and standard deviation of state ``j`` of the likeliest hypothesis."""
    f = record["filter"]
    best = f["best"]
    return float(f["mean"][best, j]), math.sqrt(f["covariance"][best, j, j])
