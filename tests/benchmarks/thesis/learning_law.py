"""Simulations of the learning law for the tables of docs/theory/observer.md: ``make learning``.

The cell of the thesis has a load of steps of random height and length, sampled each second. In the cell file R_s, R_ts,
tau_ts, R_tl and tau_tl are wrong by a factor of 2 up or down. Sixteen of the 32 combinations are used, in which every pair of
parameters has each of its four combinations equally often. The law bounds each parameter to a quarter and to four times its
value in the file. The tables contain two medians over the files: of the largest error among R_s and both RC products, and of
the largest error among all five parameters.

The printed law is Algorithm 1 of the thesis, with the Nussbaum gain N(k). The effect of N
on this law is measured on the real captures of ``../shared/data``, if they exist.
"""

import itertools
import math
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from bms_estimator import load_capture, load_cell
from bms_estimator.estimator import Estimator
from bms_estimator.estimator.learning_settings import RATE_HZ
from bms_estimator.kernels import step
from bms_estimator.kernels.cell_model import chen_mora as elements
from bms_estimator.kernels.observer import learning_law
from bms_estimator.kernels.observer.chen_mora_sensitivity import NAMES
from bms_estimator.kernels.observer.observer import integral_of_exponential
from bms_estimator.kernels.trace import TRACE
from bms_estimator.model.arrays import Record
from bms_estimator.model.cell import CellModel
from bms_estimator.model.sample import SampleBlock
from bms_estimator.numba_cache import njit
from bms_estimator.settings.observer import ObserverSettings
from tests.conftest import SHARED_DATA
from tests.estimator.random_steps import (
    FIRST_SOC,
    RATED_A,
    RESOLUTION_V,
    TRUTH,
    file_off_by,
    held_currents,
    learner,
    measured,
    random_steps,
    relative_errors,
)

FILE_FACTORS = [factors for factors in itertools.product((0.5, 2.0), repeat=5) if factors.count(2.0) % 2 == 0]
"""Factors by which R_s, R_ts, tau_ts, R_tl and tau_tl of each cell file are wrong."""
HOURS = (0.5, 1.0, 3.0, 10.0)
"""Times at which errors are printed [h]."""
NOISES_V = (0.0, 1e-3, 5e-3)
"""Standard deviations of the voltage noise [V]."""
CONVERGING = [0, 2, 4]
"""Indices of R_s and both RC products, which every informative load determines."""
INFINITE_DEAD_ZONE_V = 9.0
"""Dead zone that no error exceeds [V]."""
K_BOUND = learning_law.MAX_RATE_HZ / RATE_HZ
"""Upper bound of k in the learning law."""
OBSERVER_SETTINGS = ("dead_zone_v", "k0")
"""Changed settings that belong to the observer; all others belong to the learning law."""
LEAK = 1e-4
"""Gain of the leakage in the law without a memory. This law diverges at ten times this gain."""
HIGH_OHM_FACTOR = 10.0
"""Factor of the resistances of a cell on which k has a visible effect."""
SOC_ERROR = 0.05
"""Error of the initial SOC, by which the counted SOC is too low."""
NO_N: dict[str, Any] = {"nussbaum": "k2-cos", "k0": 0.0, "dead_zone_v": INFINITE_DEAD_ZONE_V}
"""Settings of N(k) = k^2 cos k with constant k = 0."""
NO_LOCK_DETECTION = {"lock_error_v": 100.0}
"""Settings with which no error counts as a loss of lock."""
CAPTURES = ("cell5_relaxation_c2", "cell1_random_steps", "cell1_dst")
"""Captures of the NCR18650 with which the gains N(k) and N = 0 are compared."""
Run = Callable[[Any, Any, Any, Any], int]
"""Type of ``kernels.step.run``."""


def learning_errors(
    block: SampleBlock,
    soc: float = FIRST_SOC,
    run: Run = step.run,
    settings: Mapping[str, float] | None = None,
    ohm_factor: float = 1.0,
) -> np.ndarray:
    """Return the relative errors of the five parameters after each of ``HOURS``, for each file. Shape (files, hours, 5).

    Args:
        block: Samples of the load.
        soc: SOC that the estimator is given at the first sample.
        run: ``kernels.step.run``, or a version of it.
        settings: Changed settings.
        ohm_factor: Factor of the resistances of the cell and of all files.
    """
    errors_by_file = np.empty((len(FILE_FACTORS), len(HOURS), 5))
    trace = np.zeros(block.size, dtype=TRACE)
    for n, factors in enumerate(FILE_FACTORS):
        r_s, r_ts, tau_ts, r_tl, tau_tl = factors
        estimator = learner(file_off_by(ohm_factor * r_s, ohm_factor * r_ts, tau_ts, ohm_factor * r_tl, tau_tl), soc)
        begin = 0
        for name, value in (settings or {}).items():
            estimator.settings_record["observer" if name in OBSERVER_SETTINGS else "learning"][name] = value
        for h, hours in enumerate(HOURS):
            end = int(3600 * hours)
            run(estimator.record, estimator.settings_record, block[begin:end], trace)
            errors_by_file[n, h], begin = relative_errors(estimator, factors), end
    return errors_by_file


def percent(errors_by_file: np.ndarray) -> list[str]:
    """Return for each hour, as text, two medians over the files [%].

    The first is the largest error among R_s and both RC products, the second the largest error among all five parameters.
    """
    converging = 100.0 * np.median(errors_by_file[:, :, CONVERGING].max(axis=2), axis=0)
    all_five = 100.0 * np.median(errors_by_file.max(axis=2), axis=0)
    return [f"{three:.1f} / {five:.1f}" for three, five in zip(converging, all_five, strict=True)]


def run_printed_law(block: SampleBlock, *, gain: float | None) -> tuple[str, str]:
    """Return the results of the printed law: largest error of R_s and both RC products [%], and RMS of the output error e [mV].

    A ``gain`` replaces N(k) and is constant, because no error exceeds the dead zone.
    """
    errors_by_file, e_v = [], []
    for factors in FILE_FACTORS:
        estimator = make_printed_law(file_off_by(*factors))
        estimator.run(block[:1])
        if gain is not None:
            estimator.state["gain"] = gain
            estimator.settings["dead_zone_v"] = INFINITE_DEAD_ZONE_V
        e_v.append(estimator.run(block[1:])["tracking_error_v"])
        errors_by_file.append(max(converging_errors(estimator)))
    return f"{100.0 * np.median(errors_by_file):.1f}", f"{1e3 * float(np.sqrt(np.mean(np.square(e_v)))):.2f}"


def make_printed_law(file: CellModel) -> Estimator:
    """Return an estimator with Algorithm 1 of the thesis without gain reset and lock detection, which would change N."""
    settings = ObserverSettings(rearm_gain=None, lock_error_v=100.0)
    return Estimator(file, settings, identifier=None, initial_soc=FIRST_SOC, voltage_resolution_v=RESOLUTION_V)


def converging_errors(estimator: Estimator) -> tuple[float, float, float]:
    """Return the relative errors of R_s, R_ts C_ts and R_tl C_tl at SOC 0.5."""
    a, true_a = estimator.state[0]["a"], TRUTH.a
    quantities = (
        lambda p: elements.r_s(0.5, p),
        lambda p: elements.r_ts(0.5, p) * elements.c_ts(0.5, p),
        lambda p: elements.r_tl(0.5, p) * elements.c_tl(0.5, p),
    )
    r_s, short, long = (abs(quantity(a) / quantity(true_a) - 1.0) for quantity in quantities)
    return r_s, short, long


def recompile_with(kernel: Any, **replacements: Any) -> Any:
    """Recompile a kernel with replacements of functions and constants that it uses, by their names in its module.

    Raises:
        KeyError: The kernel does not use a name.
    """
    original = kernel.py_func
    if unused := replacements.keys() - set(original.__code__.co_names):
        raise KeyError(*unused)
    return njit()(types.FunctionType(original.__code__, original.__globals__ | replacements, original.__name__))


def run_with(**replacements: Any) -> Run:
    """Return ``kernels.step.run`` with replaced parts of the learning law."""
    law = recompile_with(learning_law.learning_step, **replacements)
    run: Run = recompile_with(step.run, step=recompile_with(step.step, learning_step=law))
    return run


@njit()
def step_without_states(m: Record, q: Record, share: float) -> None:
    """Replace ``apply_parameter_step``: change theta (ln of the parameters) without correcting states and offset."""
    squared_step = 0.0
    for j in range(q.count):
        squared_step += m.step[j] * m.step[j]
        m.theta[j] = min(max(m.theta[j] + share * m.step[j], q.lower[j]), q.upper[j])
    learning_law.discount_information(m, q, share * squared_step / (q.reach * q.reach))


@njit()
def step_along_gradient(m: Record, q: Record) -> bool:
    """Replace ``solve_parameter_step``: step along the gradient divided by the trace of the memory, instead of Newton's step."""
    trace_of_information = 0.0
    for j in range(q.count):
        trace_of_information += m.information[j, j] + q.leak_v2s[j]
    for j in range(q.count):
        m.step[j] = m.pull[j] + q.leak_v2s[j] * (q.middle[j] - m.theta[j])
        for i in range(q.count):
            m.step[j] -= m.information[max(i, j), min(i, j)] * m.theta[i]
        m.step[j] /= trace_of_information
    return True


@njit()
def remember_last_sample(m: Record, q: Record, dt_s: float, e: float) -> None:
    """Replace ``accumulate_information``: use only the present sample, as normalized product of sensitivity psi and error e."""
    psi_squared = 0.0
    for j in range(q.count):
        psi_squared += m.psi[j] * m.psi[j]
    for j in range(q.count):
        m.pull[j] = m.psi[j] * e / (psi_squared + q.told_v * q.told_v)


@njit()
def step_along_pull(m: Record, q: Record) -> bool:
    """Replace ``solve_parameter_step`` to suit ``remember_last_sample``.

    theta' = gamma k (psi e / (eps2^2 + psi^2) - LEAK (theta - theta_m)), with the value theta_m of the file.
    """
    for j in range(q.count):
        m.step[j] = m.pull[j] - LEAK * (m.theta[j] - q.middle[j])
    return True


@njit()
def inject_as_printed(m: Record, q: Record, dt_s: float, e: float) -> None:
    """Replace ``inject_output_error``: u = -N e into both RC pairs, by (3.2) and (3.3) of the thesis with N = N(0) = 1/s."""
    share = 2.0 * integral_of_exponential(-2.0, dt_s)
    for branch in range(2):
        m.x[branch] -= 0.5 * share * e
        for j in range(q.count):
            m.dx[branch, j] += 0.5 * share * m.psi[j]


NO_MEMORY = {"accumulate_information": remember_last_sample, "solve_parameter_step": step_along_pull}
NO_INJECTION = {"offset_s": math.inf}
PARTS: dict[str, dict[str, Any]] = {  # name of the row: replaced functions or constants, and changed settings
    "all": {},
    "no memory: gradient of e^2, normalized": {"replacements": NO_MEMORY},
    "no memory, no injection": {"replacements": NO_MEMORY, "settings": NO_INJECTION},
    "a memory of 1 s": {"settings": {"memory_s": 1.0}},
    "gradient on the memory, not Newton's step": {"replacements": {"solve_parameter_step": step_along_gradient}},
    "the states do not move with theta": {"replacements": {"apply_parameter_step": step_without_states}},
    "memory does not fade as theta moves": {"settings": {"reach": 1e9}},
    "no leakage": {"settings": {"leak_v2s": 1e-14}},
    "no injection": {"settings": NO_INJECTION},
    "injection u = -N e into both branches, N = 1/s": {"replacements": {"inject_output_error": inject_as_printed}},
    "k = 1": {"settings": {"dead_zone_v": INFINITE_DEAD_ZONE_V}},
    "k at its bound from the start": {"settings": {"k0": K_BOUND}},
    "ten times this bound, k there from the start": {
        "replacements": {"MAX_RATE_HZ": 10.0 * learning_law.MAX_RATE_HZ},
        "settings": {"k0": 10.0 * K_BOUND},
    },
}


def ablation(blocks: Mapping[str, tuple[SampleBlock, float]]) -> Iterator[tuple[str, ...]]:
    """Yield a row for each removed part: errors at 1 h and 10 h for each block, given with the SOC at its first sample."""
    for name, changes in PARTS.items():
        run = run_with(**changes["replacements"]) if "replacements" in changes else step.run
        cells = []
        for block, soc in blocks.values():
            texts = percent(learning_errors(block, soc, run, changes.get("settings")))
            cells += [texts[1], texts[3]]  # 1 h and 10 h of ``HOURS``
        yield name, *cells


def effect_of_k() -> Iterator[tuple[str, ...]]:
    """Yield the effect of k on a cell with ten times the resistances, whose voltage errors are ten times as large."""
    high_ohm_cell = file_off_by(HIGH_OHM_FACTOR, HIGH_OHM_FACTOR, 1.0, HIGH_OHM_FACTOR, 1.0)
    block = random_steps(3.0, 1e-3, cell=high_ohm_cell)
    for period_s, within_dead_zone in itertools.product((60.0, 1000.0), (False, True)):
        settings = {"rate": 1.0 / period_s} | ({"dead_zone_v": INFINITE_DEAD_ZONE_V} if within_dead_zone else {})
        errors_by_file = learning_errors(block, settings=settings, ohm_factor=HIGH_OHM_FACTOR)
        r_s_percent = 100.0 * np.median(errors_by_file[:, :3, 0], axis=0)  # R_s at the first three of ``HOURS``
        yield (
            f"1/{period_s:g} s",
            "1" if within_dead_zone else "as it grows",
            *(f"{percent_at_hour:.1f}" for percent_at_hour in r_s_percent),
        )


def errors_by_element(block: SampleBlock) -> Iterator[tuple[str, ...]]:
    """Yield the median error of each element [%] with a counted SOC that is too low."""
    median_percent = 100.0 * np.median(learning_errors(block, FIRST_SOC - SOC_ERROR), axis=0)
    for hours, percent_by_element in zip(HOURS, median_percent, strict=True):
        yield f"{hours:g} h", *(f"{element_percent:.1f}" for element_percent in percent_by_element)


def compare_with_zero_gain() -> Iterator[tuple[str, ...]]:
    """Yield the difference between a1..a15 with N = 0 and a1..a15 with N(k) for each real capture. The identifier is on."""
    for name in CAPTURES:
        path = SHARED_DATA / "ncr18650" / f"{name}.csv.gz"
        if not path.is_file():
            yield name, "", "", "", f"not there: {path}"
            continue
        rows = load_capture(path).rows
        printed_law, trace_with_gain = run_capture(rows, {})
        for lock_detection, settings in (("as it is", NO_N), ("off", NO_N | NO_LOCK_DETECTION)):
            estimator, trace = run_capture(rows, settings)
            is_equal = all(
                np.array_equal(trace[f], trace_with_gain[f], equal_nan=True) for f in ("soc", "soc_std", "innovation_v")
            )
            is_equal &= estimator.record["elements"].tobytes() == printed_law.record["elements"].tobytes()
            deviation = np.abs(estimator.state[0]["a"][1:16] / printed_law.state[0]["a"][1:16] - 1.0)
            yield (
                name,
                lock_detection,
                str(estimator.state["lock_losses"][0]),
                f"{100.0 * deviation.max():.2g}",
                "the same to the last bit" if is_equal else "not the same",
            )


def run_capture(rows: SampleBlock, observer: Mapping[str, Any]) -> tuple[Estimator, SampleBlock]:
    """Return the estimator after a capture, and its trace."""
    estimator = Estimator(load_cell("ncr18650"), ObserverSettings.model_validate(observer))
    return estimator, estimator.run(rows).copy()


def measure_guarantees() -> Iterator[tuple[str, str]]:
    """Yield a row for each guarantee of docs/theory/observer.md except convergence."""
    with_noise = learner(TRUTH)
    q, theta = with_noise.settings_record[0]["learning"], with_noise.record[0]["learning"]["theta"]
    inside, estimate_v = True, []
    for part in np.array_split(random_steps(3.0, 0.2), 100):
        estimate_v += list(with_noise.run(part)["voltage_estimate_v"])
        inside &= bool((q["lower"] <= theta).all() and (theta <= q["upper"]).all())
    yield (
        "200 mV of noise, 3 h: theta within its bounds; y^ [V]",
        f"{inside}; {min(estimate_v):.2f}..{max(estimate_v):.2f}",
    )
    with_noise = learner(TRUTH)
    with_noise.run(random_steps(10.0, 0.05))
    yield "50 mV of noise, 10 h: k", f"{with_noise.state['k'][0]:g}"
    within_dead_zone = learner(TRUTH)
    within_dead_zone.run(random_steps(2.0, 0.1 * RESOLUTION_V))
    yield "noise within the dead zone, 2 h: k", f"{within_dead_zone.state['k'][0]:g}"
    beyond_bounds = learner(file_off_by(8.0, 1.0, 1.0, 1.0, 1.0))
    beyond_bounds.run(random_steps(3.0, 1e-3))
    yield (
        "file's R_s eight times the true, bounds from a quarter: R_s over the file's",
        f"{ratio_of_r_s(beyond_bounds):.3f}",
    )
    factors = (2.0, 0.5, 1.0, 2.0, 0.5)
    constant = learner(file_off_by(*factors))
    constant.run(measured(np.full(4 * 7200, 0.1 * RATED_A), 1e-3, np.random.default_rng(1)))
    yield (
        "4 h of constant current: errors [%]",
        " ".join(f"{100.0 * e:.0f}" for e in relative_errors(constant, factors)),
    )
    for minutes, error in measure_resistance_step():
        yield f"R_s increases to 1.5 times after 3 h: its error {minutes} min later [%]", f"{100.0 * error:.1f}"


def ratio_of_r_s(estimator: Estimator) -> float:
    """Return the learned R_s divided by the file's."""
    return float(np.exp(estimator.record[0]["learning"]["theta"][0]))


def measure_resistance_step() -> Iterator[tuple[int, float]]:
    """Yield times after a step of R_s to 1.5 times [min], and the errors then."""
    factor = 1.5
    current_a = held_currents(6.0, np.random.default_rng(2))
    block, after = (
        measured(current_a, 1e-3, np.random.default_rng(3), cell) for cell in (TRUTH, file_off_by(factor, 1, 1, 1, 1))
    )
    step_index = 3 * 3600  # after 3 h at 1 Hz
    block["voltage_v"][step_index:] = after["voltage_v"][step_index:]
    estimator = learner(TRUTH)
    estimator.run(block[:step_index])
    begin = step_index
    for minutes in (10, 30, 60):
        end = step_index + 60 * minutes
        estimator.run(block[begin:end])
        begin = end
        yield minutes, abs(ratio_of_r_s(estimator) / factor - 1.0)


def table(title: str, columns: tuple[str, ...], rows: Iterator[tuple[str, ...]]) -> None:
    """Print a table row by row."""
    printed_table = Table(title=title)
    for column in columns:
        printed_table.add_column(column)
    for row in rows:
        printed_table.add_row(*row)
    Console(width=150).print(printed_table)


def main() -> None:
    blocks = {noise_v: random_steps(10.0, noise_v) for noise_v in NOISES_V}
    table(
        "errors [%]: R_s and RC products / all five",
        ("noise", *(f"{hours:g} h" for hours in HOURS)),
        ((f"{1e3 * noise_v:g} mV", *percent(learning_errors(block))) for noise_v, block in blocks.items()),
    )
    table(
        "the printed law, 10 h",
        ("noise", "N(k)", "R_s and RC products [%]", "e, RMS [mV]"),
        (
            (f"{1e3 * noise_v:g} mV", name, *run_printed_law(blocks[noise_v], gain=gain))
            for noise_v in NOISES_V
            for name, gain in (("as printed", None), ("== 0", 0.0))
        ),
    )
    table(
        "without one part: errors [%] of R_s and RC products / all five",
        ("", "1 mV, 1 h", "10 h", "5 mV, 1 h", "10 h", "SOC 0.05 too low, 1 h", "10 h"),
        ablation(
            {
                "1 mV": (blocks[1e-3], FIRST_SOC),
                "5 mV": (blocks[5e-3], FIRST_SOC),
                "SOC": (blocks[1e-3], FIRST_SOC - SOC_ERROR),
            }
        ),
    )
    table(
        "effect of k: error of R_s [%], ten times the resistances, 1 mV of noise",
        ("gamma", "k", *(f"{hours:g} h" for hours in HOURS[:3])),
        effect_of_k(),
    )
    table("SOC 0.05 too low, 1 mV: error of each [%]", ("", *NAMES), errors_by_element(blocks[1e-3]))
    table(
        "the printed law with N == 0 on real captures, against N(k)",
        (
            "capture",
            "lock detection",
            "losses of lock",
            "largest error of a1..a15 [%]",
            "SOC, std, elements, innovation",
        ),
        compare_with_zero_gain(),
    )
    table("guarantees under any load", ("", "measured"), measure_guarantees())


if __name__ == "__main__":
    main()
