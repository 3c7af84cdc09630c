"""Causes of alarms: suspected and impossible inputs, faults of cells, losses of measured quantities, and unknown values."""

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from bms_estimator.model.arrays import ProbeBlock, SampleBlock, SampleStatus
from bms_estimator.model.input_faults import InputFault
from bms_estimator.settings.alarm_kinds import ALARM_KINDS, Quantity
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.telemetry.alarms.definitions import AlarmMessage, RaisedAlarm
from bms_estimator.telemetry.cells import NO_FAULTY_CELL, CellAlarmInput
from bms_estimator.telemetry.state import UNKNOWN_SOC, missing_margin_reason

FaultyInput = Quantity | Literal["time", "publishers"]
"""Faulty quantity of the samples, or a fault of whole samples: their time stamps, or two publishers."""
PROBE_TEXT = "a temperature probe is broken, loose or missing, or far from the others: check it"
"""Fault of temperature probes, and its remedy."""
WRONG_CLOCK_TEXT = "the clock of the source runs at a wrong rate, and the arrival times are used instead"
"""Description of a clock fault that ended before the end of its block."""
RESET_WINDOW_S = 1800.0
"""Time within which resets count as repeated [s]. It covers three resets at the longest waiting time of the relay."""
MIN_RESETS = 3
"""Number of resets within ``RESET_WINDOW_S`` that raise the alarm. A cable that is plugged in again causes one."""
RESETS_TEXT = f"the board was reset at least {MIN_RESETS} times within {RESET_WINDOW_S / 60:.0f} min; check its supply and its cable"
"""Description of repeated resets, and the remedy."""


class _Fault(NamedTuple):
    kind: str
    text: str


class FaultTexts:
    """Faults by quantity. The text of a fault changes only with its kind, because its numbers change often."""

    def __init__(self) -> None:
        self._faults: dict[FaultyInput, _Fault] = {}
        self._present: set[FaultyInput] = set()

    def add(self, name: FaultyInput, kind: str, text: str) -> None:
        """Add a fault of the present interval.

        Args:
            name: Faulty quantity.
            kind: Kind of the fault.
            text: Description with numbers, a sentence.
        """
        self._present.add(name)
        if name not in self._faults or self._faults[name].kind != kind:
            self._faults[name] = _Fault(kind, text)

    def end_interval(self, *, keep: bool) -> None:
        """Begin the next interval.

        Args:
            keep: True: keep the texts of faults that have ended.
        """
        present, self._present = self._present, set()
        if not keep:
            self._faults = {name: fault for name, fault in self._faults.items() if name in present}

    @property
    def texts(self) -> Mapping[FaultyInput, str]:
        """Description of each fault, by quantity."""
        return {name: fault.text for name, fault in self._faults.items()}


class ProbeFaults:
    """Faulty and missing temperature probes since the last evaluation of the alarms.

    Attributes:
        expected: Largest number of probes in a sample so far. Samples with fewer probes have a missing one.
    """

    def __init__(self) -> None:
        self.expected = 0
        self._is_faulty, self._readings_c = False, dict[int, float]()

    def add(self, samples: SampleBlock, probes: ProbeBlock) -> SampleBlock:
        """Add samples and their probes, which may be empty. Return the samples with ``PROBE_FAULT`` also for missing probes."""
        if probes.size:
            present = np.count_nonzero(np.isfinite(probes["temperature_c"]), axis=1)
            expected = np.maximum.accumulate(np.maximum(present, self.expected))
            self.expected = int(expected[-1])
            # without any probe the whole temperature is missing, which is not a fault of probes
            missing = (present > 0) & (present < expected)
            if missing.any():
                samples = samples.copy()
                samples["status"] |= np.where(missing, SampleStatus.PROBE_FAULT, 0).astype(samples["status"].dtype)
        if not (samples["status"] & SampleStatus.PROBE_FAULT).any():
            return samples
        self._is_faulty = True
        for row, column in np.argwhere(probes["faulty"]).tolist():
            self._readings_c[column + 1] = float(probes[row, column]["temperature_c"])
        return samples

    def take(self) -> str:
        """Return and clear the faulty probes, as one sentence with their last readings; empty if there are none.

        The sentence names no probe if the samples were received without a list of their probes.
        """
        is_faulty, readings_c = self._is_faulty, self._readings_c
        self._is_faulty, self._readings_c = False, {}
        if not is_faulty:
            return ""
        names = ", ".join(
            f"probe {number} reads {reading_c:.4g} °C" for number, reading_c in sorted(readings_c.items())
        )
        return f"{names}: {PROBE_TEXT}" if names else PROBE_TEXT


class BoardResets:
    """Times of the last resets of the sensor board."""

    def __init__(self) -> None:
        self._resets = 0
        self._times_s = deque[float](maxlen=MIN_RESETS)

    def update(self, resets: int, now_s: float) -> str:
        """Return ``RESETS_TEXT`` while resets are repeated, otherwise an empty text.

        Args:
            resets: Number of resets since start.
            now_s: Monotonic clock [s].
        """
        self._times_s.extend([now_s] * min(resets - self._resets, MIN_RESETS))
        self._resets = resets
        is_repeated = len(self._times_s) == MIN_RESETS and now_s - self._times_s[0] < RESET_WINDOW_S
        return RESETS_TEXT if is_repeated else ""


LOSS_TEXTS: dict[FaultyInput, str] = {
    "voltage": "the voltage is no longer measured",
    "current": "the current is no longer measured",
    "temperature": "the temperature is no longer measured",
    "cells": "cell voltages are missing that were measured before",
}
"""Description of the loss, by quantity."""


class Causes:
    """Causes of the alarms of one pack.

    Attributes:
        input_faults: Faults of the input that ``sensor_fault`` describes.
        board_fault: Reason why the board's resets raise ``sensor_fault``; empty if they do not.
        unwatched: Alarms that cannot be watched, each with the reason.
        unknown: Alarms whose value is not known, each with the reason.
    """

    def __init__(self) -> None:
        self.input_faults, self.board_fault = FaultTexts(), ""
        self.unwatched: Mapping[AlarmName, str] = {}
        self.unknown: Mapping[AlarmName, str] = {}
        self._lost: tuple[Quantity, ...] = ()
        self._texts: dict[AlarmName, tuple[str, ...]] = {}
        self._suspects: dict[AlarmName, InputFault] = {}  # faults that the text of an alarm describes
        self._faulty_cells: dict[AlarmName, CellAlarmInput] = {}

    @property
    def has_suspects(self) -> bool:
        """True if the causes of an alarm are suspected faults."""
        return any(self._suspects.values())

    def set_texts(self, name: AlarmName, *texts: str) -> None:
        """Replace the causes of an alarm, one sentence each."""
        self._texts[name] = texts

    def set_suspects(
        self, name: AlarmName, suspects: InputFault, suspicions: Callable[[], Sequence[str]], *, is_raised: bool
    ) -> None:
        """Replace the causes of an alarm by the texts of suspected faults if their set has changed.

        The numbers in the texts may change each second and are therefore not compared.

        Args:
            name: Name of the alarm.
            suspects: Input faults that the filter suspects now and that raise this alarm.
            suspicions: Returns all suspected faults, one sentence each.
            is_raised: True if the alarm is raised.
        """
        if suspects != self._suspects.get(name, InputFault(0)) and (suspects or not is_raised):
            self._suspects[name] = suspects
            self._texts[name] = suspect_texts(suspects, suspicions())

    def set_cell_fault(self, name: AlarmName, fault: CellAlarmInput, *, is_raised: bool) -> None:
        """Replace the causes of an alarm by faults of single cells.

        The text of a raised alarm changes only with the kinds of its faults, because its numbers change often.
        """
        described = self._faulty_cells.get(name, NO_FAULTY_CELL)
        if not is_raised or (fault.kinds and fault.kinds != described.kinds):
            self._texts[name], self._faulty_cells[name] = fault.texts, fault

    def set_unwatched(self, names: Iterable[AlarmName], lost: tuple[Quantity, ...], silence_reason: str) -> None:
        """Replace the alarms that cannot be watched.

        Args:
            names: Names of these alarms.
            lost: Lost quantities.
            silence_reason: Reason why no samples arrive; empty while they arrive.
        """
        self._lost, texts = lost, self._loss_texts
        reasons = {}
        for name in names:
            missing = "; ".join(texts[each] for each in ALARM_KINDS[name].needs if each in lost)
            # an alarm that waits for the end of its delay keeps its reason
            reasons[name] = missing or silence_reason or self.unwatched.get(name, "")
        self.unwatched = reasons

    def message(self, name: AlarmName, raised: RaisedAlarm | None, *, cause_cleared: bool) -> AlarmMessage:
        """Return the changing content of the payload of an alarm."""
        reasons = self._texts.get(name, ())
        if name == "sensor_fault":
            faults = (text for quantity, text in self.input_faults.texts.items() if quantity not in self._lost)
            board = (self.board_fault,) if self.board_fault else ()
            reasons = (*(self._loss_text(each) for each in self._lost), *faults, *board, *reasons)
        return AlarmMessage(
            raised,
            cause_cleared=cause_cleared,
            reasons=reasons,
            unwatched_reason=self.unwatched.get(name),
            unknown_reason=self.unknown.get(name),
        )

    @property
    def _loss_texts(self) -> Mapping[FaultyInput, str]:
        return LOSS_TEXTS | dict(self.input_faults.texts)

    def _loss_text(self, quantity: Quantity) -> str:
        """Describe a lost quantity and the unwatched alarms that need it."""
        names = ", ".join(name for name in self.unwatched if quantity in ALARM_KINDS[name].needs)
        text = self._loss_texts[quantity]
        return f"{text}: {names} cannot be raised" if names else text


def suspect_texts(suspects: InputFault, suspicions: Sequence[str]) -> tuple[str, ...]:
    """Return the suspicions that describe ``suspects``. Each suspicion ends in the text of its fault."""
    return tuple(text for text in suspicions for suspect in suspects if text.endswith(suspect.text))


def find_unknown(row: np.void, *, soc_known: bool) -> dict[AlarmName, str]:
    """Return the alarms whose value is not known although the quantities that they need are measured, each with the reason.

    A fuel cell has no such alarm, because it has no SOC. The probability of ``collapse_risk`` includes the uncertainty of the
    SOC.

    Args:
        row: The last estimate, dtype TRACE.
        soc_known: True if its SOC is known.
    """
    if math.isnan(row["soc"]):
        return {}
    reasons: dict[AlarmName, str | None] = {
        "soc_low": None if soc_known else UNKNOWN_SOC,
        "stability_margin_low": missing_margin_reason(row, soc_known=soc_known),
    }
    return {name: reason for name, reason in reasons.items() if reason}


def time_left_text(forecast: np.void) -> str:
    """Return a sentence with the 90 % band of the time to the cut-off, from a record of FORECAST."""
    early_min, late_min = (float(forecast[f"time_to_cutoff_{name}_s"]) / 60.0 for name in ("p05", "p95"))
    return f"the time left was {early_min:.0f} to {late_min:.0f} min (90 % band) when the alarm was raised"
