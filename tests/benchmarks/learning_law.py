"""Value of the learning law, simulated: ``make learning``. The tables of docs/theory/observer.md.

The thesis's cell under steps of random height and length, a sample each second, bounds a quarter to four times the
file's; the file is off by a factor 2 in R_s, R_ts, tau_ts, R_tl, tau_tl: sixteen of the 32 combinations, in which every
pair is off in each of its four ways equally often. Median over the starts of the largest error, of R_s and both RC
products and of all five.

What N is worth to the printed law on real captures is read from ``../shared/data``, where that is there.
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

STARTS = [factors for factors in itertools.product((0.5, 2.0), repeat=5) if factors.count(2.0) % 2 == 0]
HOURS = (0.5, 1.0, 3.0, 10.0)
NOISES_V = (0.0, 1e-3, 5e-3)
CONVERGING = [0, 2, 4]
INFINITE_DEAD_ZONE_V = 9.0
"""Dead zone that no error exceeds [V]."""
K_BOUND = learning_law.MAX_RATE_HZ / RATE_HZ
OBSERVER_SETTINGS = ("dead_zone_v", "k0")
LEAK = 1e-4
"""Gain of the law without a memory. It diverges at ten times this value."""
HIGH_OHM = 10.0
SOC_ERROR = 0.05
NO_N: dict[str, Any] = {"nussbaum": "k2-cos", "k0": 0.0, "dead_zone_v": INFINITE_DEAD_ZONE_V}
"""Settings of N(k) = k^2 cos k with constant k = 0."""
NO_LOCK_DETECTION = {"lock_error_v": 100.0}
CAPTURES = ("cell5_relaxation_c2", "cell1_random_steps", "cell1_dst")
Run = Callable[[Any, Any, Any, Any], int]


def learned(
    block: SampleBlock,
    soc: float = FIRST_SOC,
    run: Run = step.run,
    settings: Mapping[str, float] | None = None,
    ohms: float = 1.0,
) -> np.ndarray:
    """Return the relative errors after each of ``HOURS`` from each start, for a cell with ``ohms`` times the resistances; shape (starts, hours, 5)."""
    found = np.empty((len(STARTS), len(HOURS), 5))
    trace = np.zeros(block.size, dtype=TRACE)
    for n, factors in enumerate(STARTS):
        r_s, r_ts, tau_ts, r_tl, tau_tl = factors
        estimator = learner(file_off_by(ohms * r_s, ohms * r_ts, tau_ts, ohms * r_tl, tau_tl), soc)
        before = 0
        for name, value in (settings or {}).items():
            estimator.settings_record["observer" if name in OBSERVER_SETTINGS else "learning"][name] = value
        for h, hours in enumerate(HOURS):
            until = int(3600 * hours)
            run(estimator.record, estimator.settings_record, block[before:until], trace)
            found[n, h], before = relative_errors(estimator, factors), until
    return found


def percent(found: np.ndarray) -> list[str]:
    """Return for each hour the median over the starts of the largest error of R_s and both RC products, and of all five [%]."""
    converging = 100.0 * np.median(found[:, :, CONVERGING].max(axis=2), axis=0)
    every = 100.0 * np.median(found.max(axis=2), axis=0)
    return [f"{one:.1f} / {other:.1f}" for one, other in zip(converging, every, strict=True)]


def printed(block: SampleBlock, *, gain: float | None) -> tuple[str, str]:
    """Return the results of the printed law: largest error of R_s and both RC products [%], and RMS of e [mV]."""
    found, e = [], []
    for factors in STARTS:
        estimator = of_printed_law(file_off_by(*factors))
        estimator.run(block[:1])
        if gain is not None:
            estimator.state["gain"] = gain
            estimator.settings["dead_zone_v"] = INFINITE_DEAD_ZONE_V
        e.append(estimator.run(block[1:])["tracking_error_v"])
        found.append(max(products(estimator)))
    return f"{100.0 * np.median(found):.1f}", f"{1e3 * float(np.sqrt(np.mean(np.square(e)))):.2f}"


def of_printed_law(file: CellModel) -> Estimator:
    """Return an estimator with Algorithm 1 without gain reset and lock detection, so that N is unchanged."""
    settings = ObserverSettings(rearm_gain=None, lock_error_v=100.0)
    return Estimator(file, settings, identifier=None, initial_soc=FIRST_SOC, voltage_resolution_v=RESOLUTION_V)


def products(estimator: Estimator) -> tuple[float, float, float]:
    """Return the relative errors of R_s, R_ts C_ts and R_tl C_tl at SOC 0.5."""
    a, true = estimator.state[0]["a"], TRUTH.a
    of = (
        lambda p: elements.r_s(0.5, p),
        lambda p: elements.r_ts(0.5, p) * elements.c_ts(0.5, p),
        lambda p: elements.r_tl(0.5, p) * elements.c_tl(0.5, p),
    )
    r_s, short, long = (abs(f(a) / f(true) - 1.0) for f in of)
    return r_s, short, long


def put_in(kernel: Any, **others: Any) -> Any:
    """Recompile a kernel with other functions under the names of those that it calls."""
    plain = kernel.py_func
    return njit(types.FunctionType(plain.__code__, plain.__globals__ | others, plain.__name__))


def run_with(**others: Any) -> Run:
    """Return the kernels' ``run`` with replaced parts of the learning law."""
    law = put_in(learning_law.learning_step, **others)
    run: Run = put_in(step.run, step=put_in(step.step, learning_step=law))
    return run


@njit
def step_alone(m: Record, q: Record, share: float) -> None:
    """Change theta without correcting states and offset."""
    way = 0.0
    for j in range(q.count):
        way += m.step[j] * m.step[j]
        m.theta[j] = min(max(m.theta[j] + share * m.step[j], q.lower[j]), q.upper[j])
    learning_law.discount_information(m, q, share * way / (q.reach * q.reach))


@njit
def gradient(m: Record, q: Record) -> bool:
    """Compute the gradient on the memory divided by its trace, in place of Newton's step."""
    total = 0.0
    for j in range(q.count):
        total += m.information[j, j] + q.leak_v2s[j]
    for j in range(q.count):
        m.step[j] = m.pull[j] + q.leak_v2s[j] * (q.middle[j] - m.theta[j])
        for i in range(q.count):
            m.step[j] -= m.information[max(i, j), min(i, j)] * m.theta[i]
        m.step[j] /= total
    return True


@njit
def remember_nothing(m: Record, q: Record, dt_s: float, e: float) -> None:
    """Use only the present sample: normalized product of sensitivity and e."""
    told = 0.0
    for j in range(q.count):
        told += m.psi[j] * m.psi[j]
    for j in range(q.count):
        m.pull[j] = m.psi[j] * e / (told + q.told_v * q.told_v)


@njit
def along_pull(m: Record, q: Record) -> bool:
    """Compute the step for ``remember_nothing``: theta' = gamma k (psi e / (eps2^2 + psi^2) - LEAK (theta - theta_m))."""
    for j in range(q.count):
        m.step[j] = m.pull[j] - LEAK * (m.theta[j] - q.middle[j])
    return True


@njit
def inject_as_printed(m: Record, q: Record, dt_s: float, e: float) -> None:
    """Inject u = -N e into both RC pairs (3.2), (3.3) with N = N(0) = 1/s, with its sensitivities."""
    share = 2.0 * integral_of_exponential(-2.0, dt_s)
    for branch in range(2):
        m.x[branch] -= 0.5 * share * e
        for j in range(q.count):
            m.dx[branch, j] += 0.5 * share * m.psi[j]


NO_MEMORY = {"remember": remember_nothing, "find_step": along_pull}
NO_INJECTION = {"offset_s": math.inf}
PARTS: dict[str, dict[str, Any]] = {
    "all": {},
    "no memory: gradient of e^2, normalised": {"others": NO_MEMORY},
    "no memory, no injection": {"others": NO_MEMORY, "settings": NO_INJECTION},
    "a memory of 1 s": {"settings": {"memory_s": 1.0}},
    "gradient on the memory, not Newton's step": {"others": {"find_step": gradient}},
    "the states do not move with theta": {"others": {"take_step": step_alone}},
    "memory does not fade as theta moves": {"settings": {"reach": 1e9}},
    "no leakage": {"settings": {"leak_v2s": 1e-14}},
    "no injection": {"settings": NO_INJECTION},
    "injection u = -N e into both branches, N = 1/s": {"others": {"inject": inject_as_printed}},
    "k = 1": {"settings": {"dead_zone_v": INFINITE_DEAD_ZONE_V}},
    "k at its bound from the start": {"settings": {"k0": K_BOUND}},
    "ten times this bound, k there from the start": {
        "others": {"MAX_RATE_HZ": 10.0 * learning_law.MAX_RATE_HZ},
        "settings": {"k0": 10.0 * K_BOUND},
    },
}


def ablation(blocks: Mapping[str, tuple[SampleBlock, float]]) -> Iterator[tuple[str, ...]]:
    """Yield a row for each removed part: errors at 1 h and 10 h for each block."""
    for name, changed in PARTS.items():
        run = run_with(**changed["others"]) if "others" in changed else step.run
        cells = []
        for block, soc in blocks.values():
            at = percent(learned(block, soc, run, changed.get("settings")))
            cells += [at[1], at[3]]
        yield name, *cells


def gains() -> Iterator[tuple[str, ...]]:
    """Yield the effect of k on a cell with ten times the resistances, whose errors are ten times as large."""
    block = random_steps(3.0, 1e-3, cell=file_off_by(HIGH_OHM, HIGH_OHM, 1.0, HIGH_OHM, 1.0))
    for period_s, still in itertools.product((60.0, 1000.0), (False, True)):
        settings = {"rate": 1.0 / period_s} | ({"dead_zone_v": INFINITE_DEAD_ZONE_V} if still else {})
        found = 100.0 * np.median(learned(block, settings=settings, ohms=HIGH_OHM)[:, :3, 0], axis=0)
        yield f"1/{period_s:g} s", "1" if still else "as it grows", *(f"{one:.1f}" for one in found)


def each_element(block: SampleBlock) -> Iterator[tuple[str, ...]]:
    """Yield the median error of each element [%] with a counted SOC that is too low."""
    found = 100.0 * np.median(learned(block, FIRST_SOC - SOC_ERROR), axis=0)
    for hours, of_five in zip(HOURS, found, strict=True):
        yield f"{hours:g} h", *(f"{one:.1f}" for one in of_five)


def without_n() -> Iterator[tuple[str, ...]]:
    """Yield for each real capture, with the identifier, how much a1..a15 with N = 0 differ from those with N(k)."""
    for name in CAPTURES:
        path = SHARED_DATA / "ncr18650" / f"{name}.csv.gz"
        if not path.is_file():
            yield name, "", "", "", f"not there: {path}"
            continue
        rows = load_capture(path).rows
        as_printed, with_n = ended(rows, {})
        for watch, settings in (("as it is", NO_N), ("off", NO_N | NO_LOCK_DETECTION)):
            estimator, trace = ended(rows, settings)
            same = all(np.array_equal(trace[f], with_n[f], equal_nan=True) for f in ("soc", "soc_std", "innovation_v"))
            same &= estimator.record["elements"].tobytes() == as_printed.record["elements"].tobytes()
            off = np.abs(estimator.state[0]["a"][1:16] / as_printed.state[0]["a"][1:16] - 1.0)
            yield (
                name,
                watch,
                str(estimator.state["lock_losses"][0]),
                f"{100.0 * off.max():.2g}",
                "the same to the last bit" if same else "not the same",
            )


def ended(rows: SampleBlock, observer: Mapping[str, Any]) -> tuple[Estimator, SampleBlock]:
    """Return the estimator after a capture, and its trace."""
    estimator = Estimator(load_cell("ncr18650"), ObserverSettings.model_validate(observer))
    return estimator, estimator.run(rows).copy()


def guarantees() -> Iterator[tuple[str, str]]:
    """Yield a row for each guarantee of docs/theory/observer.md except convergence."""
    noisy = learner(TRUTH)
    q, theta = noisy.settings_record[0]["learning"], noisy.record[0]["learning"]["theta"]
    inside, estimate_v = True, []
    for part in np.array_split(random_steps(3.0, 0.2), 100):
        estimate_v += list(noisy.run(part)["voltage_estimate_v"])
        inside &= bool((q["lower"] <= theta).all() and (theta <= q["upper"]).all())
    yield (
        "200 mV of noise, 3 h: theta within its bounds; y^ [V]",
        f"{inside}; {min(estimate_v):.2f}..{max(estimate_v):.2f}",
    )
    noisy = learner(TRUTH)
    noisy.run(random_steps(10.0, 0.05))
    yield "50 mV of noise, 10 h: k", f"{noisy.state['k'][0]:g}"
    still = learner(TRUTH)
    still.run(random_steps(2.0, 0.1 * RESOLUTION_V))
    yield "noise within the dead zone, 2 h: k", f"{still.state['k'][0]:g}"
    beyond = learner(file_off_by(8.0, 1.0, 1.0, 1.0, 1.0))
    beyond.run(random_steps(3.0, 1e-3))
    yield "file's R_s eight times the true, bounds from a quarter: R_s over the file's", f"{ratio_of_r_s(beyond):.3f}"
    factors = (2.0, 0.5, 1.0, 2.0, 0.5)
    constant = learner(file_off_by(*factors))
    constant.run(measured(np.full(4 * 7200, 0.1 * RATED_A), 1e-3, np.random.default_rng(1)))
    yield (
        "4 h of constant current: errors [%]",
        " ".join(f"{100.0 * e:.0f}" for e in relative_errors(constant, factors)),
    )
    for minutes, error in jump():
        yield f"R_s jumps to 1.5 times after 3 h: its error {minutes} min later [%]", f"{100.0 * error:.1f}"


def ratio_of_r_s(estimator: Estimator) -> float:
    """Return the learned R_s divided by the file's."""
    return float(np.exp(estimator.record[0]["learning"]["theta"][0]))


def jump() -> Iterator[tuple[int, float]]:
    """Yield times after a step of R_s to 1.5 times [min], and the errors then."""
    grown = 1.5
    current_a = held_currents(6.0, np.random.default_rng(2))
    block, after = (
        measured(current_a, 1e-3, np.random.default_rng(3), cell) for cell in (TRUTH, file_off_by(grown, 1, 1, 1, 1))
    )
    at = 3 * 3600
    block["voltage_v"][at:] = after["voltage_v"][at:]
    estimator = learner(TRUTH)
    estimator.run(block[:at])
    for minutes in (10, 30, 60):
        until = 3 * 3600 + 60 * minutes
        estimator.run(block[at:until])
        at = until
        yield minutes, abs(ratio_of_r_s(estimator) / grown - 1.0)


def table(title: str, columns: tuple[str, ...], rows: Iterator[tuple[str, ...]]) -> None:
    """Print a table row by row."""
    shown = Table(title=title)
    for column in columns:
        shown.add_column(column)
    for row in rows:
        shown.add_row(*row)
    Console(width=150).print(shown)


def main() -> None:
    blocks = {noise_v: random_steps(10.0, noise_v) for noise_v in NOISES_V}
    table(
        "errors [%]: R_s and RC products / all five",
        ("noise", *(f"{hours:g} h" for hours in HOURS)),
        ((f"{1e3 * noise_v:g} mV", *percent(learned(block))) for noise_v, block in blocks.items()),
    )
    table(
        "the printed law, 10 h",
        ("noise", "N(k)", "R_s and RC products [%]", "e, RMS [mV]"),
        (
            (f"{1e3 * noise_v:g} mV", name, *printed(blocks[noise_v], gain=gain))
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
        "what k is worth: error of R_s [%], ten times the resistances, 1 mV",
        ("gamma", "k", *(f"{hours:g} h" for hours in HOURS[:3])),
        gains(),
    )
    table("SOC 0.05 too low, 1 mV: error of each [%]", ("", *NAMES), each_element(blocks[1e-3]))
    table(
        "the printed law with N == 0 on real captures, against N(k)",
        ("capture", "lock watch", "losses of lock", "worst of a1..a15 off by [%]", "SOC, std, elements, innovation"),
        without_n(),
    )
    table("what holds under any load", ("", "measured"), guarantees())


if __name__ == "__main__":
    main()
