"""Identified parameters of a fuel cell with their errors."""

import math

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.fuel_cell import ACTIVATION, NAMES, TAFEL
from bms_estimator.kernels.stability_margin import VALID_STD
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.payloads.snapshot import Parameter
from bms_estimator.telemetry.state import finite


def fuel_cell_parameters(estimator: Estimator, now_s: float) -> dict[str, Parameter]:
    """Return the learned values of the cell file's section ``[fuel_cell]``, at the temperature of the file.

    Args:
        estimator: Estimator of a fuel cell, after a sample; read only.
        now_s: Wall clock [s since 1970].
    """
    a, covariance = estimator.state[0]["a"], ln_covariance(estimator)
    std = np.sqrt(np.diagonal(covariance))
    parameters = {}
    for j, name in enumerate(NAMES):
        if j == ACTIVATION:
            parameters["exchange_current_a"] = _exchange_current(a, covariance, now_s)
        else:
            parameters[name] = _learned_parameter(float(a[1 + j]), float(std[j]), now_s)
    return parameters


def ln_covariance(estimator: Estimator) -> np.ndarray:
    """Return the covariance of the logarithms of the learned parameters, shape (n, n).

    The covariance is the inverse of the information of past data [V^2 s] plus a prior. In the prior the bounds of each
    parameter count as one standard deviation. Errors of the model itself are not included.
    """
    settings = estimator.settings_record[0]["learning"]
    n = int(settings["count"])
    lower, leak = np.tril(estimator.record[0]["learning"]["information"][:n, :n]), settings["leak_v2s"][:n]
    information = lower + np.tril(lower, -1).T + np.diag(leak)
    # the leakage is inversely proportional to the squared bounds; this factor makes its std without data equal to the bounds
    return float(leak[0] * settings["upper"][0] ** 2) * np.linalg.inv(information)


def _exchange_current(a: np.ndarray, covariance: np.ndarray, now_s: float) -> Parameter:
    """Return the exchange current e^(-a / A), where a is the activation loss at 1 A and A is the Tafel slope.

    The derivatives of its logarithm by ln a and ln A are -a / A and a / A.
    """
    ln_i_0 = -float(a[1 + ACTIVATION] / a[1 + TAFEL])
    gradient = np.zeros(covariance.shape[0])
    gradient[ACTIVATION], gradient[TAFEL] = ln_i_0, -ln_i_0
    return _learned_parameter(math.exp(ln_i_0), math.sqrt(gradient @ covariance @ gradient), now_s)


def _learned_parameter(value: float, ln_std: float, now_s: float) -> Parameter:
    """Return the payload of a learned value; ``ln_std`` is the std of its logarithm."""
    valid = ln_std < VALID_STD
    return Parameter(
        value=finite(value),
        std=finite(value * ln_std),
        valid=valid,
        source="identified",
        updated=iso_utc(now_s),
        reason=None if valid else f"known to {ln_std:.0%} so far, valid below {VALID_STD:.0%}",
    )
