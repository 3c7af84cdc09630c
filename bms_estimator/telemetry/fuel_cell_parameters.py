"""Published parameters of a fuel cell, and of R_s by the least squares of (4.2), step 3 of the thesis, with their errors."""

import math

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.fuel_cell import ACTIVATION, NAMES, TAFEL
from bms_estimator.kernels.identifier import VALID_STD
from bms_estimator.kernels.observer.series_resistance import MIN_CURRENT_C
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads.snapshot import Parameter
from bms_estimator.telemetry.state import finite

REASON = "by (4.2), step 3 of the thesis; includes errors of the OCV and of a1..a12, which std does not cover"
"""Reason why ``valid`` is False in the published parameters."""


def settling_reason(settle_s: float) -> str | None:
    """Return the reason why nothing is learned while the RC voltages depend on an unmeasured load; None afterwards.

    Args:
        settle_s: Remaining time [s].
    """
    if settle_s <= 0.0:
        return None
    return f"settling after a start under load or a gap: nothing is learned for another {settle_s / 60.0:.0f} min"


def series_resistance_parameters(estimator: Estimator) -> dict[str, Parameter]:
    """Return ``r_s_ohm``, and a13..a15 once the swept range of SOC is large enough to fit (2.9).

    ``r_s_ohm`` is null until a current has flowed. Its std is the scatter of (4.2) about (2.9), unknown before the fit.

    Args:
        estimator: Estimator of a battery, after a sample, with R_s by (4.2).
    """
    from bms_estimator.calibration.thesis.series_resistance import (  # noqa: PLC0415 - most packs do not need it
        LOWEST_SOC,
        fit_series_resistance,
        series_resistance_from_sums,
    )

    record = estimator.record[0]
    sums = record["series_resistance"]
    square_a2 = float(sums["square_a2"].sum())
    if square_a2 == 0.0:
        smallest_a = MIN_CURRENT_C * float(estimator.settings[0]["capacity_as"]) / 3600.0
        settling = settling_reason(float(sums["settle_s"]))
        missing = settling or f"(4.2) needs a current: none above {smallest_a:.3g} A has flowed"
        return {"r_s_ohm": Parameter(value=None, std=None, valid=False, source="identified", reason=missing)}
    try:
        fit = fit_series_resistance(series_resistance_from_sums(record), LOWEST_SOC)
    except UserError:  # the swept range of SOC is too small for three parameters: use one mean value
        return {"r_s_ohm": _parameter(float(sums["product_va"].sum()) / square_a2, None)}
    parameters = {f"a{i}": _parameter(*pair) for i, *pair in zip((13, 14, 15), fit.a, fit.std, strict=True)}
    return parameters | {"r_s_ohm": _parameter(float(fit(record["observer"]["soc"])), fit.rms_ohm)}


def _parameter(value: float, std: float | None) -> Parameter:
    finite_std = None if std is None else finite(std)
    return Parameter(value=finite(value), std=finite_std, valid=False, source="identified", reason=REASON)


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
