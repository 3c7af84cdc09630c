"""The methods, each behind the same interface: learn from a capture, then return the results.

``learn`` takes blocks of samples in turn, each told its SOC at the first sample. What comes back says a voltage open loop,
the elements at an SOC, the SOC of a capture entered at a wrong one, and R_s over time; None is what a method does not do.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Protocol

import numpy as np

from bms_estimator.calibration.cleaning.rests import soc_by_counting
from bms_estimator.calibration.thesis.adapt_steps import Start, steps_2_and_3
from bms_estimator.calibration.thesis.prediction import open_circuit, predict
from bms_estimator.calibration.thesis.printed_bounds import printed_bounds
from bms_estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import fitted_parameter
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock
from bms_estimator.settings.observer import IdentifierSettings, ObserverSettings
from tests.benchmarks.baselines import fixed_ekf, joint_ekf, rls_arx, simulate_arx

Reader = Callable[[Estimator, CellModel], Floats]

LOWEST_SOC = 0.1
MAX_MV = 1e4
"""A model that is off by more has run away."""
WHOLE = 0.9
"""Minimum fraction of the capture that a prediction must cover before a learned capacitance becomes negative."""
TRACED_S = 30.0
"""Interval at which R_s is read from the observer's parameters."""
RLS_EVERY_S, RLS_FORGETTING = 1.0, 0.9995
SEEDS = range(1, 6)
"""PyBOP's optimizer draws random numbers: one fit for each seed."""


class Learned(Protocol):
    """Result of a method."""

    def voltage_rms_mv(self, samples: SampleBlock, initial_soc: float) -> float | None:
        """Open loop along a capture from rest, SOC above ``LOWEST_SOC`` [mV]."""

    def elements(self, soc: Floats) -> Floats:
        """R_s [ohm] and both RC products [s] at each SOC, shape (3, n)."""

    def soc(self, samples: SampleBlock, start_soc: float) -> Floats | None:
        """At each sample of a capture entered with ``start_soc``."""

    def series_resistance(self, samples: SampleBlock, initial_soc: float) -> tuple[Floats, Floats] | None:
        """Return times [s] and R_s [ohm] while learning continues on a capture."""


Learn = Callable[[CellModel, SampleBlock, float], Learned | None]


@dataclass(frozen=True)
class Method:
    """A method by its name in the tables.

    Attributes:
        name: Of the method.
        learn: From the cell of the start, the samples and the SOC at the first of them; None: it cannot.
        run: What a step costs is measured with: a call that takes all samples; None: it is offline.
        other_seeds: ``learn`` with other random numbers, of a method that draws any.
    """

    name: str
    learn: Learn
    run: Callable[[CellModel, SampleBlock], Callable[[], object]] | None
    other_seeds: tuple[Learn, ...] = ()


class Elements:
    """a1..a15 that stay as they are; no SOC."""

    def __init__(self, cell: CellModel, a: Floats) -> None:
        self.cell, self.a = cell, a

    def voltage_rms_mv(self, samples: SampleBlock, initial_soc: float) -> float | None:
        """Return the value as ``Learned`` does."""
        counted = soc_by_counting(samples, self.cell.cell.capacity_ah, initial_soc)
        judged = np.flatnonzero(counted < LOWEST_SOC)
        whole = judged[0] if judged.size else counted.size
        try:
            error_v = predict(self.cell, samples, initial_soc, a=self.a, lowest_soc=LOWEST_SOC).error_v
        except UserError:
            return None
        rms_mv = 1e3 * _rms(error_v)
        return rms_mv if error_v.size >= WHOLE * whole and rms_mv < MAX_MV else None

    def elements(self, soc: Floats) -> Floats:
        """Return the values as ``Learned`` does."""
        return np.array([elements_at(x, self.a) for x in soc]).reshape(-1, 3).T

    def soc(self, samples: SampleBlock, start_soc: float) -> Floats | None:
        """None."""
        del samples, start_soc
        return None

    def series_resistance(self, samples: SampleBlock, initial_soc: float) -> tuple[Floats, Floats] | None:
        """None."""
        del samples, initial_soc
        return None


class FixedEkf(Elements):
    """The textbook filter with these elements at mid SOC."""

    def soc(self, samples: SampleBlock, start_soc: float) -> Floats | None:
        """Return the SOC as ``Learned`` does."""
        return fixed_ekf(*_columns(samples), start_soc, textbook(self.cell), np.array(ocv_grid(self.cell)))[0]


class Counted(Elements):
    """Elements of a method whose SOC is coulomb counting."""

    def soc(self, samples: SampleBlock, start_soc: float) -> Floats | None:
        """Return the SOC as ``Learned`` does."""
        return np.clip(soc_by_counting(samples, self.cell.cell.capacity_ah, start_soc), 0.0, 1.0)


class JointEkf(Elements):
    """A filter over SOC, two RC voltages and five elements; these are its geometric mean over the last half of a capture."""

    def __init__(self, cell: CellModel, samples: SampleBlock, initial_soc: float) -> None:
        _, elements = joint_ekf(*_columns(samples), initial_soc, textbook(cell), np.array(ocv_grid(cell)))
        learned = np.exp(np.log(elements[len(elements) // 2 :]).mean(axis=0))
        r_s, r1, tau1, r2, tau2 = learned.tolist()
        super().__init__(cell, constant_a(r_s, r1, tau1 / r1, r2, tau2 / r2))
        self.start = textbook(cell)
        self.start[1:] = learned

    def _run(self, samples: SampleBlock, start_soc: float) -> tuple[Floats, Floats]:
        return joint_ekf(*_columns(samples), start_soc, self.start, np.array(ocv_grid(self.cell)))

    def soc(self, samples: SampleBlock, start_soc: float) -> Floats | None:
        """Return the SOC as ``Learned`` does."""
        return self._run(samples, start_soc)[0]

    def series_resistance(self, samples: SampleBlock, initial_soc: float) -> tuple[Floats, Floats] | None:
        """Return R_s as ``Learned`` does."""
        return samples["time_s"].copy(), self._run(samples, initial_soc)[1][:, 0]


class Observed(Elements):
    """The estimator after it learned, to go on from there as often as one likes."""

    def __init__(self, cell: CellModel, estimator: Estimator, read: Reader, *, filtered: bool) -> None:
        super().__init__(cell, read(estimator, cell))
        self._estimator, self._read, self._filtered = estimator, read, filtered
        self._saved = estimator.record.copy()

    def _entered(self, soc: float) -> Estimator:
        self._estimator.record[:] = self._saved
        self._estimator.set_soc(soc)
        self._estimator.resume(np.inf)
        return self._estimator

    def soc(self, samples: SampleBlock, start_soc: float) -> Floats | None:
        """Return the SOC as ``Learned`` does."""
        trace = self._entered(start_soc).run(samples)
        return np.interp(samples["time_s"], trace["time_s"], trace["soc"])

    def series_resistance(self, samples: SampleBlock, initial_soc: float) -> tuple[Floats, Floats] | None:
        """Return R_s as ``Learned`` does; the identifier's own if it is used."""
        estimator = self._entered(initial_soc)
        if self._filtered:
            trace = estimator.run(samples)
            return trace["time_s"].copy(), trace["r_s_ohm"].copy()
        time_s = samples["time_s"]
        cuts = np.searchsorted(time_s, np.arange(time_s[0], time_s[-1], TRACED_S)[1:])
        said = []
        for piece in np.split(samples, np.unique(cuts)):
            estimator.run(piece)
            state = estimator.state[0]
            said.append((piece["time_s"][-1], chen_mora.r_s(float(state["soc"]), state["a"])))
        times_s, ohm = np.array(said).T
        return times_s, ohm


class Arx:
    """Coefficients of a 2RC model, the mean over the last half of a capture; SOC through the inverted OCV (7.1), smoothed over a minute."""

    def __init__(self, cell: CellModel, history: Floats) -> None:
        self.cell, self.coefficients = cell, history[len(history) // 2 :].mean(axis=0)

    def voltage_rms_mv(self, samples: SampleBlock, initial_soc: float) -> float | None:
        """Return the value as ``Learned`` does."""
        current_a, over_v, soc = overpotential(self.cell, samples, initial_soc)
        predicted_v = simulate_arx(self.coefficients, current_a)
        below = np.flatnonzero(soc < LOWEST_SOC)
        rms_mv = 1e3 * _rms((over_v - predicted_v)[: below[0] if below.size else soc.size])
        return rms_mv if rms_mv < MAX_MV else None

    def elements(self, soc: Floats) -> Floats:
        """Return the values as ``Learned`` does: equal at each SOC."""
        c1, c2, c3 = self.coefficients[:3]
        poles = np.sort(np.roots([1.0, -c1, -c2]))
        real = np.isreal(poles).all() and (np.real(poles) > 0.0).all() and (np.real(poles) < 1.0).all()
        taus = -RLS_EVERY_S / np.log(np.real(poles)) if real else np.full(2, np.nan)
        return np.tile(np.array([c3, *taus])[:, None], soc.size)

    def soc(self, samples: SampleBlock, start_soc: float) -> Floats | None:
        """Return the SOC as ``Learned`` does; it starts at rest without a value."""
        current_a, over_v, soc = overpotential(self.cell, samples, start_soc)
        open_v = open_circuit(self.cell, soc) - over_v + simulate_arx(self.coefficients, current_a)
        grid = ocv_grid(self.cell)
        raw = np.array([chen_mora.soc_from_ocv(v, *grid) for v in open_v])
        smooth = np.convolve(raw, np.ones(60) / 60.0, "same")
        return np.interp(samples["time_s"], evenly(samples), smooth)

    def series_resistance(self, samples: SampleBlock, initial_soc: float) -> tuple[Floats, Floats] | None:
        """Return R_s as ``Learned`` does, from the first sample on."""
        current_a, over_v, _ = overpotential(self.cell, samples, initial_soc)
        return evenly(samples), rls_arx(current_a, over_v, RLS_FORGETTING)[:, 2]


def observer(name: str, settings: ObserverSettings, identifier: IdentifierSettings | None, read: Reader) -> Method:
    """The estimator with these settings, its parameters as ``read``."""

    def learn(cell: CellModel, samples: SampleBlock, initial_soc: float) -> Learned:
        estimator = Estimator(cell, settings, identifier=identifier, initial_soc=initial_soc)
        estimator.run(samples)
        return Observed(cell, estimator, read, filtered=read is by_identifier)

    def run(cell: CellModel, samples: SampleBlock) -> Callable[[], object]:
        estimator = Estimator(cell, settings, identifier=identifier, initial_soc=1.0)

        def again() -> object:
            estimator.state["started"] = 0
            return estimator.run(samples)

        return again

    return Method(name, learn, run)


def by_observer(estimator: Estimator, cell: CellModel) -> Floats:
    """a1..a15 of the observer."""
    del cell
    return np.array(estimator.state[0]["a"])


def by_identifier(estimator: Estimator, cell: CellModel) -> Floats:
    """Return a1..a15 of the identifier's fit to its map, or of the start."""
    a = cell.a[:16].copy()
    for i in range(1, 16):
        learned = fitted_parameter(estimator.record[0], i)
        a[i] = learned.value if learned else a[i]
    return a


def learn_nothing(cell: CellModel, samples: SampleBlock, initial_soc: float) -> Learned:
    """The filter that is as it was given."""
    del samples, initial_soc
    return FixedEkf(cell, cell.a[:16])


def run_ekf(cell: CellModel, samples: SampleBlock) -> Callable[[], object]:
    """The filter over all samples."""
    columns, model, grid = _columns(samples), textbook(cell), np.array(ocv_grid(cell))
    return lambda: fixed_ekf(*columns, 1.0, model, grid)


def learn_arx(cell: CellModel, samples: SampleBlock, initial_soc: float) -> Learned:
    """Run recursive least squares; its start is 0, for any cell file."""
    current_a, over_v, _ = overpotential(cell, samples, initial_soc)
    return Arx(cell, rls_arx(current_a, over_v, RLS_FORGETTING))


def run_arx(cell: CellModel, samples: SampleBlock) -> Callable[[], object]:
    """The recursion over all samples; as many as there are, though it takes one a second."""
    current_a = samples["current_a"].astype(np.float64)
    over_v = open_circuit(cell, np.full(current_a.size, 0.5)) - samples["voltage_v"]
    return lambda: rls_arx(current_a, over_v, RLS_FORGETTING)


def learn_thesis(cell: CellModel, samples: SampleBlock, initial_soc: float) -> Learned:
    """Steps 2 and 3 of the thesis with the bounds of its Table 10; step 1 is the OCV that every method is given."""
    return learn_from_start(cell.model_copy(update={"adaptation": printed_bounds(cell)}), samples, initial_soc)


def learn_from_start(cell: CellModel, samples: SampleBlock, initial_soc: float) -> Learned:
    """Steps 2 and 3 with bounds around the start."""
    return Counted(cell, steps_2_and_3(cell, [Start(samples, initial_soc)], LOWEST_SOC).a)


def run_joint_ekf(cell: CellModel, samples: SampleBlock) -> Callable[[], object]:
    """The filter over all samples."""
    columns, model, grid = _columns(samples), textbook(cell), np.array(ocv_grid(cell))
    return lambda: joint_ekf(*columns, 1.0, model, grid)


def offline_fit(seed: int) -> Learn:
    """PyBOP's fit of constant elements with the random numbers of ``seed``."""

    def learn(cell: CellModel, samples: SampleBlock, initial_soc: float) -> Learned | None:
        from tests.benchmarks.pybop_fit import fit  # noqa: PLC0415 - an optional, heavy package

        _, r_s, r1, tau1, r2, tau2 = textbook(cell).tolist()
        start = {"R0 [Ohm]": r_s, "R1 [Ohm]": r1, "C1 [F]": tau1 / r1, "R2 [Ohm]": r2, "C2 [F]": tau2 / r2}
        found = fit(cell, samples, initial_soc, start, seed)
        return Elements(cell, constant_a(*found)) if found else None

    return learn


def constant_a(r_s: float, r1: float, c1: float, r2: float, c2: float) -> Floats:
    """a1..a15 of elements that are the same at any SOC. Shape (16,)."""
    tiny = 1e-30
    return np.array([np.nan, tiny, 1.0, r1, tiny, 1.0, r2, tiny, 1.0, c1, tiny, 1.0, c2, tiny, 1.0, r_s])


PRINTED, LEARNING, ON = ObserverSettings(), ObserverSettings(law="learning"), IdentifierSettings()
FILE = Method("the file, EKF", learn_nothing, run_ekf)
"""The correct start values, for comparison."""
OFFLINE = tuple(map(offline_fit, SEEDS))
METHODS = (
    observer("UAS printed", PRINTED, None, by_observer),
    Method("thesis, steps 1-3", learn_thesis, None),
    Method("steps 1-3, bounds of the start", learn_from_start, None),
    observer("UAS, bounds identified", PRINTED, ON, by_observer),
    observer("UAS learning", LEARNING, None, by_observer),
    observer("UAS learning + filter", LEARNING, ON, by_observer),
    observer("identifier", PRINTED, ON, by_identifier),
    Method("EKF, fixed", learn_nothing, run_ekf),
    Method("RLS", learn_arx, run_arx),
    Method("joint AEKF", JointEkf, run_joint_ekf),
    *((Method("PyBOP", OFFLINE[0], None, OFFLINE[1:]),) if find_spec("pybop") else ()),
)


def elements_at(soc: float, a: Floats) -> tuple[float, float, float]:
    """R_s [ohm] and both RC products [s]; NaN where a capacitance is negative."""
    tau_ts, tau_tl = chen_mora.r_ts(soc, a) * chen_mora.c_ts(soc, a), chen_mora.r_tl(soc, a) * chen_mora.c_tl(soc, a)
    return chen_mora.r_s(soc, a), tau_ts if tau_ts > 0.0 else np.nan, tau_tl if tau_tl > 0.0 else np.nan


def textbook(cell: CellModel) -> Floats:
    """Capacity [A s] and elements at SOC 0.5 as ``fixed_ekf`` takes them."""
    r_s, tau1, tau2 = elements_at(0.5, cell.a)
    r1, r2 = chen_mora.r_ts(0.5, cell.a), chen_mora.r_tl(0.5, cell.a)
    return np.array([3600.0 * cell.cell.capacity_ah, r_s, r1, tau1, r2, tau2])


def evenly(samples: SampleBlock) -> Floats:
    """A time axis of even steps [s]."""
    return np.arange(samples["time_s"][0], samples["time_s"][-1], RLS_EVERY_S)


def overpotential(cell: CellModel, samples: SampleBlock, initial_soc: float) -> tuple[Floats, Floats, Floats]:
    """Current [A], E_o less terminal voltage [V] and SOC by counting, evenly in time."""
    time_s = evenly(samples)
    held = np.searchsorted(samples["time_s"], time_s, side="right") - 1
    current_a = samples["current_a"][held].astype(np.float64)
    charge_as = np.concatenate([[0.0], np.cumsum(current_a[:-1]) * RLS_EVERY_S])
    soc = initial_soc - charge_as / (3600.0 * cell.cell.capacity_ah)
    voltage_v = np.interp(time_s, samples["time_s"], samples["voltage_v"])
    return current_a, open_circuit(cell, soc) - voltage_v, soc


def _columns(samples: SampleBlock) -> list[Floats]:
    return [np.ascontiguousarray(samples[name]) for name in ("time_s", "current_a", "voltage_v")]


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
