"""Forecast of a request, made in a thread while samples arrive."""

import asyncio
import threading
from typing import Any

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.forecast.trip import Trip, constant_trip
from bms_estimator.kernels.forecast.given_load import simulate_given_load
from bms_estimator.kernels.forecast.observed_load import record_curves, simulate_observed_load
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import load_cell
from bms_estimator.pack.pack import Pack
from bms_estimator.service import request_handlers
from bms_estimator.service.request_handlers import forecast_data, forecast_in_thread

SAMPLES = np.zeros(800, SAMPLE)
SAMPLES["time_s"], SAMPLES["temperature_c"] = np.arange(SAMPLES.size), 25.0
SAMPLES["voltage_v"] = 3.9 - 1e-4 * np.arange(SAMPLES.size)
SAMPLES["current_a"] = np.where(np.arange(SAMPLES.size) % 60 < 30, 0.8, 0.2)


def loaded_pack() -> Pack:
    """Return a cell after 400 s of load."""
    estimator = Estimator(load_cell("chen_mora"), initial_soc=0.9)
    pack = Pack(estimator, forecaster=Forecaster(estimator, cutoff_v=3.0))
    pack.run(SAMPLES[:400])
    return pack


@pytest.fixture
def forecaster() -> Forecaster:
    """Return the forecaster of a cell after 400 s of load."""
    return loaded_pack().forecaster


@pytest.mark.parametrize("trip", [None, constant_trip("power_w", 2.0, 600.0)], ids=["observed load", "given load"])
async def test_samples_that_arrive_meanwhile_do_not_change_the_forecast(
    trip: Trip | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    pack = loaded_pack()
    forecaster = pack.forecaster
    expected, samples_processed = forecast_data(forecaster, trip), threading.Event()

    def forecast_later(*arguments: Any) -> dict[str, Any]:
        samples_processed.wait()
        return forecast_data(*arguments)

    monkeypatch.setattr(request_handlers, "forecast_data", forecast_later)
    response = asyncio.create_task(forecast_in_thread(forecaster, trip))
    await asyncio.sleep(0)  # the task takes its copy
    pack.run(SAMPLES[400:])
    samples_processed.set()
    assert await response == expected
    assert forecast_data(forecaster, trip) != expected


async def test_a_forecast_in_a_thread_does_not_change_later_estimates() -> None:
    asked, undisturbed = loaded_pack(), loaded_pack()
    await forecast_in_thread(asked.forecaster, constant_trip("power_w", 2.0, 600.0))
    for each in (asked, undisturbed):
        each.run(SAMPLES[400:])
    assert asked.estimator.record.tobytes() == undisturbed.estimator.record.tobytes()
    assert asked.forecaster.latest.values.tobytes() == undisturbed.forecaster.latest.values.tobytes()


@pytest.mark.parametrize(
    "kernel", [simulate_observed_load, record_curves, simulate_given_load], ids=lambda kernel: kernel.__name__
)
def test_simulation_of_the_draws_lets_other_threads_run(kernel: Any) -> None:
    assert kernel.targetoptions["nogil"]
