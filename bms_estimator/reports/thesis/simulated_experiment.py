"""Simulated 6S 22.2 V 6.6 Ah pack with the loads of chapter 5 of the thesis, measured by a simulated sensor chain.

Numbers of tables, figures, sections and errata refer to the thesis. The pack has the open-circuit voltage of Table 8 and the
R_s of Table 9. Its R_ts, R_tl, C_ts and C_tl come from Chen and Mora's cell, because Fig. 29 compares the pack with
that cell. These elements lie within the bounds of Table 10, but differ from the values to which the adaptation
converges (Lemma 4.1.3).

The loads are the resistors of section 5.1. Their currents differ from the printed currents (erratum 21). The bulb is a
resistor with the bulb's printed current. The voltage is measured by a divider, the current by a +-10 A sensor. The
noise is uniform within half a step and is added before rounding.
"""

from dataclasses import dataclass

import numpy as np

from bms_estimator.kernels.cell_model.chen_mora import cell_step, terminal_voltage
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.reports.thesis import printed_values
from bms_estimator.reports.thesis.procedure import Capture, Kind

VOLTAGE_RANGE_V = 30.0
"""Range of the divider [V]. The thesis's 0-25 V sensor would saturate: the curve of Table 8 begins at 25.40 V."""
CURRENT_RANGE_A = 20.0
"""Range of the current sensor, -10 to +10 A [A]."""
MEAN_VOLTAGE_V = 23.0
"""Mean voltage of the pack over a discharge [V]. Divided by the bulb's mean current it gives the bulb's resistance."""
QUARTER_HOUR_S = 900.0
"""Duration of a pulse and of a rest, a quarter of an hour [s]."""
OBSERVER_STEP_S = 0.2
"""Sample interval of the capture that the observer runs on [s]. The others have an interval of 1 s."""
LOWEST_SOC = 0.012
"""SOC at the end of a discharge, just above delta2 of the pack, the SOC below which its C_tl is negative."""
VARIABLE_STEPS = ((600.0, "12.5 ohm"), (300.0, "50 W bulb"), (900.0, "12.5 ohm"), (420.0, ""), (240.0, "50 W bulb"))
"""Duration [s] and load of each step of test protocol 4. The thesis does not print them."""


@dataclass(frozen=True)
class SensorChain:
    """Sensor chain of divider, current sensor and converter.

    Attributes:
        bits: Number of bits of the converter: 10 for an Arduino, 16 for the dSpace board of the thesis.
    """

    bits: int

    @property
    def voltage_step_v(self) -> float:
        """Resolution of the voltage [V]."""
        return float(VOLTAGE_RANGE_V / 2**self.bits)

    @property
    def current_step_a(self) -> float:
        """Resolution of the current [A]."""
        return float(CURRENT_RANGE_A / 2**self.bits)

    def read(self, samples: SampleBlock, seed: int) -> SampleBlock:
        """Return the values that the sensor chain measures for true samples."""
        generator = np.random.default_rng(seed)
        measured = samples.copy()
        for name, step in (("voltage_v", self.voltage_step_v), ("current_a", self.current_step_a)):
            noise_steps = generator.uniform(-0.5, 0.5, samples.size)
            measured[name] = np.rint(samples[name] / step + noise_steps) * step
        return measured


def pack() -> CellModel:
    """Return the simulated pack with the adaptation bounds of Table 10."""
    model, chen_mora = load_cell("thunder_power_6s"), load_cell("chen_mora")
    elements = {name: getattr(chen_mora, name) for name in ("r_ts", "r_tl", "c_ts", "c_tl")}
    adaptation = {f"a{i}": printed_values.bounds("10", i) for i in printed_values.BOUNDS}
    renamed = model.cell.model_copy(update={"name": "simulated 6S pack"})
    return model.model_copy(update=elements | {"cell": renamed, "adaptation": adaptation})


def resistance_ohm(load: str) -> float:
    """Return the resistance of a load; infinite without a load."""
    if not load:
        return float("inf")
    return printed_values.RESISTORS_OHM.get(load, MEAN_VOLTAGE_V / printed_values.CURRENTS_A[load])


def run_down(cell: CellModel, schedule: list[tuple[float, str]], step_s: float = 1.0) -> SampleBlock:
    """Simulate a full pack until it is empty, under a repeating schedule of (seconds, load); return the true values."""
    a, capacity_as = cell.a, cell.cell.capacity_ah * 3600.0
    state = (1.0, 0.0, 0.0)
    time_s, currents, voltages = 0.0, [], []
    step_ends_s = np.cumsum([seconds for seconds, _ in schedule])
    ohm_of_steps = [resistance_ohm(load) for _, load in schedule]
    voltage_v = float(terminal_voltage(state, 0.0, a))
    while True:
        ohm = ohm_of_steps[int(np.searchsorted(step_ends_s, time_s % step_ends_s[-1], side="right"))]
        current_a = voltage_v / ohm
        next_soc = state[0] - current_a * step_s / capacity_as
        if next_soc < LOWEST_SOC:
            break
        voltage_v = float(terminal_voltage(state, current_a, a))
        currents.append(current_a)
        voltages.append(voltage_v)
        state = cell_step(state, current_a, step_s, capacity_as, a)
        time_s += step_s
    samples = np.zeros(len(currents), dtype=SAMPLE)
    samples["time_s"] = np.arange(len(currents)) * step_s
    samples["current_a"], samples["voltage_v"], samples["temperature_c"] = currents, voltages, np.nan
    return samples


def experiments() -> list[Capture]:
    """Simulate the experiments of chapter 5: relaxation tests, constant loads, steps."""
    cell = pack()
    rest, pulse = (QUARTER_HOUR_S, ""), (QUARTER_HOUR_S, "12.5 ohm")
    simulated = [
        Capture(f"relaxation {load}", Kind.RELAXATION, run_down(cell, [(QUARTER_HOUR_S, load), rest]))
        for load in printed_values.CURRENTS_A
    ]
    # the capture at the smallest current has a higher sample rate, because the observer runs only on it
    simulated += [
        Capture(
            load, Kind.CONSTANT, run_down(cell, [(QUARTER_HOUR_S, load)], OBSERVER_STEP_S if load == "50 ohm" else 1.0)
        )
        for load in printed_values.CURRENTS_A
    ]
    simulated.append(Capture("constant steps", Kind.STEPS, run_down(cell, [rest, pulse])))
    simulated.append(Capture("variable steps", Kind.STEPS, run_down(cell, list(VARIABLE_STEPS))))
    return simulated


def captures(true_captures: list[Capture], chain: SensorChain) -> list[Capture]:
    """Return the experiments as the sensor chain reports them."""
    return [Capture(c.name, c.kind, chain.read(c.samples, seed)) for seed, c in enumerate(true_captures)]
