"""A sample that no pack like this can give: what it says, what is possible, and what may be the matter."""

import math

import numpy as np

from bms_estimator.model.sample import SampleBlock


def impossible_sample(block: SampleBlock, settings: np.void) -> str | None:
    """The last sample of a block that is out of range or has no number, for people; None where there is none.

    Args:
        block: Some of its samples were dropped.
        settings: A record of OBSERVER_SETTINGS.
    """
    low_v, high_v = float(settings["voltage_min_v"]), float(settings["voltage_max_v"])
    most_a = float(settings["current_max_a"])
    voltage_v, current_a = block["voltage_v"], block["current_a"]
    outside = ~((voltage_v >= low_v) & (voltage_v <= high_v) & (np.abs(current_a) <= most_a))
    if not outside.any():
        return None
    volt, ampere = float(voltage_v[outside][-1]), float(current_a[outside][-1])
    missing = [what for what, value in (("voltage", volt), ("current", ampere)) if math.isnan(value)]
    if missing:
        return f"the last of them tells no {' and no '.join(missing)}: is the sensor connected?"
    said = (
        f"the last of them {volt:g} V, {ampere:g} A, where {low_v:g}..{high_v:g} V and up to {most_a:g} A are possible"
    )
    for guess, v, a in (
        ("are the columns swapped?", abs(ampere), volt),
        ("are these millivolts?", 1e-3 * volt, ampere),
        ("are these milliamperes?", volt, 1e-3 * ampere),
        ("are these millivolts and milliamperes?", 1e-3 * volt, 1e-3 * ampere),
    ):
        if low_v <= v <= high_v and abs(a) <= most_a:
            return f"{said}: {guess}"
    return said
