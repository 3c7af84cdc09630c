"""Sources: the samples that reach the estimator, made from the true values."""

from dataclasses import dataclass

import numpy as np

from bms_estimator.model.arrays import SAMPLE, Floats, SampleBlock, SampleStatus
from bms_estimator.settings.observer import Sampling
from tests.estimator.month.topics import Topics, paired


@dataclass(frozen=True)
class Source:
    """Errors and resolution of a source."""

    name: str
    step_s: float = 1.0
    volt_step: float = 1e-3
    volt_noise_std: float = 1e-3
    ampere_step: float = 0.0
    """Resolution of the current [A]; 0: exact."""
    dead_band_a: float = 0.0
    """Magnitude below which the source reports a current of 0 [A]."""
    offset_a: float = 0.0
    """Magnitude of the offset of the current; its sign is random [A]."""
    voltage_gain: float = 1.0
    """Measured voltage divided by the true voltage."""
    current_gain: float = 1.0
    """Measured current divided by the true current."""
    voltage_gain_std: float = 0.001
    """Std of the voltage's gain that the owner configures; default: that of a calibrated board."""
    current_gain_std: float = 0.001
    """Std of the current's gain that the owner configures."""
    voltage_period_s: float = 0.0
    """Time between two voltages that come on a topic of their own [s]; 0: a voltage in each sample."""
    topics: Topics | None = None
    """Topics of voltage and current, if they are measured at different times."""
    fast_day: int = 0
    """Number of the day on which a board delivers 100 samples a second; 0: none."""

    @property
    def sampling(self) -> Sampling:
        """Sampling that the owner configures."""
        period_s = self.topics.interval_s if self.topics else self.step_s
        return Sampling(period_s, self.ampere_step, self.dead_band_a, self.voltage_gain_std, self.current_gain_std)


BOARD = Source("board")
"""Measuring board with this project's firmware, at one sample a second."""
SLOW_BOARD = Source("board, 10 s", step_s=10.0)
"""The same board at one sample in ten seconds."""
FAST_BOARD = Source("board, 100 Hz on day 2", fast_day=2)
"""Measuring board whose samples have the firmware's rate on one day. Weeks at 100 Hz would take too long."""
BMS_GAINS = {"voltage_gain_std": 0.005, "current_gain_std": 0.005}
"""Default of the service for a BMS."""
BMS = Source("bms", volt_step=0.01, volt_noise_std=0.0, ampere_step=0.1, **BMS_GAINS)
"""BMS with coarse steps, of one cell."""
SPLIT = Source("split", voltage_period_s=10.0, **BMS_GAINS)
"""Voltage and current on separate topics."""
SKEWED = Source("5 s skewed", topics=Topics(current_shift_s=5.0), **BMS_GAINS)
"""Voltage and current on separate topics each 10 s, with 5 s between them."""
MINUTE_SKEWED = Source(
    "30 s skewed",
    topics=Topics(voltage_period_s=60.0, current_period_s=60.0, current_shift_s=30.0, interval_s=60.0),
    **BMS_GAINS,
)
"""Zigbee meter that reports voltage and current each minute, with 30 s between them."""
CHANGES = Source(
    "changes",
    topics=Topics(
        voltage_period_s=60.0,
        current_period_s=60.0,
        current_shift_s=30.0,
        dead_band_v=0.01,
        dead_band_a=0.05,
        interval_s=60.0,
    ),
    **BMS_GAINS,
)
"""The same meter if it reports only changes, or a value after ten minutes."""
SOLAR = Source("solar", step_s=10.0, ampere_step=0.01, dead_band_a=0.1, offset_a=0.03, **BMS_GAINS)
"""Charge controller of a solar system, for some tens of ampere-hours. Steps of 10 mV of 16 cells in series are below 1 mV
of one cell."""


def measure(source: Source, history: np.ndarray, rng: np.random.Generator) -> SampleBlock:
    """Return the samples of the seen part of a history, dtype ``SAMPLE``."""
    samples = np.zeros(history.size, dtype=SAMPLE)
    samples["time_s"], samples["temperature_c"] = history["time_s"], history["temperature_c"]
    current_a = source.current_gain * history["current_a"] + source.offset_a * rng.choice((-1.0, 1.0))
    current_a[np.abs(current_a) < source.dead_band_a] = 0.0
    samples["current_a"] = rounded(current_a, source.ampere_step)
    noise_v = source.volt_noise_std * rng.standard_normal(history.size)
    samples["voltage_v"] = rounded(source.voltage_gain * history["voltage_v"] + noise_v, source.volt_step)
    if source.voltage_period_s:
        samples = pair_with_last_voltage(samples, round(source.voltage_period_s / source.step_s))
    seen: SampleBlock = samples[history["is_seen"]]
    return paired(source.topics, seen) if source.topics else seen


def rounded(values: Floats, step: float) -> Floats:
    """Return the values in whole steps; a step of 0 changes nothing."""
    return np.round(values / step) * step if step else values


def pair_with_last_voltage(samples: SampleBlock, period: int) -> SampleBlock:
    """Return samples of which one in ``period`` has a new voltage. The others repeat the last one and are marked as held."""
    last = np.arange(samples.size) // period * period
    samples["voltage_v"] = samples["voltage_v"][last]
    samples["status"][last != np.arange(samples.size)] = SampleStatus.VOLTAGE_HELD
    return samples
