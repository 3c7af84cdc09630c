"""Numbers of docs/theory/fuel-cell.md: ``make fuelcell`` prints them in half a minute.

The data come from the simulated stack of ``tests.mann_stack``, which has effects that the model omits, and from two measured
curves in tests/data/fuel_cell.

Parameters: r is the resistance [ohm], A the Tafel slope [V], a the activation loss at 1 A [V], C the double-layer capacitance
[F], B the factor of the concentration loss [V], i_L the limiting current and i_n the internal current [A]; e is the error of
the voltage.
"""

import itertools
import sys
import time
from pathlib import Path

import numpy as np

from bms_estimator.calibration.fuel_cell_fit import KEYS, FuelCellFit, Source, fit_fuel_cell
from bms_estimator.estimator import Estimator
from bms_estimator.estimator.fuel_cell_settings import MEMORY_S
from bms_estimator.kernels.cell_model.fuel_cell_open_loop import open_loop
from bms_estimator.kernels.observer.learning_records import LEARNABLE
from bms_estimator.model.fuel_cell import FuelCellModel, load_fuel_cell
from bms_estimator.model.sample import SAMPLE, SampleBlock
from bms_estimator.sources.captures.curves import read_polarisation
from bms_estimator.telemetry.fuel_cell_parameters import fuel_cell_parameters
from tests import mann_stack
from tests.mann_stack import CURVE_A, Record

PEM = load_fuel_cell("pem_30w")
DATA = Path(__file__).parents[2] / "data" / "fuel_cell"
MIN_A = 0.1
"""Minimum current of the measured points that are used; the measured cells have 1 cm2 [A]."""
WRONG_FACTORS = np.array([1.0, 1.5, 0.8, 1.05, 2.0, 0.5, 1.3, 0.5, *[1.0] * 8])
"""Initial values of the fit divided by the values of ``pem_30w``, by index of the kernel constant. Index 0 is unused."""
LEARNING_HZ = 100
"""Sample rate at which parameters are learned in operation [Hz]."""
LAST_SAMPLES = 30 * LEARNING_HZ
"""Number of samples of 30 s, over which values are averaged at the end of each part of a run."""
R, LOSSES = 1, slice(5, 8)
"""Index of the kernel constant r, and indices of B, i_L and i_n."""
PRINTED_PARAMETERS = "r_ohm", "tafel_slope_v", "exchange_current_a", "c_dl_farad"
STEP_OHM = 0.06
"""Increase of the resistance during a run [ohm]."""


def print_line(text: str) -> None:
    sys.stdout.write(f"{text}\n")


def make_source(name: str, record: Record, *, timed: bool = True) -> Source:
    """Return data of a fit: samples in time, or points of a polarization curve."""
    return Source(name, record.time_s if timed else None, record.current_a, record.voltage_v, record.temperature_c)


def make_samples(record: Record) -> SampleBlock:
    block = np.zeros(record.time_s.size, SAMPLE)
    for name in ("time_s", "current_a", "voltage_v", "temperature_c"):
        block[name] = getattr(record, name)
    return block


def rms_mv(error_v: np.ndarray) -> float:
    return 1e3 * float(np.sqrt(np.mean(error_v**2)))


def prediction_rms_mv(model: FuelCellModel, held_back: Source) -> float:
    return rms_mv(held_back.voltage_v - held_back.predict(model.a, np.zeros(LEARNABLE))[0])


def format_parameters(fit: FuelCellFit) -> str:
    """Return each parameter with its standard deviation; "kept" marks those that the data do not determine."""
    texts = []
    for key in KEYS:
        value, std = getattr(fit.model.fuel_cell, key), fit.model.std.get(key)
        texts.append(f"{key} {value:.4g}" + (" (kept)" if std is None else f" +- {value * std:.2g}"))
    return ", ".join(texts)


def print_identification() -> None:
    print_line(
        "## Identified from a curve and 60 s of steps, from a wrong initial file, evaluated on 60 s that were held back"
    )
    start = PEM.identified(PEM.a * WRONG_FACTORS, {})
    measured_curve = mann_stack.curve(CURVE_A)
    # seeds 1 and 5: different loads and noise
    learned, evaluated = (mann_stack.measured(*mann_stack.random_steps(60.0, 1000.0, seed=s), seed=s) for s in (1, 5))
    for rate_hz, every in ((500, 2), (100, 10)):  # every nth sample of 1000 Hz
        held_back = make_source("held back", evaluated.every(every))
        for name, sources in (
            (
                "curve and steps",
                [make_source("curve", measured_curve, timed=False), make_source("steps", learned.every(every))],
            ),
            ("curve alone", [make_source("curve", measured_curve, timed=False)]),
            ("steps alone", [make_source("steps", learned.every(every))]),
        ):
            fit = fit_fuel_cell(sources, start)
            residuals = ", ".join(f"{k} {1e3 * v:.1f} mV" for k, v in fit.rms_v.items())
            print_line(
                f"{rate_hz} Hz, {name}: held back {prediction_rms_mv(fit.model, held_back):.1f} mV; residuals {residuals}"
            )
            print_line(f"    {format_parameters(fit)}")
        print_line(
            f"    the wrong file {prediction_rms_mv(start, held_back):.1f} mV, pem_30w {prediction_rms_mv(PEM, held_back):.1f} mV"
        )
    kelvin = learned.temperature_c.mean() + 273.15
    print_line(
        f"    truth: r_ohm {learned.r_ohm.mean():.4f} on the mean at {kelvin - 273.15:.1f} C, c_dl_farad 0.067, B 0.224 V, i_L 9.38 A"
    )


def print_temperature_effect() -> None:
    print_line("## Voltage error of the held-back minute with and without the temperature")
    held_back = make_source(
        "held back", mann_stack.measured(*mann_stack.random_steps(60.0, 1000.0, seed=5), seed=5).every(2)
    )
    fit = fit_fuel_cell([make_source("curve", mann_stack.curve(CURVE_A), timed=False)], PEM)
    without_temperature = Source(
        held_back.name,
        held_back.time_s,
        held_back.current_a,
        held_back.voltage_v,
        np.full(held_back.voltage_v.size, np.nan),
    )
    print_line(
        f"with {prediction_rms_mv(fit.model, held_back):.1f} mV, without {prediction_rms_mv(fit.model, without_temperature):.1f} mV"
    )


def print_real_curves() -> None:
    print_line("## Measured curves, 1 cm2, 75 C; impedance has 0.061 ohm (oxygen)")
    for name in ("oxygen", "air"):
        columns = read_polarisation(DATA / f"nafion112_{name}.csv")
        assert columns is not None
        for text, part in ((f"above {MIN_A} A", columns[columns[:, 0] > MIN_A]), ("all points", columns)):
            fit = fit_fuel_cell([Source(name, None, *part.T.copy())], load_fuel_cell(DATA / "one_cm2.toml"))
            print_line(
                f"{name}, {text}: {1e3 * fit.rms_v[name]:.1f} mV RMS of {len(part)} points\n    {format_parameters(fit)}"
            )


def print_learning() -> None:
    print_line("## Learned in operation at 100 Hz; the contacts grow by 60 mohm at 300 s")
    time_s, current_a = mann_stack.random_steps(1200.0, 500.0, seed=4)
    record = mann_stack.measured(time_s, current_a, seed=4, more_ohm=np.where(time_s < 300.0, 0.0, STEP_OHM)).every(5)
    estimator, block = Estimator(PEM), make_samples(record)
    estimator.run(block[:1])
    edges = [1, *(LEARNING_HZ * s for s in (60, 150, 300, 310, 360, 450, 600, 900, 1200))]
    for low, high in itertools.pairwise(edges):
        innovation_v = estimator.run(block[low:high])["innovation_v"]
        p = fuel_cell_parameters(estimator, 0.0)
        values = ", ".join(f"{k} {p[k].value:.4g} +- {p[k].std:.1g}" for k in PRINTED_PARAMETERS)
        true_ohm = record.r_ohm[max(low, high - LAST_SAMPLES) : high].mean()
        print_line(f"{high / LEARNING_HZ:6.0f} s: e {rms_mv(innovation_v):6.1f} mV, true r {true_ohm:.4f}; {values}")


def print_wrong_start() -> None:
    print_line("## The model itself: r +50 %, A -10 %, a +5 %, C +30 % of the file's, 3 mV of noise, 100 Hz")
    factors = np.array([1.0, 1.5, 0.9, 1.05, 1.3, *[1.0] * 11])
    block = make_samples(mann_stack.model_itself(PEM.a * factors, 600.0))
    for memory_s in (MEMORY_S, 600.0):
        print_line(f"memory {memory_s:.0f} s")
        estimator = Estimator(PEM)
        estimator.settings_record["learning"]["memory_s"] = memory_s
        for low, high in itertools.pairwise(LEARNING_HZ * s for s in (0, 30, 60, 120, 300, 600)):
            innovation_v = estimator.run(block[low:high])["innovation_v"]
            error_percent = 100.0 * (estimator.state["a"][0][1:5] / (PEM.a * factors)[1:5] - 1.0)
            texts = ", ".join(f"{x:+.1f} %" for x in error_percent)
            print_line(f"{high / LEARNING_HZ:6.0f} s: e {rms_mv(innovation_v):6.1f} mV; r, A, a, C off by {texts}")


def print_ablation() -> None:
    print_line(
        "## Number of learned parameters, and memory: r increases by 60 mohm at 300 s; learned over true values at 450, 600, 900 s"
    )
    time_s, current_a = mann_stack.random_steps(900.0, 500.0, seed=4)
    more_ohm = np.where(time_s < 300.0, 0.0, STEP_OHM)
    no_temperature, grown_a = np.full(time_s.size, np.nan), PEM.a.copy()
    grown_a[R] += STEP_OHM
    before_v, after_v = (
        open_loop(a, np.zeros(LEARNABLE), time_s, current_a, no_temperature)[0] for a in (PEM.a, grown_a)
    )
    own_v = np.where(time_s < 300.0, before_v, after_v) + np.random.default_rng(0).normal(0.0, 0.003, time_s.size)
    records = {
        "Mann's stack": mann_stack.measured(time_s, current_a, seed=4, more_ohm=more_ohm).every(5),
        "the model itself": Record(time_s, current_a, own_v, no_temperature, PEM.a[R] + more_ohm).every(5),
    }
    for count, memory_s in ((4, 60.0), (4, 600.0), (7, 60.0), (7, 600.0)):
        for name, record in records.items():
            print_line(
                f"{count} learned, memory {memory_s:3.0f} s, {name}: {_format_after_step(record, count, memory_s)}"
            )


def _format_after_step(record: Record, count: int, memory_s: float) -> str:
    """Return the learned values, divided by the true ones, and the error of the voltage after the step of r at 300 s."""
    estimator, block = Estimator(PEM), make_samples(record)
    q = estimator.settings_record["learning"]
    q["count"], q["memory_s"] = count, memory_s
    texts = []
    for low, high in itertools.pairwise(LEARNING_HZ * s for s in (0, 300, 450, 600, 900)):
        innovation_v = estimator.run(block[low:high])["innovation_v"][-LAST_SAMPLES:]
        a = estimator.state["a"][0]
        r, losses = a[R] / record.r_ohm[high - LAST_SAMPLES : high].mean(), a[LOSSES] / PEM.a[LOSSES]
        texts.append(f"r {r:.2f} B, i_L, i_n {' '.join(f'{x:.2f}' for x in losses)} e {rms_mv(innovation_v):.0f} mV")
    return "; ".join(texts[1:])  # without the time before the step


def print_speed() -> None:
    block = make_samples(mann_stack.measured(*mann_stack.random_steps(100.0, 1000.0, seed=1)))
    best = min(_run_time_s(block) for _ in range(5))
    print_line(f"## {1e9 * best / block.size:.0f} ns per sample (run, least of 5)")


def _run_time_s(block: SampleBlock) -> float:
    estimator = Estimator(PEM)
    started = time.perf_counter()
    estimator.run(block)
    return time.perf_counter() - started


if __name__ == "__main__":
    for part in (
        print_identification,
        print_temperature_effect,
        print_real_curves,
        print_wrong_start,
        print_learning,
        print_ablation,
        print_speed,
    ):
        part()
