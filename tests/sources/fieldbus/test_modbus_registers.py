"""Modbus registers: planning of the requests, and decoding of the registers to readings."""

import itertools
import math
import struct

import pytest
from hypothesis import given, strategies as st
from pydantic import ValidationError

from bms_estimator.settings.sources.fieldbus import MAX_WORDS, MODBUS_PROFILES, CellRegisters, ModbusSource, Register
from bms_estimator.sources.fieldbus.modbus import (
    MAX_GAP_WORDS,
    RegisterQuantity,
    decode,
    decode_reading,
    list_values,
    plan_requests,
    split_request,
)

STRUCT_FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f"}
RANGES = {
    "int16": st.integers(-(1 << 15), (1 << 15) - 1),
    "uint16": st.integers(0, (1 << 16) - 1),
    "int32": st.integers(-(1 << 31), (1 << 31) - 1),
    "uint32": st.integers(0, (1 << 32) - 1),
    "float32": st.floats(-1e6, 1e6, width=32),
}


def source(**options: object) -> ModbusSource:
    return ModbusSource.model_validate({"kind": "modbus", "host": "127.0.0.1"} | options)


def words(
    raw: float, register_type: str, *, low_word_first: bool = False, address: int = 0
) -> dict[tuple[str, int], int]:
    """Return the words of a value in holding registers, by table and address."""
    data = struct.pack(STRUCT_FORMATS[register_type], raw)
    high_first = [int.from_bytes(data[i : i + 2], "big") for i in range(0, len(data), 2)]
    ordered = high_first[::-1] if low_word_first else high_first
    return {("holding", address + i): word for i, word in enumerate(ordered)}


@given(st.data(), st.sampled_from(list(STRUCT_FORMATS)), st.booleans())
def test_value_of_each_type_and_word_order_is_decoded(
    data: st.DataObject, register_type: str, low_word_first: bool
) -> None:
    raw = data.draw(RANGES[register_type])
    register = Register(address=7, type=register_type, low_word_first=low_word_first, scale=0.01, offset=-2.0)
    words_read = words(raw, register_type, low_word_first=low_word_first, address=7)
    assert decode(register, words_read) == round(raw * 0.01 - 2.0, 5)


# few distant registers, or a dense range, in which a request reaches the maximum length
@given(
    st.lists(st.tuples(st.integers(0, 2000), st.sampled_from(list(STRUCT_FORMATS)), st.booleans()), max_size=60)
    | st.lists(st.tuples(st.integers(0, 200), st.sampled_from(list(STRUCT_FORMATS)), st.booleans()), min_size=60)
)
def test_requests_cover_every_register_once_within_the_maximum_length(registers: list[tuple[int, str, bool]]) -> None:
    values = [
        RegisterQuantity(
            "cells", Register(address=address, type=register_type, table="input" if is_input else "holding")
        )
        for address, register_type, is_input in registers
    ]
    requests = plan_requests(values)
    assert sorted((v for request in requests for v in request.values), key=repr) == sorted(values, key=repr)
    for request in requests:
        assert 1 <= request.words <= MAX_WORDS
        for value in request.values:
            assert value.register.table == request.table
            assert request.address <= value.register.address
            assert value.register.address + value.register.words <= request.address + request.words
    for request, following in itertools.pairwise(requests):
        is_near = (
            following.table == request.table and following.address <= request.address + request.words + MAX_GAP_WORDS
        )
        # Near requests remain separate only if the next value, which has at most two words, would exceed the maximum length.
        assert not is_near or following.address + 2 - request.address > MAX_WORDS


def test_device_with_a_profile_is_read_in_as_few_requests_as_possible() -> None:
    (request,) = plan_requests(list_values(source(profile="victron-gx")))
    assert (request.table, request.address, request.words) == ("holding", 259, 8)
    assert (
        request.description
        == "source.voltage, source.current, source.temperature, source.soc (holding registers 259 to 266)"
    )
    seplos = plan_requests(list_values(source(profile="seplos-v3")))
    assert [(r.table, r.address, r.words) for r in seplos] == [("input", 0x1000, 14), ("input", 0x1100, 16)]


def test_rejected_request_is_split_by_quantity_and_without_gaps() -> None:
    (request,) = plan_requests(list_values(source(profile="victron-gx")))
    assert [(r.address, r.words) for r in split_request(request)] == [(259, 1), (261, 1), (262, 1), (266, 1)]
    single_value_request = split_request(request)[0]
    assert split_request(single_value_request) == (single_value_request,)


def test_registers_of_devices_with_a_profile_are_decoded() -> None:
    victron = source(profile="victron-gx")
    resolutions = {"voltage_resolution_v": 0.01, "current_resolution_a": 0.1}
    assert victron.sensor_defaults == {"current_sign": "charge_positive", **resolutions}
    words_read = (
        words(5234, "uint16", address=259) | words(-123, "int16", address=261) | words(-25, "int16", address=262)
    )
    reading = decode_reading(list_values(victron), words_read)
    assert reading is not None
    assert reading[:4] == (52.34, -12.3, (-2.5,), ())
    seplos = source(profile="seplos-v3")
    words_read = {0x1000: 5320, 0x1001: 0xFF38, 0x1009: 2961} | {0x1100 + i: 3325 + i for i in range(16)}
    reading = decode_reading(list_values(seplos), {("input", address): word for address, word in words_read.items()})
    assert reading is not None
    assert reading[:2] == (53.2, -2.0)
    assert reading.temperatures_c[0] == 22.95
    assert reading.cells_v == tuple(round(3.325 + i / 1000, 3) for i in range(16))


@pytest.mark.parametrize("raw", [math.nan, math.inf, -math.inf])
def test_nan_and_infinity_count_as_not_measured(raw: float) -> None:
    register = {"address": 0, "type": "float32"}
    source_settings = source(voltage=register, current=register | {"address": 2}, temperature=register | {"address": 4})
    words_read = words(13.0, "float32") | words(1.5, "float32", address=2) | words(raw, "float32", address=4)
    reading = decode_reading(list_values(source_settings), words_read)
    assert reading is not None
    assert math.isnan(*reading.temperatures_c)
    assert decode_reading(list_values(source_settings), words_read | words(raw, "float32")) is None
    assert decode_reading(list_values(source_settings), words_read | words(raw, "float32", address=2)) is None


def test_value_that_the_scale_makes_infinite_counts_as_not_measured() -> None:
    register = Register(address=0, type="float32", scale=1e300)
    assert math.isnan(decode(register, words(1e30, "float32")))


def test_configured_absent_value_counts_as_not_measured() -> None:
    source_settings = source(
        voltage={"address": 0, "scale": 0.01},
        current={"address": 1, "type": "int16"},
        temperature={"address": 2, "type": "int16", "absent": 32767},
        cells={"address": 3, "count": 2, "absent": 0, "scale": 0.001},
    )
    words_read = {("holding", i): word for i, word in enumerate([1300, 0xFFFF, 32767, 3300, 0])}
    reading = decode_reading(list_values(source_settings), words_read)
    assert reading is not None
    assert (reading.current_a, reading.cells_v[0]) == (-1.0, 3.3)
    assert math.isnan(*reading.temperatures_c)
    assert math.isnan(reading.cells_v[1])
    reading_without_cells = decode_reading(list_values(source_settings), words_read | {("holding", 3): 0})
    assert reading_without_cells is not None
    assert reading_without_cells.cells_v == ()


def test_registers_of_cells_may_have_gaps_between_them() -> None:
    cells = CellRegisters(address=100, count=3, step=4)
    assert [cells.cell(number).address for number in range(3)] == [100, 104, 108]


V, I = {"address": 0}, {"address": 1}  # noqa: E741


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"profile": "victron"}, "profile: 'victron' must be one of victron-gx, seplos-v3"),
        ({"voltage": V, "current": I, "port": "/dev/ttyUSB0"}, "give either host"),
        ({"voltage": V, "current": I, "host": None}, "give either host"),
        ({"voltage": V, "current": I, "host": None, "port": "/dev/x", "framing": "tcp"}, "serial line"),
        ({"voltage": V}, "current"),
        ({"voltage": V | {"scale": 0.0}, "current": I}, "must not be 0"),
        ({"voltage": {"address": 65535, "type": "int32"}, "current": I}, "beyond the last register"),
        ({"voltage": V, "current": I, "cells": {"address": 65530, "count": 16}}, "beyond the last register"),
    ],
)
def test_invalid_settings_are_rejected_with_a_reason(options: dict[str, object], reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        source(**options)


def test_settings_override_the_profile() -> None:
    source_settings = source(profile="victron-gx", unit=3, temperature={"address": 61, "type": "int16", "scale": 0.1})
    assert source_settings.unit == 3
    assert [register.address for register in source_settings.temperature] == [61]
    assert source_settings.voltage.address == 259


@pytest.mark.parametrize("profile", MODBUS_PROFILES)
def test_profile_sets_the_sign_of_the_current(profile: str) -> None:
    assert source(profile=profile).sensor_defaults["current_sign"] == "charge_positive"


@pytest.mark.parametrize(
    ("registers", "measured"),
    [((2659, -25, 210), (26.59, -2.5, 21.0)), ((2659, 0, 0), (26.59, 0.0, None)), ((0, 0, 0), None)],
)
def test_zero_in_a_register_of_a_gx_device_counts_as_not_measured(
    registers: tuple[int, int, int], measured: tuple[float, float, float | None] | None
) -> None:
    voltage, current, temperature = registers
    read = words(voltage, "uint16", address=259) | words(current, "int16", address=261)
    reading = decode_reading(list_values(source(profile="victron-gx")), read | words(temperature, "int16", address=262))
    assert (reading is None) is (measured is None)
    if reading is not None and measured is not None:
        temperature_c = None if math.isnan(*reading.temperatures_c) else reading.temperatures_c[0]
        assert (reading.voltage_v, reading.current_a, temperature_c) == measured
