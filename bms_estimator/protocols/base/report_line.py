"""A sample as a line of JSON, as the text dialect reads it: what sources that are no serial line hand on and record."""

import json
import math
from collections.abc import Sequence

CONNECTED = b""
"""In place of a line: what is measured can be reached now."""


def report_line(
    voltage_v: float,
    current_a: float,
    *,
    temperature_c: float | None = None,
    cells_v: Sequence[float | None] = (),
    time_s: float | None = None,
) -> bytes:
    """The line of one sample.

    Args:
        voltage_v: Of the pack's terminals [V].
        current_a: As the device counts it [A]; ``sensor.current_sign`` says what is positive.
        temperature_c: None or NaN: not measured [degC].
        cells_v: Of single cells, from the first on; None or NaN: this one was not measured [V].
        time_s: When it was measured by the device's clock, whatever that counts from; None: it does not say [s].

    Raises:
        ValueError: Voltage or current is no number.
    """
    if not (math.isfinite(voltage_v) and math.isfinite(current_a)):
        raise ValueError(f"no sample: {voltage_v} V, {current_a} A")
    line: dict[str, object] = {"voltage_v": round(voltage_v, 6), "current_a": round(current_a, 6)}
    if temperature_c is not None and math.isfinite(temperature_c):
        line["temperature_c"] = round(temperature_c, 3)
    if time_s is not None and math.isfinite(time_s):
        line["time_s"] = round(time_s, 6)
    if cells_v:
        line["cells_v"] = [None if v is None or not math.isfinite(v) else round(v, 4) for v in cells_v]
    return json.dumps(line, separators=(",", ":")).encode() + b"\n"
