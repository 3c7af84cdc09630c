"""Faulty temperature probes since the last evaluation of the alarms, as text."""

import numpy as np

from bms_estimator.model.sample import ProbeBlock, SampleBlock, SampleStatus

REMEDY = "a temperature probe is broken or loose, or far from the others: check it"
"""Fault and remedy."""


class ProbeFaults:
    """Collector of the faults of temperature probes."""

    def __init__(self) -> None:
        self._is_faulty, self._readings_c = False, dict[int, float]()

    def add(self, samples: SampleBlock, probes: ProbeBlock) -> None:
        """Add samples and their probes, which may be empty."""
        if not (samples["status"] & SampleStatus.PROBE_FAULT).any():
            return
        self._is_faulty = True
        for row, column in np.argwhere(probes["faulty"]).tolist():
            self._readings_c[column + 1] = float(probes[row, column]["temperature_c"])

    def take(self) -> str:
        """Return the faulty probes with their last readings as one sentence, and forget them; empty without any.

        The sentence names no probe if the samples were received without a list of their probes.
        """
        is_faulty, readings_c = self._is_faulty, self._readings_c
        self._is_faulty, self._readings_c = False, {}
        if not is_faulty:
            return ""
        names = ", ".join(
            f"probe {number} reads {reading_c:.4g} °C" for number, reading_c in sorted(readings_c.items())
        )
        return f"{names}: {REMEDY}" if names else REMEDY
