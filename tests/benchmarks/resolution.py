"""Effect of sample rate, resolution and delay of a source on the SOC and its interval, on cells that differ from the model.

Each row is a kind of source. A run is one simulated cell of ``tests.estimator.anywhere``. The errors of its cell file are as
large as the cell file declares. The load changes every few seconds, as in a drive, or is the load of a house. The estimator
starts in mid-load with an SOC 0.2 too low or 0.2 too high. Results are scored from 15 min on, above SOC 0.05:

- RMSE: error of the SOC, of all runs and of the worst run [%]
- inside: fraction of time with the true SOC inside soc +- 2 soc_std, of all runs and of the worst run [%]
- std: mean of soc_std [%]
- score: interval score of this interval as a 95 % interval: width plus 40 times the distance outside; smaller is better [%]

    make resolution ARGS="--undeclared"

With ``--undeclared`` the estimator has the default sampling settings instead of the settings for the source.
"""

import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from rich.console import Console
from rich.table import Table

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import SAMPLE, Floats, SampleBlock
from bms_estimator.settings.observer import Sampling
from tests.estimator.anywhere.cases import OXIDE, PHOSPHATE, SOC_ERRORS, Case, cell_file, load_a
from tests.estimator.anywhere.score import Score, score
from tests.estimator.anywhere.truth import simulate

TRUTH_HZ = 10
"""Minimum rate of the simulation of the cell [Hz]."""
SEEDS = range(1, 9)
"""Seeds of the runs of a source: odd for oxide, even for phosphate cells."""
NOISE_V = 5e-4
"""Std of the noise of the voltage [V]."""
JITTER = 0.02
"""Maximum jitter of the sample times, as a fraction of the sample period."""


@dataclass(frozen=True)
class Source:
    """Kind of source and use of a pack."""

    rate_hz: float = 1.0
    ampere_step: float = 0.01
    """Resolution of the current [A]."""
    dead_band_a: float = 0.0
    """Current below which the source reports 0 [A]."""
    delay_s: float = 0.0
    """Delay of a sample's current relative to its voltage [s]; negative: the voltage is delayed."""
    volt_step: float = 1e-3
    """Resolution of the voltage [V]."""
    capacity_ah: float = 3.0
    """Capacity of one cell [Ah]."""
    house: bool = False
    """True: hours of small loads and a night of standby; False: a drive."""
    standby_a: float = 0.0
    """Current that always flows in the house [A]."""

    @property
    def name(self) -> str:
        """Return the name of the row."""
        period_s = 1.0 / self.rate_hz
        rate = f"{self.rate_hz:g} Hz" if self.rate_hz >= 1.0 else f"{period_s:g} s"
        parts = [f"{self.capacity_ah:g} Ah", rate, f"{1e3 * self.ampere_step:g} mA"]
        parts += [f"{1e3 * self.volt_step:g} mV"] * (self.volt_step != Source.volt_step)
        parts += [f"{'I' if self.delay_s > 0.0 else 'V'} {abs(self.delay_s):g} s late"] * (self.delay_s != 0.0)
        parts += ["house"] * self.house
        parts += [f"nothing below {self.dead_band_a:g} A, standby {self.standby_a:g} A"] * (self.dead_band_a > 0.0)
        return ", ".join(parts)

    @property
    def sampling(self) -> Sampling:
        """Return the sampling that the settings declare for the source."""
        return Sampling(1.0 / self.rate_hz, self.ampere_step, self.dead_band_a)


RATES_HZ = (100.0, 1.0, 0.1, 1.0 / 60.0)
SOURCES = (  # rate, resolution of the current, dead band
    *(Source(rate, step) for step in (0.01, 0.1) for rate in RATES_HZ),
    *(Source(rate, delay_s=delay_s) for delay_s in (1.0, -1.0) for rate in RATES_HZ),
    *(
        Source(rate, delay_s=delay_s)
        for delay_s, rate in ((3.0, 1.0), (-3.0, 1.0), (10.0, 1.0 / 60.0), (-10.0, 1.0 / 60.0))
    ),
    *(Source(rate, step, capacity_ah=100.0) for step in (0.01, 0.1) for rate in (1.0, 0.1, 1.0 / 60.0)),
    Source(1.0, 0.1, volt_step=0.01),
    Source(1.0 / 60.0, 0.1, volt_step=0.01),
    *(Source(rate, 0.1, capacity_ah=100.0, house=True, standby_a=0.2) for rate in (1.0, 0.1, 1.0 / 60.0)),
    *(Source(rate, 0.1, 0.3, capacity_ah=100.0, house=True, standby_a=0.2) for rate in (1.0, 1.0 / 60.0)),
    Source(1.0, 0.1, 2.5, capacity_ah=100.0, house=True, standby_a=2.0),
    Source(1.0 / 60.0, 0.1, 2.5, capacity_ah=100.0, house=True, standby_a=2.0),
    Source(1.0, 0.1, house=True, standby_a=0.04),
    Source(1.0 / 60.0, 0.1, house=True, standby_a=0.04),
)


def main() -> None:
    """Print the table of the rows whose name contains an argument, or all."""
    is_declared = "--undeclared" not in sys.argv
    wanted = [argument for argument in sys.argv[1:] if not argument.startswith("--")]
    table = Table(title="RMSE/worst, inside/worst, std, score in %")
    table.add_column("source")
    for column in ("RMSE", "inside", "std", "score"):
        table.add_column(column, justify="right")
    for source in SOURCES:
        if not wanted or any(name in source.name for name in wanted):
            table.add_row(source.name, *table_cells(list(scores(source, is_declared=is_declared))))
    Console(width=None if sys.stdout.isatty() else 130).print(table)


def table_cells(results: list[Score]) -> Iterator[str]:
    """Yield the cells of one table row."""
    rmse, cover = [s.rmse for s in results], [s.cover for s in results]
    yield f"{np.sqrt(np.mean(np.square(rmse))):.2f}/{max(rmse):.2f}"
    yield f"{np.mean(cover):.1f}/{min(cover):.0f}"
    yield f"{np.mean([s.std for s in results]):.2f}"
    yield f"{np.mean([s.score for s in results]):.2f}"


def scores(source: Source, *, is_declared: bool = True, seeds: Iterable[int] = SEEDS) -> Iterator[Score]:
    """Yield the score of each run of a kind of source."""
    for case in cases_of(source, seeds):
        samples, soc = sample_source(case, source)
        for soc_error in SOC_ERRORS:
            sampling = {"sampling": source.sampling} if is_declared else {}
            estimator = Estimator(
                cell_file(case),
                voltage_resolution_v=source.volt_step,
                initial_soc=float(np.clip(soc[0] + soc_error, 0.0, 1.0)),
                **sampling,
            )
            trace = estimator.run(samples)
            has_row = np.isin(samples["time_s"], trace["time_s"])  # a doubtful sample has none
            result = score(samples["time_s"][has_row], trace["soc"], trace["soc_std"], soc[has_row])
            assert result is not None
            yield result


def cases_of(source: Source, seeds: Iterable[int]) -> Iterator[Case]:
    """Yield a case (cell, cell file and load) for each seed, alternating between oxide and phosphate."""
    for seed in seeds:
        truth, file_c = (OXIDE, (25.0, 10.0, 0.0, -10.0)) if seed % 2 else (PHOSPHATE, (25.0, 5.0, -15.0))
        scaled = replace(truth, capacity_ah=source.capacity_ah, ohm=truth.ohm * truth.capacity_ah / source.capacity_ah)
        hours = 13.0 if source.house else 1.3
        yield Case(f"{source.name} {seed}", truth=scaled, file_temperatures_c=file_c, hours=hours, seed=seed)


def current_of(case: Case, source: Source, rate_hz: int) -> Floats:
    """Return the true current at ``rate_hz`` [A]; its levels change at arbitrary times."""
    seconds = round(3600 * (case.load_before_h + case.hours))  # the load before the estimator starts, and after it
    if not source.house:
        return np.repeat(load_a(case, seconds), rate_hz)
    rng, one_c = np.random.default_rng(case.seed), source.capacity_ah
    # Appliances: levels of about 0.1 C and pauses, of four minutes on average. A night of standby follows after 5 h, and the
    # last 3 h have a constant load.
    level_a = one_c * np.abs(rng.normal(0.08, 0.08, 400))
    level_a[rng.random(400) < 0.3] = 0.0
    level_a = np.repeat(level_a, rng.exponential(240.0, 400).astype(int) + 5)[:seconds]
    level_a[5 * 3600 :] = 0.0
    level_a[round(seconds - 3 * 3600) :] = 0.1 * one_c
    return np.repeat(level_a + source.standby_a, rate_hz)


def sample_source(case: Case, source: Source) -> tuple[SampleBlock, Floats]:
    """Return the samples of the source until the cell is empty, and the true SOC at each."""
    rng = np.random.default_rng(1000 + case.seed)
    rate_hz = max(TRUTH_HZ, round(source.rate_hz))
    current_a = current_of(case, source, rate_hz)
    shift = rng.integers(rate_hz)  # less than a second
    current_a = np.concatenate([np.full(shift, current_a[0]), current_a])  # no sample falls on a change of level
    truth = case.truth
    curves = truth.ocv_v, truth.per_kelvin_v, truth.hysteresis_v, truth.ohm
    temperature_c = np.full(current_a.size, case.temperature_c)
    voltage_v, soc = simulate(1.0 / rate_hz, current_a, temperature_c, case.soc, -1.0, truth.capacity_ah, *curves)
    step, delay_steps = round(rate_hz / source.rate_hz), round(source.delay_s * rate_hz)
    sample_indices = np.arange(round(3600 * case.load_before_h * rate_hz), current_a.size, step)
    max_jitter_steps = round(JITTER * step)
    sample_indices = np.clip(
        sample_indices + rng.integers(-max_jitter_steps, max_jitter_steps + 1, sample_indices.size),
        0,
        current_a.size - 1,
    )
    cutoff_v = 2.5 if case.truth.ocv_v is OXIDE.ocv_v else 2.0
    empty = (soc[sample_indices] < 0.02) | (voltage_v[sample_indices] < cutoff_v)  # the load would be disconnected
    sample_indices = sample_indices[: int(np.argmax(empty))] if empty.any() else sample_indices
    samples = np.zeros(sample_indices.size, dtype=SAMPLE)
    samples["time_s"] = sample_indices / rate_hz
    noise_a = rng.normal(0.0, 2e-3 * source.capacity_ah / 3.0, sample_indices.size)  # 2 mA on a cell of 3 Ah
    reported_a = current_a[np.clip(sample_indices - delay_steps, 0, current_a.size - 1)] + noise_a
    reported_a[np.abs(reported_a) < source.dead_band_a] = 0.0
    samples["current_a"] = np.round(reported_a / source.ampere_step) * source.ampere_step
    samples["voltage_v"] = (
        np.round((voltage_v[sample_indices] + rng.normal(0.0, NOISE_V, sample_indices.size)) / source.volt_step)
        * source.volt_step
    )
    samples["temperature_c"] = case.temperature_c
    return samples, soc[sample_indices]


if __name__ == "__main__":
    main()
