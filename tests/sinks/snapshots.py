"""Snapshots for tests, built by the functions that the service uses."""

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.forecast.available_power import Forecast, ForecastCurve, unknown_values
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.pack_model import PackModel, load_fuel_cell
from bms_estimator.model.payloads.health import LoopHealth
from bms_estimator.model.payloads.snapshot import Alarm, CellReport, CellsReport, Snapshot
from bms_estimator.mqtt.connection import DeliveryStats
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.health import make_health_payload
from bms_estimator.telemetry.parameters import make_parameters_payload
from bms_estimator.telemetry.publish_window import ChargeEnergy, Window, new_totals
from bms_estimator.telemetry.state import (
    make_forecast_payload,
    make_info_payload,
    make_state_payload,
    no_forecast,
    remaining_capacity_ah,
)

NOW = 1_700_000_000.0
"""Wall clock of the snapshots [s since 1970]."""

CUTOFF_V = 2.7
"""Cut-off voltage of the forecast [V]."""


def forecast_at(median_s: float) -> Forecast:
    """Return a forecast at the time 0.1 s with a linear course of SOC and voltage, whose median time to the cut-off is given."""
    values, part = unknown_values(), np.linspace(0.0, 1.0, 61)
    values["time_to_cutoff_s"], values["time_to_cutoff_p05_s"] = median_s, 0.75 * median_s
    values["time_to_cutoff_p95_s"], values["cutoff_within_15min"] = 1.5 * median_s, 0.01
    values["cutoff_within_2min"], values["cutoff_within_5min"] = 0.0, 0.002
    soc, voltage_v = 0.5 * (1.0 - part), 3.8 - 1.1 * part**3
    survival = np.interp(part, [0.0, 0.5, 1.0], [1.0, 1.0, 0.0])
    bands = 0.9 * soc, soc, 1.1 * soc, voltage_v - 0.3 * part, voltage_v, voltage_v + 0.2 * part
    return Forecast(0.1, values, None, ForecastCurve(1.5 * median_s * part, *bands, survival))


FORECAST = forecast_at(6600.0)
"""Forecast of the snapshots of a cell."""

IDLE_LOOP = LoopHealth(
    latency_p50_s=None,
    latency_p99_s=None,
    latency_max_s=None,
    reads_waiting=0,
    messages_waiting=0,
    log_lines_lost=0,
    disk_free_mib=None,
)


def snapshot(sensor_message: str | None = None, delivery: DeliveryStats | None = None) -> Snapshot:
    """Return a new snapshot of a cell at SOC 0.5. ``sensor_message`` is the reason why the sensor is offline."""
    cell = load_cell("chen_mora")
    estimator = Estimator(cell, identifier=None, initial_soc=0.5)
    return _make_snapshot(cell, estimator, voltage_v=3.8, sensor_message=sensor_message, delivery=delivery)


def _capacity_ah(cell: PackModel) -> float | None:
    return cell.cell.capacity_ah if isinstance(cell, CellModel) else None


def fuel_cell_snapshot() -> Snapshot:
    stack = load_fuel_cell("pem_30w")
    return _make_snapshot(stack, Estimator(stack), voltage_v=13.0)


def _make_snapshot(
    cell: PackModel,
    estimator: Estimator,
    voltage_v: float,
    sensor_message: str | None = None,
    delivery: DeliveryStats | None = None,
) -> Snapshot:
    """Return the snapshot of an estimator after two samples without a load."""
    window = Window()
    block = np.zeros(2, dtype=SAMPLE)
    block["time_s"], block["voltage_v"], block["temperature_c"] = [0.0, 0.1], voltage_v, np.nan
    window.add(estimator.run(block), NOW)
    summary = window.take()
    assert summary
    return Snapshot(
        make_state_payload(
            summary,
            remaining_capacity_ah(estimator),
            FORECAST if isinstance(cell, CellModel) else no_forecast("a fuel cell"),
            {"crc_errors": 3},
            NOW,
            ChargeEnergy(),
            _capacity_ah(cell),
        ),
        make_parameters_payload(estimator, NOW),
        make_health_payload(
            estimator.record[0],
            estimator.settings_record[0],
            {"frames_received": 2},
            now_s=NOW,
            uptime_s=1.0,
            loop_lag_s=0.0,
            restarts=0,
            checkpoint="off",
            sensor_message=sensor_message,
            clock_ppm=None,
            delivery=delivery or DeliveryStats(),
            total=new_totals(NOW),
            unseen_s=None,
            loop=IDLE_LOOP,
            recording=None,
        ),
        make_info_payload(Settings(), cell, {"firmware": "1.0", "serial": "A1"}, NOW, temperature_sensor=False),
        forecast=make_forecast_payload(FORECAST, CUTOFF_V, summary, NOW) if isinstance(cell, CellModel) else None,
    )


CELL_SNAPSHOT = snapshot()
"""Snapshot of a cell at SOC 0.5."""
STACK_SNAPSHOT = fuel_cell_snapshot()
"""Snapshot of a fuel cell stack."""
SNAPSHOT_WITHOUT_SAMPLES = CELL_SNAPSHOT._replace(
    estimate=None, parameters=make_parameters_payload(Estimator(load_cell("chen_mora"), identifier=None), NOW)
)
"""Snapshot before the first sample."""

CELLS_REPORT = CellsReport(
    publish_time=iso_utc(NOW),
    weakest=2,
    cells=[
        CellReport(
            number=number,
            soc=soc,
            soc_std=0.01,
            soc_deviation=soc - 0.5,
            soc_deviation_std=0.003,
            resistance_ratio=ratio,
            resistance_ratio_std=0.03,
            capacity_ratio=1.0,
            self_discharge_a=leak_a,
            self_discharge_std_a=0.001,
            fault=fault,
        )
        for number, soc, ratio, leak_a, fault in (
            (1, 0.51, 0.98, 0.0, None),
            (2, 0.47, 1.08, 0.02, "internal short"),
            (3, 0.5, 1.0, 0.0, "contact"),
            (4, 0.52, 1.01, -0.001, None),
        )
    ],
)
"""Comparison of four cells."""
SOC_LOW_ALARM = Alarm(
    name="soc_low",
    severity="warning",
    active=True,
    latched=False,
    since="2024-05-01T12:00:00.000Z",
    value=9.5,
    limit=10.0,
    unit="%",
    text="charge",
)
"""Raised alarm of a low SOC."""
