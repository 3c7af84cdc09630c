"""Alarms: a capture for each of them, and limits, delays, latches, restarts and lost quantities."""

import itertools
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.alarms.evaluate import update_alarm
from bms_estimator.kernels.alarms.records import (
    ALARMS as STATES,
    EVALUATION_IO,
    LIMITS,
    LOG,
    RAISED,
    SETTINGS,
    acknowledge,
)
from bms_estimator.kernels.cells.records import ReadingFault
from bms_estimator.kernels.records import TRACE
from bms_estimator.model.arrays import NO_CELLS, SAMPLE, SampleStatus
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.errors import UserError
from bms_estimator.model.events import events
from bms_estimator.model.pack_model import load_fuel_cell
from bms_estimator.protocols.base.device_clock import MAX_LEAD_S
from bms_estimator.protocols.base.probe_check import probe_block
from bms_estimator.settings.alarm_limits import implausible_limits, monitored_alarms
from bms_estimator.settings.alarms import ALARMS
from bms_estimator.telemetry.alarms.alarm_list import NO_VALUE
from bms_estimator.telemetry.alarms.evaluator import AlarmEvaluator
from bms_estimator.telemetry.cells import NO_FAULTY_CELL, CellAlarmInput, CellAlarmInputs
from tests.telemetry.alarm_captures import (
    PACK,
    WALL_S,
    Line,
    ReplayResult,
    knee_lines,
    record,
    replayed,
    settings,
)

NAN = math.nan
NO_TRACE = np.zeros(0, TRACE)
GOOD_CELLS = (3.70, 3.70)
"""Cell voltages that raise no alarm [V]."""
WITHOUT_IDENTIFIER: dict[str, Any] = {"identifier": {"enabled": False}}
"""Settings by which the SOC is that of coulomb counting, without an uncertainty."""

COMPARISONS = {"cell_short", "cell_sensor_fault"}
"""Alarms that compare at least three cells: ``tests/service/test_cell_alarms.py``."""
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
    "over_temperature": (
        [Line(30), Line(20, temperature_c=61.0), Line(40, temperature_c=57.0), Line(80, temperature_c=53.0)],
        {},
        [(40.0, True), (150.0, False)],
    ),
    "under_temperature": ([Line(30), Line(20, temperature_c=-21.0), Line(80)], {}, [(40.0, True), (110.0, False)]),
    "charging_below_freezing": (
        [Line(30, temperature_c=-5.0), Line(20, temperature_c=-5.0, current_a=-2.0), Line(30, temperature_c=-5.0)],
        {},
        [(40.0, True)],
    ),
    "soc_low": (
        [Line(400, current_a=20.0), Line(500, current_a=-18.0)],
        WITHOUT_IDENTIFIER | {"pack": {"initial_soc": 0.2}},
        [(190.0, True), (0.0, False)],
    ),
    "collapse_risk": (knee_lines(), {"pack": {}}, [(0.0, True), (0.0, False)]),
    "cell_imbalance": (
        [Line(10, cells_v=GOOD_CELLS), Line(80, cells_v=(3.7, 3.64)), Line(80, cells_v=GOOD_CELLS)],
        {},
        [(70.0, True), (150.0, False)],
    ),
    "sensor_fault": ([Line(30), Line(20, voltage_v=0.5), Line(60)], {}, [(40.0, True), (80.0, False)]),
    "model_mismatch": (
        [Line(30), Line(80, voltage_v=7.9), Line(150)],
        WITHOUT_IDENTIFIER,
        [(90.0, True), (0.0, False)],
    ),
    # raised after 30 s instead of the delay, because a replay sees the silence only at the next sample
    "link_lost": ([Line(30), Line(30, silent=True), Line(30)], {}, [(60.0, True), (66.0, False)]),
}
"""For each alarm: parts of a capture, sections of the settings, and expected transitions.

A transition is the time since the start of the capture [s], and True if the alarm is raised or False if it is cleared
then. At a time of 0, the transition may be at any time. An alarm without a second transition is latched. The time of
raising contains the delay of the alarm.
"""


def make_evaluator(alarms: dict[str, Any] | None = None, cell: CellModel = PACK) -> AlarmEvaluator:
    """Return an evaluator for a pack with these settings of the alarms. A silence of 10 s raises link_lost."""
    return AlarmEvaluator(settings(alarms), Estimator(cell))


def add_samples(
    alarms: AlarmEvaluator,
    *times_s: float,
    temperature_c: float = NAN,
    voltage_v: float = 7.4,
    current_a: float = 0.0,
    cells_v: tuple[float, ...] = (),
    probes_c: tuple[float, ...] = (),
    status: int = 0,
) -> None:
    """Evaluate samples of a pack."""
    block = np.zeros(len(times_s), dtype=SAMPLE)
    block["time_s"], block["voltage_v"], block["temperature_c"] = times_s, voltage_v, temperature_c
    block["temperature_min_c"] = block["temperature_max_c"] = temperature_c
    block["current_a"], block["status"] = current_a, status
    cells = np.tile(cells_v, (len(times_s), 1)) if cells_v else NO_CELLS
    probes = probe_block([[(reading_c, False) for reading_c in probes_c]] * len(times_s))
    alarms.evaluate(block, NO_TRACE, cells, WALL_S, probes=probes)


async def test_one_hot_probe_of_four_raises_the_alarm_and_is_named(tmp_path: Path) -> None:
    rise = [Line(1, temperatures_c=(25.0, 25.0 + 8.0 * n, 25.0, 25.0)) for n in range(10)]
    lines = [
        *rise,
        Line(20, temperatures_c=(25.0, 97.0, 25.0, 25.0)),
        *(Line(1, temperatures_c=(25.0, 97.0 - 0.5 * n, 25.0, 25.0)) for n in range(94)),
        Line(70, temperatures_c=(25.0, 50.0, 25.0, 25.0)),
    ]
    result = await replayed(record(tmp_path / "capture.bms", lines), settings())
    # above 60 degC from 5 s on, below 55 degC from 115 s on
    assert result.transitions("over_temperature") == [(15.0, True), (175.0, False)]
    texts = [
        change.alarm.text for change in result.changes if change.alarm.name == "sensor_fault" and change.alarm.active
    ]
    assert len(texts) == 1
    assert "probe 2 reads 57 °C: a temperature probe is broken" in texts[0]
    last = [snapshot.estimate for snapshot in result.snapshots if snapshot.estimate][-1]
    assert (last.temperatures_c, last.faulty_probes) == ([25.0, 50.0, 25.0, 25.0], [])


@pytest.mark.parametrize("others_c", [(), (5.0,), (25.0, 26.0, 25.0)])
async def test_an_open_probe_raises_no_freezing_alarm_but_is_named(others_c: tuple[float, ...], tmp_path: Path) -> None:
    lines = [Line(20, current_a=-2.0, temperatures_c=(*others_c, 25.0))] if others_c else []
    lines += [Line(60, current_a=-2.0, temperatures_c=(*others_c, -30.0))]
    result = await replayed(record(tmp_path / "capture.bms", lines), settings())
    assert result.transitions("charging_below_freezing") == result.transitions("under_temperature") == []
    (text,) = [change.alarm.text for change in result.changes if change.alarm.name == "sensor_fault"]
    assert f"probe {len(others_c) + 1} reads -30 °C" in text


async def test_the_coldest_probe_raises_the_freezing_alarm(tmp_path: Path) -> None:
    lines = [Line(40, current_a=-2.0, temperatures_c=(12.0, -3.0, 10.0))]
    result = await replayed(record(tmp_path / "capture.bms", lines), settings())
    assert result.transitions("charging_below_freezing") == [(10.0, True)]
    assert result.transitions("sensor_fault") == []


@pytest.mark.parametrize(("temperature_c", "name"), [(70.0, "over_temperature"), (-25.0, "under_temperature")])
def test_a_mean_temperature_without_extremes_raises_an_alarm(temperature_c: float, name: str) -> None:
    samples = np.zeros(100, dtype=SAMPLE)  # lowest and highest temperature stay 0 degC: they are not measured
    samples["time_s"], samples["voltage_v"], samples["temperature_c"] = np.arange(100.0), 7.4, temperature_c
    alarms = make_evaluator()
    alarms.evaluate(samples, NO_TRACE, NO_CELLS, WALL_S)
    assert alarms.active == (name,)


def test_each_alarm_has_a_capture() -> None:
    # these need hooks, earlier runs, several discharges, hours or three cells
    unrecorded = {"hook_failed", "alarm_state_lost", "weak_cell", "stability_margin_low", *COMPARISONS}
    assert set(CAPTURES) == set(ALARMS) - unrecorded


@pytest.mark.parametrize("name", CAPTURES)
async def test_each_alarm_is_raised_and_cleared_or_latched_on_its_capture(name: str, tmp_path: Path) -> None:
    lines, sections, expected = CAPTURES[name]
    latched = len(expected) == 1  # such an alarm stays raised
    result = await replayed(record(tmp_path / "capture.bms", lines), settings(**sections))
    transitions = result.transitions(name)
    assert [active for _, active in transitions] == [active for _, active in expected]
    for (at_s, _), (expected_s, _) in zip(transitions, expected, strict=True):
        assert expected_s in (0.0, at_s)
    raised = next(
        alarm for snapshot in result.snapshots for alarm in snapshot.alarms if alarm.name == name and alarm.since
    )
    assert raised.active
    assert raised.text
    last = next(alarm for alarm in result.snapshots[-1].alarms if alarm.name == name)
    assert (last.active, last.latched, bool(last.text)) == (latched, latched, latched)


async def test_a_healthy_pack_raises_no_alarm_and_alarms_of_unmeasured_quantities_are_not_reported(
    tmp_path: Path,
) -> None:
    lines = [Line(60, current_a=5.0, temperature_c=None), Line(60, current_a=-5.0, temperature_c=None)]
    result = await replayed(record(tmp_path / "capture.bms", lines), settings())
    assert result.changes == []
    reported = {alarm.name for alarm in result.snapshots[-1].alarms}
    assert set(ALARMS) - reported == {
        "hook_failed",
        *COMPARISONS,
        "cell_over_voltage",
        "cell_under_voltage",
        "cell_imbalance",
        "over_temperature",
        "under_temperature",
        "charging_below_freezing",
    }


async def test_cells_of_lfp_are_compared_only_below_the_steep_end_of_a_charge(tmp_path: Path) -> None:
    """Balanced cells differ at the end of each charge; a cell that falls behind under load or near empty is weak."""
    full, weak = Line(80, 6.90, -5.0, cells_v=(3.50, 3.40)), Line(80, 6.50, 5.0, cells_v=(3.28, 3.22))
    path = record(tmp_path / "capture.bms", [Line(10, 6.60, cells_v=(3.30, 3.30)), full, weak])
    result = await replayed(path, settings(), load_cell("lfp", 10.0).pack(2, 1))
    assert result.transitions("cell_imbalance") == [(pytest.approx(150.0, abs=1.5), True)]


async def test_an_over_current_of_200_ms_is_published_once_after_it_has_ended(tmp_path: Path) -> None:
    rule = {"delay_s": 0.0, "clear_delay_s": 0.0, "latch": False}
    path = record(tmp_path / "capture.bms", [Line(5), Line(0.2, current_a=60.0), Line(5)], period_s=0.1)
    result = await replayed(path, settings({"discharge_over_current": rule}))
    transitions = result.transitions("discharge_over_current")
    assert [active for _, active in transitions] == [True, False]
    published = [a.active for s in result.snapshots for a in s.alarms if a.name == "discharge_over_current"]
    assert True in published
    assert not published[-1]
    names = [event.name for before, after in itertools.pairwise(result.snapshots) for event in events(before, after)]
    assert [name for name in names if name.startswith("alarm")] == ["alarm_raised", "alarm_cleared"]


async def test_transitions_of_a_replay_do_not_depend_on_the_size_of_blocks(tmp_path: Path) -> None:
    path = record(tmp_path / "capture.bms", CAPTURES["pack_under_voltage"][0])
    result = await replayed(path, settings())
    result_of_long_blocks = await replayed(path, settings(), at_once=True)
    assert _transitions(result_of_long_blocks) == _transitions(result) != []


@pytest.fixture(scope="module")
def knee(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the capture of a pack that is driven into the knee and then charged."""
    return record(tmp_path_factory.mktemp("knee") / "capture.bms", knee_lines())


@pytest.mark.thorough
async def test_collapse_risk_contains_probability_and_time_left_and_does_not_depend_on_the_size_of_blocks(
    knee: Path,
) -> None:
    result = await replayed(knee, settings(pack={}), at_once=True)
    raised = next(change.alarm for change in result.changes if change.alarm.name == "collapse_risk")
    assert raised.value is not None
    assert raised.limit is not None
    assert raised.limit <= raised.value <= 1.0
    assert f"{100.0 * raised.value:.4g} %, limit" in raised.text
    assert re.search(r"the time left was \d+ to \d+ min \(90 % band\)", raised.text)
    of_single_samples = await replayed(knee, settings(pack={}))
    assert of_single_samples.transitions("collapse_risk") == result.transitions("collapse_risk")


async def test_a_higher_accepted_rate_of_false_alarms_warns_earlier(knee: Path) -> None:
    times_s = []
    for rate in (1.0, 3.0):
        result = await replayed(
            knee, settings({"collapse_risk": {"false_alarms_per_month": rate}}, pack={}), at_once=True
        )
        times_s.append(result.transitions("collapse_risk")[0][0])
    assert times_s[1] < times_s[0]


async def test_collapse_risk_stays_raised_over_a_restart_until_there_is_a_forecast(tmp_path: Path) -> None:
    saved = json.dumps({"collapse_risk": {"since_s": WALL_S, "value": 0.9, "gone": False, "acknowledged": False}})
    resting = record(tmp_path / "capture.bms", [Line(200, voltage_v=6.4)])
    result = await replayed(resting, settings(), saved_state=saved, at_once=True)
    assert result.transitions("collapse_risk") == []
    assert next(alarm for alarm in result.snapshots[-1].alarms if alarm.name == "collapse_risk").active


def _transitions(result: ReplayResult) -> list[tuple[float, str, bool]]:
    """Return time [s], name and new state of each change of an alarm."""
    return [(change.at_s, change.alarm.name, change.alarm.active) for change in result.changes]


class KernelAlarm:
    """State of an alarm with limit 10, clear level 8, and delays of 2 s and 3 s, except for ``changes``.

    For ``sign`` = -1 all limits and values are negative, and the limit is a lower one.
    """

    def __init__(self, sign: float = 1.0, **changes: float) -> None:
        self._alarms, self._io, self._log = np.zeros(1, STATES), np.zeros(1, EVALUATION_IO), np.zeros(9, LOG)
        self._limits, self._sign, self._time_s = np.zeros(1, LIMITS), sign, 0.0
        rule = {"limit": 10.0, "clear": 8.0, "delay_s": 2.0, "clear_delay_s": 3.0, "latch": 0} | changes
        for name, value in {"monitored": 1, "sign": sign, **rule}.items():
            self._limits[name] = sign * value if name in ("limit", "clear") else value

    def process(self, *values: float) -> list[tuple[float, bool]]:
        """Process values at intervals of 1 s, from 0 s on over all calls. Return the times of raising (True) and ending."""
        for value in values:
            tables = self._alarms, self._limits, np.zeros(1, SETTINGS), self._io, self._log
            update_alarm(*tables, 0, self._time_s, 1.0, self._sign * value)
            self._time_s += 1.0
        return self._changes()

    def acknowledge(self) -> list[tuple[float, bool]]:
        """Acknowledge the alarm. Return the times of raising (True) and ending."""
        acknowledge(self._alarms, self._io, self._log, 0, self._time_s)
        return self._changes()

    def _changes(self) -> list[tuple[float, bool]]:
        entries = self._log[: self._io["logged"][0]]
        self._io["logged"] = 0
        return list(zip(entries["at_s"].tolist(), (entries["kind"] == RAISED).tolist(), strict=True))


@pytest.mark.parametrize(
    ("values", "transitions"),
    [
        ([9.9, 10.0, 10.0, 10.0, 9.0], [(3.0, True)]),  # a value equal to the limit counts
        ([10.0, 10.0, 9.99, 10.0, 10.0, 9.0], []),  # a value below the limit restarts the delay
        ([11.0] * 3 + [8.0] * 9, [(2.0, True)]),  # a value equal to the clear level does not end the alarm
        ([11.0] * 3 + [7.9] * 3 + [8.0] + [7.9] * 4, [(2.0, True), (10.0, False)]),
        ([11.0, 11.0, NAN, NAN, 11.0, 11.0], [(4.0, True)]),  # NaN adds nothing to the delay and does not restart it
        ([11.0] * 3 + [NAN] * 20, [(2.0, True)]),
        ([NAN] * 5, []),
        ([11.0, 11.0, 9.0, 11.0, 11.0, 11.0, NAN, 7.0, 7.0, 7.0, 7.0, 11.0], [(5.0, True), (10.0, False)]),
    ],
)
def test_an_alarm_is_raised_at_its_limit_and_cleared_below_its_clear_level_after_delays(
    values: list[float], transitions: list[tuple[float, bool]]
) -> None:
    assert KernelAlarm().process(*values) == KernelAlarm(sign=-1.0).process(*values) == transitions


def test_without_delay_and_hysteresis_each_crossing_is_a_transition() -> None:
    alarm = KernelAlarm(clear=10.0, delay_s=0.0, clear_delay_s=0.0)
    assert alarm.process(9.0, 10.0, 9.9, 10.0) == [(1.0, True), (2.0, False), (3.0, True)]


def test_a_latched_alarm_ends_only_after_it_was_acknowledged() -> None:
    alarm = KernelAlarm(latch=1, delay_s=0.0, clear_delay_s=0.0)
    assert alarm.process(11.0, 7.0) == [(0.0, True)]
    assert alarm.process(11.0) == alarm.acknowledge() == [], "the cause is there again"
    assert alarm.process(7.0) == [(3.0, False)]
    assert alarm.process(11.0, 7.0) == [(4.0, True)], "an earlier acknowledgment does not count"
    assert alarm.acknowledge() == [(6.0, False)]


async def test_a_gap_does_not_count_toward_a_delay_but_time_between_slow_samples_does(tmp_path: Path) -> None:
    rule = {"over_temperature": {"delay_s": 25.0}, "link_lost": {"enabled": False}}
    hot = Line(20, temperature_c=70.0)
    lines = [Line(5), hot, hot._replace(silent=True), hot._replace(seconds=10)]
    result = await replayed(record(tmp_path / "gap.bms", lines), settings(rule))
    assert result.transitions("over_temperature") == [(51.0, True)]  # 19 s before the gap and 6 s after it
    slow = [Line(50), Line(80, temperature_c=70.0)]
    result = await replayed(record(tmp_path / "slow.bms", slow, period_s=10.0), settings(rule))
    assert result.transitions("over_temperature") == [(80.0, True)]


async def test_a_latched_alarm_survives_a_restart(tmp_path: Path) -> None:
    before = await replayed(record(tmp_path / "one.bms", CAPTURES["pack_over_voltage"][0]), settings())
    assert '"pack_over_voltage"' in before.saved_state
    healthy = record(tmp_path / "two.bms", [Line(30)])
    after = await replayed(healthy, settings(), saved_state=before.saved_state, begin_s=WALL_S + 1000.0)
    first, last = (next(a for a in s.alarms if a.active) for s in (after.snapshots[0], after.snapshots[-1]))
    assert first == last
    assert last.latched
    assert after.changes == []
    names = [event.name for event in events(None, after.snapshots[0])]
    assert "alarm_raised" not in names, "the run before the restart has reported the alarm"
    without_latch = settings({"pack_over_voltage": {"latch": False}})
    after = await replayed(healthy, without_latch, saved_state=before.saved_state)
    assert [alarm.name for alarm in after.snapshots[-1].alarms if alarm.latched] == ["pack_over_voltage"]


async def test_a_raised_alarm_survives_a_restart_and_ends_with_its_cause(tmp_path: Path) -> None:
    under_voltage = record(tmp_path / "one.bms", [Line(30), Line(20, voltage_v=5.3)])
    before = await replayed(under_voltage, settings())
    # 5.7 V is above the limit and below the clear level.
    recovering = record(tmp_path / "two.bms", [Line(30, voltage_v=5.7), Line(60)])
    after = await replayed(recovering, settings(), saved_state=before.saved_state, begin_s=WALL_S + 1000.0)
    assert after.snapshots[0].alarms != ()
    assert after.transitions("pack_under_voltage") == [(60.0, False)]
    assert json.loads(after.saved_state).keys() & {"pack_under_voltage"} == set()


def test_text_of_a_raised_reading_fault_stays_while_only_its_numbers_change() -> None:
    alarms = make_evaluator({"cell_sensor_fault": {"delay_s": 0.0}}, load_cell("nmc", 10.0).pack(3, 1))
    for at_s, text in enumerate(["cell 2 is off by 0.1 V", "cell 2 is off by 0.1 V", "cell 2 is off by 0.2 V"]):
        fault = CellAlarmInput(0.1, (text,), ((1, ReadingFault.OFFSET),))
        faults, samples = CellAlarmInputs(float(at_s), NO_FAULTY_CELL, fault), np.zeros(1, SAMPLE)
        samples["time_s"] = at_s
        alarms.evaluate(samples, NO_TRACE, NO_CELLS, WALL_S, cell_alarm_inputs=faults)
    (text,) = [alarm.text for alarm in alarms.report() if alarm.name == "cell_sensor_fault"]
    assert "cell 2 is off by 0.1 V" in text


async def test_a_saturated_current_is_possible_and_exceeds_any_limit() -> None:
    alarms = make_evaluator({"discharge_over_current": {"delay_s": 0.0, "limit_a": 500.0}})
    block = np.zeros(2, dtype=SAMPLE)
    block["time_s"], block["current_a"], block["voltage_v"] = [0.0, 0.1], [25.0, 1e6], 7.4
    block["status"] = [0, int(SampleStatus.CURRENT_SATURATED)]
    alarms.evaluate(block, NO_TRACE, NO_CELLS, WALL_S)
    (change,) = alarms.changes()
    assert (change.alarm.name, change.at_s, change.alarm.value) == ("discharge_over_current", 0.1, None)
    assert change.alarm.since == iso_utc(WALL_S)


@pytest.mark.parametrize(
    ("voltage_v", "status"),
    [(0.05, SampleStatus(0)), (5.0, SampleStatus(0)), (7.6, SampleStatus.VOLTAGE_SATURATED)],
    ids=["broken wire", "floating wire", "range of the converter that sags with its supply"],
)
def test_a_voltage_that_cannot_be_measured_does_not_end_an_over_voltage(voltage_v: float, status: SampleStatus) -> None:
    alarms = make_evaluator({"pack_over_voltage": {"latch": False}})
    add_samples(alarms, *range(20), voltage_v=8.6)
    assert alarms.active == ("pack_over_voltage",)
    add_samples(alarms, *range(20, 100), voltage_v=voltage_v, status=int(status))
    assert "pack_over_voltage" in alarms.active
    add_samples(alarms, *range(100, 200), voltage_v=7.4)
    assert "pack_over_voltage" not in alarms.active


def test_a_current_sensor_that_dies_does_not_end_an_over_current_and_is_lost() -> None:
    alarms = make_evaluator({"discharge_over_current": {"limit_a": 20.0, "latch": False}})
    add_samples(alarms, *range(20), current_a=22.0)
    assert alarms.active == ("discharge_over_current",)
    add_samples(alarms, *range(20, 100), current_a=-25.0, status=int(SampleStatus.CURRENT_SATURATED))
    assert "discharge_over_current" in alarms.active
    assert "discharge_over_current" in alarms.unwatched_critical


def test_a_voltage_at_the_end_of_the_range_does_not_end_an_under_voltage() -> None:
    alarms = make_evaluator({"pack_under_voltage": {"latch": False}})
    add_samples(alarms, *range(20), voltage_v=5.3)
    assert "pack_under_voltage" in alarms.active
    add_samples(alarms, *range(20, 100), voltage_v=30.0, status=int(SampleStatus.VOLTAGE_SATURATED))
    assert "pack_under_voltage" in alarms.active


def test_a_cell_whose_wire_reads_0_v_does_not_end_a_cell_over_voltage() -> None:
    alarms = make_evaluator({"cell_over_voltage": {"latch": False}})
    add_samples(alarms, *range(20), cells_v=(3.7, 4.3))
    add_samples(alarms, *range(20, 100), cells_v=(3.7, 0.0))
    assert "cell_over_voltage" in alarms.active
    alarms.acknowledge("cell_over_voltage")
    add_samples(alarms, *range(100, 110), cells_v=(3.7, 4.3))
    add_samples(alarms, *range(110, 190), cells_v=(3.7, 0.0))
    assert "cell_over_voltage" in alarms.active, "the acknowledgement was of the earlier cause"
    add_samples(alarms, *range(190, 300), cells_v=(3.7, 3.7))
    assert "cell_over_voltage" not in alarms.active


def test_a_cell_whose_wire_floats_does_not_end_a_cell_under_voltage() -> None:
    alarms = make_evaluator()
    add_samples(alarms, *range(20), cells_v=(3.7, 2.4))
    add_samples(alarms, *range(20, 200), cells_v=(3.7, 5.9))
    assert "cell_under_voltage" in alarms.active


@pytest.mark.parametrize(("voltage_v", "status"), [(0.05, SampleStatus(0)), (30.0, SampleStatus.VOLTAGE_SATURATED)])
def test_a_broken_wire_of_the_pack_voltage_counts_as_lost(voltage_v: float, status: SampleStatus) -> None:
    alarms = make_evaluator()
    add_samples(alarms, *range(20))
    add_samples(alarms, *range(20, 100), voltage_v=voltage_v, status=int(status))
    assert {"pack_over_voltage", "pack_under_voltage"} <= {*alarms.unwatched_critical}


def test_charging_below_freezing_does_not_end_when_the_cold_probe_fails_but_when_the_charge_ends() -> None:
    alarms = make_evaluator({"charging_below_freezing": {"latch": False}})
    add_samples(alarms, *range(20), current_a=-2.0, temperature_c=-5.0)
    faulty = int(SampleStatus.PROBE_FAULT)
    add_samples(alarms, *range(20, 100), current_a=-2.0, temperature_c=20.0, status=faulty)
    assert "charging_below_freezing" in alarms.active
    add_samples(alarms, *range(100, 200), temperature_c=20.0, status=faulty)
    assert "charging_below_freezing" not in alarms.active


def test_an_alarm_whose_cause_has_returned_is_not_ended_by_its_acknowledgement() -> None:
    """The delay of ``over_temperature`` is 10 s."""
    alarms = make_evaluator({"over_temperature": {"latch": True}})
    add_samples(alarms, *range(20), temperature_c=70.0)
    add_samples(alarms, *range(20, 100), temperature_c=25.0)
    add_samples(alarms, *range(100, 105), temperature_c=70.0)
    alarms.acknowledge("over_temperature")
    assert "over_temperature" in alarms.active
    add_samples(alarms, *range(105, 200), temperature_c=25.0)
    assert "over_temperature" not in alarms.active


def test_only_its_own_acknowledgement_ends_over_temperature_while_the_hot_probe_is_missing() -> None:
    alarms = make_evaluator()
    add_samples(alarms, *range(20), temperature_c=70.0, probes_c=(25.0, 70.0))
    add_samples(alarms, *range(20, 60), temperature_c=25.0, probes_c=(25.0,))
    alarms.acknowledge("sensor_fault")
    add_samples(alarms, *range(60, 200), temperature_c=25.0, probes_c=(25.0,))
    assert "over_temperature" in alarms.active
    alarms.acknowledge("over_temperature")
    add_samples(alarms, *range(200, 300), temperature_c=25.0, probes_c=(25.0,))
    assert "over_temperature" not in alarms.active


def test_a_saturated_voltage_exceeds_any_limit() -> None:
    alarms = make_evaluator({"pack_over_voltage": {"limit_v": 9.0, "clear_v": 8.5}})
    add_samples(alarms, *range(20), voltage_v=8.0, status=int(SampleStatus.VOLTAGE_SATURATED))
    assert "pack_over_voltage" in alarms.active


def test_a_latched_link_lost_is_active_again_during_a_second_silence() -> None:
    alarms = make_evaluator({"link_lost": {"latch": True}})
    # gone: the cause of the alarm has ended
    saved = {"since_s": WALL_S, "value": 10.0, "gone": True, "acknowledged": False, "severity": "warning"}
    alarms.restore(json.dumps({"link_lost": saved}))
    alarms.on_silence(1.0, WALL_S, "", 0.0)
    assert json.loads(alarms.saved_state)["link_lost"]["gone"]
    alarms.on_silence(1000.0, WALL_S, "", 0.0)
    assert json.loads(alarms.saved_state)["link_lost"] == saved | {"gone": False}
    assert alarms.acknowledge(None) == ["link_lost"]
    assert alarms.active == ("link_lost",), "the cause is still there"


def test_a_saved_alarm_with_an_invalid_value_is_rejected() -> None:
    alarms = make_evaluator()
    saved = {"since_s": WALL_S, "value": math.inf, "gone": False, "acknowledged": False}
    with pytest.raises(ValueError, match="pack_over_voltage: value = inf"):
        alarms.restore(json.dumps({"pack_over_voltage": saved}))


@pytest.mark.parametrize(
    ("alarms", "reason"),
    [
        ({"pack_over_voltage": {"limit_v": 8.4, "clear_v": 8.5}}, r"clear_v = 8\.5: must not be above limit_v = 8\.4"),
        ({"soc_low": {"clear": 0.05}}, r"soc_low\.clear = 0\.05: must not be below limit = 0\.1"),
    ],
)
def test_a_clear_level_beyond_the_limit_is_rejected(alarms: dict[str, Any], reason: str) -> None:
    with pytest.raises(UserError, match=reason):
        monitored_alarms(settings(alarms), PACK)


@pytest.mark.parametrize(
    ("alarm", "rule", "start"),
    [
        ("cell_over_voltage", {"limit_v": 8.4}, "limit_v = 8.4: outside 3.65 to 4.5 V, the range of the cell file"),
        ("over_temperature", {"limit_c": 140.0}, "limit_c = 140: outside 30 to 120 °C, the plausible range"),
        ("under_temperature", {"limit_c": -273.0}, "limit_c = -273: outside -60 to 40 °C"),
        ("pack_over_voltage", {"delay_s": 36000.0}, "delay_s = 36000: this critical alarm is raised only if"),
    ],
)
def test_an_implausible_limit_or_delay_is_reported(alarm: str, rule: dict[str, float], start: str) -> None:
    assert implausible_limits(settings(), PACK) == []
    (warning,) = implausible_limits(settings({alarm: rule}), PACK)
    assert warning.startswith(f"alarms.{alarm}.{start}")


def test_limits_depend_on_chemistry_size_and_settings() -> None:
    lfp_pack = load_cell("lfp", 100.0).pack(16, 2)  # 3.65 V, 3.4 V, 5 C and 1 C for each cell
    lfp = {alarm.name: alarm for alarm in monitored_alarms(settings(), lfp_pack)}
    assert (lfp["pack_over_voltage"].limit, lfp["pack_over_voltage"].clear) == pytest.approx((58.4, 54.4))
    assert (lfp["discharge_over_current"].limit, lfp["charge_over_current"].limit) == (1000.0, 200.0)
    limits = {
        "pack_over_voltage": {"limit_v": 57.6},
        "cell_imbalance": {"enabled": False},
        "charge_over_current": {"limit_a": 120.0},
    }
    rated = settings(limits, pack={"max_discharge_a": 150.0, "max_charge_a": 90.0})
    configured = {alarm.name: alarm for alarm in monitored_alarms(rated, lfp_pack)}
    assert (configured["discharge_over_current"].limit, configured["charge_over_current"].limit) == (150.0, 120.0)
    assert configured["pack_over_voltage"].clear == pytest.approx(53.6)
    assert configured["pack_over_voltage"].latch
    assert "cell_imbalance" not in configured
    stack = {alarm.name for alarm in monitored_alarms(settings(), load_fuel_cell("pem_30w"))}
    assert not stack & {"cell_over_voltage", "cell_under_voltage", "charge_over_current", "charging_below_freezing"}


CHARGING = Line(30, voltage_v=7.6, current_a=-5.0, cells_v=(3.8, 3.8))
LOSSES = [
    (CHARGING._replace(temperature_c=None), "temperature", ("charging_below_freezing", "over_temperature")),
    (CHARGING._replace(cells_v=()), "cell voltages", ("cell_over_voltage", "cell_under_voltage")),
    (CHARGING._replace(cells_v=(3.8,)), "cell voltages", ("cell_over_voltage", "cell_under_voltage")),
]
"""Readings without a quantity, the quantity's name in messages, and critical alarms that need the quantity."""


@pytest.mark.parametrize(("lost", "word", "unwatched_alarms"), LOSSES)
async def test_a_lost_quantity_raises_sensor_fault_after_ten_seconds_and_its_alarms_are_unwatched(
    lost: Line, word: str, unwatched_alarms: tuple[str, ...], tmp_path: Path
) -> None:
    lines = [CHARGING, lost, CHARGING._replace(seconds=60)]
    result = await replayed(record(tmp_path / "capture.bms", lines), settings())
    # The quantity counts as lost or measured after 10 s. The clear delay of the alarm is 30 s.
    assert result.transitions("sensor_fault") == [(40.0, True), (100.0, False)]
    for name in unwatched_alarms:
        assert result.watched(name) == [(40.0, False), (70.0, True)]
    assert result.watched("pack_over_voltage") == []
    published = [{a.name: a for a in s.alarms} for s in result.snapshots]
    unwatched = [alarms[name] for alarms in published for name in unwatched_alarms if not alarms[name].watched]
    assert {alarm.active for alarm in unwatched} == {False}
    assert all(word in (alarm.unwatched_reason or "") for alarm in unwatched)
    fault = next(alarms["sensor_fault"] for alarms in published if alarms["sensor_fault"].active)
    assert all(name in fault.text for name in (word, *unwatched_alarms))
    assert fault.text.index(word) < fault.text.index("samples are lost")
    names = {e.name for before, after in itertools.pairwise(result.snapshots) for e in events(before, after)}
    assert {"alarm_raised", "alarm_unwatched", "alarm_watched", "alarm_cleared"} <= names


async def test_a_short_loss_or_the_loss_of_a_quantity_that_no_critical_alarm_needs_raises_no_alarm(
    tmp_path: Path,
) -> None:
    short = [CHARGING, CHARGING._replace(seconds=10, temperature_c=None), CHARGING]
    path = record(tmp_path / "short.bms", short)
    assert (await replayed(path, settings())).changes == []
    result = await replayed(path, settings({"lost_s": 5.0}))
    assert result.transitions("sensor_fault")[:1] == [(35.0, True)]
    warnings = {name: {"severity": "warning"} for name in ("over_temperature", "charging_below_freezing")}
    lines = [CHARGING, CHARGING._replace(temperature_c=None)]
    result = await replayed(record(tmp_path / "warning.bms", lines), settings(warnings))
    assert result.transitions("sensor_fault") == []
    assert result.watched("over_temperature") == [(40.0, False)]


async def test_a_rarely_measured_quantity_is_watched_again_after_a_loss(tmp_path: Path) -> None:
    rare = [CHARGING._replace(seconds=1), CHARGING._replace(seconds=4, temperature_c=None)]
    lines = [*rare * 6, CHARGING._replace(temperature_c=None), *rare * 8]
    result = await replayed(record(tmp_path / "capture.bms", lines), settings())
    # last value at 26 s, then lost after 10 s; next value at 60 s, then measured after 10 s
    assert result.watched("over_temperature") == [(36.0, False), (70.0, True)]


async def test_a_lost_quantity_stays_lost_over_a_restart(tmp_path: Path) -> None:
    lines = [CHARGING, CHARGING._replace(temperature_c=None)]
    before = await replayed(record(tmp_path / "one.bms", lines), settings())
    without = record(tmp_path / "two.bms", [CHARGING._replace(temperature_c=None)])
    after = await replayed(without, settings(), saved_state=before.saved_state, begin_s=WALL_S + 1000.0)
    first = {alarm.name: alarm for alarm in after.snapshots[0].alarms}
    assert (first["sensor_fault"].active, first["over_temperature"].watched) == (True, False)
    assert (after.transitions("sensor_fault"), after.watched("over_temperature")) == ([], [])
    measured_before = await replayed(record(tmp_path / "three.bms", [CHARGING]), settings())
    after = await replayed(without, settings(), saved_state=measured_before.saved_state, begin_s=WALL_S + 1000.0)
    assert after.transitions("sensor_fault") == [(10.0, True)]


def test_alarms_are_unwatched_during_silence_and_the_first_10_s_of_samples() -> None:
    alarms = make_evaluator()
    add_samples(alarms, 0.0)
    # Time of a sample [s], None: no sample; duration of the silence [s], and the expected state of an alarm.
    steps = [(None, 9.9, True), (None, 10.0, False), (20.0, 0.0, False), (None, 10.0, False), (50.0, 0.0, False)]
    steps += [(50.0 + after_s, 0.0, after_s >= 10.0) for after_s in (5.0, 9.9, 10.0)]
    now_s = 0.0
    for time_s, silent_s, is_watched in steps:
        if time_s is not None:
            add_samples(alarms, time_s)
        now_s = max(now_s, time_s or 0.0) + silent_s
        alarms.on_silence(silent_s, WALL_S, "no cable", now_s)
        reported = {alarm.name: alarm for alarm in alarms.report()}
        over_voltage = reported["pack_over_voltage"]
        assert (over_voltage.watched, over_voltage.unwatched_reason) == (is_watched, None if is_watched else "no cable")
        assert reported["link_lost"].watched
        assert "over_temperature" not in reported, "it was never measured"


def test_an_alarm_without_a_value_is_reported_before_during_and_after_an_outage() -> None:
    """The report before the outage corrects a retained message that an earlier run left in an outage."""
    alarms, reported = make_evaluator(), []
    for silent_s, now_s in ((0.0, 20.0), (10.0, 30.0), (0.0, 60.0)):
        if not silent_s:
            add_samples(alarms, *np.arange(now_s - 20.0, now_s))
        alarms.on_silence(silent_s, WALL_S, "no cable", now_s)
        reported += [(alarm.watched, alarm.unknown_reason) for alarm in alarms.report() if alarm.name == "weak_cell"]
    assert reported == [(True, NO_VALUE), (False, NO_VALUE), (True, NO_VALUE)]


def test_an_alarm_of_which_a_quantity_was_never_measured_is_not_reported_when_another_one_is_lost() -> None:
    alarms = make_evaluator()
    add_samples(alarms, 0.0)
    add_samples(alarms, *range(1, 20), current_a=NAN)
    watched = {alarm.name: alarm.watched for alarm in alarms.report()}
    assert not watched["discharge_over_current"]
    assert "charging_below_freezing" not in watched, "no temperature was ever measured"


def test_sensor_fault_names_two_publishers_and_then_the_share_of_lost_samples() -> None:
    alarms, samples = make_evaluator({"sensor_fault": {"delay_s": 0.0}}), np.zeros(2, SAMPLE)
    for lost in range(2):
        samples["time_s"], samples["voltage_v"] = (10.0 * lost, 10.0 * lost + 1.0), 7.4
        alarms.evaluate(samples, NO_TRACE, NO_CELLS, WALL_S, lost=lost, conflict=f"two publishers, {lost}")
    (text,) = [alarm.text for alarm in alarms.report() if alarm.name == "sensor_fault"]
    assert text.startswith("two publishers, 0; samples are lost, unusable or from two publishers: 100 %, limit 10 %; ")


def test_link_lost_names_the_reason_that_the_source_knows_later() -> None:
    alarms = make_evaluator()
    for reason in ("", "the publisher reports offline", ""):
        alarms.on_silence(30.0, WALL_S, reason, 0.0)
    (text,) = [alarm.text for alarm in alarms.report() if alarm.name == "link_lost"]
    assert text.startswith("the publisher reports offline; no samples arrive: 30 s, limit 10 s; ")


@pytest.mark.parametrize(("status", "watched"), [(SampleStatus.PROBE_FAULT, False), (SampleStatus(0), True)])
def test_a_temperature_that_only_faulty_probes_measure_is_lost_from_the_start_and_an_absent_one_is_not(
    status: SampleStatus, watched: bool
) -> None:
    alarms = make_evaluator()
    for time_s in range(20):
        add_samples(alarms, float(time_s), status=int(status))
    assert ("over_temperature" not in alarms.unwatched_critical) == watched


def test_a_relay_does_not_close_between_a_silence_and_an_alarm_whose_cause_arose_meanwhile() -> None:
    alarms = make_evaluator()
    add_samples(alarms, 0.0, temperature_c=25.0)
    alarms.on_silence(10.0, WALL_S, "no cable", 10.0)
    for time_s in range(20, 40):
        add_samples(alarms, float(time_s), temperature_c=80.0)
        alarms.on_silence(0.0, WALL_S, "", float(time_s))
        assert {"over_temperature"} & {*alarms.unwatched_critical, *alarms.active}


@pytest.mark.parametrize("seconds", [15, 60])
def test_an_alarm_with_a_long_delay_stays_unwatched_while_a_lost_sensor_returns_hot(seconds: int) -> None:
    alarms = make_evaluator({"over_temperature": {"delay_s": 30.0}})
    add_samples(alarms, 0.0, temperature_c=25.0)
    add_samples(alarms, *range(1, 20), temperature_c=NAN)
    for time_s in range(20, 20 + seconds):
        add_samples(alarms, float(time_s), temperature_c=80.0)
        assert {"over_temperature"} & {*alarms.unwatched_critical, *alarms.active}
    assert ("over_temperature" in alarms.active) == (seconds > 30)
    add_samples(alarms, 100.0, temperature_c=25.0)
    assert "over_temperature" not in alarms.unwatched_critical


def test_an_alarm_unwatched_by_silence_stays_so_over_a_restart_until_samples_arrive() -> None:
    before, after = (make_evaluator() for _ in range(2))
    add_samples(before, 0.0)
    before.on_silence(10.0, WALL_S, "no cable", 10.0)
    after.restore(before.saved_state)
    after.on_silence(0.0, WALL_S, "", 20.0)
    assert "pack_over_voltage" in after.unwatched_critical, "no sample has come since the restart"
    add_samples(after, *range(11))
    after.on_silence(0.0, WALL_S, "", 20.0)
    changed = {change.alarm.name: change for change in after.changes()}
    assert (changed["pack_over_voltage"].field, changed["pack_over_voltage"].alarm.watched) == ("watched", True)
    assert after.unwatched_critical == ()
    assert "silence" not in json.loads(after.saved_state)


@pytest.mark.parametrize("jitter_s", [0.5, 3.0])
async def test_times_with_jitter_neither_shorten_delays_nor_count_charge_twice(tmp_path: Path, jitter_s: float) -> None:
    hot_s = 70
    lines = [Line(hot_s, temperature_c=60.1, current_a=10.0), Line(100, temperature_c=54.9, current_a=10.0)]
    capture = record(tmp_path / "capture.bms", lines, period_s=0.1, jitter_s=jitter_s)
    result = await replayed(capture, settings(**WITHOUT_IDENTIFIER))
    (raised_s, _), (ended_s, _) = result.transitions("over_temperature")
    assert raised_s == pytest.approx(10.0, abs=MAX_LEAD_S)
    # times of samples, whose lead over the arrivals is limited at both transitions
    assert ended_s == pytest.approx(hot_s + 60.0, abs=2.0 * MAX_LEAD_S)
    texts = [change.alarm.text for change in result.changes if change.alarm.name == "sensor_fault"]
    assert any("the times of the source jump again and again" in text for text in texts)
    (*_, last) = (snapshot.estimate.soc for snapshot in result.snapshots if snapshot.estimate)
    assert 0.5 - last == pytest.approx(170.0 / 3600.0, abs=2.0 * MAX_LEAD_S / 3600.0)
    at_once = await replayed(capture, settings(**WITHOUT_IDENTIFIER), at_once=True)
    assert at_once.transitions("over_temperature") == [(raised_s, True), (ended_s, False)]


HEATING = [Line(1, temperatures_c=(25.0, 25.0 + 10.0 * second)) for second in range(5)]
"""Rise of one probe to the limit of ``over_temperature``, for less than its delay."""


@pytest.mark.parametrize("failed_c", [(25.0, -40.0), (25.0, 300.0), (25.0,), (25.0, 127.0)])
async def test_a_pack_stays_hot_over_a_restart_while_the_probe_that_was_hot_is_faulty_or_missing(
    tmp_path: Path, failed_c: tuple[float, ...]
) -> None:
    fails = record(tmp_path / "one.bms", [*HEATING, Line(100, temperatures_c=failed_c)])
    before = await replayed(fails, settings())
    assert before.transitions("over_temperature") == [(14.0, True)], (
        "5 s of the delay of 10 s are with the faulty probe"
    )
    failed = record(tmp_path / "two.bms", [Line(100, temperatures_c=failed_c)])
    after = await replayed(failed, settings(), saved_state=before.saved_state, begin_s=WALL_S + 1000.0)
    assert after.transitions("over_temperature") == []
    cool = record(tmp_path / "three.bms", [Line(100, temperatures_c=(25.0, 26.0))])
    cooled = await replayed(cool, settings(), saved_state=after.saved_state, begin_s=WALL_S + 2000.0)
    assert [active for _, active in cooled.transitions("over_temperature")] == [False]


@pytest.mark.parametrize("others_c", [(), (30.0,)])
async def test_a_pack_stays_hot_while_the_hot_probe_reads_cold_sooner_than_it_can_cool(
    tmp_path: Path, others_c: tuple[float, ...]
) -> None:
    heating = [Line(1, temperatures_c=(*others_c, 30.0 + 10.0 * second)) for second in range(4)]
    lines = [*heating, Line(20, temperatures_c=(*others_c, 60.0)), Line(120, temperatures_c=(*others_c, 0.0))]
    result = await replayed(record(tmp_path / "capture.bms", lines), settings())
    assert result.transitions("over_temperature") == [(13.0, True)]
    texts = [change.alarm.text for change in result.changes if change.alarm.name == "sensor_fault"]
    assert any(f"probe {len(others_c) + 1} reads 0 °C" in text for text in texts)


@pytest.mark.parametrize("is_faulty", [False, True])
def test_over_temperature_with_a_faulty_probe_ends_only_if_it_was_acknowledged_after_the_fault(is_faulty: bool) -> None:
    alarms = make_evaluator()
    faulty = int(SampleStatus.PROBE_FAULT)
    add_samples(alarms, *range(20), temperature_c=70.0)
    add_samples(alarms, *range(20, 25), temperature_c=57.0 if is_faulty else 70.0, status=faulty if is_faulty else 0)
    alarms.acknowledge("over_temperature")
    add_samples(alarms, *range(25, 100), temperature_c=25.0, status=faulty)
    assert ("over_temperature" in alarms.active) == (not is_faulty)


@pytest.mark.parametrize("second_c", [57.0, 64.0], ids=["second probe hot after", "second probe hot before"])
def test_an_acknowledgement_with_a_faulty_probe_does_not_cover_the_loss_of_a_second_hot_one(second_c: float) -> None:
    alarms, faulty = make_evaluator(), int(SampleStatus.PROBE_FAULT)
    add_samples(alarms, *range(20), temperature_c=70.0)
    add_samples(alarms, *range(20, 30), temperature_c=second_c, status=faulty)
    alarms.acknowledge("over_temperature")
    if second_c < 60.0:
        add_samples(alarms, *range(30, 35), temperature_c=64.0, status=faulty)
    add_samples(alarms, *range(35, 200), temperature_c=35.0, status=faulty)
    assert "over_temperature" in alarms.active
    alarms.acknowledge("over_temperature")
    add_samples(alarms, *range(200, 300), temperature_c=35.0, status=faulty)
    assert "over_temperature" not in alarms.active


def test_an_acknowledgement_with_a_broken_wire_does_not_cover_the_broken_wire_of_a_second_full_cell() -> None:
    alarms = make_evaluator({"cell_over_voltage": {"latch": False}})
    add_samples(alarms, *range(20), cells_v=(4.3, 4.2))
    add_samples(alarms, *range(20, 30), cells_v=(0.3, 4.2))
    alarms.acknowledge("cell_over_voltage")
    add_samples(alarms, *range(30, 35), cells_v=(0.3, 4.3))
    add_samples(alarms, *range(35, 100), cells_v=(0.3, 0.3))
    assert "cell_over_voltage" in alarms.active


async def test_an_alarm_of_a_cell_does_not_end_when_the_wire_of_the_cell_breaks(tmp_path: Path) -> None:
    alarms = {"cell_under_voltage": {"clear_delay_s": 2.0}}
    low, good = (2.5, 3.7), (3.7, 3.7)
    lines = [Line(10, cells_v=good), Line(10, cells_v=low), Line(8, cells_v=low[1:]), Line(5, cells_v=good)]
    result = await replayed(record(tmp_path / "capture.bms", lines), settings(alarms))
    assert result.transitions("cell_under_voltage") == [(15.0, True), (30.0, False)]


async def test_a_missing_probe_stays_missing_over_a_restart_until_a_person_acknowledges(tmp_path: Path) -> None:
    lines = [Line(10, temperatures_c=(25.0, 40.0)), Line(20, temperatures_c=(25.0,))]
    before = await replayed(record(tmp_path / "one.bms", lines), settings())
    assert before.transitions("sensor_fault") == [(20.0, True)]
    alarms = make_evaluator()
    alarms.restore(before.saved_state)
    assert "probes" in json.loads(alarms.saved_state)
    alarms.acknowledge("sensor_fault")
    assert "probes" not in json.loads(alarms.saved_state)


def test_a_crash_within_the_delay_of_a_critical_alarm_raises_it() -> None:
    before, after = (make_evaluator() for _ in range(2))
    add_samples(before, 0.0, 1.0, temperature_c=70.0)
    after.restore(before.saved_state, crashed_s=WALL_S)
    assert after.active == ("over_temperature",)


def test_an_alarm_that_is_disabled_within_its_delay_is_missing_after_a_restart() -> None:
    before, after = make_evaluator(), make_evaluator({"over_temperature": {"enabled": False}})
    add_samples(before, 0.0, 1.0, temperature_c=70.0)
    assert "over_temperature" in after.restore(before.saved_state)


def test_restarts_within_the_delay_of_a_critical_alarm_do_not_prevent_it() -> None:
    before, after = (make_evaluator({"cell_over_voltage": {"severity": "warning"}}) for _ in range(2))
    add_samples(before, 0.0, 1.0, temperature_c=70.0)
    assert not before.active
    after.restore(before.saved_state)
    add_samples(after, 0.0, temperature_c=NAN)
    assert not after.active, "no value has confirmed the pending alarm"
    add_samples(after, 1.0, temperature_c=70.0)
    assert after.active == ("over_temperature",)
    after = make_evaluator()
    after.restore(before.saved_state)
    add_samples(after, 0.0, temperature_c=25.0)
    add_samples(after, 1.0, 2.0, temperature_c=70.0)
    assert not after.active, "a value below the limit restarts the delay"


SAVED_BEFORE = (
    '{"pack_over_voltage": {"since_s": 1699999983.0, "value": 8.6, "gone": true, "acknowledged": false, '
    '"severity": "critical"}, "over_temperature": {"since_s": 1699999991.0, "value": 70.0, "gone": false, '
    '"acknowledged": true, "severity": "critical"}, "link_lost": {"since_s": 1700000000.0, "value": 30.0, "gone": false, '
    '"acknowledged": false, "severity": "warning"}, "inputs": {"voltage": [1, false], "current": [1, false], '
    '"temperature": [1, false]}, "silence": "no cable", "pending": ["discharge_over_current"], "probes": 2}'
)
"""State that the version before saved: an alarm that is latched, one that is acknowledged, one whose delay runs, and a silence."""


def test_a_state_of_the_version_before_keeps_alarms_delays_acknowledgements_and_losses() -> None:
    alarms = make_evaluator({"over_temperature": {"latch": True}})
    assert alarms.restore(SAVED_BEFORE) == ""
    assert json.loads(alarms.saved_state) == json.loads(SAVED_BEFORE)
    assert alarms.active == ("pack_over_voltage", "over_temperature", "link_lost")
    reported = {alarm.name: alarm for alarm in alarms.report()}
    assert (reported["pack_over_voltage"].latched, reported["pack_over_voltage"].value) == (True, 8.6)
    assert reported["pack_over_voltage"].since == iso_utc(1699999983.0)
    assert reported["discharge_over_current"].unwatched_reason == "no cable"
    add_samples(alarms, 1.0, temperature_c=25.0, current_a=55.0, probes_c=(25.0,))
    assert "discharge_over_current" in alarms.active, "its delay counts as elapsed"
    add_samples(alarms, *range(2, 30), temperature_c=25.0, probes_c=(25.0,))
    assert "sensor_fault" in alarms.active, "the second probe is missing"
    add_samples(alarms, *range(30, 200), temperature_c=25.0, probes_c=(25.0, 25.0))
    assert "over_temperature" not in alarms.active, "it was acknowledged"
    assert "pack_over_voltage" in alarms.active, "it is latched"
    assert "pack_over_voltage" in alarms.acknowledge(None)
    assert "pack_over_voltage" not in alarms.active


def test_damaged_saved_quantities_are_rejected() -> None:
    with pytest.raises(ValueError, match="temperature: measured = -1"):
        make_evaluator().restore(json.dumps({"inputs": {"temperature": [-1, True]}}))


@pytest.mark.parametrize("spacing_s", [0.0, 0.1, 1.0])
def test_the_time_between_bursts_of_samples_counts_toward_a_delay(spacing_s: float) -> None:
    """A burst is two samples, and there are two bursts a minute.

    The voltage is above the limit from the fifth burst on.
    """
    alarms = make_evaluator({"pack_over_voltage": {"delay_s": 10.0}})
    for burst in range(12):
        block = np.zeros(2, dtype=SAMPLE)
        block["time_s"], block["voltage_v"] = 30.0 * burst + np.array([0.0, spacing_s]), 8.6 if burst >= 4 else 7.4
        alarms.evaluate(block, NO_TRACE, NO_CELLS, WALL_S)
    transitions = [change.at_s for change in alarms.changes() if change.alarm.name == "pack_over_voltage"]
    assert transitions == [150.0], "the first burst after which it has been over the limit for 10 s"


def test_isolated_gaps_do_not_count_toward_a_delay() -> None:
    alarms = make_evaluator({"pack_over_voltage": {"delay_s": 25.0}})
    # a gap from 4 to 25 s, with the voltage above the limit before and below after it, and a gap from 199 to 220 s within
    # the time above the limit
    times_s = [*range(5), *range(25, 200), *range(220, 300)]
    block = np.zeros(len(times_s), dtype=SAMPLE)
    block["time_s"] = times_s
    block["voltage_v"] = np.where((block["time_s"] < 180.0) & (block["time_s"] > 10.0), 7.4, 8.6)
    alarms.evaluate(block, NO_TRACE, NO_CELLS, WALL_S)
    transitions = [change.at_s for change in alarms.changes() if change.alarm.name == "pack_over_voltage"]
    assert transitions == [226.0]  # 19 s before the gap of 20 s, and 6 s after it


async def test_an_intermittent_temperature_does_not_prolong_the_delay_of_its_alarm(tmp_path: Path) -> None:
    """A loose wire gives one value in five seconds, which does not yet count as a lost sensor."""
    hot = [Line(1, temperature_c=61.0), Line(4, temperature_c=None)] * 4
    result = await replayed(record(tmp_path / "capture.bms", [Line(30), *hot]), settings())
    assert result.transitions("over_temperature") == [(40.0, True)]
    assert result.transitions("sensor_fault") == []
