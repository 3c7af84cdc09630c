"""Simulated divider, current sensor, NTC and 10-bit converter of the board."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FULL_SCALE = 1024
"""Number of steps of the 10-bit converter."""
CLOCK_HZ = 16_000_000
"""Clock of the microcontroller [Hz]."""
AUX_PER_S = 100
"""Number of NTC and bandgap readings of the firmware per second, if the sample rate allows this number."""
AUX_MAX = 63
"""Maximum number of NTC or bandgap readings in one window, because the firmware sends their sum in 16 bits."""
CONVERSIONS_PER_S = 8000
"""Number of conversions of the firmware per second, alternately of voltage and current."""
RATIOMETRIC_V = 5.0
"""Supply at which the data sheet of a ratiometric sensor gives its slope [V]."""
_NOISE_POINTS = 1 << 16
"""Number of noise values, which are repeated: random numbers for each conversion would be slow."""


class Reading(NamedTuple):
    """True values at the sensors; current positive on discharge, temperature NaN without an NTC."""

    current_a: float
    voltage_v: float
    temperature_c: float = math.nan


class Sums(NamedTuple):
    """Sums of the conversions of one window."""

    voltage: int
    current: int
    pairs: int
    voltage_saturated: bool
    current_saturated: bool


@dataclass(frozen=True)
class BoardParts:
    """Parts of the board as built; the defaults are those of the firmware."""

    supply_v: float = 5.0
    """AVcc, the converter's reference, which the host does not know [V]."""
    bandgap_v: float = 1.1
    """Voltage of the internal reference [V]."""
    divider: float = 6.1
    """Ratio of the pack's voltage to the voltage at the converter."""
    volts_per_ampere: float = 0.1
    """Slope of a ratiometric sensor at 5 V of supply [V/A]."""
    ratiometric: bool = True
    """True if the current sensor is supplied with AVcc, so that its slope is proportional to AVcc."""
    current_zero: float = 0.5
    """Output of the current sensor without current, as a fraction of the supply."""
    ntc_series_ohm: int = 10_000
    ntc_r25_ohm: int = 10_000
    ntc_beta_k: int = 3950

    @property
    def fraction_per_ampere(self) -> float:
        """Slope of the current sensor as a fraction of the supply [1/A]."""
        return self.volts_per_ampere / (RATIOMETRIC_V if self.ratiometric else self.supply_v)


class VirtualConverter:
    """Simulated converter. As in the firmware, the conversions of 10 bits are summed over a window.

    Args:
        parts: The board as built.
        noise_lsb: Standard deviation of a conversion [steps of the converter].
        seed: Seed of the noise.
    """

    def __init__(self, parts: BoardParts, noise_lsb: float, seed: int) -> None:
        self.parts = parts
        self._noise = np.random.default_rng(seed).normal(0.0, noise_lsb, _NOISE_POINTS) if noise_lsb else None
        self._cursor = 0

    def window(self, reading: Reading, count: int) -> Sums:
        """Return the sums of ``count`` pairs of conversions."""
        parts = self.parts
        voltage = self.convert(reading.voltage_v / parts.divider / parts.supply_v, count)
        current = self.convert(parts.current_zero + reading.current_a * parts.fraction_per_ampere, count)
        return Sums(
            int(voltage.sum()),
            int(current.sum()),
            count,
            bool(voltage.max() == FULL_SCALE - 1),
            bool(current.max() == FULL_SCALE - 1 or current.min() == 0),
        )

    def bandgap(self, count: int) -> int:
        """Return the sum of ``count`` conversions of the internal reference."""
        return int(self.convert(self.parts.bandgap_v / self.parts.supply_v, count).sum())

    def ntc(self, temperature_c: float, count: int) -> int:
        """Return the sum of ``count`` conversions of the NTC, or of an open input for a temperature of NaN."""
        if math.isnan(temperature_c):
            return count * (FULL_SCALE - 1)
        parts = self.parts
        r_ohm = parts.ntc_r25_ohm * math.exp(parts.ntc_beta_k * (1.0 / (temperature_c + 273.15) - 1.0 / 298.15))
        return int(self.convert(r_ohm / (r_ohm + parts.ntc_series_ohm), count).sum())

    def convert(self, fraction_of_reference: float, count: int) -> NDArray[np.float64]:
        """Return ``count`` conversions of a voltage, given as a fraction of the reference."""
        steps: NDArray[np.float64] = np.full(count, fraction_of_reference * FULL_SCALE)
        if self._noise is not None:
            if self._cursor + count > _NOISE_POINTS:
                self._cursor = 0
            steps += self._noise[self._cursor : self._cursor + count]
            self._cursor += count
        return np.clip(np.rint(steps), 0, FULL_SCALE - 1)


def compute_window(rate_hz: int) -> tuple[int, int]:
    """Return the number of conversion pairs in a window, and the length of the window [ns].

    The firmware divides its clock, so that a conversion takes a whole number of clock cycles.
    """
    conversions = CONVERSIONS_PER_S // rate_hz // 2 * 2  # an even number, because they come in pairs
    cycles = round(CLOCK_HZ / (rate_hz * conversions))
    return conversions // 2, conversions * cycles * 1_000_000_000 // CLOCK_HZ


def compute_aux_count(rate_hz: int) -> int:
    """Return the number of NTC or bandgap readings in one window: odd, as in the firmware."""
    readings = AUX_PER_S // rate_hz
    return 1 if readings == 0 else min((readings - 1) | 1, AUX_MAX)  # the largest odd number up to ``readings``
