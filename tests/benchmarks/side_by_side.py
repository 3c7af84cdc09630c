"""Methods side by side on real captures: what each learns from one profile, tried on another that it never saw.

Every method starts from the same cell: its OCV and capacity, every resistance twice and so every time constant twice
what the cell file says. It learns from the relaxation test. Then:

- voltage: its elements, frozen, predict the random steps open loop from the rested start, SOC above 0.1
- SOC: it starts half an hour into the random steps, under load, at a SOC that is 0.20 too low; RMS error from an hour
  later on against the rested start of the capture less Ah / capacity, SOC above 0.05
- seconds: what learning took, on one core, compiled before
"""

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from baselines import fixed_ekf, rls_arx, simulate_arx
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from bms_estimator.calibration.identify import identify
from bms_estimator.calibration.prediction import open_circuit, predict
from bms_estimator.calibration.relaxation import without_glitches
from bms_estimator.calibration.validate import validate
from bms_estimator.estimator import Estimator
from bms_estimator.estimator.learned import fitted_parameter
from bms_estimator.estimator.records import ocv_grid
from bms_estimator.kernels import cell as chen_mora
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.columns import Columns
from bms_estimator.model.sample import SampleBlock
from bms_estimator.model.settings import IdentifierSettings
from bms_estimator.sources.replay import load_capture

Floats = NDArray[np.float64]

DATA = Path(__file__).parents[3] / "shared" / "data" / "ncr18650"
LEARN, HELD_BACK = "cell5_relaxation_c2", "cell5_random_steps"
WRONG_BY = 2.0
WRONG_SOC = 0.2
LOWEST_SOC = 0.1
RLS_EVERY_S = 1.0
RLS_FORGETTING = 0.9995
START_S = 1800.0
SETTLED_S = 3600.0
ON = IdentifierSettings()


@dataclass(frozen=True)
class Outcome:
    """What came of one method; None where it does not do that."""

    method: str
    voltage_rms_mv: float | None
    soc_rmse_percent: float | None
    seconds: float | None
    remark: str = ""


class Trial:
    """The two captures and the cell that all methods start from."""

    def __init__(self) -> None:
        self.cell = wrong(load_cell("ncr18650"))
        self.learn, self.held_back = (
            without_glitches(load_capture(DATA / f"{n}.csv.gz").rows, n) for n in (LEARN, HELD_BACK)
        )
        self.grid = np.array(ocv_grid(self.cell))
        self.initial_soc = chen_mora.soc_from_ocv(float(self.held_back["voltage_v"][0]), *self.grid)
        time_s, current_a = (np.ascontiguousarray(self.held_back[n]) for n in ("time_s", "current_a"))
        charge_as = np.concatenate([[0.0], np.cumsum(current_a[:-1] * np.diff(time_s).clip(min=0.0))])
        true_soc = self.initial_soc - charge_as / (3600.0 * self.cell.cell.capacity_ah)
        elapsed_s = time_s - time_s[0]
        self.blind = self.held_back[elapsed_s >= START_S]
        self.true_soc = true_soc[elapsed_s >= START_S]
        self.start_soc = float(self.true_soc[0]) - WRONG_SOC
        self.judged = (elapsed_s[elapsed_s >= START_S] >= START_S + SETTLED_S) & (self.true_soc >= 0.05)

    def voltage_rms_mv(self, a: Floats) -> float:
        """Open loop along the held-back capture with a1..a15 frozen."""
        error_v = predict(self.cell, self.held_back, self.initial_soc, a=a, lowest_soc=LOWEST_SOC).error_v
        return 1e3 * float(np.sqrt(np.mean(error_v**2)))

    def soc_rmse_percent(self, soc: Floats) -> float:
        """Of the SOC at each sample from ``START_S`` on."""
        return 100.0 * float(np.sqrt(np.mean((soc - self.true_soc)[self.judged] ** 2)))

    def run_held_back(self, estimator: Estimator) -> float:
        """SOC RMSE [%] of an estimator that learned before and is told a wrong SOC."""
        estimator.set_soc(self.start_soc)
        estimator.resume(np.inf)
        return self.soc_rmse_percent(estimator.run(self.blind)["soc"])


def wrong(cell: CellModel) -> CellModel:
    """The cell with resistances twice as large, and no ladder."""
    parts: dict[str, object] = {"ladder": None}
    for name in ("r_s", "r_ts", "r_tl"):
        part = getattr(cell, name)
        ohms = {key: WRONG_BY * getattr(part, key) for key in ("amplitude_ohm", "offset_ohm")}
        parts[name] = part.model_copy(update=ohms)
    return cell.model_copy(update=parts)


def observer_alone(trial: Trial) -> Outcome:
    """Algorithm 1 as printed: SOC by coulomb counting, a_i go where their bounds say (Lemma 4.1.3)."""
    estimator = Estimator(trial.cell, initial_soc=1.0, identifier=None)
    seconds = timed(lambda: estimator.run(trial.learn))
    a = estimator.state[0]["a"].copy()
    return Outcome(
        "UAS as printed", trial.voltage_rms_mv(a), trial.run_held_back(estimator), seconds, "its limits are the start"
    )


def observer_with_bounds(trial: Trial) -> Outcome:
    """The same with bounds from the identifier."""
    estimator = Estimator(trial.cell, identifier=ON, initial_soc=1.0)
    seconds = timed(lambda: estimator.run(trial.learn))
    a = estimator.state[0]["a"].copy()
    return Outcome("UAS, bounds identified", trial.voltage_rms_mv(a), trial.run_held_back(estimator), seconds)


def identifier(trial: Trial) -> Outcome:
    """The identifier's own fit to its map."""
    estimator = Estimator(trial.cell, identifier=ON, initial_soc=1.0)
    seconds = timed(lambda: estimator.run(trial.learn))
    record, a = estimator.record[0], trial.cell.a[:16].copy()
    for i in range(1, 16):
        learned = fitted_parameter(record, i)
        a[i] = learned.value if learned else a[i]
    return Outcome("identifier (online)", trial.voltage_rms_mv(a), trial.run_held_back(estimator), seconds)


def textbook_ekf(trial: Trial) -> Outcome:
    """(soc, v1, v2) with the elements it was given."""
    a = trial.cell.a
    values = [f(0.5, a) for f in (chen_mora.r_s, chen_mora.r_ts, chen_mora.c_ts, chen_mora.r_tl, chen_mora.c_tl)]
    r_s, r1, c1, r2, c2 = values
    model = np.array([3600.0 * trial.cell.cell.capacity_ah, r_s, r1, r1 * c1, r2, r2 * c2])
    columns = [np.ascontiguousarray(trial.blind[name]) for name in ("time_s", "current_a", "voltage_v")]
    soc, _ = fixed_ekf(*columns, trial.start_soc, model, trial.grid)
    return Outcome(
        "EKF, parameters fixed", trial.voltage_rms_mv(a[:16]), trial.soc_rmse_percent(soc), None, "learns nothing"
    )


def rls(trial: Trial) -> Outcome:
    """ARX of two RC pairs on the overpotential; SOC through the inverted OCV (7.1), smoothed over a minute."""
    current_a, over_v, _ = overpotential(trial, trial.learn, 1.0)
    rls_arx(current_a[:10], over_v[:10], RLS_FORGETTING)
    coefficients: list[Floats] = []
    seconds = timed(lambda: coefficients.append(rls_arx(current_a, over_v, RLS_FORGETTING)))
    current_a, over_v, soc = overpotential(trial, trial.held_back, trial.initial_soc)
    predicted_v = simulate_arx(coefficients[0], current_a)
    error_v = (over_v - predicted_v)[soc >= LOWEST_SOC]
    ocv_v = trial_voltage(trial.held_back) + predicted_v
    raw = np.array([chen_mora.soc_from_ocv(v, *trial.grid) for v in ocv_v])
    smooth = np.convolve(raw, np.ones(60) / 60.0, "same")
    return Outcome(
        "RLS with forgetting, ARX",
        1e3 * float(np.sqrt(np.mean(error_v**2))),
        trial.soc_rmse_percent(np.interp(trial.blind["time_s"], evenly(trial.held_back), smooth)),
        seconds,
    )


def pybop(trial: Trial) -> Outcome:
    """Two RC pairs of constant elements, CMA-ES, the same OCV."""
    try:
        from pybop_fit import fit  # noqa: PLC0415 - an optional, heavy package
    except ModuleNotFoundError as error:
        return Outcome("PyBOP, CMA-ES", None, None, None, f"{error.name} is not installed: make compare installs it")
    start = time.perf_counter()
    r_s, r1, c1, r2, c2 = fit(trial.cell, trial.learn)
    seconds = time.perf_counter() - start
    tiny = 1e-30
    a = np.array([np.nan, tiny, 1.0, r1, tiny, 1.0, r2, tiny, 1.0, c1, tiny, 1.0, c2, tiny, 1.0, r_s])
    return Outcome("PyBOP, CMA-ES", trial.voltage_rms_mv(a), None, seconds, "offline")


def offline(trial: Trial) -> Outcome:
    """bms-estimator identify; it corrects the OCV as well."""
    capture = [Columns(trial.learn, LEARN)]
    identify(capture, trial.cell)
    start = time.perf_counter()
    found = identify(capture, trial.cell).cell
    seconds = time.perf_counter() - start
    rms_mv = 1e3 * validate(Columns(trial.held_back, HELD_BACK), found).above.voltage_rms_v
    return Outcome("identify (offline)", rms_mv, None, seconds, "offline; corrects the OCV")


def evenly(samples: SampleBlock) -> Floats:
    """A time axis of even steps [s]."""
    return np.arange(samples["time_s"][0], samples["time_s"][-1], RLS_EVERY_S)


def trial_voltage(samples: SampleBlock) -> Floats:
    """Voltage on the even time axis [V]."""
    return np.interp(evenly(samples), samples["time_s"], samples["voltage_v"])


def overpotential(trial: Trial, samples: SampleBlock, initial_soc: float) -> tuple[Floats, Floats, Floats]:
    """Current [A], E_o less terminal voltage [V] and SOC by counting, evenly in time."""
    time_s = evenly(samples)
    held = np.searchsorted(samples["time_s"], time_s, side="right") - 1
    current_a = samples["current_a"][held].astype(np.float64)
    charge_as = np.concatenate([[0.0], np.cumsum(current_a[:-1]) * RLS_EVERY_S])
    soc = initial_soc - charge_as / (3600.0 * trial.cell.cell.capacity_ah)
    return current_a, open_circuit(trial.cell, soc) - trial_voltage(samples), soc


def timed(work: Callable[[], object]) -> float:
    """Processor time of a call that has run before [s]."""
    start = time.thread_time()
    work()
    return time.thread_time() - start


METHODS = (observer_alone, observer_with_bounds, identifier, textbook_ekf, rls, offline, pybop)


def outcomes(trial: Trial) -> Iterator[Outcome]:
    """One for each method."""
    Estimator(trial.cell, identifier=ON, initial_soc=1.0).run(trial.learn[:10])  # compiles
    for method in METHODS:
        yield method(trial)


def main() -> None:
    if not DATA.is_dir():
        sys.exit(f"{DATA}: the captures are not there")
    table = Table(
        title=f"learned from {LEARN}, tried on {HELD_BACK}; start: resistances x {WRONG_BY:g}, SOC -{WRONG_SOC:g}"
    )
    for column in ("method", "voltage RMS [mV]", "SOC RMSE [%]", "seconds", ""):
        table.add_column(column, justify="left" if column in ("method", "") else "right")
    for o in outcomes(Trial()):
        numbers = [
            ("-" if v is None else f"{v:.{d}f}")
            for v, d in ((o.voltage_rms_mv, 2), (o.soc_rmse_percent, 2), (o.seconds, 3))
        ]
        table.add_row(o.method, *numbers, o.remark)
    Console().print(table)


if __name__ == "__main__":
    main()
