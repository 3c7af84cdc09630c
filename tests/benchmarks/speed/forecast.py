"""Benchmarks of the forecast: draws of an hour and share of a core, and pauses of the event loop by requests for a forecast."""

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterator

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.forecast.forecaster import MIN_INTERVAL_S, Forecaster
from bms_estimator.forecast.projection import DRAWS, MIN_OBSERVED_BLOCK_S
from bms_estimator.forecast.trip import Trip, constant_trip, profile_trip
from bms_estimator.kernels.forecast.draws import DRAW, draw_packs
from bms_estimator.kernels.forecast.load_seconds import MAX_LOAD_S
from bms_estimator.kernels.forecast.observed_load import LOAD_BLOCK, simulate_observed_load, tabulate_blocks
from bms_estimator.kernels.forecast.projected_pack import PROJECTED_PACK, project_pack
from bms_estimator.model.cell import load_cell
from bms_estimator.pack.pack import Pack
from bms_estimator.service.request_handlers import forecast_data, forecast_in_thread
from tests.benchmarks.load import CELL, pulses
from tests.benchmarks.table import Row

HOUR_S = 3600
ROUNDS = 20
"""Number of measurements, of which the shortest counts, and of requests for each load."""
NO_CUTOFF_V = 1.0
"""Cut-off voltage that no draw reaches within an hour [V]."""
CUTOFF_V = 18.0
"""Cut-off voltage of the pack of six cells [V]."""
TICK_S = 0.001
"""Interval of the task that measures the pauses [s]."""
POWER_W = 20.0
"""Constant power of the trip, and mean power of the profile [W]."""


def after_load(seconds: int) -> tuple[Estimator, Forecaster]:
    """Return estimator and forecaster of a pack after current pulses."""
    estimator = Estimator(load_cell(CELL))
    forecaster = Forecaster(estimator, cutoff_v=CUTOFF_V)
    Pack(estimator, forecaster=forecaster).run(pulses(seconds, rate_hz=1))
    return estimator, forecaster


def rows() -> Iterator[Row]:
    """Measure the draws of an hour, the table of the longest load history, and whole forecasts on full history."""
    estimator, forecaster = after_load(MAX_LOAD_S + HOUR_S)
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


def request_rows() -> Iterator[Row]:
    """Measure the requests under the observed load, under a constant power for an hour, and under a profile of an hour."""
    _, forecaster = after_load(MAX_LOAD_S)
    time_s = np.arange(3600.0)
    trips: dict[str, Trip | None] = {
        "observed load": None,
        "constant power": constant_trip("power_w", POWER_W, 3600.0),
        "profile of 1 Hz": profile_trip("power_w", time_s, POWER_W * (1.0 + np.sin(time_s / 30.0))),
    }

    async def in_loop(trip: Trip | None) -> object:
        return forecast_data(forecaster, trip)

    async def in_thread(trip: Trip | None) -> object:
        return await forecast_in_thread(forecaster, trip)

    for name, trip in trips.items():
        for place, forecast in (("event loop", in_loop), ("thread", in_thread)):
            median_ms, longest_ms = asyncio.run(pauses_ms(forecast, trip))
            yield Row(
                f"pause of the event loop, {name}, in the {place}",
                "-",
                f"{median_ms:.1f} ms, longest {longest_ms:.1f} ms",
                None,
            )


async def pauses_ms(forecast: Callable[[Trip | None], Awaitable[object]], trip: Trip | None) -> tuple[float, float]:
    """Return median and maximum of the longest pause of the event loop during each request [ms]."""
    await forecast(trip)  # loads the kernels
    longest_s = 0.0

    async def measure() -> None:
        nonlocal longest_s
        while True:
            begin_s = time.perf_counter()
            await asyncio.sleep(TICK_S)
            longest_s = max(longest_s, time.perf_counter() - begin_s - TICK_S)

    pauses_s = []
    task = asyncio.create_task(measure())
    for _ in range(ROUNDS):
        await asyncio.sleep(10.0 * TICK_S)
        longest_s = 0.0
        await forecast(trip)
        await asyncio.sleep(2.0 * TICK_S)
        pauses_s.append(longest_s)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    return 1e3 * float(np.median(pauses_s)), 1e3 * max(pauses_s)
