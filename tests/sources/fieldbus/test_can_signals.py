"""Readings from CAN frames, by profiles and by DBC files."""

import math
from importlib.resources import files
from pathlib import Path

import cantools
import pytest
from cantools.database.can import Database
from hypothesis import given, strategies as st
from pydantic import ValidationError

from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.reading import Reading
from bms_estimator.settings.sources.fieldbus import CAN_PROFILES, CanSource, CellSignals
from bms_estimator.sources.fieldbus.can_signals import MAX_AGE_S, CanDecoder, FrameId

PYLONTECH_DATA = bytes([0x72, 0x14, 0x85, 0xFF, 0xD7, 0x00])
"""Data of frame 0x356 with 52.34 V, -12.3 A (charge is positive) and 21.5 degC."""
DBC_TEXT = """
VERSION ""
BU_: BMS
BO_ 1280 Pack: 8 BMS
 SG_ PackVoltage : 7|16@0+ (0.1,0) [0|1000] "V" X
 SG_ PackCurrent : 23|16@0- (0.1,-1000) [-1000|1000] "A" X
 SG_ Fast : 32|8@1+ (1,0) [0|0] "" X
BO_ 1281 Cells: 8 BMS
 SG_ Group M : 0|8@1+ (1,0) [0|3] "" X
 SG_ Cell1 m0 : 8|16@1+ (1,0) [0|5000] "mV" X
 SG_ Cell2 m0 : 24|16@1+ (1,0) [0|5000] "mV" X
 SG_ Cell3 m1 : 8|16@1+ (1,0) [0|5000] "mV" X
BO_ 1 V: 1 BMS
 SG_ Volts : 0|8@1+ (0.1,0) [0|0] "V" X
BO_ 2 I: 1 BMS
 SG_ Amperes : 0|8@1+ (0.1,0) [0|0] "A" X
BO_ 3 T: 1 BMS
 SG_ Degrees : 0|8@1+ (0.1,0) [0|0] "degC" X
BO_ 4 C: 2 BMS
 SG_ C1 : 0|8@1+ (0.1,0) [0|0] "V" X
 SG_ C2 : 8|8@1+ (0.1,0) [0|0] "V" X
BO_ 5 C_: 1 BMS
 SG_ Last : 0|8@1+ (0.1,0) [0|0] "V" X
BO_ 2566848512 Other: 8 BMS
 SG_ Fast : 0|8@1+ (1,0) [0|0] "" X
 SG_ Temp : 8|8@1+ (1,-40) [0|0] "degC" X
"""
"""DBC file with a multiplexer, an identifier of 29 bits (2566848512 is 0x18FF0000 with the flag of DBC), and frames of
one value each."""


@pytest.fixture(scope="module")
def dbc_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dbc") / "pack.dbc"
    path.write_text(DBC_TEXT)
    return path


@pytest.fixture(scope="module")
def dbc_source(dbc_path: Path) -> CanSource:
    return source(
        dbc=str(dbc_path),
        voltage={"signal": "PackVoltage"},
        current={"signal": "Pack.PackCurrent"},
        temperature={"signal": "Temp"},
        cells=[{"signal": "Cell{}", "count": 3, "scale": 0.001}],
    )


def source(**options: object) -> CanSource:
    return CanSource.model_validate({"kind": "can"} | options)


@given(st.lists(st.tuples(st.sampled_from([0x355, 0x356, 0x357]), st.booleans(), st.binary(max_size=64)), max_size=20))
def test_arbitrary_frames_raise_no_error_with_a_profile(frames: list[tuple[int, bool, bytes]]) -> None:
    decoder = CanDecoder(source(profile="pylontech-can"))
    for identifier, extended, data in frames:
        reading = decoder.feed(0.0, identifier, extended, data)
        assert (reading is not None) == ((identifier, extended) == (0x356, False) and len(data) >= 4)


@given(st.lists(st.tuples(st.sampled_from([0x500, 0x501]), st.binary(max_size=64)), max_size=20))
def test_arbitrary_frames_raise_no_error_with_a_dbc_file(
    dbc_source: CanSource, frames: list[tuple[int, bytes]]
) -> None:
    decoder = CanDecoder(dbc_source)
    for identifier, data in frames:
        decoder.feed(0.0, identifier, extended=False, data=data)


def test_frames_of_the_profile_are_decoded() -> None:
    source_settings = source(profile="pylontech-can")
    resolutions = {"voltage_resolution_v": 0.01, "current_resolution_a": 0.1}
    assert source_settings.sensor_defaults == {"current_sign": "charge_positive", **resolutions}
    decoder = CanDecoder(source_settings)
    assert decoder.frame_ids == (FrameId(0x356, False), FrameId(0x355, False))
    assert decoder.missing == "source.voltage (frame 0x356), source.current (frame 0x356)"
    assert decoder.feed(0.0, 0x355, extended=False, data=bytes([62, 0, 99, 0])) is None
    reading = decoder.feed(0.0, 0x356, extended=False, data=PYLONTECH_DATA)
    assert reading is not None
    assert reading[:4] == (52.34, -12.3, (21.5,), ())
    assert reading.soc == 0.62


def test_truncated_frame_gives_the_values_that_it_contains() -> None:
    decoder = CanDecoder(source(profile="pylontech-can"))
    reading = decoder.feed(0.0, 0x356, extended=False, data=PYLONTECH_DATA[:4])
    assert reading is not None
    assert reading[:2] == (52.34, -12.3)
    assert math.isnan(*reading.temperatures_c)
    assert decoder.feed(0.0, 0x356, extended=False, data=PYLONTECH_DATA[:2]) is None
    assert decoder.counters["short_frames"] == 2


def test_voltage_and_current_of_a_reading_are_of_about_the_same_time_and_other_values_are_recent(
    dbc_path: Path,
) -> None:
    decoder = CanDecoder(
        source(
            dbc=str(dbc_path),
            voltage={"signal": "Volts"},
            current={"signal": "Amperes", "absent": 25.5},
            temperature={"signal": "Degrees"},
            cells=[{"signal": "C{}", "count": 2}, {"signal": "Last"}],
        )
    )
    volts, amperes, degrees, two_cells = 1, 2, 3, 4  # identifiers of the frames; each byte is in units of 0.1

    def feed(arrival_s: float, identifier: int, data: bytes) -> Reading | None:
        return decoder.feed(arrival_s, identifier, extended=False, data=data)

    assert feed(0.0, degrees, b"\xd2") is None
    assert feed(0.0, two_cells, b"\x20\x21") is None
    assert feed(0.0, amperes, b"\x05") is None
    assert decoder.missing == "source.voltage (frame 0x001)"
    reading = feed(1.0, volts, b"\x82")
    assert reading is not None
    assert reading[:3] == (13.0, 0.5, (21.0,))
    assert reading.cells_v[:2] == (3.2, 3.3)
    assert math.isnan(reading.cells_v[2])
    assert feed(2.0, volts, b"\x83") is None
    assert feed(2.0, amperes, b"\xff") is None  # 25.5 A means that the current is not measured
    assert decoder.counters["not_measured"] == 1
    assert feed(3.0, volts, b"\x83") is None
    assert feed(6.1, amperes, b"\x05") is None  # voltage and current are more than three periods apart
    assert feed(7.0, volts, b"\x83") is None
    assert feed(10.0, amperes, b"\x05") is not None
    assert feed(11.0, volts, b"\x83") is None
    assert feed(12.0 + MAX_AGE_S, amperes, b"\x05") is None
    assert feed(13.0 + MAX_AGE_S, volts, b"\x83") is None
    late_reading = feed(13.5 + MAX_AGE_S, amperes, b"\x05")
    assert late_reading is not None
    assert (late_reading.voltage_v, late_reading.cells_v) == (13.1, ())
    assert math.isnan(*late_reading.temperatures_c)


def test_signals_of_a_dbc_file_are_decoded(dbc_source: CanSource) -> None:
    decoder = CanDecoder(dbc_source)
    assert set(decoder.frame_ids) == {FrameId(0x500, False), FrameId(0x501, False), FrameId(0x18FF0000, True)}
    assert decoder.feed(0.0, 0x18FF0000, extended=True, data=bytes([1, 65])) is None
    assert decoder.feed(0.0, 0x501, extended=False, data=bytes([0, 0xE4, 0x0C, 0xE5, 0x0C])) is None
    assert decoder.feed(0.0, 0x501, extended=False, data=bytes([1, 0xE6, 0x0C])) is None
    assert decoder.counters["short_frames"] == 0  # a multiplexed frame contains only some of the signals
    assert decoder.feed(0.0, 0x501, extended=False, data=bytes([7, 0, 0])) is None
    assert decoder.counters["short_frames"] == 1  # also counts multiplexer values without signals, such as 7
    reading = decoder.feed(0.0, 0x500, extended=False, data=(4001).to_bytes(2, "big") + (10123).to_bytes(2, "big"))
    assert reading is not None
    assert reading[:4] == (400.1, 12.3, (25.0,), (3.3, 3.301, 3.302))


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        (
            "Voltage",
            "source.voltage: signal = 'Voltage': the DBC file has no such signal; it has Amperes, C1, C2, Cell1",
        ),
        ("Fast", "several messages have it: write Pack.Fast or Other.Fast"),
        ("Cells.PackVoltage", "no such signal"),
    ],
)
def test_unknown_or_ambiguous_signal_is_rejected(dbc_path: Path, name: str, reason: str) -> None:
    with pytest.raises(UserError) as raised:
        CanDecoder(source(dbc=str(dbc_path), voltage={"signal": name}, current={"signal": "PackCurrent"}))
    assert reason in str(raised.value)


def test_missing_or_invalid_dbc_file_is_rejected(tmp_path: Path) -> None:
    signals = {"voltage": {"signal": "V"}, "current": {"signal": "I"}}
    with pytest.raises(UserError, match="cannot be read: No such file"):
        CanDecoder(source(dbc=str(tmp_path / "none.dbc"), **signals))
    junk = tmp_path / "junk.dbc"
    junk.write_bytes(bytes(range(256)))
    with pytest.raises(UserError, match=f"source.dbc = {junk}: "):
        CanDecoder(source(dbc=str(junk), **signals))


def test_name_of_a_cell_signal_is_numbered_from_the_first_number_on() -> None:
    signals = CellSignals(signal="C{}", count=2, first=0).cell_signals()
    assert [signal.signal for signal in signals] == ["C0", "C1"]


@pytest.mark.parametrize("profile", CAN_PROFILES)
def test_resolutions_of_a_profile_are_the_factors_of_its_dbc_file(profile: str) -> None:
    text = (files("bms_estimator.sources.fieldbus") / f"{profile}.dbc").read_text()
    database = cantools.database.load_string(text, database_format="dbc")
    assert isinstance(database, Database)
    factors = {signal.name: signal.conversion.scale for message in database.messages for signal in message.signals}
    source_settings = source(profile=profile)
    assert source_settings.sensor_defaults["voltage_resolution_v"] == factors[source_settings.voltage.signal]
    assert source_settings.sensor_defaults["current_resolution_a"] == factors[source_settings.current.signal]


def test_configured_dbc_file_replaces_that_of_the_profile(dbc_path: Path) -> None:
    source_settings = source(profile="pylontech-can", dbc=str(dbc_path), temperature={"signal": "Temp"})
    assert source_settings.sensor_defaults == {"current_sign": "charge_positive"}
    assert set(CanDecoder(source_settings).frame_ids) == {FrameId(0x500, False), FrameId(0x18FF0000, True)}


V, I = {"signal": "V"}, {"signal": "I"}  # noqa: E741


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"profile": "pylontech"}, "'pylontech' must be one of pylontech-can"),
        ({"voltage": {}, "current": I, "dbc": "x"}, "voltage.signal\n  Field required"),
        ({"voltage": V, "current": I}, "dbc: missing"),
        (
            {"voltage": {"id": 0x356, "start_bit": 0, "bits": 16, "scale": 0.01}, "current": I, "dbc": "x"},
            "id, start_bit, bits: not supported; describe the signal in a DBC file, set source.dbc",
        ),
        ({"voltage": V, "current": I, "dbc": "x", "cells": [{"id": 3, "count": 2}]}, "id: not supported"),
        ({"voltage": V | {"scale": 0.0}, "current": I, "dbc": "x"}, "must not be 0"),
        ({"voltage": V, "current": I, "dbc": "x", "cells": [{"signal": "C{}", "count": 97}]}, "96"),
        ({"voltage": V, "current": I, "dbc": "x", "cells": 2 * [{"signal": "C{}", "count": 60}]}, "at most 96"),
        ({"voltage": V, "current": I, "dbc": "x", "cells": [{"signal": "Cell", "count": 2}]}, "must contain {}"),
    ],
)
def test_invalid_settings_are_rejected_with_a_reason(options: dict[str, object], reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        source(**options)
