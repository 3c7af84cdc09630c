"""Published parameters of R_s by the least squares of (4.2), step 3 of the thesis."""

from bms_estimator.estimator import Estimator
from bms_estimator.kernels.observer.series_resistance import MIN_CURRENT_C
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
