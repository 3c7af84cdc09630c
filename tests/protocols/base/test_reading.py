"""Formats of printed lines from which voltage, current, temperature and cell voltages are read."""

import math

import pytest
from hypothesis import given, strategies as st

from bms_estimator.protocols.base.reading import Reading, read_line, sample_json_line


@pytest.mark.parametrize(
    "line",
    [
        b"13.3,2.0",
        b"13.3 2.0",
        b"13.3\t2\r",
        b"13.3;2.0",
        b"13,3;2,0",
        b"13,3; 2,0\r",
        b"V=13.3 I=2",
        b"V=13.3,I=2.0",
        b"v:13.3;i:2",
        b"V=13,3;I=2,0",
        b"V=13.3V I=2A",
        b"U = 13.3 V, I = 2000 mA, P = 26.6 W",
        b"Voltage: 13300 mV  Current: 2.0 A",
        b"12:30:01 Bus Voltage: 13.3 V Current: 2 A t=17",
        b'{"voltage":13.3,"current":2}',
        b' {"name": "pack", "pack_voltage": 13.3, "current_mA": 2e3, "ok": true, "t": 17}\r',
    ],
)
def test_voltage_and_current_are_read_from_common_formats(line: bytes) -> None:
    reading = read_line(line)
    assert reading is not None
    assert (reading.voltage_v, reading.current_a) == pytest.approx((13.3, 2.0))
    assert reading.temperatures_c == reading.cells_v == ()


@pytest.mark.parametrize(
    "line", [b"6.6,-2,25.5", b"6,6;-2;25,5", b"V=6.6 I=-2 T=25.5C", b'{"volts": 6.6, "amps": -2, "temperature": 25.5}']
)
def test_temperature_is_read_from_common_formats(line: bytes) -> None:
    assert read_line(line) == Reading(voltage_v=6.6, current_a=-2.0, temperatures_c=(25.5,))


@pytest.mark.parametrize(
    ("line", "held"),
    [
        (b'{"voltage_v": 6.6, "current_a": 2, "voltage_held": 1}', True),
        (b'{"voltage_v": 6.6, "current_a": 2, "voltage_held": true}', True),
        (b'{"voltage_v": 6.6, "current_a": 2, "voltage_held": false}', False),
        (b"V=6.6 I=2 voltage_held=1", True),
        (b"V=6.6 I=2 voltage_held=0", False),
        (b"V=6.6 I=2", False),
        (sample_json_line(6.6, 2.0, voltage_held=True), True),
        (sample_json_line(6.6, 2.0), False),
    ],
)
def test_a_line_marks_a_held_voltage(line: bytes, held: bool) -> None:
    reading = read_line(line)
    assert reading is not None
    assert (reading.voltage_v, reading.current_a, reading.voltage_held) == (6.6, 2.0, held)


@pytest.mark.parametrize(
    ("line", "held"),
    [
        (b'{"voltage_v": 6.6, "current_a": 2, "current_held": true}', True),
        (b"V=6.6 I=2 current_held=0", False),
        (sample_json_line(6.6, 2.0, current_held=True), True),
        (sample_json_line(6.6, 2.0, voltage_held=True), False),
    ],
)
def test_a_line_marks_a_held_current(line: bytes, held: bool) -> None:
    reading = read_line(line)
    assert reading is not None
    assert (reading.voltage_v, reading.current_a, reading.current_held) == (6.6, 2.0, held)


@pytest.mark.parametrize(
    "line",
    [b"V=6.6 I=2 cells=3.31,3.29", b'{"V": 6.6, "I": 2, "cells": [3.31, 3.29]}', b"cells_mV=3310,3290 V=6.6 I=2"],
)
def test_cell_voltages_are_read_from_common_formats(line: bytes) -> None:
    reading = read_line(line)
    assert reading is not None
    assert reading.cells_v == pytest.approx((3.31, 3.29))


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"INA226 found",
        b"13.3",
        b"13.3,2.0,25,7",
        b"V=13.3",
        b"V=13.3kV I=2",
        b"V=13.3 V=13.2 I=2",
        b"V=13.3,2 I=2",
        b"Bus Voltage: 13.3 V Shunt Voltage: 2 mV Current: 2 A",
        b'{"voltage": [13.3], "current": [2, 3]}',
        b'{"voltage": "13.3", "current": 2}',
        b'{"voltage": 13.3, "current": 2',
        b'{"voltage": 1' + 400 * b"0" + b', "current": 2}',
        b'{"a":' + 500 * b"[" + 500 * b"]" + b"}",
        b"3_9,2.0",
        b"13.3,2.0,2_5",
        b"nan,2.0",
        b"13.3,inf",
        b"1e999,2.0",
        "١٣.٣,2".encode(),  # 13.3 in Arabic digits, which float() accepts
        b"V=3_9 I=2",
        b"V=13.3.1 I=2",
        b"V=0x1F I=2",
        b"V=1e999 I=2",
        b'{"voltage": NaN, "current": 2}',
        b'{"voltage": 13.3, "current": -Infinity}',
        b'{"voltage": 1e999, "current": 2}',
        b'{"voltage": 13.3, "current": 2, "voltage_held": null}',
        b'{"voltage": 13.3, "current": 2, "current_held": [[]]}',
        b'{"voltage": 13.3, "current": 2, "current_held": {}}',
    ],
)
def test_line_without_valid_voltage_and_current_is_rejected(line: bytes) -> None:
    assert read_line(line) is None


@pytest.mark.parametrize("line", [b"13.3,2.0,nan", b"13.3 2.0 NaN", b"13.3;2.0;-inf", b"13.3,2.0,ovf"])
def test_temperature_is_nan_if_the_line_has_a_word_for_a_missing_value(line: bytes) -> None:
    reading = read_line(line)
    assert reading is not None
    assert math.isnan(*reading.temperatures_c)


def test_invalid_list_of_cells_is_ignored() -> None:
    assert read_line(b"V=6.6 I=2 cells=3.31,3_2") == Reading(voltage_v=6.6, current_a=2.0)


fragments = st.sampled_from(
    [
        b"V",
        b"I=",
        b"13.3",
        b"13,3",
        b";",
        b",",
        b" ",
        b":",
        b"=",
        b"mA",
        b"cells=",
        b"{",
        b'"voltage":',
        b'{"voltage": 13.3, "current": 2, "voltage_held": ',
        b"null",
        b"[",
        b"]",
        b"}",
        b"e9",
        b"_",
        b"nan",
        b"1e308",
    ]
)


@given(st.binary(max_size=300) | st.lists(fragments, max_size=40).map(b"".join))
def test_no_line_raises_or_gives_an_infinite_value(line: bytes) -> None:
    reading = read_line(line)
    if reading is not None:
        assert all(map(math.isfinite, (reading.voltage_v, reading.current_a, *reading.cells_v)))
