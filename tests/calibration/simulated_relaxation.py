"""Simulated captures of voltage relaxation tests, of which some are invalid."""

import numpy as np

from tests.calibration.simulated_load import capture

LOAD_A = 1.5
LOAD_S = 360
"""Duration of a load, which discharges 5 % of the charge of the cell of 3 Ah [s]."""
REST_S = 900
FIRST_REST_S = 60


def schedule(*, load_a=LOAD_A, load_s=LOAD_S, rest_s=REST_S, rounds=30):
    """Return the current at 1 Hz: a short rest, then ``rounds`` times a load followed by a rest [A].

    19 rounds empty the cell of 3 Ah. ``capture`` ends there and omits the other rounds.
    """
    return np.r_[np.zeros(FIRST_REST_S), np.tile(np.r_[np.full(load_s, load_a), np.zeros(rest_s)], rounds)]


def relaxation(**options):
    """Return samples of a relaxation test of a full cell at 1 Hz, by default with 0.5 mV of noise.

    ``options`` are those of ``schedule``, and ``noise_v`` and ``seed`` of ``capture``.
    """
    noise = {key: options.pop(key) for key in ("noise_v", "seed") if key in options}
    return capture(schedule(**options), soc=1.0, **noise)


def glitched(share, seed=5):
    """Return a relaxation test in which the fraction ``share`` of the voltages is 0 V, as with a loose wire."""
    samples = relaxation()
    is_glitch = np.random.default_rng(seed).random(samples.size) < share
    samples["voltage_v"][is_glitch] = 0.0
    return samples


def wrong_sign():
    """Return a relaxation test whose current has the wrong sign."""
    samples = relaxation()
    samples["current_a"] *= -1.0
    return samples


INVALID_CAPTURES = {
    "no rests": (
        lambda: capture(np.full(7200, LOAD_A), soc=1.0),
        3.0,
        "no rests in 1.94 h: the current never falls below 1.500 A",
    ),
    "short rests": (
        lambda: relaxation(rest_s=20),
        3.0,
        "1 usable rests, at least 6 are needed; 19 others were too short",
    ),
    "wrong sign": (wrong_sign, 3.0, "current has the wrong sign or the capture charges: 0.000 Ah out, 2.9"),
    "capacity": (relaxation, 2.0, "SOC runs from 1.000 to -0.4"),
    "few rests": (lambda: relaxation(rounds=4), 3.0, "5 usable rests, at least 6 are needed"),
    "span": (lambda: relaxation(load_s=60, rounds=8), 3.0, "points span SOC 0.93 to 1.00 only"),
    "0 V": (
        lambda: glitched(0.7),
        3.0,
        "of 24144 samples are glitches, the first at 2 s with 0.000 V where the median is 3.6",
    ),
}
"""Invalid captures by fault: function that simulates the capture, capacity [Ah], and part of the error message."""
