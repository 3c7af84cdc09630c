"""Faults of the input that raise the alarm ``sensor_fault``, with stable texts."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

from bms_estimator.settings.alarm_kinds import Quantity

FaultyInput = Quantity | Literal["time"]
"""Faulty quantity of the samples."""


class _Fault(NamedTuple):
    kind: str
    text: str


class InputFaults:
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

    def update(self, *, keep: bool) -> bool:
        """Begin the next interval. Return True if the last one had a fault.

        Args:
            keep: True: keep the texts of faults that have ended.
        """
        present, self._present = self._present, set()
        if not keep:
            self._faults = {name: fault for name, fault in self._faults.items() if name in present}
        return bool(present)

    @property
    def texts(self) -> Mapping[FaultyInput, str]:
        """Description of each fault, by quantity."""
        return {name: fault.text for name, fault in self._faults.items()}
