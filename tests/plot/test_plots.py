"""Public plots: what they draw, and on which axes."""

import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from bms_estimator import plot
from bms_estimator.model.cell import load_cell
from bms_estimator.plot.style import new_axes

TIME_S = np.arange(0.0, 10_800.0)
CELL = load_cell("nmc", 3.0)


@pytest.fixture
def ax():
    return Figure().subplots()


def test_voltage_is_drawn_over_hours_with_the_model(ax):
    assert plot.voltage(TIME_S, np.full(TIME_S.size, 3.7), np.full(TIME_S.size, 3.6), ax=ax) is ax
    measured, model = ax.get_lines()
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time [h]", "voltage [V]")
    assert measured.get_xdata()[-1] == pytest.approx(10_799.0 / 3600.0)
    assert set(measured.get_ydata()) == {3.7}
    assert set(model.get_ydata()) == {3.6}


@pytest.mark.parametrize(
    ("duration_s", "label"), [(100.0, "s"), (600.0, "min"), (10_000.0, "h"), (1e6, "days"), (0.0, "s")]
)
def test_the_unit_of_time_follows_from_the_duration(ax, duration_s, label):
    plot.current(np.array([5.0, 5.0 + duration_s]), np.zeros(2), ax=ax)
    assert ax.get_xlabel() == f"time [{label}]"


def test_a_large_error_does_not_hide_small_ones(ax):
    error_v = np.full(TIME_S.size, 1e-3)
    plot.voltage_error(TIME_S, error_v, ax=ax)
    assert ax.get_yscale() == "linear"
    error_v[5_000] = 0.6
    plot.voltage_error(TIME_S, error_v, ax=ax)
    assert ax.get_yscale() == "symlog"
    assert ax.get_lines()[-2].get_ydata().max() == pytest.approx(600.0)


def test_the_band_of_the_soc_stays_within_0_to_100_percent(ax):
    plot.soc(TIME_S, np.full(TIME_S.size, 0.97), np.full(TIME_S.size, 0.05), ax=ax)
    edges = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert (edges.min(), edges.max()) == (pytest.approx(87.0), 100.0)


def test_a_temperature_that_was_not_measured_is_not_drawn(ax):
    plot.temperature(TIME_S, np.full(TIME_S.size, np.nan), ax=ax)
    assert np.isnan(ax.get_lines()[0].get_ydata()).all()


@pytest.mark.parametrize(
    ("draw", "value", "noise", "span"),
    [
        (plot.voltage, 3.3, 1e-4, 0.01),
        (plot.voltage_error, 0.0, 1e-5, 1.0),
        (plot.current, 0.0, 1e-4, 0.01),
        (plot.temperature, 24.99, 0.01, 1.0),
        (plot.soc, 0.9, 1e-5, 1.0),
    ],
)
def test_a_constant_value_is_a_line_on_an_axis_of_a_minimum_span_without_offset(draw, value, noise, span):
    ax = new_axes()
    draw(TIME_S, value + noise * (TIME_S % 2), ax=ax)
    ax.figure.draw_without_rendering()
    plt.close(ax.figure)
    low, high = ax.get_ylim()
    assert high - low >= span * (1.0 - 1e-9)
    assert ax.yaxis.get_offset_text().get_text() == ""


def test_estimates_of_an_element_are_averaged_over_soc(ax):
    columns = {
        "soc": np.array([0.5, 0.505, 0.9]),
        "r_s_ohm": np.array([0.010, 0.020, 0.030]),
        "r_s_std_ohm": np.array([0.001, 0.001, np.nan]),
    }
    plot.element(CELL, "r_s", columns, ax=ax)
    cell_file, estimated = ax.get_lines()
    assert cell_file.get_label() == "cell file"
    assert (estimated.get_xdata().tolist(), estimated.get_ydata().tolist()) == ([51.0], [15.0])


def test_a_stability_limit_above_0_is_marked(ax):
    cell = load_cell("chen_mora")
    plot.element(cell, "c_ts", ax=ax)
    limits = [line for line in ax.get_lines() if line.get_label() == "stability limit"]
    assert [line.get_xdata()[0] for line in limits] == [
        pytest.approx(-100.0 * np.log(cell.a[9] / cell.a[7]) / cell.a[8])
    ]
    plot.element(CELL, "c_ts", ax=(other := Figure().subplots()))
    assert "stability limit" not in [line.get_label() for line in other.get_lines()]


def test_an_rc_product_is_resistance_times_capacitance(ax):
    plot.rc_product(CELL, "tl", ax=ax)
    a = CELL.a
    at_full = (a[4] * np.exp(-a[5]) + a[6]) * (a[12] - a[10] * np.exp(-a[11]))
    assert ax.get_lines()[0].get_ydata()[-1] == pytest.approx(at_full)


def test_the_ocv_has_the_band_of_the_cell_file_and_the_measured_points(ax):
    plot.ocv(CELL, np.array([0.2, 0.8]), np.array([3.4, 4.0]), ax=ax)
    assert [label.get_text() for label in ax.get_legend().get_texts()] == ["±2 std", "OCV of nmc", "rests"]
    plot.ocv_residuals(CELL, np.array([0.2, 0.8]), np.array([0.01, -0.02]), ax=(other := Figure().subplots()))
    assert other.get_lines()[-1].get_ydata().tolist() == [10.0, -20.0]


def test_without_axes_a_figure_is_created():
    plt.switch_backend("agg")
    try:
        assert plot.current(TIME_S, np.ones(TIME_S.size)).figure.number in plt.get_fignums()
    finally:
        plt.close("all")
