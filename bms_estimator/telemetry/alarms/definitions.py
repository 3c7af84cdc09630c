"""Definitions of a pack's alarms as records of the kernels, the kernel with its buffers, the saved state, and messages."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple, Self, get_args

import numpy as np

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.kernels.alarms.evaluate import evaluate
from bms_estimator.kernels.alarms.quantities import BROKEN_WIRE_V
from bms_estimator.kernels.alarms.records import EVALUATION_IO, LIMITS, LOG, NAMES, SAMPLE_ALARMS, SETTINGS
from bms_estimator.model.arrays import CellBlock, Floats, Records, SampleBlock
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.pack_model import PackModel
from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.settings.alarm_kinds import Quantity
from bms_estimator.settings.alarm_limits import AlarmDefinition, min_charge_current_a, voltage_limits
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.impossible import PackBounds


class RaisedAlarm(NamedTuple):
    """Time and value at which an alarm was raised."""

    since_s: float
    """Time on the wall clock at which the alarm was raised [s since 1970]."""
    value: float | None
    """Value in the unit of the alarm; None if the alarm has no number."""


LATCHED = "the cause is gone; acknowledge it (request acknowledge_alarm if mqtt.commands lists it, or SIGUSR1 to the service) to end it: "
"""Prefix of the text of a latched alarm."""
CAUSE_FIRST: tuple[AlarmName, ...] = ("sensor_fault", "link_lost")
"""Alarms whose cause stands before their general text, which fits many causes and would hide it."""


def alarm_text(alarm: AlarmDefinition, value: float | None, reasons: Sequence[str], *, cause_cleared: bool) -> str:
    """Return one or two sentences: the fault and its remedy.

    Args:
        alarm: The alarm.
        value: Value when the alarm was raised, in the unit of the alarm; None without a number.
        reasons: Other causes, one sentence each.
        cause_cleared: True if the cause is gone but the alarm is latched.
    """
    factor, unit = (100.0, " %") if alarm.kind.is_fraction else (1.0, f" {alarm.kind.unit}" if alarm.kind.unit else "")
    numbers = "" if value is None else f": {factor * value:.4g}{unit}, limit {factor * alarm.limit:.4g}{unit}"
    text = f"{alarm.kind.fault}{numbers}; {alarm.kind.remedy}"
    texts = (*reasons, text) if alarm.name in CAUSE_FIRST else (text, *reasons)
    return (LATCHED if cause_cleared else "") + "; ".join(texts)


class Change(NamedTuple):
    """Change of an alarm: raised, ended, no longer watched, or watched again."""

    at_s: float
    """Time on the samples' clock [s]."""
    alarm: Alarm
    field: Literal["active", "watched"] = "active"
    """Field of ``alarm`` that has changed."""


class AlarmMessage(NamedTuple):
    """Changing content of an alarm's payload."""

    raised: RaisedAlarm | None
    """Time and value of an active alarm; None if inactive."""
    cause_cleared: bool
    """True if the cause is gone but the alarm is latched."""
    reasons: tuple[str, ...]
    """Causes, one sentence each."""
    unwatched_reason: str | None
    """Reason why the alarm cannot be watched; None while it is watched."""
    unknown_reason: str | None
    """Reason why the value of the alarm is not known; None while it is known."""


def alarm_payload(definition: AlarmDefinition, message: AlarmMessage) -> Alarm:
    """Return the payload of an alarm."""
    raised, value = message.raised, message.raised.value if message.raised else None
    text = alarm_text(definition, value, message.reasons, cause_cleared=message.cause_cleared) if raised else ""
    return Alarm(
        name=definition.name,
        severity=definition.severity,
        active=raised is not None,
        latched=message.cause_cleared,
        since=iso_utc(raised.since_s) if raised else None,
        value=value,
        limit=definition.limit,
        unit=definition.kind.unit,
        text=text,
        watched=message.unwatched_reason is None,
        unwatched_reason=message.unwatched_reason,
        unknown_reason=message.unknown_reason,
    )


QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
"""All measured quantities, by their positions in the kernels."""
SENSOR_SUSPECTS = (
    InputFault.SIGN_OF_CURRENT | InputFault.OFFSET | InputFault.OUTLIERS | InputFault.VOLTAGE | InputFault.CURRENT
)
"""Input faults that raise ``sensor_fault``."""
MODEL_SUSPECTS = InputFault.CAPACITY | InputFault.OCV
"""Input faults that raise ``model_mismatch``."""
UNKNOWN_RISK = np.full(1, np.nan)
"""Probability of a cut-off for a pack without forecasts."""
_MAX_CHANGES_PER_SAMPLE = len(NAMES)
"""Maximum number of changes by a sample and its estimate."""


class AlarmDefinitions(NamedTuple):
    """Alarms of a pack."""

    by_position: dict[int, AlarmDefinition]
    """Definition of each monitored alarm by its position in ``NAMES``."""
    limits: Records
    """Shape (number of ``NAMES``,), dtype ``LIMITS``."""
    settings: Records
    """Shape (1,), dtype ``SETTINGS``."""
    bounds: PackBounds

    @classmethod
    def of(cls, definitions: Iterable[AlarmDefinition], settings: Settings, model: PackModel, gap_s: float) -> Self:
        """Return the definitions for settings and model of a whole pack.

        Args:
            definitions: The monitored alarms.
            settings: Settings of the pack.
            model: Model of the whole pack.
            gap_s: Minimum length of a gap between samples [s].
        """
        by_position = {NAMES.index(each.name): each for each in definitions}
        limits, bounds = np.zeros(len(NAMES), LIMITS), PackBounds.of(model)
        for k, each in by_position.items():
            needs = sum(1 << QUANTITIES.index(name) for name in each.kind.needs)
            sign = 1.0 if each.kind.is_upper_limit else -1.0
            numbers = (each.limit, each.clear, each.delay_s, each.clear_delay_s)
            limits[k] = (1, each.severity == "critical", sign, *numbers, needs, each.latch)
        limit_of = {each.name: each.limit for each in by_position.values()}
        broken_v, n = BROKEN_WIRE_V * bounds.series, bounds.series
        values: dict[str, Any] = {
            "gap_s": gap_s,
            "lost_s": settings.alarms.lost_s,
            "charging_a": min_charge_current_a(model),
            "series": n,
            "max_a": bounds.max_a,
            "range_a": bounds.range_a,
            "low_v": bounds.range_v[0],
            "high_v": bounds.range_v[1],
            "wire_v": limit_of.get("pack_under_voltage", broken_v),
            "wire_low_cell_v": limit_of.get("cell_under_voltage", BROKEN_WIRE_V),
            "wire_high_cell_v": limit_of.get("cell_over_voltage", np.inf),
            "steep_v": voltage_limits(model).steep_v,
            "sensor_suspects": int(SENSOR_SUSPECTS),
            "model_suspects": int(MODEL_SUSPECTS),
        }
        record = np.zeros(1, SETTINGS)
        for name, value in values.items():
            record[name] = value
        return cls(by_position, limits, record, bounds)


class EvaluationKernel:
    """Kernel that evaluates the alarms, with its buffers.

    Attributes:
        io: Further inputs of the kernel, and its results, shape (1,), dtype ``EVALUATION_IO``.
        log: Buffer of the changes, dtype ``LOG``; ``entries`` returns those since the last call of ``clear``.
    """

    def __init__(self) -> None:
        self.io, self.log = np.zeros(1, EVALUATION_IO), np.zeros(_MAX_CHANGES_PER_SAMPLE, LOG)
        for name in ("cells_at_s", "short_a", "reading_v", "weak_cell_std"):
            self.io[name] = np.nan
        self._scratch = np.zeros((6, SAMPLE_ALARMS))  # rows that the kernel requires

    def run(
        self,
        alarms: Records,
        definitions: AlarmDefinitions,
        estimator: Records,
        samples: SampleBlock,
        cells_v: CellBlock,
        trace: TraceBlock,
        cutoff_risk: Floats = UNKNOWN_RISK,
    ) -> bool:
        """Evaluate all alarms with buffers that are long enough.

        ``kernels.alarms.evaluate`` describes arguments and result.
        """
        if self._scratch.shape[1] < samples.size:
            self._scratch = np.zeros((6, samples.size))
        rows = int(self.io["logged"][0]) + _MAX_CHANGES_PER_SAMPLE * (
            samples.size + 1
        )  # + 1: alarms evaluated once a call
        if self.log.size < rows:
            self.log = np.concatenate((self.entries, np.empty(rows, LOG)))
        return evaluate(
            alarms,
            definitions.limits,
            definitions.settings,
            self.io,
            estimator,
            samples,
            np.ascontiguousarray(cells_v),
            trace,
            cutoff_risk,
            self._scratch,
            self.log,
        )

    @property
    def entries(self) -> Records:
        """Changes since the last call of ``clear``, oldest first, dtype ``LOG``."""
        return self.log[: int(self.io["logged"][0])]

    def clear(self) -> None:
        """Remove all changes."""
        self.io["logged"] = 0


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
