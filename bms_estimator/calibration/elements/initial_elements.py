"""Initial elements of a cell from the rests of a relaxation test: one value each for all SOC.

A fit of a whole capture starts from these. At the end of a load the voltage steps by i R_s and then rises in two
exponentials, which give the two RC pairs: (2.2), (2.3) with i = 0.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from bms_estimator.calibration.cleaning.rests import remove_glitches
from bms_estimator.calibration.ocv.relaxation_test import RelaxationTest
from bms_estimator.model.cell import Capacitance, Resistance
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock

FAST = np.geomspace(0.003, 0.05, 12)
SLOW = np.geomspace(0.08, 0.7, 10)
"""Time constants tried for the short and the long branch, in rests."""
NEGLIGIBLE = 1e-6
"""Part of an element that depends on SOC: none, but a cell file wants it above 0."""
LOWEST_SOC = 0.1
"""Rests below are left out: the elements rise there."""
MAX_SAMPLES = 1000
"""Maximum number of samples of a rest; longer ones are thinned."""
MIN_OHM = 1e-5


@dataclass(frozen=True)
class InitialElements:
    """Elements that do not depend on SOC.

    Attributes:
        r_s_ohm: Series resistance, all that is faster than the capture's sampling [ohm].
        r_ts_ohm: Resistance of the short branch [ohm].
        tau_ts_s: Time constant [s].
        r_tl_ohm: Resistance of the long branch [ohm].
        tau_tl_s: Time constant [s].
    """

    r_s_ohm: float
    r_ts_ohm: float
    tau_ts_s: float
    r_tl_ohm: float
    tau_tl_s: float

    @property
    def sections(self) -> dict[str, Resistance | Capacitance]:
        """Return the sections of a cell file."""
        return {
            "r_ts": _resistance(self.r_ts_ohm),
            "r_tl": _resistance(self.r_tl_ohm),
            "c_ts": _capacitance(self.tau_ts_s / self.r_ts_ohm),
            "c_tl": _capacitance(self.tau_tl_s / self.r_tl_ohm),
            "r_s": _resistance(self.r_s_ohm),
        }


def initial_elements(samples: SampleBlock, test: RelaxationTest, capacity_ah: float) -> InitialElements:
    """Return the medians over the rests of one test.

    Args:
        samples: What ``test`` was made of, dtype ``SAMPLE``, raw.
        test: Relaxation test with its rests.
        capacity_ah: As ``test`` was counted with [Ah].

    Raises:
        UserError: No rest follows a load.
    """
    good = remove_glitches(samples, test.name)
    found = []
    soc = test.start_soc
    for rest in test.rests:
        drawn_as = (soc - rest.soc) * capacity_ah * 3600.0
        soc = rest.soc
        first = int(np.searchsorted(good["time_s"], rest.start_s))
        last = int(np.searchsorted(good["time_s"], rest.start_s + rest.duration_s, side="right"))
        current_a = float(good["current_a"][first - 1]) if first else 0.0
        if drawn_as > 0.0 and current_a > 0.0 and rest.soc > LOWEST_SOC:
            found.append(_of_rest(good[first:last], float(good["voltage_v"][first - 1]), current_a, drawn_as))
    if not found:
        raise UserError(f"{test.name}: none of its {len(test.rests)} rests follows a discharge above SOC {LOWEST_SOC}")
    return InitialElements(*(float(x) for x in np.median(np.array(found), axis=0)))


def _of_rest(rest: SampleBlock, loaded_v: float, current_a: float, drawn_as: float) -> tuple[float, ...]:
    """R_s, R_ts, tau_ts, R_tl, tau_tl from one rest after a load of ``current_a``."""
    rest = rest[:: -(-rest.size // MAX_SAMPLES)]
    time_s = rest["time_s"] - rest["time_s"][0]
    duration_s = float(time_s[-1])
    fits = []
    for fast in FAST * duration_s:
        for slow in SLOW * duration_s:
            basis = np.column_stack([np.ones_like(time_s), -np.exp(-time_s / fast), -np.exp(-time_s / slow)])
            sizes, norm = nnls(basis, rest["voltage_v"])
            fits.append((float(norm), fast, slow, sizes))
    _, fast, slow, (end_v, short_v, long_v) = min(fits, key=lambda fit: fit[0])
    load_s = drawn_as / current_a
    return (
        max((end_v - short_v - long_v - loaded_v) / current_a, MIN_OHM),
        _loaded_ohm(short_v, current_a, load_s, fast),
        fast,
        _loaded_ohm(long_v, current_a, load_s, slow),
        slow,
    )


def _loaded_ohm(size_v: float, current_a: float, load_s: float, tau_s: float) -> float:
    """Resistance of a branch that a load of ``load_s`` has charged to ``size_v``, (2.2) solved for it [ohm]."""
    return max(size_v / (current_a * -float(np.expm1(-load_s / tau_s))), MIN_OHM)


def _resistance(ohm: float) -> Resistance:
    return Resistance(amplitude_ohm=NEGLIGIBLE * ohm, exponent=10.0, offset_ohm=ohm)


def _capacitance(farad: float) -> Capacitance:
    return Capacitance(amplitude_farad=NEGLIGIBLE * farad, exponent=10.0, offset_farad=farad)
