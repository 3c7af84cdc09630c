"""Histories in long form become samples at the changes of voltage and current, with held values marked."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.model.arrays import SampleStatus
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.replay import load_capture
from bms_estimator.sources.captures.tables.layout_finder import parse_column_map
from tests.sources.captures.history_exports import (
    CHARGE_AH,
    CURRENT,
    EXPORTS,
    MODE,
    PERIOD_S,
    SKEW_S,
    START_S,
    UNAVAILABLE_S,
    VOLTAGE,
    Change,
    changes,
    histories,
    home_assistant_csv,
    influx_2_fields,
    json_minimal,
    json_period,
)


def load(folder: Path, text: str, column_map: str = "") -> Columns:
    """Return the samples of a file with a text."""
    path = folder / "history.txt"
    path.write_text(text, encoding="utf-8")
    return load_capture(path, column_map=parse_column_map(column_map) if column_map else None)


def charge_ah(samples: Columns) -> float:
    """Return the charge of all samples, positive on discharge [Ah]."""
    return float(np.trapezoid(samples["current_a"], samples["time_s"])) / 3600.0


@pytest.mark.parametrize("export", EXPORTS, ids=lambda export: export.__name__)
def test_history_gives_the_charge_of_its_load(tmp_path: Path, export: Callable[[list[Change]], str]) -> None:
    samples = load(tmp_path, export(changes()))
    assert samples["time_s"][0] == 0.0
    assert charge_ah(samples) == pytest.approx(CHARGE_AH, abs=0.05)
    assert "positive on charge (response of the voltage)" in samples.note
    assert np.unique(samples["current_a"]).tolist() == [18.0, 24.0]
    assert 52.5 < samples["voltage_v"].min() <= samples["voltage_v"].max() < 52.8


def test_all_exports_of_home_assistant_give_the_same_samples(tmp_path: Path) -> None:
    reference = load(tmp_path, home_assistant_csv(changes()))
    for export in EXPORTS[1:7]:
        samples = load(tmp_path, export(changes()))
        for name in reference:
            np.testing.assert_allclose(samples[name], reference[name], atol=1e-6, err_msg=export.__name__)


def test_held_values_are_marked(tmp_path: Path) -> None:
    """A voltage within a period before a new current may belong to it; every other voltage has the current that holds."""
    rows = changes(unavailable_s=(0.0, 0.0))
    samples = load(tmp_path, home_assistant_csv(rows))
    time_s, status = samples["time_s"] + SKEW_S, samples["status"]  # the first sample is the first current
    voltages_s = np.array([row.time_s - START_S for row in histories(rows)[VOLTAGE]])
    is_new_voltage = np.isclose(time_s[:, None], voltages_s, rtol=0.0, atol=1e-3).any(axis=1)
    until_change_s = 600.0 - (time_s - SKEW_S) % 600.0
    before_change = is_new_voltage & (until_change_s <= PERIOD_S)
    assert np.count_nonzero(before_change) >= 5
    assert (status[before_change] == SampleStatus.CURRENT_HELD).all()
    assert (status[is_new_voltage & ~before_change] == 0).all()
    assert (status[~is_new_voltage] == SampleStatus.VOLTAGE_HELD).all()
    assert samples["current_a"][np.searchsorted(time_s, 600.0 + SKEW_S - 1e-3)] == 24.0


def test_unavailable_value_has_no_samples(tmp_path: Path) -> None:
    samples = load(tmp_path, home_assistant_csv(changes()))
    time_s = samples["time_s"] + SKEW_S
    begin_s, end_s = (second + SKEW_S for second in UNAVAILABLE_S)
    assert not ((time_s >= begin_s) & (time_s < end_s - 1e-3)).any()
    assert np.diff(time_s).max() < end_s - begin_s + PERIOD_S


def test_value_holds_for_an_hour_without_a_change_and_no_longer(tmp_path: Path) -> None:
    """A current of 10 A that does not change for 50 min holds, and the recording stops for the two hours after."""
    rows = [
        Change(entity, state, START_S + second)
        for second, voltage, current in ((0.0, "26.5", "-10"), (3000.0, "26.4", "-9"), (10_200.0, "26.3", "-8"))
        for entity, state in ((VOLTAGE, voltage), (CURRENT, current))
    ]
    samples = load(tmp_path, home_assistant_csv(rows), f"voltage={VOLTAGE},current={CURRENT}")
    steps_s = np.diff(samples["time_s"])
    assert samples["time_s"][-1] == pytest.approx(10_200.0)
    assert steps_s[-1] == pytest.approx(7200.0)
    assert steps_s[:-1].max() < 120.0
    assert float(np.trapezoid(np.abs(samples["current_a"][:-1]), samples["time_s"][:-1])) == pytest.approx(
        30_000.0, rel=0.01
    )


def test_map_names_entities_with_their_units(tmp_path: Path) -> None:
    rows = [row._replace(state=str(1e3 * float(row.state))) if row.entity == VOLTAGE else row for row in changes()]
    rows += [Change("sensor.bank_temperature", "77", START_S), Change("sensor.pv_voltage", "101.5", START_S)]
    given = f"voltage={VOLTAGE} [mV],current={CURRENT},temperature=sensor.bank_temperature [°F]"
    samples = load(tmp_path, home_assistant_csv(rows), given)
    assert samples["voltage_v"].max() < 53.0
    assert samples["temperature_c"] == pytest.approx(np.full(samples["time_s"].size, 25.0))
    fields = load(tmp_path, influx_2_fields(changes()), "voltage=bus_voltage,time=_time")
    assert charge_ah(fields) == pytest.approx(CHARGE_AH, abs=0.05)


def test_unit_of_an_entity_is_used(tmp_path: Path) -> None:
    rows = [row._replace(state=str(1e3 * float(row.state))) if row.entity == VOLTAGE else row for row in changes()]
    samples = load(tmp_path, json_period(rows).replace('"V"', '"mV"'))
    assert 52.5 < samples["voltage_v"].min() <= samples["voltage_v"].max() < 52.8


def test_cut_last_row_is_named(tmp_path: Path) -> None:
    samples = load(tmp_path, home_assistant_csv(changes()) + "sensor.bank_cur")
    assert "1 values, but the header has 3 columns" in samples.warning
    assert charge_ah(samples) == pytest.approx(CHARGE_AH, abs=0.05)


HOUR = changes()
VOLTAGES = [row for row in HOUR if row.entity == VOLTAGE]
SECOND = [row._replace(entity="sensor.pv_voltage") for row in VOLTAGES]
LATER = [row._replace(time_s=row.time_s + 1e6) for row in HOUR if row.entity == CURRENT]


@pytest.mark.parametrize(
    ("text", "column_map", "message"),
    [
        (home_assistant_csv(VOLTAGES), "", f"no entities look like a current; entities with numbers: {VOLTAGE}; .*current=NAME_OF_CURRENT"),
        (home_assistant_csv(HOUR + SECOND), "", f'2 entities look like a voltage; .*--map "voltage={VOLTAGE},current={CURRENT}"'),
        (home_assistant_csv(HOUR), f"voltage={MODE}", f"no entities have the name {MODE}; entities with numbers: {VOLTAGE}, {CURRENT};"),
        (home_assistant_csv(HOUR), f"voltage={VOLTAGE} [mA]", "'mA' is not a unit of voltage"),
        (home_assistant_csv(HOUR), "time=last_seen", "no column last_seen for the time; found entity_id, state, last_changed"),
        (home_assistant_csv([*HOUR, Change(CURRENT, "overload", START_S)]), "", f"line {len(HOUR) + 2}: 'overload' of sensor.bank_current: must be a number"),
        (home_assistant_csv(VOLTAGES + SECOND), f"voltage={VOLTAGE},current={MODE}", "no entities have the name"),
        (home_assistant_csv(VOLTAGES + LATER), "", "have no values at the same time"),
        ("entity_id,state,last_changed\nsensor.bank_current,4,04/03/2026 12:00\n", "", "line 2: time = '04/03/2026 12:00': must be a date"),
        ("entity_id,state,last_changed\nsensor.bank_current,4,inf\n", "", "line 2: time = 'inf'"),
        ("entity_id,state,last_changed\nsensor.bank_current,4\nsensor.bank_current,4,2026-03-04T12:00:00Z\n", "", "line 2: 2 values"),
        ("entity_id,state,last_changed\n", "", "entities with numbers: none"),
        (json_minimal(HOUR)[:-40], "", "JSON damaged or cut short"),
        ("[" * 100_000, "", "JSON damaged or cut short"),
        ('[[{"state": "5"}]]', "", "history 1, record 1: has no entity_id"),
        ('[[{"entity_id": "sensor.a", "state": "5", "last_changed": [1]}]]', "", "record 1: time = '\\[1\\]'"),
        ('{"message": "401: Unauthorized"}', "", "history message, record 1: has no entity_id"),
        ('[{"entity_id": "\\ud800", "state": null, "last_changed": "2026-03-04"}]', "", "entities with numbers: none"),
    ],
)  # fmt: skip
def test_error_says_what_to_do(tmp_path: Path, text: str, column_map: str, message: str) -> None:
    with pytest.raises(UserError, match=message) as error:
        load(tmp_path, text, column_map)
    str(error.value).encode()
