"""Benchmark of the forecast: the draws of an hour, and the share of a core."""

import time
from collections.abc import Callable, Iterator

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.forecast.forecaster import MIN_INTERVAL_S, Forecaster
from bms_estimator.forecast.projection import DRAWS, MIN_OBSERVED_BLOCK_S
from bms_estimator.kernels.forecast.block_table import LOAD_BLOCK, tabulate_blocks
from bms_estimator.kernels.forecast.draws import DRAW, draw_packs
from bms_estimator.kernels.forecast.load_seconds import MAX_LOAD_S
from bms_estimator.kernels.forecast.observed_load import simulate_observed_load
from bms_estimator.kernels.forecast.projected_pack import PROJECTED_PACK, project_pack
from bms_estimator.model.cell import load_cell
from bms_estimator.pack.pack import Pack
from tests.benchmarks.load import CELL, pulses
from tests.benchmarks.table import Row

HOUR_S = 3600
ROUNDS = 20
"""Number of measurements, of which the shortest counts."""
NO_CUTOFF_V = 1.0
"""Cut-off voltage that no draw reaches within an hour [V]."""
CUTOFF_V = 18.0
"""Cut-off voltage of the pack of six cells [V]."""


def rows() -> Iterator[Row]:
    """Measure the draws of an hour, the table of the longest load history, and whole forecasts on full history."""
    estimator = Estimator(load_cell(CELL))
    forecaster = Forecaster(estimator, cutoff_v=CUTOFF_V)
    Pack(estimator, forecaster=forecaster).run(pulses(MAX_LOAD_S + HOUR_S, rate_hz=1))
    mean_a, max_a = forecaster.load.mean_and_max()
    pack, blocks, draws = (
        np.zeros(1, PROJECTED_PACK),
        np.zeros(MAX_LOAD_S // MIN_OBSERVED_BLOCK_S, LOAD_BLOCK),
        np.zeros(DRAWS, DRAW),
    )
    project_pack(
        pack[0], estimator.record[0]["filter"], estimator.settings_record[0]["filter"], NO_CUTOFF_V, float(max_a.max())
    )
    draw_packs(pack[0], np.uint64(1), draws)
    table_ms = shortest_ms(lambda: tabulate_blocks(pack[0], mean_a, max_a, MIN_OBSERVED_BLOCK_S, blocks))
    steps = HOUR_S // MIN_OBSERVED_BLOCK_S
    draws_ms = shortest_ms(lambda: simulate_observed_load(pack[0], blocks, float(MIN_OBSERVED_BLOCK_S), steps, draws))
    assert not draws["ended"].any()
    yield Row(f"{DRAWS} draws of an hour", "at most 10 ms", f"{draws_ms:.1f} ms", draws_ms <= 10.0)
    yield Row(f"  table of {MAX_LOAD_S} s of load", "-", f"{table_ms:.1f} ms", None)
    forecast_ms = shortest_ms(forecaster.forecast)
    share = forecast_ms / (10.0 * MIN_INTERVAL_S)
    yield Row("  whole forecast", "-", f"{forecast_ms:.1f} ms", None)
    yield Row(
        f"  share of a core with a forecast each {MIN_INTERVAL_S:.0f} s", "at most 1 %", f"{share:.2f} %", share <= 1.0
    )


def shortest_ms(call: Callable[[], object]) -> float:
    """Return the shortest time of a call [ms]."""
    shortest_s = np.inf
    for _ in range(ROUNDS):
        begin_s = time.perf_counter()
        call()
        shortest_s = min(shortest_s, time.perf_counter() - begin_s)
    return 1e3 * float(shortest_s)
