"""Electrochemical cells in use for days: PyBaMM's single particle model with electrolyte, with published parameter sets.

The true SOC is the mean stoichiometry of the negative electrode between those at the voltage limits at rest. Generic cell files
have their OCV from some of these sets, but neither resistances nor diffusion.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured, unstructured_to_structured

from bms_estimator.model.cell import load_cell
from tests.estimator.anywhere.truth import KELVIN, TAPER_C
from tests.estimator.anywhere.use import DAY_S
from tests.estimator.month.cases import Case, Recording
from tests.estimator.month.packs import generator
from tests.estimator.month.simulation import TRUE_VALUES
from tests.estimator.month.sources import SLOW_BOARD, Source, measure
from tests.estimator.month.uses import USES, Phase, sampled

CELLS = {
    "Ai2020": ("lco", 2.28),
    "Chen2020": ("nmc", 5.0),
    "Ecker2015": ("nmc", 0.15625),
    "Mohtat2020": ("nmc", 5.0),
    "NCA_Kim2011": ("nca", 0.43),
    "OKane2022": ("nmc", 5.0),
    "Prada2013": ("lfp", 2.3),
    "Ramadass2004": ("lco", 1.0),
}
"""Generic cell file and nominal capacity [Ah] by parameter set. Chen2020 does not depend on the temperature. By the notes of
Prada2013 the OCV curves of its electrodes are stand-ins."""
STEP_S = int(SLOW_BOARD.step_s)
DIGITS = (2, 4, 4, 1, 5, 4)
"""Decimal digits of the columns of a recording, in the order of ``TRUE_VALUES``."""


@dataclass(frozen=True)
class ElectrochemicalCase(Case):
    """Parameters of one run; ``cell`` is a name in ``CELLS``."""

    source: Source = SLOW_BOARD
    room_c: float = 25.0
    days: int = 1

    @property
    def name(self) -> str:
        """Parameter set, use and temperature."""
        return f"{self.cell}, {self.use}, {self.room_c:.0f} C"

    @property
    def path(self) -> Path:
        """Recording of the first day under version control, if there is one."""
        return Path(__file__).parent / "recordings" / f"{self.cell}-{self.room_c:.0f}C.csv.gz"

    def draw(self, data: Path) -> Recording:  # noqa: ARG002 - needs no captures
        """Measure the recorded cell, or solve its equations."""
        truth = self.recorded() if self in RECORDED else self.solve()
        samples = measure(self.source, truth, generator(self.name, self.seed))
        chemistry, declared_ah = CELLS[self.cell]
        return Recording(samples, truth, chemistry, declared_ah, load_cell(chemistry, declared_ah))

    def recorded(self) -> np.ndarray:
        """Return the recorded values, dtype ``TRUE_VALUES``."""
        table = np.loadtxt(self.path, delimiter=",", skiprows=1)
        return unstructured_to_structured(np.column_stack([table, np.ones(len(table))]), TRUE_VALUES)

    def record(self) -> None:
        """Write the recording."""
        columns, header = structured_to_unstructured(self.solve())[:, : len(DIGITS)], ",".join(TRUE_VALUES.names[:-1])
        np.savetxt(self.path, columns, [f"%.{n}f" for n in DIGITS], delimiter=",", header=header, comments="")

    def solve(self) -> np.ndarray:
        """Return the true values of all days, dtype ``TRUE_VALUES``."""
        use, rng = USES[self.use], generator(self.cell, self.use, self.seed)
        cell = ElectrochemicalCell(self.cell, self.room_c, rng.uniform(*use.initial_soc))
        phases, parts = sampled(use.phases, STEP_S)(rng, cell), []
        while cell.time_s < self.days * DAY_S:
            parts.append(cell.run(next(phases)))
        truth = np.concatenate(parts)
        return truth[truth["time_s"] < self.days * DAY_S]


CASES = tuple(ElectrochemicalCase(cell, "full_nightly", room_c=room_c) for cell in CELLS for room_c in (0.0, 25.0))
"""Cases of the table."""
RECORDED = tuple(case for case in CASES if case.cell in ("Ai2020", "OKane2022"))
"""Cases of the summary, with a recording."""


class ElectrochemicalCell:
    """Cell whose phases are solved one after the other. It satisfies ``PackState``."""

    def __init__(self, parameters: str, room_c: float, soc: float) -> None:
        os.environ["PYBAMM_DISABLE_TELEMETRY"] = "true"  # set before the import, which would send usage data
        import pybamm  # noqa: PLC0415 - takes seconds, and a recording does not need it

        self.pybamm, self.values = pybamm, pybamm.ParameterValues(parameters)
        self.empty_x, self.full_x = pybamm.lithium_ion.get_min_max_stoichiometries(self.values)[:2]
        electrode_ah = self.values.evaluate(pybamm.LithiumIonParameters().n.prim.Q_init)
        self.capacity_ah = float(electrode_ah * (self.full_x - self.empty_x))
        self.low_v, self.high_v = (float(self.values[f"{end} voltage cut-off [V]"]) for end in ("Lower", "Upper"))
        kelvin = room_c + KELVIN
        limits = {"Lower voltage cut-off [V]": self.low_v - 1.0, "Upper voltage cut-off [V]": self.high_v + 0.5}
        self.values.update({"Ambient temperature [K]": kelvin, "Initial temperature [K]": kelvin, **limits})
        self.model, self.solver = pybamm.lithium_ion.SPMe(), pybamm.IDAKLUSolver(rtol=1e-6, atol=1e-8)
        self.room_c, self.one_c, self.soc, self.time_s, self.last_state = room_c, CELLS[parameters][1], soc, 0.0, None

    def run(self, phase: Phase) -> np.ndarray:
        """Solve a phase until its end or a voltage limit, and return its true values, dtype ``TRUE_VALUES``."""
        request_a, step = phase.current_a, self.pybamm.step
        soc = self.soc - np.cumsum(request_a) * STEP_S / 3600.0 / self.capacity_ah
        is_beyond = {"empty": soc < phase.soc, "charged_to": soc > phase.soc}.get(phase.end, np.zeros(1, dtype=bool))
        if is_beyond.any():
            request_a = request_a[: 1 + int(np.argmax(is_beyond))]
        seconds = STEP_S * request_a.size
        if np.ptp(request_a):
            load_a = np.column_stack([STEP_S * np.arange(request_a.size + 1), np.append(request_a, request_a[-1])])
            return self.solve(step.current(load_a, duration=seconds, period=STEP_S, termination=f"< {self.low_v} V"))
        limit = f"> {self.high_v} V" if request_a[0] < 0.0 else f"< {self.low_v} V"
        truth = self.solve(step.current(request_a[0], duration=seconds, period=STEP_S, termination=limit))
        if request_a[0] >= 0.0 or truth.size >= request_a.size:
            return truth
        taper = step.voltage(self.high_v, duration=seconds, period=STEP_S, termination=f"{TAPER_C}C")
        return np.concatenate([truth, self.solve(taper)])

    def solve(self, step: object) -> np.ndarray:
        """Solve a step, and return its true values without the last one, because the next step begins at its time."""
        experiment = self.pybamm.Experiment([step])
        simulation = self.pybamm.Simulation(
            self.model, experiment=experiment, parameter_values=self.values, solver=self.solver
        )
        initial_soc = None if self.last_state else self.soc
        solution = simulation.solve(starting_solution=self.last_state, initial_soc=initial_soc, showprogress=False)
        cycle, self.last_state = solution.cycles[-1], solution.last_state
        stoichiometry = cycle["Negative electrode stoichiometry"].entries
        truth = np.ones(cycle.t.size, dtype=TRUE_VALUES)
        truth["time_s"], truth["temperature_c"], truth["capacity_ah"] = cycle.t, self.room_c, self.capacity_ah
        truth["current_a"], truth["voltage_v"] = cycle["Current [A]"].entries, cycle["Voltage [V]"].entries
        truth["soc"] = (stoichiometry - self.empty_x) / (self.full_x - self.empty_x)
        self.time_s, self.soc = float(cycle.t[-1]), float(truth["soc"][-1])
        return truth[:-1]
