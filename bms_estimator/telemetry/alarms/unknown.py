"""Alarms whose value is not known, although all quantities that they need are measured. They are neither raised nor cleared."""

import math

import numpy as np

from bms_estimator.kernels.accumulators.soc_certainty import MIN_UNKNOWN_STD
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.telemetry.stability_margin import applicable_margin

SOC_ALARMS: tuple[AlarmName, ...] = ("soc_low", "stability_margin_low")
"""Alarms that need a known SOC. The probability of ``collapse_risk`` includes the uncertainty of the SOC."""
UNKNOWN_SOC = (
    "the SOC is not known yet: it is known once its standard deviation has fallen below "
    f"{100.0 * MIN_UNKNOWN_STD:.0f} %"
)
"""Reason of ``SOC_ALARMS``."""
NO_MARGIN = "the margin does not apply: the cell model is stable at each SOC"
"""Reason of ``stability_margin_low`` with a known SOC."""


def find_unknown(row: np.void, *, soc_known: bool) -> dict[AlarmName, str]:
    """Return the reason by alarm. A fuel cell has no such alarm, because it has no SOC.

    Args:
        row: The last estimate, dtype TRACE.
        soc_known: True if its SOC is known.
    """
    if math.isnan(row["soc"]):
        return {}
    if not soc_known:
        return dict.fromkeys(SOC_ALARMS, UNKNOWN_SOC)
    return {"stability_margin_low": NO_MARGIN} if np.isnan(applicable_margin(row, soc_known)) else {}
