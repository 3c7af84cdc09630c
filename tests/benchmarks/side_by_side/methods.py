"""Compared methods with a common interface.

``Method.learn`` receives the samples of one capture and the SOC at the first sample. The result can predict the voltage in
open loop, return the circuit elements at an SOC, estimate the SOC from a wrong initial value, and return R_s over time. A
result is None if the method does not offer it. Numbers in parentheses are equations of the thesis.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Protocol

import numpy as np

from bms_estimator.calibration.cleaning.rests import soc_by_counting
from bms_estimator.calibration.thesis.adapt_steps import CaptureWithSoc, steps_2_and_3
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
from tests.benchmarks.side_by_side.baselines import fixed_ekf, joint_ekf, rls_arx, simulate_arx

ParameterReader = Callable[[Estimator, CellModel], Floats]
"""Function that returns a1..a15 of an estimator after learning. Shape (16,)."""

LOWEST_SOC = 0.1
"""SOC below which no method learns or is evaluated, because real elements deviate from (2.5)-(2.9) there."""
MAX_MV = 1e4
"""RMS voltage error above which a model counts as diverged [mV]."""
MIN_COVERAGE = 0.9
"""Minimum fraction of a capture that a prediction must cover. A prediction ends where a learned capacitance becomes
negative."""
R_S_INTERVAL_S = 30.0
"""Interval at which R_s is calculated from the observer's parameters [s]."""
RLS_EVERY_S = 1.0
"""Sampling interval of recursive least squares [s]."""
RLS_FORGETTING = 0.9995
"""Forgetting factor of recursive least squares: a memory of 2000 samples."""
SEEDS = range(1, 6)
"""Seeds of PyBOP's optimizer, which is stochastic. Each seed gives one fit."""


class Learned(Protocol):
    """Result of a method."""

    def voltage_rms_mv(self, samples: SampleBlock, initial_soc: float) -> float | None:
        """Return the RMS error of the open-loop voltage above ``LOWEST_SOC`` [mV]; None if the prediction fails.

        The capture starts from rest.
        """

    def elements(self, soc: Floats) -> Floats:
        """Return R_s [ohm] and both RC products [s] at each SOC, shape (3, n)."""

    def soc(self, samples: SampleBlock, start_soc: float) -> Floats | None:
        """Return the estimated SOC at each sample for the initial SOC ``start_soc``; None without an SOC estimator."""

    def series_resistance(self, samples: SampleBlock, initial_soc: float) -> tuple[Floats, Floats] | None:
        """Return times [s] and R_s [ohm] while learning continues on a capture; None if R_s is constant."""


Learn = Callable[[CellModel, SampleBlock, float], Learned | None]
"""Function that learns from the initial cell model, the samples, and the SOC at the first sample; it returns None if the
fit fails."""


@dataclass(frozen=True)
class Method:
    """Compared method.

    Attributes:
        name: Name of the method in the tables.
        learn: Function that learns from a capture.
        run: Returns a function that processes all samples, for the measurement of the time of a step; None for an
            offline method.
        other_seeds: ``learn`` with other random seeds, for a stochastic method.
    """

    name: str
    learn: Learn
    run: Callable[[CellModel, SampleBlock], Callable[[], object]] | None
    other_seeds: tuple[Learn, ...] = ()


class Elements:
    """Result with constant a1..a15 and without an SOC estimator."""

    def __init__(self, cell: CellModel, a: Floats) -> None:
        self.cell, self.a = cell, a

    def voltage_rms_mv(self, samples: SampleBlock, initial_soc: float) -> float | None:
        """Return the value as ``Learned`` does."""
        counted = soc_by_counting(samples, self.cell.cell.capacity_ah, initial_soc)
        below = np.flatnonzero(counted < LOWEST_SOC)
        evaluated_count = below[0] if below.size else counted.size
        try:
            error_v = predict(self.cell, samples, initial_soc, a=self.a, lowest_soc=LOWEST_SOC).error_v
        except UserError:
            return None
        rms_mv = 1e3 * _rms(error_v)
        return rms_mv if error_v.size >= MIN_COVERAGE * evaluated_count and rms_mv < MAX_MV else None

    def elements(self, soc: Floats) -> Floats:
        """Return the values as ``Learned`` does."""
        return np.array([elements_at(x, self.a) for x in soc]).reshape(-1, 3).T

    def soc(self, samples: SampleBlock, start_soc: float) -> Floats | None:
        """Return None, because the result has no SOC estimator."""
        del samples, start_soc
        return None

    def series_resistance(self, samples: SampleBlock, initial_soc: float) -> tuple[Floats, Floats] | None:
        """Return None, because R_s is constant."""
        del samples, initial_soc
        return None


class FixedEkf(Elements):
    """Result with constant a1..a15 and the SOC of an EKF with the cell's elements at SOC 0.5."""

    def soc(self, samples: SampleBlock, start_soc: float) -> Floats | None:
        """Return the SOC as ``Learned`` does."""
        return fixed_ekf(*_columns(samples), start_soc, ekf_parameters(self.cell), np.array(ocv_grid(self.cell)))[0]


class Counted(Elements):
    """Result with constant a1..a15 and the SOC by coulomb counting."""

    def soc(self, samples: SampleBlock, start_soc: float) -> Floats | None:
        """Return the SOC as ``Learned`` does."""
        return np.clip(soc_by_counting(samples, self.cell.cell.capacity_ah, start_soc), 0.0, 1.0)


class JointEkf(Elements):
    """Joint EKF with the states SOC, two RC voltages and five elements.

    The learned elements are the geometric mean of the estimates over the last half of the capture.
    """

    def __init__(self, cell: CellModel, samples: SampleBlock, initial_soc: float) -> None:
        _, elements = joint_ekf(*_columns(samples), initial_soc, ekf_parameters(cell), np.array(ocv_grid(cell)))
        learned = np.exp(np.log(elements[len(elements) // 2 :]).mean(axis=0))
        r_s, r1, tau1, r2, tau2 = learned.tolist()
        super().__init__(cell, constant_a(r_s, r1, tau1 / r1, r2, tau2 / r2))
        self.start = ekf_parameters(cell)
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
    """Result of the estimator. Each call continues from the state after learning."""

    def __init__(self, cell: CellModel, estimator: Estimator, read: ParameterReader, *, filtered: bool) -> None:
        super().__init__(cell, read(estimator, cell))
        self._estimator, self._read, self._filtered = estimator, read, filtered
        self._saved = estimator.record.copy()

    def _restart_from_learned(self, soc: float) -> Estimator:
        self._estimator.record[:] = self._saved
        self._estimator.set_soc(soc)
        self._estimator.resume(np.inf)  # the time since the learned capture is unknown
        return self._estimator

    def soc(self, samples: SampleBlock, start_soc: float) -> Floats | None:
        """Return the SOC as ``Learned`` does."""
        trace = self._restart_from_learned(start_soc).run(samples)
        return np.interp(samples["time_s"], trace["time_s"], trace["soc"])

    def series_resistance(self, samples: SampleBlock, initial_soc: float) -> tuple[Floats, Floats] | None:
        """Return R_s as ``Learned`` does: by the identifier if it is used, otherwise by the observer."""
        estimator = self._restart_from_learned(initial_soc)
        if self._filtered:
            trace = estimator.run(samples)
            return trace["time_s"].copy(), trace["r_s_ohm"].copy()
        time_s = samples["time_s"]
        cuts = np.searchsorted(time_s, np.arange(time_s[0], time_s[-1], R_S_INTERVAL_S)[1:])
        rows = []
        for piece in np.split(samples, np.unique(cuts)):
            estimator.run(piece)
            state = estimator.state[0]
            rows.append((piece["time_s"][-1], chen_mora.r_s(float(state["soc"]), state["a"])))
        times_s, ohm = np.array(rows).T
        return times_s, ohm


class Arx:
    """Result of recursive least squares: ARX coefficients of two RC pairs, averaged over the last half of a capture.

    The SOC is the inverse OCV of terminal voltage plus overpotential (7.1), as a moving average over 60 s.
    """

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
        """Return the SOC as ``Learned`` does.

        The method has no initial SOC: ``start_soc`` cancels out, because E_o at the counted SOC is subtracted again.
        """
        current_a, over_v, soc = overpotential(self.cell, samples, start_soc)
        open_v = open_circuit(self.cell, soc) - over_v + simulate_arx(self.coefficients, current_a)
        grid = ocv_grid(self.cell)
        raw_soc = np.array([chen_mora.soc_from_ocv(v, *grid) for v in open_v])
        smooth = np.convolve(raw_soc, np.ones(60) / 60.0, "same")
        return np.interp(samples["time_s"], evenly_spaced_times(samples), smooth)

    def series_resistance(self, samples: SampleBlock, initial_soc: float) -> tuple[Floats, Floats] | None:
        """Return R_s as ``Learned`` does. The recursion restarts at the first sample."""
        current_a, over_v, _ = overpotential(self.cell, samples, initial_soc)
        return evenly_spaced_times(samples), rls_arx(current_a, over_v, RLS_FORGETTING)[:, 2]


def observer(
    name: str, settings: ObserverSettings, identifier: IdentifierSettings | None, read: ParameterReader
) -> Method:
    """Return the method that runs the estimator with these settings and uses the parameters that ``read`` returns."""

    def learn(cell: CellModel, samples: SampleBlock, initial_soc: float) -> Learned:
        estimator = Estimator(cell, settings, identifier=identifier, initial_soc=initial_soc)
        estimator.run(samples)
        return Observed(cell, estimator, read, filtered=read is by_identifier)

    def run(cell: CellModel, samples: SampleBlock) -> Callable[[], object]:
        estimator = Estimator(cell, settings, identifier=identifier, initial_soc=1.0)

        def run_from_start() -> object:
            estimator.state["started"] = 0
            return estimator.run(samples)

        return run_from_start

    return Method(name, learn, run)


def by_observer(estimator: Estimator, cell: CellModel) -> Floats:
    """Return a1..a15 of the observer."""
    del cell
    return np.array(estimator.state[0]["a"])


def by_identifier(estimator: Estimator, cell: CellModel) -> Floats:
    """Return a1..a15 fitted by the identifier, and the initial value of each parameter that is not fitted."""
    a = cell.a[:16].copy()
    for i in range(1, 16):
        learned = fitted_parameter(estimator.record[0], i)
        a[i] = learned.value if learned else a[i]
    return a


def learn_nothing(cell: CellModel, samples: SampleBlock, initial_soc: float) -> Learned:
    """Return the EKF with the constant elements of the initial cell."""
    del samples, initial_soc
    return FixedEkf(cell, cell.a[:16])


def run_ekf(cell: CellModel, samples: SampleBlock) -> Callable[[], object]:
    """Return a function that runs the EKF with constant elements over all samples."""
    columns, model, grid = _columns(samples), ekf_parameters(cell), np.array(ocv_grid(cell))
    return lambda: fixed_ekf(*columns, 1.0, model, grid)


def learn_arx(cell: CellModel, samples: SampleBlock, initial_soc: float) -> Learned:
    """Run recursive least squares. Its coefficients start at 0, whatever the cell file."""
    current_a, over_v, _ = overpotential(cell, samples, initial_soc)
    return Arx(cell, rls_arx(current_a, over_v, RLS_FORGETTING))


def run_arx(cell: CellModel, samples: SampleBlock) -> Callable[[], object]:
    """Return a function that runs recursive least squares over every sample, for timing. Learning uses one sample per second."""
    current_a = samples["current_a"].astype(np.float64)
    over_v = open_circuit(cell, np.full(current_a.size, 0.5)) - samples["voltage_v"]
    return lambda: rls_arx(current_a, over_v, RLS_FORGETTING)


def learn_thesis(cell: CellModel, samples: SampleBlock, initial_soc: float) -> Learned:
    """Run steps 2 and 3 of the thesis with the bounds of its Table 10. All methods have the OCV, which is step 1."""
    return learn_from_start(cell.model_copy(update={"adaptation": printed_bounds(cell)}), samples, initial_soc)


def learn_from_start(cell: CellModel, samples: SampleBlock, initial_soc: float) -> Learned:
    """Run steps 2 and 3 of the thesis with bounds around the initial parameters."""
    return Counted(cell, steps_2_and_3(cell, [CaptureWithSoc(samples, initial_soc)], LOWEST_SOC).a)


def run_joint_ekf(cell: CellModel, samples: SampleBlock) -> Callable[[], object]:
    """Return a function that runs the joint EKF over all samples."""
    columns, model, grid = _columns(samples), ekf_parameters(cell), np.array(ocv_grid(cell))
    return lambda: joint_ekf(*columns, 1.0, model, grid)


def offline_fit(seed: int) -> Learn:
    """Return the function that fits constant elements by PyBOP with the random seed ``seed``."""

    def learn(cell: CellModel, samples: SampleBlock, initial_soc: float) -> Learned | None:
        from tests.benchmarks.side_by_side.pybop_fit import fit  # noqa: PLC0415 - an optional, heavy package

        _, r_s, r1, tau1, r2, tau2 = ekf_parameters(cell).tolist()
        start = {"R0 [Ohm]": r_s, "R1 [Ohm]": r1, "C1 [F]": tau1 / r1, "R2 [Ohm]": r2, "C2 [F]": tau2 / r2}
        fitted = fit(cell, samples, initial_soc, start, seed)
        return Elements(cell, constant_a(*fitted)) if fitted else None

    return learn


def constant_a(r_s: float, r1: float, c1: float, r2: float, c2: float) -> Floats:
    """Return a1..a15 of elements that are equal at all SOCs. Shape (16,)."""
    tiny = 1e-30  # amplitude of the exponentials; not 0, because ``chen_mora.delta`` divides by it
    return np.array([np.nan, tiny, 1.0, r1, tiny, 1.0, r2, tiny, 1.0, c1, tiny, 1.0, c2, tiny, 1.0, r_s])


OBSERVER_AS_PRINTED = ObserverSettings()
"""Settings of the observer with the law of the thesis."""
OBSERVER_LEARNING_LAW = ObserverSettings(law="learning")
"""Settings of the observer with the learning law."""
IDENTIFIER = IdentifierSettings()
"""Default settings of the identifier."""
FILE = Method("the file, EKF", learn_nothing, run_ekf)
"""EKF with the correct elements, for comparison. The method ``EKF, fixed`` runs with wrong initial elements."""
OFFLINE = tuple(map(offline_fit, SEEDS))
"""Fits by PyBOP, one for each of ``SEEDS``."""
METHODS = (
    # UAS: universal adaptive stabilizer, the observer of the thesis
    observer("UAS printed", OBSERVER_AS_PRINTED, None, by_observer),
    Method("thesis, steps 1-3", learn_thesis, None),
    Method("steps 1-3, bounds of the start", learn_from_start, None),
    observer("UAS, bounds identified", OBSERVER_AS_PRINTED, IDENTIFIER, by_observer),
    observer("UAS learning", OBSERVER_LEARNING_LAW, None, by_observer),
    observer("UAS learning + filter", OBSERVER_LEARNING_LAW, IDENTIFIER, by_observer),
    observer("identifier", OBSERVER_AS_PRINTED, IDENTIFIER, by_identifier),
    Method("EKF, fixed", learn_nothing, run_ekf),
    Method("RLS", learn_arx, run_arx),
    Method("joint AEKF", JointEkf, run_joint_ekf),
    *((Method("PyBOP", OFFLINE[0], None, OFFLINE[1:]),) if find_spec("pybop") else ()),
)


def elements_at(soc: float, a: Floats) -> tuple[float, float, float]:
    """Return R_s [ohm] and both RC products [s]; NaN where a capacitance is negative."""
    tau_ts, tau_tl = chen_mora.r_ts(soc, a) * chen_mora.c_ts(soc, a), chen_mora.r_tl(soc, a) * chen_mora.c_tl(soc, a)
    return chen_mora.r_s(soc, a), tau_ts if tau_ts > 0.0 else np.nan, tau_tl if tau_tl > 0.0 else np.nan


def ekf_parameters(cell: CellModel) -> Floats:
    """Return capacity [A s], R_s, R_1 [ohm], tau_1 [s], R_2 [ohm] and tau_2 [s] at SOC 0.5, as for ``fixed_ekf``."""
    r_s, tau1, tau2 = elements_at(0.5, cell.a)
    r1, r2 = chen_mora.r_ts(0.5, cell.a), chen_mora.r_tl(0.5, cell.a)
    return np.array([3600.0 * cell.cell.capacity_ah, r_s, r1, tau1, r2, tau2])


def evenly_spaced_times(samples: SampleBlock) -> Floats:
    """Return sample times at intervals of ``RLS_EVERY_S`` [s]."""
    return np.arange(samples["time_s"][0], samples["time_s"][-1], RLS_EVERY_S)


def overpotential(cell: CellModel, samples: SampleBlock, initial_soc: float) -> tuple[Floats, Floats, Floats]:
    """Return current [A], E_o minus terminal voltage [V] and counted SOC at intervals of ``RLS_EVERY_S``."""
    time_s = evenly_spaced_times(samples)
    last_rows = np.searchsorted(samples["time_s"], time_s, side="right") - 1
    current_a = samples["current_a"][last_rows].astype(np.float64)
    charge_as = np.concatenate([[0.0], np.cumsum(current_a[:-1]) * RLS_EVERY_S])
    soc = initial_soc - charge_as / (3600.0 * cell.cell.capacity_ah)
    voltage_v = np.interp(time_s, samples["time_s"], samples["voltage_v"])
    return current_a, open_circuit(cell, soc) - voltage_v, soc


def _columns(samples: SampleBlock) -> list[Floats]:
    return [np.ascontiguousarray(samples[name]) for name in ("time_s", "current_a", "voltage_v")]


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
