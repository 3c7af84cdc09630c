"""What the identifier has learned, read from the estimator's records."""

import math
from typing import NamedTuple

import numpy as np

from bms_estimator.kernels.element_map import ELEMENT_NAMES
from bms_estimator.kernels.identification import LEAST_BINS
from bms_estimator.kernels.identifier import element_ln_stds, element_values
from bms_estimator.kernels.identifier_state import LN_CAPACITY


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
        record: Of dtype ESTIMATOR_STATE, with an identifier that has taken a sample.
    """
    r_s, r_ts, _, c_ts, r_tl, _, c_tl = element_values(record["identifier"])
    s_r_s, s_r_ts, _, s_c_ts, s_r_tl, _, s_c_tl = element_ln_stds(record["identifier"])
    values = (r_ts, s_r_ts), (r_tl, s_r_tl), (c_ts, s_c_ts), (c_tl, s_c_tl), (r_s, s_r_s)
    ages = record["unlearned_s"]
    return {
        name: Learned(value, value * ln_std, float(age_s))
        for name, (value, ln_std), age_s in zip(ELEMENT_NAMES, values, ages, strict=True)
    }


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
    x = record["identifier"]
    ratio = math.exp(x["mean"][LN_CAPACITY])
    return Learned(ratio, ratio * math.sqrt(x["covariance"][LN_CAPACITY, LN_CAPACITY]), 0.0)
