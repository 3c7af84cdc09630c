"""Currents of a cell in use for hours and days, at 1 Hz."""

import numpy as np

from bms_estimator.model.arrays import Floats

LEVEL_S = 20.0
"""Mean duration of a level of the current [s]."""
DAY_S = 86400


def drive(rng: np.random.Generator, one_c: float, mean_c: float, seconds: int) -> Floats:
    """Return a current of levels of some seconds, stops and some regeneration [A]."""
    level = np.clip(rng.normal(mean_c, 0.9 * mean_c + 0.1, seconds), -0.5, 3.0)
    level[rng.random(seconds) < 0.15] = 0.0
    return one_c * np.repeat(level, rng.exponential(LEVEL_S, seconds).astype(int) + 2)[:seconds]


def charge(one_c: float, rate_c: float, soc: float) -> Floats:
    """Return the current at ``rate_c`` that increases the SOC by ``soc`` [A]."""
    return np.full(round(3600.0 * soc / rate_c), -rate_c * one_c)


def cycles(rng: np.random.Generator, one_c: float, count: int, by_soc: float, rest_s: int) -> Floats:
    """Return currents of drives over ``by_soc`` and charges at C/2, each followed by a rest [A]."""
    parts = []
    for _ in range(count):
        down = drive(rng, one_c, 0.5, 20000)
        down = down[: 1 + int(np.argmax(np.cumsum(down) >= 3600.0 * by_soc * one_c))]
        parts += [down, np.zeros(rest_s), charge(one_c, 0.5, down.sum() / 3600.0 / one_c), np.zeros(rest_s)]
    return np.concatenate(parts)


def days(rng: np.random.Generator, one_c: float, count: int, soc: float) -> Floats:
    """Return currents of repeated days: two drives with rests, a charge if less than half is left, and a rest [A]."""
    parts = [np.zeros(0)]
    while sum(part.size for part in parts) < count * DAY_S:
        for _ in range(2):
            down = drive(rng, one_c, 0.4, int(rng.uniform(1200, 3600)))
            left = soc - np.cumsum(down) / 3600.0 / one_c
            down = down[: int(np.argmax(left < 0.12)) if left.min() < 0.12 else down.size]
            soc -= down.sum() / 3600.0 / one_c
            parts += [down, np.zeros(int(rng.uniform(1800, 4 * 3600)))]
        if soc < 0.5:
            to = rng.uniform(0.7, 0.95)
            parts += [charge(one_c, 0.3, to - soc), np.zeros(int(rng.uniform(1800, 8 * 3600)))]
            soc = to
    return np.concatenate(parts)[: count * DAY_S]
