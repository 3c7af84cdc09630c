"""R_s by (4.2), step 3 of the thesis, as published parameters."""

from bms_estimator.estimator import Estimator
from bms_estimator.kernels.observer.series_resistance import MIN_CURRENT_C
from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads import Parameter
from bms_estimator.telemetry.state import finite

ORIGIN = "by (4.2), step 3 of the thesis; takes up what the OCV and a1..a12 have wrong, which std does not know"


def series_resistance_parameters(estimator: Estimator) -> dict[str, Parameter]:
    """``r_s_ohm``, null until a current has flowed, and a13..a15 as soon as enough SOC was swept to fit (2.9).

    The error of ``r_s_ohm`` is the scatter of (4.2) about (2.9); before the fit it is not known.

    Args:
        estimator: Estimator of a battery, after a sample, with R_s by (4.2).
    """
    from bms_estimator.calibration.thesis.series_resistance import LOWEST_SOC, fit_series_resistance, summed  # noqa: PLC0415 - most packs do not need it

    record = estimator.record[0]
    sums = record["series_resistance"]
    square_a2 = float(sums["square_a2"].sum())
    if square_a2 == 0.0:
        smallest_a = MIN_CURRENT_C * float(estimator.settings[0]["capacity_as"]) / 3600.0
        missing = f"(4.2) needs a current: none above {smallest_a:.3g} A has flowed"
        return {"r_s_ohm": Parameter(value=None, std=None, valid=False, source="identified", reason=missing)}
    try:
        fit = fit_series_resistance(summed(record), LOWEST_SOC)
    except UserError:  # too few steps of SOC for three parameters: one value for all of them
        return {"r_s_ohm": _of_4_2(float(sums["product_va"].sum()) / square_a2, None)}
    found = {f"a{i}": _of_4_2(*pair) for i, *pair in zip((13, 14, 15), fit.a, fit.std, strict=True)}
    return found | {"r_s_ohm": _of_4_2(float(fit(record["observer"]["soc"])), fit.rms_ohm)}


def _of_4_2(value: float, std: float | None) -> Parameter:
    known = None if std is None else finite(std)
    return Parameter(value=finite(value), std=known, valid=False, source="identified", reason=ORIGIN)
