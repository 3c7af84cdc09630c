"""Saved state of the alarms, as JSON. With it, a relay that an alarm has opened stays open over a restart."""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bms_estimator.model.clock import iso_utc
from bms_estimator.settings.alarm_kinds import Quantity
from bms_estimator.settings.alarm_limits import AlarmDefinition
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.telemetry.alarms.definitions import QUANTITIES

INPUTS = "inputs"
"""Key of the measured quantities in the saved state."""
SILENCE = "silence"
"""Key of the reason why no samples arrived, in the saved state."""
PENDING = "pending"
"""Key of the critical alarms whose delay runs, in the saved state."""
PROBES = "probes"
"""Key of the number of temperature probes, in the saved state. All keys but these four are names of alarms."""


class SavedState(NamedTuple):
    """Decoded state of an earlier run."""

    raised: dict[AlarmName, dict[str, float | bool]]
    """Fields of dtype ``ALARM`` of each raised alarm."""
    raised_critical: list[AlarmName]
    """Names of the raised critical alarms. New settings or another version may no longer monitor them."""
    pending: list[AlarmName]
    """Names of the critical alarms whose delay ran."""
    counts: dict[Quantity, tuple[int, bool]]
    """Largest number of values in a sample, and True if lost, by quantity."""
    silence_reason: str
    """Reason why no samples arrived; empty if they did."""
    probes: int
    """Largest number of temperature probes in a sample."""


def encode(
    record: np.void,
    definitions: Mapping[int, AlarmDefinition],
    pending: Sequence[AlarmName],
    silence_reason: str,
    probes: int,
) -> str:
    """Return a state as JSON; empty if there is nothing to restore.

    Args:
        record: State of the alarms, dtype ``ALARMS``.
        definitions: Definition of each monitored alarm by its position.
        pending: Critical alarms whose delay runs.
        silence_reason: Reason why no samples arrive; empty while they arrive.
        probes: Largest number of temperature probes in a sample.
    """
    saved: dict[str, Any] = {}
    for k, definition in definitions.items():
        state = record["states"][k]
        if state["raised"]:
            saved[definition.name] = {
                "since_s": float(state["since_s"]),
                "value": None if math.isnan(state["value"]) else float(state["value"]),
                "gone": bool(state["cause_cleared"]),
                "acknowledged": bool(state["acknowledged"]),
                "severity": definition.severity,
            }
    quantities = record["quantities"]
    counts = zip(QUANTITIES, quantities["max_count"].tolist(), quantities["lost"].tolist(), strict=True)
    if inputs := {name: [count, bool(lost)] for name, count, lost in counts if count or lost}:
        saved[INPUTS] = inputs
    if silence_reason:
        saved[SILENCE] = silence_reason
    if pending:
        saved[PENDING] = list(pending)
    if probes > 1:
        saved[PROBES] = probes
    return json.dumps(saved) if saved else ""


def decode(saved: str, series: int) -> SavedState:
    """Decode a state for a pack that now has ``series`` cells in series, perhaps fewer than before.

    Raises:
        ValueError, TypeError, LookupError, AttributeError, ArithmeticError, OSError: The saved state is damaged.
    """
    text = json.dumps(json.loads(saved or "{}"), ensure_ascii=False)
    entries = json.loads(text.encode(errors="replace"))  # a lone surrogate could not be published
    inputs, counts = entries.pop(INPUTS, {}), dict[Quantity, tuple[int, bool]]()
    for quantity in QUANTITIES:
        max_count, lost = inputs.get(quantity, (0, False))
        if not isinstance(max_count, int) or max_count < 0 or not isinstance(lost, bool):
            raise ValueError(f"{quantity}: measured = {max_count}, lost = {lost}")
        counts[quantity] = min(max_count, series if quantity == "cells" else 1), lost
    silence_reason, probes = str(entries.pop(SILENCE, "")), int(entries.pop(PROBES, 0))
    pending = list(entries.pop(PENDING, []))
    raised = {name: _decode_alarm(name, entry) for name, entry in entries.items()}
    # a former version saved no severity
    critical = [name for name, entry in entries.items() if entry.get("severity", "critical") == "critical"]
    return SavedState(raised, critical, pending, counts, silence_reason, probes)


def _decode_alarm(name: str, entry: Any) -> dict[str, float | bool]:
    """Return the fields of a raised alarm; ``decode`` describes the exceptions."""
    since_s, value, flags = float(entry["since_s"]), entry["value"], (entry["gone"], entry["acknowledged"])
    iso_utc(since_s)  # raises ValueError for a time that cannot be published
    if value is not None and not math.isfinite(value):
        raise ValueError(f"{name}: value = {value}")
    if not all(isinstance(flag, bool) for flag in flags):
        raise TypeError(f"{name}: gone, acknowledged = {flags}")
    return {
        "raised": True,
        "since_s": since_s,
        "value": math.nan if value is None else float(value),
        "cause_cleared": flags[0],
        "acknowledged": flags[1],
    }
