"""Correction of measured voltages and currents, from a comparison with a multimeter."""

from typing import NamedTuple

from bms_estimator.model.arrays import SampleBlock


class SensorCorrection(NamedTuple):
    """Gains of voltage and current, and the zero of the current."""

    voltage_gain: float = 1.0
    """True voltage / measured voltage."""
    current_gain: float = 1.0
    """True current / measured current without its zero."""
    current_zero_a: float = 0.0
    """Measured current while no current flows, positive on discharge [A]."""

    def apply(self, block: SampleBlock) -> SampleBlock:
        """Correct the samples of a block in place, and return the block. The default correction changes no bit."""
        if self != EXACT:
            block["voltage_v"] *= self.voltage_gain
            block["current_a"] = self.current_gain * (block["current_a"] - self.current_zero_a)
        return block


EXACT = SensorCorrection()
"""Correction of an exact sensor."""
