"""Report on a pack's history: durations, figures without values, and data quality."""

import re

import numpy as np
import pytest

from bms_estimator.reports.aging_group import AgingHistory
from bms_estimator.reports.history_report import StoredHistory, history_report
from bms_estimator.reports.report_parts import duration_text
from bms_estimator.store.history import Minute

text_only = pytest.mark.usefixtures("empty_plots")


def history_of(time_s, **columns):
    """Return a history of minutes without events, whose columns are 60 unless given."""
    time_s = np.array(time_s)
    values = {name: np.full(time_s.size, columns.get(name, 60.0)) for name in Minute._fields} | {"time_s": time_s}
    return StoredHistory(
        "shed", time_s, values, events=(), learned=(), not_learned="", aging=AgingHistory(None, "No fit.")
    )


def groups_of(history):
    return {group.title: group for group in history_report(history, "2026-01-01").sections[0].groups}


@text_only
def test_minutes_that_passed_twice_are_counted():
    rows = dict(groups_of(history_of([0.0, 60.0, 61.0, 120.0]))["Data quality"].rows)
    assert rows["clock"] == "set back; minutes that passed twice: 1"
    assert rows["gaps"] == "none"


@pytest.mark.parametrize(
    ("duration_s", "text"),
    [
        (60.0, "1 minute"),
        (25 * 60.0, "25 minutes"),
        (7200.0, "2.0 hours"),
        (86_400.0, "24.0 hours"),
        (172_800.0, "2.0 days"),
    ],
)
def test_duration_has_the_unit_that_fits(duration_s, text):
    assert duration_text(duration_s) == text


def test_one_minute_has_a_sentence_instead_of_figures():
    page = history_report(history_of([0.0], soc=0.5, soc_std=0.01, charge_out_ah=0.0123), "2026-01-01")
    over_time = page.sections[0].groups[0]
    assert over_time.figures == ()
    assert over_time.remark.startswith("No figures: they need two minutes of history.")
    assert "In 1 minute it ran between SOC 50 % and 50 %." in page.sentences
    assert "0.0123 Ah were drawn and 60 Ah charged." in page.sentences


@text_only
def test_figure_without_values_is_replaced_by_a_sentence():
    history = history_of(60.0 * np.arange(100), soc=np.nan, soc_std=np.nan, temperature_c=np.nan)
    over_time = groups_of(history)["Over time"]
    assert [figure.title for figure in over_time.figures] == ["Voltage", "Current"]
    assert "SOC with ±2 std: no figure, because the estimator has published no SOC" in over_time.remark
    assert "Temperature: no figure, because it was not measured" in over_time.remark


@text_only
def test_small_charges_and_currents_have_more_decimals():
    small = history_of(
        [0.0, 60.0], charge_out_ah=0.01, charge_in_ah=0.0, energy_out_wh=0.04, current_min_a=0.1, current_max_a=0.25
    )
    assert groups_of(small)["Days"].rows[0][3:6] == ("0.100 … 0.250", "60 … 60", "0.020")
    large = history_of([0.0, 60.0], energy_out_wh=2000.0)
    assert groups_of(large)["Days"].columns[7] == "kWh out"
    assert groups_of(large)["Days"].rows[0][7] == "4.0"


@text_only
def test_table_of_days_has_the_last_two_months():
    rows = groups_of(history_of(86_400.0 * np.arange(70)))["Days"].rows
    assert (len(rows), rows[0][0], rows[-1][0]) == (62, "1970-01-09", "1970-03-11")


@text_only
def test_missing_fit_is_a_sentence():
    group = groups_of(history_of([0.0, 60.0]))["Capacity and resistances over days"]
    assert (group.figures, group.rows, group.remark) == ((), (), "No fit.")


@pytest.mark.parametrize("minutes", [2, 3, 180, 264, 1440, 5000, 576_000, 2_000_000])
@pytest.mark.filterwarnings("error")
def test_time_axis_of_a_history_that_is_nearly_all_gap_has_two_to_seven_labels(minutes):
    svg = groups_of(history_of(60.0 * np.array([0, 1, minutes - 1])))["Over time"].figures[0].svg
    labels = re.findall(r"<!-- (.+?) -->", svg)
    assert 2 <= labels.index("time (UTC)") <= 7


def test_nearly_constant_temperature_has_an_axis_of_1_degree():
    history = history_of([0.0, 60.0], temperature_c=24.99, temperature_min_c=24.99, temperature_max_c=25.0)
    assert {"<!-- 24.6 -->", "<!-- 25.4 -->"} <= set(
        re.findall(r"<!-- 2\d\.\d -->", groups_of(history)["Over time"].figures[-1].svg)
    )


def test_time_axis_has_dates_and_times():
    svg = groups_of(history_of(60.0 * np.arange(8)))["Over time"].figures[0].svg
    assert re.findall(r"<!-- (\d\d:\d\d) -->", svg) == ["00:00", "00:02", "00:04", "00:06"]
    assert "<!-- time (UTC) -->" in svg
