"""Faults that raise the alarm ``sensor_fault``: of the input, of temperature probes, and repeated resets of the board."""

from collections import deque
from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np

from bms_estimator.model.sample import ProbeBlock, SampleBlock, SampleStatus
from bms_estimator.settings.alarm_kinds import Quantity

FaultyInput = Quantity | Literal["time"]
"""Faulty quantity of the samples."""
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
