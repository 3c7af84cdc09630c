"""Publisher: its log lines, and the times of its publications."""

import math
from collections.abc import Iterable

import numpy as np
import pytest
from structlog.testing import capture_logs

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import NO_CELLS, SAMPLE
from bms_estimator.model.cell import load_cell
from bms_estimator.model.clock import Clock
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.pack.pack import Pack, new_pack
from bms_estimator.service.publisher import Publisher
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.source import ReceivedSamples
from bms_estimator.telemetry.health import DEVICE_SOC_SUSPICION
from tests.scripted_source import Collector, ScriptedSource


def publish(settings: Settings, pack: Pack, rows: Iterable[tuple[float, ...]]) -> tuple[Publisher, list[Snapshot]]:
    """Publish the estimates of samples: time [s], current [A], voltage [V], and optionally the SOC by the device.

    Returns:
        The publisher, and the list of its snapshots.
    """
    now_s, sink = 0.0, Collector()
    clock = Clock(monotonic=lambda: now_s)
    publisher = Publisher(settings, pack, source=ScriptedSource(), sinks=[sink], clock=clock)
    for now_s, current_a, voltage_v, *soc in rows:
        block = np.array([(now_s, current_a, voltage_v, 25.0, 25.0, 25.0, 0)], dtype=SAMPLE)
        received = ReceivedSamples(block, NO_CELLS, device_soc=np.array(soc))
        publisher.add(received, pack.run(block, device_soc=received.device_soc))
    return publisher, sink.snapshots


def test_suspected_input_faults_are_logged_when_their_set_changes() -> None:
    now_s, cell = 0.0, load_cell("chen_mora")
    estimator = Estimator(cell, initial_soc=0.5)
    estimator.step(0.0, 0.0, 3.8, temperature_c=25.0)
    clock = Clock(monotonic=lambda: now_s)
    publisher = Publisher(Settings(), Pack(estimator), source=ScriptedSource(), sinks=[], clock=clock)
    logged_suspects = []
    for temperature_c, suspects in (
        (41.0, InputFault.TEMPERATURE),
        (42.0, InputFault.TEMPERATURE),
        (30.0, 0),
        (30.0, 0),
    ):
        now_s += 2.0
        estimator.record["checks"]["suspects"] = int(suspects)
        estimator.record["filter"]["temperature_c"] = temperature_c
        with capture_logs() as lines:
            publisher.publish()
        logged_suspects.append([str(line["suspects"]) for line in lines])
    [[first], *later] = logged_suspects
    assert first.startswith("['no data at 41 C, the cell fi")
    assert later == [[], ["none"], []]


@pytest.mark.parametrize(("chemistry", "suspects"), [("nmc", [DEVICE_SOC_SUSPICION]), ("lfp", [])])
def test_a_wrong_chemistry_is_suspected_by_the_soc_of_the_device(chemistry: str, suspects: list[str]) -> None:
    """The samples are those of an LFP cell at rest for ten minutes, whose device reports 60 %."""
    settings = Settings.model_validate({"pack": {"cell": chemistry, "capacity_ah": 100.0, "device_soc_std": 0.1}})
    rows = ((float(time_s), 0.0, 3.3, 0.6) for time_s in range(600))
    publisher, _ = publish(settings, new_pack(settings, load_cell(chemistry, 100.0)), rows)
    assert publisher.snapshot.health.suspects == suspects


@pytest.mark.parametrize(
    ("interval_s", "device_soc", "published"),
    [
        (1.0, (0.6, 0.6, 0.6, 0.6), [(1.0, True), (2.0, True), (3.0, True)]),
        (1.0, (math.nan, 0.6, 0.6, 0.6), [(2.0, True), (3.0, True)]),
        (4.0, (math.nan, math.nan, math.nan, math.nan, 0.6), [(12.0, False), (16.0, False)]),
        (60.0, (math.nan, math.nan, 0.6, 0.6), [(60.0, False), (120.0, False), (180.0, True)]),
        (1.0, (0.6,), [(0.0, False)]),
    ],
)
def test_the_first_estimate_waits_for_the_soc_of_the_device(
    interval_s: float, device_soc: tuple[float, ...], published: list[tuple[float, bool]]
) -> None:
    """The wait is limited to ten seconds, and to the end of the run."""
    settings = Settings.model_validate({"pack": {"cell": "lfp", "capacity_ah": 100.0, "device_soc_std": 0.1}})
    rows = ((interval_s * number, 0.0, 3.3, soc) for number, soc in enumerate(device_soc))
    publisher, snapshots = publish(settings, new_pack(settings, load_cell("lfp", 100.0)), rows)
    publisher.publish_last()
    assert [(each.estimate.board_time_s, each.estimate.soc_known) for each in snapshots if each.estimate] == published


def test_a_raised_alarm_is_published_before_the_next_snapshot_is_due() -> None:
    settings = Settings.model_validate({"publish": {"rate_hz": 0.1}, "alarms": {"pack_over_voltage": {"delay_s": 0.0}}})
    rows = [(0.0, 0.0, 3.8), (1.0, 0.0, 3.8), (2.0, 0.0, 6.0), (3.0, 0.0, 6.0)]
    _, snapshots = publish(settings, Pack(Estimator(load_cell("chen_mora"), initial_soc=0.5)), rows)
    raised_alarms = [[alarm.name for alarm in each.alarms if alarm.active] for each in snapshots]
    assert raised_alarms == [[], ["pack_over_voltage"]]
    # the second snapshot has no estimate, because the publish window has not ended
    assert [each.estimate is None for each in snapshots] == [False, True]


def test_an_estimate_that_is_due_is_published_before_the_alarm_of_the_same_sample() -> None:
    limits = {"pack_over_voltage": {"limit_v": 4.0, "clear_v": 3.9, "delay_s": 0.0}}
    settings = Settings.model_validate({"publish": {"rate_hz": 1.0}, "alarms": limits})
    pack = Pack(Estimator(load_cell("chen_mora"), initial_soc=0.5))
    _, snapshots = publish(settings, pack, [(0.0, 0.0, 3.8), (1.0, 0.0, 4.05)])
    assert [
        (each.estimate and each.estimate.voltage_v, any(alarm.active for alarm in each.alarms)) for each in snapshots
    ] == [(3.8, False), (4.05, False), (None, True)]


def test_the_curves_of_a_forecast_are_published_once_a_minute() -> None:
    settings = Settings.model_validate({"publish": {"rate_hz": 0.1}, "pack": {"initial_soc": 0.5}})
    rows = ((10.0 * number, 0.1, 3.8) for number in range(19))
    _, snapshots = publish(settings, new_pack(settings, load_cell("chen_mora")), rows)
    reports = [each.forecast for each in snapshots if each.forecast]
    assert len({id(report) for report in reports}) == 4  # at 0, 60, 120 and 180 s
    assert reports[0].cutoff_v == pytest.approx(2.7)  # default limit of the alarm pack_under_voltage


@pytest.mark.parametrize(("current_a", "direction"), [(9.0, "discharge"), (-6.0, "charge")])
def test_no_published_available_power_is_below_the_present_power(current_a: float, direction: str) -> None:
    """The load rises to 3 C, and the charge to 2 C, after a forecast that assumes less."""
    limits = {"charge_over_current": {"limit_a": 10.0}}
    settings = Settings.model_validate({"alarms": limits, "pack": {"initial_soc": 0.5}})
    pack = new_pack(settings, load_cell("nmc", 3.0))
    currents_a = [0.0] * 36 + [current_a] * 4
    rows = ((float(time_s), each_a, 3.7 - 0.03 * each_a) for time_s, each_a in enumerate(currents_a))
    estimate = publish(settings, pack, rows)[1][-1].estimate
    assert estimate
    names = [f"available_{direction}_power_{seconds}s_w" for seconds in (10, 60)]
    assert pack.forecaster
    assert max(pack.forecaster.latest.values[name][0] for name in names) < abs(estimate.power_w)
    assert [getattr(estimate, name) for name in names] == pytest.approx([abs(estimate.power_w)] * 2)


def test_a_pack_without_the_identifier_has_no_forecast_and_a_reason() -> None:
    settings = Settings.model_validate({"identifier": {"enabled": False}, "pack": {"initial_soc": 0.5}})
    pack = new_pack(settings, load_cell("chen_mora"))
    assert pack.forecaster is None
    [snapshot] = publish(settings, pack, [(0.0, 0.1, 3.8)])[1]
    assert snapshot.estimate
    assert (snapshot.estimate.forecast_reason, snapshot.forecast) == ("the identifier is switched off", None)
