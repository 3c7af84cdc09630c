"""Simulated chargers, and the full anchors that the estimator finds.

    python -m tests.estimator.anchors.chargers [PART OF A NAME]

prints the highest true SOC of each case, and the hour, the true SOC and the std of each full anchor, with the SOC of the
estimator before it. The OCV is that of the cell file. SOC 1 is its end, which a charger reaches only after hours.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.observer import NO_LIMITS, ChargeLimits, Sampling

CAPACITY_AH, SERIES = 100.0, 16
"""Capacity [Ah], and number of cells in series."""
OVERPOTENTIAL_V = {"nmc": 0.22, "lfp": 0.11}
"""Overpotential of a cell at 1C in steady state [V]."""
FRACTIONS, TAU_S = np.array([0.4, 0.25, 0.35]), np.array([20.0, 900.0])
"""Fractions of the overpotential at the series resistance and at two RC pairs, and the time constants of the pairs [s]."""
LEAD_SOC, LEAD_S = {"nmc": 0.0, "lfp": 0.05}, 600.0
"""Difference between the SOC at the surface of the particles and the mean SOC during a charge at 1C, and its time constant [s].

Charged with C/2 to 3.65 V, LFP cells accept another 2 to 3 % at this voltage. In the other cells the RC pairs have this effect.
"""
OVERCHARGE_V = 20.0
"""Slope of the OCV above SOC 1 [V]."""
MAX_CHARGE_S = 80_000
"""Maximum duration of a charge [s]."""
CHECK_S = 10
"""Interval at which the estimator is checked for a new anchor [s]."""
Load = Callable[[int], float]
"""Current [C] as a function of the time [s]."""


def no_load(_: int) -> float:
    """Return 0."""
    return 0.0


def random_load(std_c: float) -> Load:
    """Return a current around 0 that changes every 20 s."""
    values = np.random.default_rng(2).normal(0.0, std_c, MAX_CHARGE_S // 20 + 1)
    return lambda t: float(values[t // 20])


def switched(current_c: float, on_s: int, off_s: int) -> Load:
    """Return a current that is switched on and off."""
    return lambda t: current_c if t % (on_s + off_s) < on_s else 0.0


class Charged:
    """Cell on a charger. Currents are C-rates, positive on discharge.

    Args:
        chemistry: Generic cell.
        soc: Initial SOC.
        factor: Factor on the resistances and on ``LEAD_SOC``.
        celsius: Temperature [C].

    Attributes:
        rows: Current [C], voltage [V] and SOC of each second.
    """

    def __init__(self, chemistry: str, soc: float = 0.6, *, factor: float = 1.0, celsius: float = 25.0) -> None:
        self.chemistry, self.soc, self.celsius = chemistry, soc, celsius
        self.rows = list[tuple[float, float, float]]()
        self._ocv_v = ocv_grid(load_cell(chemistry, CAPACITY_AH))[0]
        self._grid = np.linspace(0.0, 1.0, self._ocv_v.size)
        self._ohm, self._lead_soc = FRACTIONS * OVERPOTENTIAL_V[chemistry] * factor, LEAD_SOC[chemistry] * factor
        self._pairs_c, self._lead_c = np.zeros(2), 0.0
        self.rest(600)

    @property
    def full_v(self) -> float:
        """Voltage of the charger: OCV at SOC 1 [V]."""
        return float(self._ocv_v[-1])

    def charge(
        self,
        max_c: float,
        volts: float | None = None,
        *,
        seconds: int = MAX_CHARGE_S,
        tail_c: float = -1.0,
        load: Load = no_load,
        sun: Load | None = None,
    ) -> Self:
        """Charge with constant current, then with constant voltage.

        Args:
            max_c: Maximum current of the charger.
            volts: Voltage of the charger [V]; default: ``full_v``.
            seconds: Duration unless the charge ends earlier [s].
            tail_c: Current of the charger at which the charge ends; negative: it does not end.
            load: Load in parallel.
            sun: Maximum current of a solar charger as a function of time; replaces ``max_c``.
        """
        for t in range(seconds):
            held_c = (
                load(t) - (self._settled_v - (volts or self.full_v)) / self._ohm[0]
            )  # current that keeps the voltage constant
            charger_c = min(max(held_c, 0.0), sun(t) if sun else max_c)
            if charger_c == held_c < tail_c:
                break
            self._step(load(t) - charger_c)
        return self

    def charge_to(self, part: float, max_c: float) -> Self:
        """Charge with constant current until the voltage is the fraction ``part`` of ``full_v``."""
        while self._settled_v + self._ohm[0] * max_c < part * self.full_v:
            self._step(-max_c)
        return self

    def rest(self, seconds: int = 1800) -> Self:
        """Simulate a rest."""
        for _ in range(seconds):
            self._step(0.0)
        return self

    @property
    def _settled_v(self) -> float:
        """Voltage without the overpotential of the series resistance [V]."""
        surface_soc = self.soc - self._lead_soc * self._lead_c
        ocv_v = np.interp(surface_soc, self._grid, self._ocv_v) + OVERCHARGE_V * max(surface_soc - 1.0, 0.0)
        return float(ocv_v - self._ohm[1:] @ self._pairs_c)

    def _step(self, current_c: float) -> None:
        self.rows.append((current_c, self._settled_v - self._ohm[0] * current_c, self.soc))
        self._pairs_c += (1.0 - np.exp(-1.0 / TAU_S)) * (current_c - self._pairs_c)
        self._lead_c += (current_c - self._lead_c) / LEAD_S
        self.soc -= current_c / 3600.0


@dataclass(frozen=True)
class Meter:
    """Source of the samples."""

    step_s: int = 1
    ampere_step: float = 0.01
    noise_a: float = 0.02
    dead_band_a: float = 0.0
    volt_step: float = 0.01

    def samples(self, cell: Charged) -> SampleBlock:
        """Return the measured samples."""
        rows = np.array(cell.rows)[:: self.step_s]
        current_a = CAPACITY_AH * rows[:, 0] + np.random.default_rng(1).normal(0.0, self.noise_a, len(rows))
        current_a[np.abs(current_a) < self.dead_band_a] = 0.0
        samples = np.zeros(len(rows), dtype=SAMPLE)
        samples["time_s"], samples["temperature_c"] = self.step_s * np.arange(len(rows)), cell.celsius
        samples["current_a"] = np.round(current_a / self.ampere_step) * self.ampere_step
        samples["voltage_v"] = np.round(SERIES * rows[:, 1] / self.volt_step) * self.volt_step
        return samples

    @property
    def sampling(self) -> Sampling:
        """Sampling that the owner configures."""
        return Sampling(float(self.step_s), self.ampere_step, self.dead_band_a, 0.005, 0.005)


@dataclass(frozen=True)
class Case:
    """Charge of a pack."""

    name: str
    charged: Callable[[], Charged]
    meter: Meter = field(default_factory=Meter)
    limits: ChargeLimits = NO_LIMITS


@dataclass(frozen=True)
class Anchor:
    """Full anchor that the estimator found."""

    hour: float
    true_soc: float
    std: float
    soc_before: float


def anchors(case: Case, cell: Charged) -> list[Anchor]:
    """Return the full anchors of a case."""
    samples, meter = case.meter.samples(cell), case.meter
    estimator = Estimator(
        load_cell(cell.chemistry, CAPACITY_AH).pack(SERIES, 1),
        sampling=meter.sampling,
        limits=case.limits,
        voltage_resolution_v=meter.volt_step,
    )
    found, state, count = list[Anchor](), estimator.record[0]["anchors"], max(CHECK_S // meter.step_s, 1)
    for first in range(0, samples.size, count):
        estimator.run(samples[first : first + count])
        if state["full_anchors"] > len(found):
            second = min((first + count) * meter.step_s, len(cell.rows)) - 1
            values = cell.rows[second][2], float(state["full_std"]), float(state["soc_before"])
            found.append(Anchor(second / 3600.0, *values))
    return found


def cases() -> Iterator[Case]:
    """Yield the cases of the table."""
    for chemistry in ("nmc", "lfp"):
        yield from constant_voltage(chemistry)
        yield from interrupted(chemistry)
        yield from without_constant_voltage(chemistry)
    yield from absorption()


def constant_voltage(chemistry: str) -> Iterator[Case]:
    """Yield charges with constant current and constant voltage."""
    for tail in (200, 100, 50, 30, 20, 10, 8, 7, 5):
        for max_c in (0.5, 0.2):
            yield Case(
                f"{chemistry} {max_c}C to C/{tail}",
                lambda tail=tail, max_c=max_c: Charged(chemistry).charge(max_c, tail_c=1.0 / tail).rest(),
            )
    for step_s in (10, 60):
        for max_c in (0.2, 1.0):
            yield Case(
                f"{chemistry} {max_c}C to C/20, samples each {step_s} s",
                lambda max_c=max_c: Charged(chemistry).charge(max_c, tail_c=0.05).rest(),
                Meter(step_s=step_s),
            )
    for dead_band_a in (0.0, 0.7, 2.5):
        yield Case(
            f"{chemistry} 0.3C to C/30, steps of 0.1 A, dead band {dead_band_a} A",
            lambda: Charged(chemistry).charge(0.3, tail_c=1 / 30).rest(),
            Meter(ampere_step=0.1, noise_a=0.1, dead_band_a=dead_band_a),
        )
    for factor, celsius in ((3.0, 0.0), (5.0, -10.0), (3.0, 25.0)):
        for tail_c in (0.02, 0.1):
            yield Case(
                f"{chemistry} {factor} times the resistance at {celsius} C, 0.2C to {tail_c}C",
                lambda tail_c=tail_c, factor=factor, celsius=celsius: (
                    Charged(chemistry, factor=factor, celsius=celsius).charge(0.2, tail_c=tail_c).rest()
                ),
            )


def interrupted(chemistry: str) -> Iterator[Case]:
    """Yield charges that are held, interrupted, or have loads in parallel."""
    yield Case(f"{chemistry} held for 8 h", lambda: Charged(chemistry).charge(0.3, seconds=8 * 3600))
    yield Case(
        f"{chemistry} held for 8 h, current noise 1 % C",
        lambda: Charged(chemistry).charge(0.3, seconds=8 * 3600, load=random_load(0.01)),
    )
    for tail, last in ((4, 20), (10, 50)):
        yield Case(
            f"{chemistry} interrupted at C/{tail}, resumed to C/{last}",
            lambda tail=tail, last=last: (
                Charged(chemistry).charge(0.5, tail_c=1 / tail).rest(900).charge(0.5, tail_c=1 / last).rest()
            ),
        )
    yield Case(
        f"{chemistry} loads of 0.2C in parallel",
        lambda: Charged(chemistry).charge(0.3, tail_c=0.03, load=switched(0.2, 600, 600)).rest(),
    )
    yield Case(
        f"{chemistry} load of 0.5C switched on at C/8, for 10 min",
        lambda: (
            Charged(chemistry).charge(0.2, tail_c=0.125).charge(0.2, seconds=600, load=switched(0.5, 600, 1))
            .charge(0.2, tail_c=1 / 30).rest()
        ),
    )  # fmt: skip


def without_constant_voltage(chemistry: str) -> Iterator[Case]:
    """Yield charges that end before, or without, the phase of constant voltage."""
    for max_c in (0.04, 0.08, 0.12):
        yield Case(
            f"{chemistry} {max_c}C behind clouds",
            lambda max_c=max_c: Charged(chemistry, 0.9).charge(1.0, seconds=6 * 3600, sun=switched(max_c, 300, 200)),
        )
        yield Case(
            f"{chemistry} {max_c}C that a cloud ends at 0.996 of the voltage",
            lambda max_c=max_c: Charged(chemistry, 0.9).charge_to(0.996, max_c).rest(),
        )
    for bulk_c, dim_c in ((0.5, 0.12), (0.3, 0.08), (1.0, 0.1)):
        yield Case(
            f"{chemistry} sun falls from {bulk_c}C to {dim_c}C",
            lambda bulk_c=bulk_c, dim_c=dim_c: (
                Charged(chemistry).charge_to(0.997, bulk_c).charge(dim_c, seconds=60).rest()
            ),
        )
    for max_c in (0.5, 0.1):
        for part in (0.985, 0.996):
            yield Case(
                f"{chemistry} protection of a high cell stops {max_c}C at {part} of the voltage, 6 times",
                lambda max_c=max_c, part=part: high_cell(chemistry, part, max_c),
            )


def absorption() -> Iterator[Case]:
    """Yield charges of LFP cells with an absorption time and a float."""
    for seconds in (600, 7200):
        for max_c in (0.1, 0.5):
            yield Case(
                f"lfp {max_c}C, {seconds} s at 3.55 V, float at 3.375 V",
                lambda seconds=seconds, max_c=max_c: absorbed(3.55, max_c, seconds),
            )
    yield Case(
        "lfp 0.3C, 3600 s at 3.55 V, float at 3.375 V, current noise 2 % C",
        lambda: absorbed(3.55, 0.3, 3600, random_load(0.02)),
    )
    yield Case("lfp 3600 s at 3.45 V, not configured", lambda: absorbed(3.45, 0.3, 3600))
    yield Case("lfp 3600 s at 3.45 V", lambda: absorbed(3.45, 0.3, 3600), limits=ChargeLimits(SERIES * 3.45))
    yield Case("lfp held at 3.375 V", lambda: Charged("lfp").charge(0.2, 3.375, seconds=12 * 3600))


def high_cell(chemistry: str, part: float, max_c: float) -> Charged:
    """Return a charge that the protection stops at a part of the charger's voltage, and releases a minute later."""
    cell = Charged(chemistry)
    for _ in range(6):
        cell.charge_to(part, max_c).rest(60)
    return cell.rest()


def absorbed(volts: float, max_c: float, seconds: int, load: Load = no_load) -> Charged:
    """Return an LFP cell after constant current, an absorption time at constant voltage, and a float at 3.375 V."""
    cell = Charged("lfp")
    cell.charge_to(volts / cell.full_v, max_c)
    return cell.charge(max_c, volts, seconds=seconds, load=load).charge(max_c, 3.375, seconds=2 * 3600, load=load)


def main() -> None:
    """Print the table."""
    part = sys.argv[1] if len(sys.argv) > 1 else ""
    for case in cases():
        if part in case.name:
            cell = case.charged()
            found = anchors(case, cell)
            highest = 100.0 * max(soc for _, _, soc in cell.rows)
            texts = [
                f"{a.hour:.2f} h at {100 * a.true_soc:.1f} % (std {100 * a.std:.1f}, before {100 * a.soc_before:.1f})"
                for a in found
            ]
            sys.stdout.write(f"{case.name:70s} {highest:5.1f} %  {'; '.join(texts) or 'none'}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
