"""Uses of a pack for weeks: phases of requested current, which depend on the SOC after the earlier phases."""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal, Protocol

import numpy as np

from bms_estimator.model.arrays import Floats
from tests.estimator.anywhere.truth import TAPER_C
from tests.estimator.anywhere.use import DAY_S, EMPTY_SOC, drive

HOUR_S = 3600
"""Seconds of an hour."""
MAX_CHARGE_S = 14 * HOUR_S
"""Maximum duration of a charge; the charger ends it earlier [s]."""
FULL_AFTER_S = 5.5 * DAY_S
"""Time after a full charge from which on the next charge is a full one [s]. The next charge begins about 1.5 days later."""
LOAD_C, LOAD_S = (0.25, 2.0), 60
"""Range of the random loads of ``full_often``, as C-rates, and duration of each [s]."""
YEAR_STEP_S = 10
"""Time between two samples of a simulated year [s]. At 1 s it would take too long."""
SHED_SOC, CURTAIL_SOC = 0.3, 0.9
"""SOC at which a solar system sheds its loads, and SOC above which it curtails the charge."""
SOLAR_STEP_S = 10
"""Time between two samples of a solar system [s]."""
REGENERATION_MIN_C = 10.0
"""Temperature below which a cell accepts no regeneration [C]."""


@dataclass(frozen=True)
class Phase:
    """Requested currents of a part of the use."""

    current_a: Floats
    """Requested current at each sample [A]."""
    end: Literal["time", "empty", "stopped", "charged_to"] = "time"
    """Condition that may end the phase before its last sample. ``empty``: SOC below ``soc``; ``charged_to``: SOC above ``soc``;
    ``stopped``: no current, because charger or protection have stopped it."""
    soc: float = np.nan
    room_c: float = 25.0
    is_seen: bool = True
    """False: the samples do not reach the estimator."""


class PackState(Protocol):
    """State of the pack after the last phase."""

    @property
    def soc(self) -> float:
        """True SOC."""

    @property
    def time_s(self) -> float:
        """Time since the first sample [s]."""

    @property
    def one_c(self) -> float:
        """Current of 1 C by the declared capacity [A]."""


PhasesOf = Callable[[np.random.Generator, PackState], Iterator[Phase]]
"""Function that yields the phases of a use."""


@dataclass(frozen=True)
class Use:
    """Kind of use."""

    phases: PhasesOf
    step_s: float = 1.0
    """Time between two samples [s]."""
    initial_soc: tuple[float, float] = field(default=(0.4, 0.9))
    """Range of the SOC at the first sample."""
    charger_c: float = 25.0
    """Temperature at which the voltage limit of the charger gives SOC 1 [C]."""


def rest(rng: np.random.Generator, low_h: float, high_h: float, room_c: float = 25.0) -> Phase:
    """Return a rest whose duration is uniform within these hours."""
    return Phase(np.zeros(int(HOUR_S * rng.uniform(low_h, high_h))), room_c=room_c)


def trip(rng: np.random.Generator, pack: PackState, empty_soc: float = EMPTY_SOC) -> Phase:
    """Return a drive of 20 to 60 min that ends at ``empty_soc``."""
    return Phase(drive(rng, pack.one_c, 0.4, int(HOUR_S * rng.uniform(1 / 3, 1.0))), "empty", empty_soc)


def full_charge(pack: PackState, rate_c: float) -> Phase:
    """Return a charge that ends at C/20 at the voltage limit of the charger."""
    return Phase(np.full(MAX_CHARGE_S, -rate_c * pack.one_c), "stopped")


def charge_to(pack: PackState, rate_c: float, soc: float) -> Phase:
    """Return a charge that ends at ``soc``."""
    return Phase(np.full(MAX_CHARGE_S, -rate_c * pack.one_c), "charged_to", soc)


def never_full(
    rng: np.random.Generator,
    pack: PackState,
    empty_soc: float = EMPTY_SOC,
    charge_below_soc: float = 0.5,
    min_charged_soc: float = 0.7,
) -> Iterator[Phase]:
    """Yield two drives to ``empty_soc`` with rests, and then, below SOC ``charge_below_soc``, a charge.

    The charge ends at a random SOC between ``min_charged_soc`` and 0.95.
    """
    while True:
        for _ in range(2):
            yield trip(rng, pack, empty_soc)
            yield rest(rng, 0.5, 4.0)
        if pack.soc < charge_below_soc:
            yield charge_to(pack, 0.3, rng.uniform(min_charged_soc, 0.95))
            yield rest(rng, 0.5, 8.0)


def full_weekly(rng: np.random.Generator, pack: PackState) -> Iterator[Phase]:
    """Yield the phases of ``never_full``, but charge to full at least once a week."""
    due_s = rng.uniform(1.0, 5.5) * DAY_S
    while True:
        for _ in range(2):
            yield trip(rng, pack)
            yield rest(rng, 0.5, 4.0)
        if pack.soc < 0.5 and pack.time_s > due_s:
            yield full_charge(pack, 0.3)
            due_s = pack.time_s + FULL_AFTER_S
            yield rest(rng, 0.5, 8.0)
        elif pack.soc < 0.5:
            yield charge_to(pack, 0.3, rng.uniform(0.7, 0.95))
            yield rest(rng, 0.5, 8.0)


def empty_weekly(rng: np.random.Generator, pack: PackState) -> Iterator[Phase]:
    """Yield the phases of ``never_full``, but discharge the pack once a week until its protection disconnects it."""
    phases, due_s = never_full(rng, pack), rng.uniform(1.0, 5.5) * DAY_S
    while True:
        yield next(phases)
        if pack.time_s > due_s:
            yield Phase(np.full(12 * HOUR_S, 0.15 * pack.one_c), "stopped")
            due_s = pack.time_s + FULL_AFTER_S
            yield rest(rng, 0.5, 2.0)


def full_nightly(rng: np.random.Generator, pack: PackState) -> Iterator[Phase]:
    """Yield two to four drives by day and a full charge each night."""
    while True:
        for _ in range(rng.integers(2, 5)):
            yield trip(rng, pack)
            yield rest(rng, 0.5, 3.0)
        yield full_charge(pack, 0.3)
        yield Phase(np.zeros(int(-pack.time_s % DAY_S)))


def full_often(rng: np.random.Generator, pack: PackState, room_c: float) -> Iterator[Phase]:
    """Yield about eight full charges a day, each after a random load that the protection stops."""
    while True:
        load_c = np.repeat(rng.uniform(*LOAD_C, 3 * HOUR_S // LOAD_S), LOAD_S)
        yield Phase(pack.one_c * load_c, "stopped", room_c=room_c)
        yield rest(rng, 0.2, 0.7, room_c)
        yield replace(full_charge(pack, 1.0), room_c=room_c)
        yield rest(rng, 0.2, 0.7, room_c)


def sampled(use: PhasesOf, step_s: int) -> PhasesOf:
    """Return a use at one sample in ``step_s`` seconds. Its current is constant between two samples."""

    def phases(rng: np.random.Generator, pack: PackState) -> Iterator[Phase]:
        for phase in use(rng, pack):
            yield replace(phase, current_a=phase.current_a[::step_s])

    return phases


def solar(rng: np.random.Generator, pack: PackState) -> Iterator[Phase]:
    """Yield nights with a small load and days with sun, at SOC 0.3 to 0.9."""
    while True:
        yield night(rng, pack)
        yield sunny_day(rng, pack, rng.uniform(max(pack.soc, 0.5), max(pack.soc, CURTAIL_SOC)))


def solar_full_weekly(rng: np.random.Generator, pack: PackState) -> Iterator[Phase]:
    """Yield the phases of ``solar``, but let the sun charge the pack to full on one day a week."""
    for day in itertools.count(int(rng.integers(7))):
        yield night(rng, pack)
        if day % 7 == 6:
            sunny = sunny_day(rng, pack, 1.0)
            # the sun gives more than needed, and never less than the current at which the charger ends (C/20)
            yield Phase(np.minimum(1.5 * sunny.current_a, -2.0 * TAPER_C * pack.one_c), "stopped")
        else:
            yield sunny_day(rng, pack, rng.uniform(max(pack.soc, 0.5), max(pack.soc, CURTAIL_SOC)))


def night(rng: np.random.Generator, pack: PackState) -> Phase:
    """Return 14 h of a load that changes every 10 min and ends at ``SHED_SOC``."""
    steps = 14 * HOUR_S // SOLAR_STEP_S
    level = np.repeat(rng.gamma(1.5, 1.0, steps // 60), 60)
    drawn_soc = min(rng.uniform(0.1, 0.35), max(pack.soc - SHED_SOC, 0.0))
    return Phase(level * drawn_soc * pack.one_c * HOUR_S / SOLAR_STEP_S / level.sum(), "empty", SHED_SOC)


def sunny_day(rng: np.random.Generator, pack: PackState, soc: float) -> Phase:
    """Return 10 h of sun with clouds that charge the pack to about ``soc``."""
    steps = 10 * HOUR_S // SOLAR_STEP_S
    clouds = np.repeat(rng.uniform(0.3, 1.0, steps // 30), 30)
    sun = np.sin(np.pi * np.arange(steps) / steps) * clouds
    return Phase(-sun * (soc - pack.soc) * pack.one_c * HOUR_S / SOLAR_STEP_S / sun.sum())


def bicycle(rng: np.random.Generator, pack: PackState) -> Iterator[Phase]:
    """Yield a ride a day at -5 to 30 C, and an unseen charge while the electronics are off."""
    while True:
        room_c = rng.uniform(-5.0, 30.0)
        ride = drive(rng, pack.one_c, 0.35, int(HOUR_S * rng.uniform(0.8, 2.5)))
        ride = ride if room_c > REGENERATION_MIN_C else np.maximum(ride, 0.0)
        yield Phase(ride, "empty", EMPTY_SOC, room_c)
        yield rest(rng, 0.2, 0.6, room_c)
        charge = full_charge(pack, 0.3) if rng.random() < 0.8 else charge_to(pack, 0.3, rng.uniform(0.75, 0.95))
        yield Phase(charge.current_a, charge.end, charge.soc, is_seen=False)
        yield Phase(np.zeros(int(-pack.time_s % DAY_S)), is_seen=False)


def boat(rng: np.random.Generator, pack: PackState) -> Iterator[Phase]:
    """Yield 8 to 12 days with only a small load, then a deep discharge and a full charge."""
    while True:
        for _ in range(rng.integers(8, 13)):
            standby_c = rng.uniform(0.0, 1e-3, 24) * (rng.random(24) < 0.5)
            yield Phase(pack.one_c * np.repeat(standby_c, HOUR_S))
        yield Phase(drive(rng, pack.one_c, 0.2, 12 * HOUR_S).clip(min=0.0), "empty", EMPTY_SOC)
        yield rest(rng, 2.0, 12.0)
        yield full_charge(pack, 0.2)


USES = {
    "never_full": Use(never_full),
    "never_full_above_0.30": Use(partial(never_full, empty_soc=0.3, charge_below_soc=0.6), initial_soc=(0.5, 0.9)),
    "never_full_above_0.50": Use(
        partial(never_full, empty_soc=0.5, charge_below_soc=0.7, min_charged_soc=0.8), initial_soc=(0.6, 0.9)
    ),
    "empty_weekly": Use(empty_weekly),
    "full_nightly": Use(full_nightly),
    "full_weekly": Use(full_weekly),
    "full_weekly_10_s": Use(sampled(full_weekly, YEAR_STEP_S), step_s=YEAR_STEP_S),
    "full_often_40_C": Use(partial(full_often, room_c=40.0), charger_c=40.0),
    "solar": Use(solar, step_s=SOLAR_STEP_S),
    "solar_full_weekly": Use(solar_full_weekly, step_s=SOLAR_STEP_S),
    "bicycle": Use(bicycle, initial_soc=(0.95, 0.98)),
    "boat": Use(boat, initial_soc=(0.6, 0.95)),
}
"""Uses by name."""
