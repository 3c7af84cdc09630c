"""Sign of the current in a table: from an option, a state column, the dialect, the settings or the voltage's response."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.sample import CurrentSign, SampleBlock
from bms_estimator.sources.captures.tables.dialects import OWN
from bms_estimator.sources.captures.tables.layout import Layout, Role

STEP_FRACTION = 0.1
"""Minimum change of the current that counts as a step, as a fraction of its range."""
MIN_STEPS = 2
"""Minimum number of steps for a decision. A single step may be a glitch."""
AGREEING_FRACTION = 0.8
"""Fraction of the steps to which the voltage must respond in the same direction."""
MIN_CORRELATION = 0.7
"""Minimum correlation of voltage and charge for a decision, if there are too few steps."""
MIN_TREND_ROWS = 20
"""Minimum number of samples for a decision by the correlation of voltage and charge."""
SIGN_TEXTS: dict[CurrentSign, str] = {
    "discharge_positive": "positive on discharge",
    "charge_positive": "positive on charge",
}


class Sign(NamedTuple):
    """Direction of positive current that the user configured."""

    option: CurrentSign | None = None
    """Direction given for this capture, which overrides everything else; None: not given."""
    sensor: CurrentSign | None = None
    """Direction of the pack's sensor, used if the format of another program defines none; None: no settings."""


class CurrentDirection(NamedTuple):
    """Direction of positive current in a table, with its reason."""

    sign: CurrentSign
    reason: str
    by_state: bool = False
    """True if words in a state column give the direction of each row."""
    warning: str = ""
    """Contradiction between the direction and the voltage; empty without one."""

    @property
    def factor(self) -> float:
        """Factor, 1 or -1, that makes discharge positive."""
        return 1.0 if self.sign == "discharge_positive" else -1.0

    @property
    def text(self) -> str:
        """Direction and reason for messages."""
        return f"{'signed' if self.by_state else SIGN_TEXTS[self.sign]} ({self.reason})"


def find_direction(layout: Layout, configured: Sign, response: CurrentSign | None) -> CurrentDirection:
    """Return the direction of positive current in a table.

    Args:
        layout: Columns of the table.
        configured: Direction that the user configured.
        response: Direction that the voltage shows, by ``voltage_response``; None: it shows none.
    """
    if configured.option:
        return CurrentDirection(configured.option, "--current-sign")
    if Role.CHARGE_CURRENT in layout.columns:
        return CurrentDirection("discharge_positive", "separate columns of charge and discharge")
    direction = _defined_direction(layout, configured)
    if direction is None and response is not None:
        direction = CurrentDirection(response, "response of the voltage")
    if direction is None:
        direction = CurrentDirection("discharge_positive", "assumed: the file does not show it; --current-sign sets it")
    if Role.STATE in layout.columns:
        return CurrentDirection(direction.sign, f"column {layout.columns[Role.STATE].name}", by_state=True)
    if response is None or response == direction.sign:
        return direction
    warning = (
        f"the current should be {SIGN_TEXTS[direction.sign]} ({direction.reason}), but the voltage shows that it is "
        f"{SIGN_TEXTS[response]}: if so, use --current-sign {response}"
    )
    return direction._replace(warning=warning)


def _defined_direction(layout: Layout, configured: Sign) -> CurrentDirection | None:
    """Return the direction that the format or the settings define; None if neither does.

    A table with this project's columns may come from the pack itself; therefore the settings of its sensor decide first.
    """
    if layout.dialect.current_sign:
        return CurrentDirection(layout.dialect.current_sign, f"convention of {layout.dialect.name}")
    if configured.sensor:
        return CurrentDirection(configured.sensor, "sensor.current_sign")
    if layout.dialect is OWN:
        return CurrentDirection("discharge_positive", f"convention of {OWN.name}")
    return None


def voltage_response(samples: SampleBlock) -> CurrentSign | None:
    """Return the direction of positive current that a battery's voltage shows.

    The voltage falls when the discharge current rises in a step. If the current has too few steps, the direction follows
    from the correlation of the voltage with the charge, because the voltage falls during a discharge.

    Args:
        samples: Samples with the current as in the table.

    Returns:
        None if the voltage shows no direction.
    """
    rows = samples[
        np.isfinite(samples["current_a"]) & np.isfinite(samples["voltage_v"]) & np.isfinite(samples["time_s"])
    ]
    if rows.size < MIN_STEPS + 1:
        return None
    with np.errstate(all="ignore"):  # values near the largest float overflow
        response = _step_response(rows["current_a"], rows["voltage_v"]) or _charge_response(rows)
    return None if response == 0 else "charge_positive" if response > 0 else "discharge_positive"


def _step_response(current_a: NDArray[np.float64], voltage_v: NDArray[np.float64]) -> int:
    """Return 1 if the voltage rises in steps of the current upward, -1 if it falls, 0 if there are too few steps."""
    current_step_a, voltage_step_v = np.diff(current_a), np.diff(voltage_v)
    range_a = float(np.ptp(current_a))
    is_step = (np.abs(current_step_a) >= STEP_FRACTION * range_a) & (voltage_step_v != 0.0) & (current_step_a != 0.0)
    rising = np.sign(current_step_a[is_step]) == np.sign(voltage_step_v[is_step])
    if rising.size < MIN_STEPS:
        return 0
    fraction = float(np.mean(rising))
    return 1 if fraction >= AGREEING_FRACTION else -1 if fraction <= 1.0 - AGREEING_FRACTION else 0


def _charge_response(rows: SampleBlock) -> int:
    """Return 1 if the voltage rises with the integral of the current, -1 if it falls, 0 if neither is clear."""
    steps_s = np.diff(rows["time_s"]).clip(min=0.0)
    charge_as = np.cumsum(rows["current_a"][1:] * steps_s)
    voltage_v = rows["voltage_v"][1:]
    if rows.size < MIN_TREND_ROWS or not np.ptp(charge_as) > 0.0 or not np.ptp(voltage_v) > 0.0:
        return 0
    correlation = float(np.corrcoef(charge_as, voltage_v)[0, 1])
    return int(np.sign(correlation)) if abs(correlation) >= MIN_CORRELATION else 0  # 0 also if it is NaN
