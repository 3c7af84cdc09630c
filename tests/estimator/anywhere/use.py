"""Currents of a cell in use for hours and days, at 1 Hz."""

import numpy as np

from bms_estimator.model.arrays import Floats

LEVEL_S = 20.0
"""Mean duration of a level of the current [s]."""
DAY_S = 86400
"""Seconds of a day."""
EMPTY_SOC = 0.12
"""SOC at which the user ends a drive."""


def drive(rng: np.random.Generator, one_c: float, mean_c: float, seconds: int) -> Floats:
    """Return a current of random levels of some seconds, with stops and some regeneration [A].

    ``one_c`` is the current of 1 C [A], and ``mean_c`` the mean of the levels [C].
    """
    level_c = np.clip(rng.normal(mean_c, 0.9 * mean_c + 0.1, seconds), -0.5, 3.0)
    level_c[rng.random(seconds) < 0.15] = 0.0
    return one_c * np.repeat(level_c, rng.exponential(LEVEL_S, seconds).astype(int) + 2)[:seconds]


def charge(one_c: float, rate_c: float, soc: float) -> Floats:
    """Return the current of a charge with ``rate_c`` that increases the SOC by ``soc`` [A]."""
    return np.full(round(3600.0 * soc / rate_c), -rate_c * one_c)


def cycles(rng: np.random.Generator, one_c: float, count: int, by_soc: float, rest_s: int) -> Floats:
    """Return the current of ``count`` cycles of a drive that lowers the SOC by ``by_soc``, a rest, a charge at C/2 and a rest [A]."""
    parts = []
    for _ in range(count):
        down = drive(rng, one_c, 0.5, 20000)  # longer than needed
        down = down[: 1 + int(np.argmax(np.cumsum(down) >= 3600.0 * by_soc * one_c))]
        parts += [down, np.zeros(rest_s), charge(one_c, 0.5, down.sum() / 3600.0 / one_c), np.zeros(rest_s)]
    return np.concatenate(parts)


def days(rng: np.random.Generator, one_c: float, count: int, soc: float) -> Floats:
    """Return currents of ``count`` days from an initial ``soc`` [A].

    Two drives, each with a rest, are followed by a charge and a rest if the SOC is below 0.5. This repeats until the
    end.
    """
    parts = [np.zeros(0)]
    while sum(part.size for part in parts) < count * DAY_S:
        for _ in range(2):
            down = drive(rng, one_c, 0.4, int(rng.uniform(1200, 3600)))
            left_soc = soc - np.cumsum(down) / 3600.0 / one_c
            down = down[: int(np.argmax(left_soc < EMPTY_SOC)) if left_soc.min() < EMPTY_SOC else down.size]
            soc -= down.sum() / 3600.0 / one_c
            parts += [down, np.zeros(int(rng.uniform(1800, 4 * 3600)))]
        if soc < 0.5:
            charged_soc = rng.uniform(0.7, 0.95)
            parts += [charge(one_c, 0.3, charged_soc - soc), np.zeros(int(rng.uniform(1800, 8 * 3600)))]
            soc = charged_soc
    return np.concatenate(parts)[: count * DAY_S]
