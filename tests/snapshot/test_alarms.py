"""Each alarm is raised and ends on a capture; what holds whatever the alarm is."""

import itertools
from pathlib import Path
from typing import Any

import pytest

from bms_estimator.model.alarm_settings import ALARMS
from bms_estimator.model.event import events
from tests.snapshot.alarm_captures import Line, Told, record, replayed, settings

GOOD_CELLS = (3.70, 3.70)
COUNTED: dict[str, Any] = {"identifier": {"enabled": False}}
"""The SOC is what is counted, and without a band."""

CAPTURES: dict[str, tuple[list[Line], dict[str, Any], list[tuple[float, bool]]]] = {
    "pack_over_voltage": ([Line(30), Line(10, voltage_v=8.6), Line(30)], {}, [(32.0, True)]),
    "pack_under_voltage": ([Line(30), Line(20, voltage_v=5.3), Line(60)], {}, [(35.0, True), (80.0, False)]),
    "cell_over_voltage": (
        [Line(30, cells_v=GOOD_CELLS), Line(10, cells_v=(3.7, 4.3)), Line(30, cells_v=GOOD_CELLS)],
        {},
        [(32.0, True)],
    ),
    "cell_under_voltage": (
        [Line(30, cells_v=GOOD_CELLS), Line(10, cells_v=(3.7, 2.6)), Line(50, cells_v=GOOD_CELLS)],
        {},
        [(35.0, True), (70.0, False)],
    ),
    "discharge_over_current": ([Line(30), Line(20, current_a=55.0), Line(80)], {}, [(40.0, True)]),
    "charge_over_current": ([Line(30), Line(20, current_a=-11.0), Line(80)], {}, [(40.0, True)]),
    "over_temperature": ([Line(30), Line(20, temperature_c=61.0), Line(80)], {}, [(40.0, True), (110.0, False)]),
    "under_temperature": ([Line(30), Line(20, temperature_c=-21.0), Line(80)], {}, [(40.0, True), (110.0, False)]),
    "charging_below_freezing": (
        [Line(30, temperature_c=-5.0), Line(20, temperature_c=-5.0, current_a=-2.0), Line(30, temperature_c=-5.0)],
        {},
        [(40.0, True)],
    ),
    "soc_low": (
        [Line(400, current_a=20.0), Line(500, current_a=-18.0)],
        COUNTED | {"pack": {"initial_soc": 0.2}},
        [(190.0, True), (0.0, False)],
    ),
    "stability_margin_low": (
        [Line(400, current_a=20.0), Line(500, current_a=-18.0)],
        COUNTED | {"pack": {"initial_soc": 0.2}},
        [(317.0, True), (0.0, False)],
    ),
    "cell_imbalance": (
        [Line(10, cells_v=GOOD_CELLS), Line(80, cells_v=(3.7, 3.64)), Line(80, cells_v=GOOD_CELLS)],
        {},
        [(70.0, True), (150.0, False)],
    ),
    "sensor_fault": ([Line(30), Line(20, voltage_v=0.5), Line(60)], {}, [(40.0, True), (80.0, False)]),
    "model_mismatch": ([Line(30), Line(80, voltage_v=7.9), Line(150)], COUNTED, [(90.0, True), (0.0, False)]),
    "link_lost": ([Line(30), Line(30, silent=True), Line(30)], {}, [(60.0, True), (66.0, False)]),
}
"""By alarm: a capture, sections of the settings, and when it is raised and ends; 0: some time later."""


def test_there_is_a_capture_of_each_alarm() -> None:
    assert set(CAPTURES) == set(ALARMS)


@pytest.mark.parametrize("name", ALARMS)
async def test_each_alarm_is_raised_and_ends_on_a_capture(name: str, tmp_path: Path) -> None:
    lines, sections, expected = CAPTURES[name]
    latched = len(expected) == 1
    told = await replayed(record(tmp_path / "capture.bms", lines), settings(**sections))
    turns = told.turns(name)
    assert [active for _, active in turns] == [active for _, active in expected]
    for (at_s, _), (expected_s, _) in zip(turns, expected, strict=True):
        assert expected_s in (0.0, at_s)
    raised = next(
        alarm for snapshot in told.snapshots for alarm in snapshot.alarms if alarm.name == name and alarm.since
    )
    assert raised.active
    assert raised.text
    last = next(alarm for alarm in told.snapshots[-1].alarms if alarm.name == name)
    assert (last.active, last.latched, bool(last.text)) == (latched, latched, latched)


async def test_no_alarm_is_raised_by_a_pack_that_is_well_and_none_is_shown_of_what_is_not_measured(
    tmp_path: Path,
) -> None:
    lines = [Line(60, current_a=5.0, temperature_c=None), Line(60, current_a=-5.0, temperature_c=None)]
    told = await replayed(record(tmp_path / "capture.bms", lines), settings())
    assert told.changes == []
    shown = {alarm.name for alarm in told.snapshots[-1].alarms}
    assert set(ALARMS) - shown == {
        "cell_over_voltage",
        "cell_under_voltage",
        "cell_imbalance",
        "over_temperature",
        "under_temperature",
        "charging_below_freezing",
    }


async def test_an_over_current_of_200_ms_is_seen_and_published_once_though_it_is_over(tmp_path: Path) -> None:
    rule = {"delay_s": 0.0, "clear_delay_s": 0.0, "latch": False}
    path = record(tmp_path / "capture.bms", [Line(5), Line(0.2, current_a=60.0), Line(5)], period_s=0.1)
    told = await replayed(path, settings({"discharge_over_current": rule}))
    turns = told.turns("discharge_over_current")
    assert [active for _, active in turns] == [True, False]
    shown = [a.active for s in told.snapshots for a in s.alarms if a.name == "discharge_over_current"]
    assert True in shown
    assert not shown[-1]
    named = [event.name for before, after in itertools.pairwise(told.snapshots) for event in events(before, after)]
    assert [name for name in named if name.startswith("alarm")] == ["alarm_raised", "alarm_cleared"]


async def test_however_a_capture_is_cut_into_blocks_the_same_is_raised_at_the_same_time(tmp_path: Path) -> None:
    path = record(tmp_path / "capture.bms", CAPTURES["pack_under_voltage"][0])
    told = await replayed(path, settings())
    again = await replayed(path, settings(), at_once=True)
    assert _named(again) == _named(told) != []


def _named(told: Told) -> list[tuple[float, str, bool]]:
    return [(change.at_s, change.alarm.name, change.alarm.active) for change in told.changes]
