"""Benchmark of requests for a forecast: the longest pause of the event loop, with the forecast in the loop and in a thread."""

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterator

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.forecast.trip import Trip, constant_trip, profile_trip
from bms_estimator.kernels.forecast.load_seconds import MAX_LOAD_S
from bms_estimator.model.cell import load_cell
from bms_estimator.pack.pack import Pack
from bms_estimator.service.forecast_request import forecast_data, forecast_in_thread
from tests.benchmarks.load import CELL, pulses
from tests.benchmarks.speed.forecast import CUTOFF_V
from tests.benchmarks.table import Row

ROUNDS = 20
"""Number of requests for each load."""
TICK_S = 0.001
"""Interval of the task that measures the pauses [s]."""
POWER_W = 20.0
"""Constant power of the trip, and mean power of the profile [W]."""


def rows() -> Iterator[Row]:
    """Measure the requests under the observed load, under a constant power for an hour, and under a profile of an hour."""
    estimator = Estimator(load_cell(CELL))
    forecaster = Forecaster(estimator, cutoff_v=CUTOFF_V)
    Pack(estimator, forecaster=forecaster).run(pulses(MAX_LOAD_S, rate_hz=1))
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
