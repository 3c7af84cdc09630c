"""Values that cannot be true: they raise ``sensor_fault`` with a hint, and neither raise nor clear other alarms."""

from pathlib import Path

import numpy as np
import pytest

from bms_estimator.model.arrays import NO_CELLS, SAMPLE
from bms_estimator.model.cell import load_cell
from bms_estimator.protocols.base.reading import sample_json_line
from bms_estimator.sources.captures.raw_capture import CaptureWriter, make_header
from bms_estimator.telemetry.impossible import PackBounds
from tests.telemetry.alarm_captures import Line, record, replayed, settings

LFP = load_cell("lfp", 100.0).pack(16, 1)
"""Pack of 16 cells in series and 100 Ah."""
GOOD = Line(30, voltage_v=53.5, current_a=10.0, cells_v=(3.344,) * 16)
IMPOSSIBLE = {
    "no voltage": (
        GOOD._replace(voltage_v=0.0),
        "voltage",
        "and the sum of the cells is 53.504 V (is the output switched off",
    ),
    "half of the voltage": (GOOD._replace(voltage_v=26.7), "voltage", "the sum of the cells is 53.504 V"),
    "decivolts": (GOOD._replace(voltage_v=535.0), "voltage", "a factor of 10?"),
    "millivolts": (GOOD._replace(voltage_v=53500.0), "voltage", "a factor of 1000?"),
    "negative voltage": (GOOD._replace(voltage_v=-53.5), "voltage", "are the wires reversed?"),
    "cells of a tenth": (GOOD._replace(cells_v=(0.3344,) * 16), "cells", "a factor of 10?"),
    "no cells": (GOOD._replace(cells_v=(0.0,) * 16), "cells", "are the wires of the cells connected?"),
    "milliamperes": (GOOD._replace(current_a=20_000.0), "current", "a factor of 10 or 100 or 1000?"),
    "swapped words": (GOOD._replace(current_a=-2.7e23), "current", "are the words of a 32-bit number swapped?"),
    "unsigned": (GOOD._replace(current_a=65_531.0), "current", "a signed number of 16 bits read as an unsigned one?"),
}
"""Reading, impossible quantity, and part of the text of ``sensor_fault``."""
CRITICAL = {
    "voltage": {"pack_over_voltage", "pack_under_voltage"},
    "cells": {"cell_over_voltage", "cell_under_voltage"},
    "current": {"discharge_over_current", "charge_over_current", "charging_below_freezing"},
}
"""Critical alarms by the quantity that they need."""


@pytest.mark.parametrize(("line", "quantity", "hint"), IMPOSSIBLE.values(), ids=IMPOSSIBLE)
async def test_an_impossible_value_raises_only_sensor_fault_with_a_hint(
    tmp_path: Path, line: Line, quantity: str, hint: str
) -> None:
    path = record(tmp_path / "capture.bms", [GOOD, line, GOOD._replace(seconds=60)])
    result = await replayed(path, settings(), LFP)
    raised = {
        change.alarm.name: change for change in result.changes if change.alarm.active and change.field == "active"
    }
    assert set(raised) == {"sensor_fault"}
    assert 40.0 <= raised["sensor_fault"].at_s <= 41.0
    texts = [a.text for s in result.snapshots for a in s.alarms if a.name == "sensor_fault" and a.active]
    assert any(hint in text for text in texts)
    # hooks count alarms that cannot be watched as raised
    unwatched = {c.alarm.name: c.alarm.unwatched_reason or "" for c in result.changes if not c.alarm.watched}
    assert CRITICAL[quantity] <= set(unwatched)
    assert all(hint in reason for reason in unwatched.values())
    assert result.changes[-1].alarm.name == "sensor_fault"
    assert not result.changes[-1].alarm.active


@pytest.mark.parametrize(("good_s", "raises"), [(1, True), (4, True), (60, False)])
async def test_an_intermittent_impossible_value_raises_sensor_fault_and_a_single_one_does_not(
    tmp_path: Path, good_s: int, raises: bool
) -> None:
    good = GOOD._replace(seconds=good_s)
    path = record(tmp_path / "capture.bms", [GOOD, *[good._replace(voltage_v=1e9, seconds=1), good] * 12])
    transitions = (await replayed(path, settings(), LFP)).transitions("sensor_fault")
    assert [is_raised for _, is_raised in transitions] == [True] * raises


async def test_milliamperes_beside_millivolts_raise_only_sensor_fault(tmp_path: Path) -> None:
    """As amperes, such a current would be possible."""
    line = GOOD._replace(voltage_v=53_500.0, current_a=9_000.0)
    result = await replayed(record(tmp_path / "capture.bms", [GOOD, line]), settings(), LFP)
    assert {c.alarm.name for c in result.changes if c.alarm.active and c.field == "active"} == {"sensor_fault"}
    (text,) = {a.text for a in result.snapshots[-1].alarms if a.name == "sensor_fault"}
    assert "9000 A with this voltage (is the unit or scale wrong by a factor of 1000?)" in text


POSSIBLE = {
    "blown fuse": (Line(30, voltage_v=0.0, cells_v=()), {"pack_under_voltage", "sensor_fault"}),
    "dead pack": (Line(30, voltage_v=0.1, cells_v=(0.0,) * 16), {"pack_under_voltage", "cell_under_voltage"}),
    "one dead cell": (GOOD._replace(cells_v=(*(3.344,) * 15, 0.0)), {"cell_under_voltage"}),
    "short circuit of 20 C": (
        GOOD._replace(voltage_v=40.0, current_a=2000.0, cells_v=(2.5,) * 16),
        {"discharge_over_current"},
    ),
    "9 C that the voltage does not follow": (GOOD._replace(current_a=900.0), {"discharge_over_current"}),
}
"""Readings that may be true, and alarms that they raise."""


@pytest.mark.parametrize(("line", "alarms"), POSSIBLE.values(), ids=POSSIBLE)
async def test_extreme_values_that_may_be_true_raise_their_alarms(tmp_path: Path, line: Line, alarms: set[str]) -> None:
    result = await replayed(record(tmp_path / "capture.bms", [GOOD, line]), settings(), LFP)
    assert alarms <= {change.alarm.name for change in result.changes if change.alarm.active}


async def test_an_impossible_value_does_not_clear_an_alarm(tmp_path: Path) -> None:
    low = GOOD._replace(voltage_v=41.0, cells_v=())
    lines = [GOOD._replace(cells_v=()), low, low._replace(seconds=60, voltage_v=535.0)]
    result = await replayed(record(tmp_path / "capture.bms", lines), settings(), LFP)
    assert result.transitions("pack_under_voltage") == [(35.0, True)]


@pytest.mark.parametrize(("rate", "words"), [(0.5, "0.5 times the rate"), (1e-3, "seconds read as milliseconds")])
async def test_a_slow_clock_of_the_source_raises_sensor_fault_and_stretches_no_delay(
    tmp_path: Path, rate: float, words: str
) -> None:
    path = tmp_path / "capture.bms"
    writer = CaptureWriter(path, make_header(settings().sensor))
    writer.write(100.0, b"\n")
    for second in range(80):
        line = sample_json_line(59.0 if second >= 60 else 53.5, 0.0, time_s=rate * second)
        writer.write(100.0 + second, line)
    writer.close()
    result = await replayed(path, settings(), LFP)
    assert result.transitions("pack_over_voltage") == [(62.0, True)]
    assert result.transitions("sensor_fault") == [(40.0, True)]  # 30 s until the rate is known
    at_once = await replayed(path, settings(), LFP, at_once=True)
    assert at_once.transitions("pack_over_voltage") == [(62.0, True)]
    assert any(words in a.text for s in result.snapshots for a in s.alarms if a.name == "sensor_fault" and a.active)


async def test_more_cells_than_in_series_raise_sensor_fault_and_leave_the_alarms_of_cells_unwatched(
    tmp_path: Path,
) -> None:
    path = record(tmp_path / "capture.bms", [GOOD._replace(cells_v=(3.344,) * 18)])
    result = await replayed(path, settings(), LFP)
    assert result.transitions("sensor_fault") == [(10.0, True)]
    assert result.watched("cell_over_voltage") == [(10.0, False)]
    fault = next(alarm for alarm in result.snapshots[-1].alarms if alarm.name == "sensor_fault")
    assert "18 cells are measured, but the pack has 16 in series: correct pack.series" in fault.text


@pytest.mark.parametrize(
    ("voltage_v", "hint"),
    [
        (535.0, "a factor of 10?"),
        (53_500.0, "a factor of 1000?"),
        (1e12, "are the words of a 32-bit number swapped?"),
        (-53.5, "are the wires reversed?"),
        (200.0, "is pack.series right?"),
    ],
)
def test_the_hint_of_an_impossible_voltage_without_cell_voltages(voltage_v: float, hint: str) -> None:
    samples = np.zeros(1, SAMPLE)
    samples["voltage_v"] = voltage_v
    assert hint in PackBounds.of(LFP).describe("voltage", samples[0], NO_CELLS)[1]
