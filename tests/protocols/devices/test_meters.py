"""Battery monitors (VE.Direct, Junctek) and Pylontech batteries: recorded and damaged frames, simulated devices."""

import asyncio
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from bms_estimator.model.arrays import SampleBlock
from bms_estimator.protocols.base.reading_protocol import ECHO_FAULT, DeviceProtocol, ReadingProtocol
from bms_estimator.protocols.devices.junctek import QUERY, JunctekProtocol
from bms_estimator.protocols.devices.pylontech import PylontechProtocol
from bms_estimator.protocols.devices.vedirect import VeDirectProtocol
from bms_estimator.protocols.registry import make_protocol
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.simulation.simulated_meter import METERS
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.sources.captures.raw_capture import CaptureWriter, make_header
from bms_estimator.sources.captures.replay import RawCapture
from bms_estimator.sources.serial.serial_source import SerialSource
from tests.patience import LONG_S


def vedirect_block(text: str) -> bytes:
    """Return a VE.Direct block. Each line of ``text`` is a name, a space and a value; ~ is a space in a value."""
    return text.replace(" ", "\t").replace("~", " ").replace("\n", "\r\n").encode("latin-1")


# test/bvm702.dump of github.com/karioja/vedirect: a BMV-700 with a load of 7.6 A
BMV_DISCHARGING = vedirect_block(
    "\nPID 0x203\nV 12065\nI -7625\nP -92\nCE -65473\nSOC 839\nTTG 942\nAlarm OFF\nRelay OFF\nAR 0\nBMV 700\nFW 0308\nChecksum q"
)
BMV_HISTORY = vedirect_block(
    "\nH1 -149322\nH2 -82854\nH3 0\nH4 0\nH5 0\nH6 -5526294\nH7 11733\nH8 16161\nH9 368003\nH10 26\nH11 0\nH12 0\n"
    "H17 6843\nH18 8527\nChecksum \xbc"
)
BMV_NEXT_SECOND = vedirect_block(
    "\nPID 0x203\nV 12065\nI -7626\nP -92\nCE -65476\nSOC 839\nTTG 942\nAlarm OFF\nRelay OFF\nAR 0\nBMV 700\nFW 0308\nChecksum m"
)
# test/test_ved.py of github.com/jblance/mpp-solar: a SmartShunt without load
SMART_SHUNT = vedirect_block(
    "\nPID 0xA389\nV 12868\nVS -12\nI 0\nP 0\nCE 0\nSOC 1000\nTTG -1\nAlarm OFF\nAR 0\nBMV SmartShunt~500A/50mV\nFW 0405\n"
    "Checksum K"
)
# CUnit test of a VE.Direct parser in C on GitHub (test__parse_block__bmv_001): a BMV-712 with a sensor, charging
BMV_CHARGING = vedirect_block(
    "\nPID 0xA381\nV 13043\nT 23\nI 3856\nP 50\nCE 0\nSOC 1000\nTTG -1\nAlarm OFF\nRelay OFF\nAR 0\nBMV 712~Smart\nFW 0403\n"
    "Checksum \xb5"
)
VEDIRECT_HEX_MESSAGE = b":7F0ED0071\n"
"""Message of VE.Direct's second protocol, which a device may send between and within blocks."""

# Manual of the KH-F, page 29; Potoonite/juntek-rs485 and mysystem32/juntek_kg on GitHub: a KG140F
KH_CHARGING = b":r50=1,123,1198,1090,7421,2749,437,298,113,0,0,1,69,100,230208,112418,\r\n"
KG_DISCHARGING = b":r50=1,34,5166,1030,109337,11738441,62100651,48663,125,0,99,0,644,9117,\r\n"
KG_CHARGING = b":r50=1,220,5366,5410,416983,289634,1427701,88851,128,0,0,1,3,4277,\r\n"

# Console output of a US5000 (test of pylon2mqtt on GitHub) and of two US2000 (notes of another user on GitHub)
US5000_PWR = (
    b"pwr\n\r@\r\r\n"
    b"Power Volt   Curr   Tempr  Tlow   Tlow.Id  Thigh  Thigh.Id Vlow   Vlow.Id  Vhigh  Vhigh.Id Base.St  Volt.St  "
    b"Curr.St  Temp.St  Coulomb  Time                 B.V.St   B.T.St  MosTempr M.T.St   SysAlarm.St\r\r\n"
    b"1     49874  -642   19100  17000  8        17600  0        3324   2        3325   0        Dischg   Normal   "
    b"Normal   Normal   81%      2025-03-18 05:58:51  Normal   Normal  18200    Normal   Normal  \r\r\n"
    b"2     -      -      -      -      -      -      -      Absent   -        -        -        -        "
    b"-                    -        -       \r\n\rCommand completed successfully\r\n\r$$\r\n\rpylon>"
)
US2000_PWR = (
    b"pwr\n\r@\r\r\nPower Volt   Curr   Tempr  Tlow   Thigh  Vlow   Vhigh  Base.St  Volt.St  Curr.St  Temp.St  Coulomb  "
    b"Time                 B.V.St   B.T.St  \r\r\n"
    b"1     50691  3806   17000  13000  14000  3378   3381   Charge   Normal   Normal   Normal   89%      "
    b"2025-12-21 20:53:06  Normal   Normal  \r\r\n"
    b"2     50673  4087   16000  13000  14000  3377   3380   Charge   Normal   Normal   Normal   89%      "
    b"2025-12-21 20:53:04  Normal   Normal  \r\r\n"
    b"3     -      -      -      -      -      -      -      Absent   -        -        -        -        -    "
    b"                -        -       \r\n\rCommand completed successfully\r\n\r$$\r\n\rpylon>"
)
US2000_END = b"\r\n\rCommand completed successfully\r\n\r$$\r\n\rpylon>"


def bat_response(battery: int, cells_mv: list[int]) -> bytes:
    """Return the response to command ``bat N``, which lists the cells of battery N, in the format of a US2000."""
    rows = b"\r\r\n".join(
        b"%-8d %-8d 4076     14000    Charge       Normal       Normal       Normal        89%%      42586 mAH"
        % (n, mv)
        for n, mv in enumerate(cells_mv)
    )
    head = b"Battery  Volt     Curr     Tempr    Base State   Volt. State  Curr. State  Temp. State  Coulomb     \r\r\n"
    return b"bat %d\n\r@\r\r\n" % battery + head + rows + US2000_END


US2000_CELLS_MV = [3379, 3379, 3379, 3379, 3381, 3378, 3378, 3378, 3380, 3379, 3380, 3380, 3378, 3380, 3380]

PROTOCOLS: Mapping[str, Callable[[], DeviceProtocol]] = {
    "vedirect": VeDirectProtocol,
    "junctek": JunctekProtocol,
    "pylontech": PylontechProtocol,
}


def voltages_and_currents(block: SampleBlock) -> list[tuple[float, float]]:
    return list(zip(block["voltage_v"].round(6).tolist(), block["current_a"].round(6).tolist(), strict=True))


@pytest.mark.parametrize(
    ("name", "data", "volts_amperes_celsius"),
    [
        ("vedirect", BMV_DISCHARGING, (12.065, 7.625, math.nan)),
        ("vedirect", SMART_SHUNT, (12.868, 0.0, math.nan)),
        ("vedirect", BMV_CHARGING, (13.043, -3.856, 23.0)),
        ("junctek", KH_CHARGING, (11.98, -10.90, 13.0)),
        ("junctek", KG_DISCHARGING, (51.66, 10.30, 25.0)),
        ("junctek", KG_CHARGING, (53.66, -54.10, 28.0)),
        ("pylontech", US5000_PWR, (49.874, 0.642, 17.3)),  # mean of the lowest and highest temperature
        ("pylontech", US2000_PWR, (50.682, -7.893, 13.5)),  # mean voltage and total current of two batteries
    ],
)
def test_recorded_frames_are_decoded_with_a_current_that_is_positive_on_discharge(
    name: str, data: bytes, volts_amperes_celsius: tuple[float, float, float]
) -> None:
    decoder = make_protocol(SensorSettings.model_validate({"protocol": name}))
    block = decoder.feed(1.0, data)
    assert [block[column].item() for column in ("voltage_v", "current_a", "temperature_c")] == pytest.approx(
        volts_amperes_celsius, nan_ok=True
    )
    assert decoder.fault is None
    assert decoder.description is not None


def test_lowest_and_highest_temperature_of_each_battery_are_part_of_the_sample() -> None:
    (sample,) = PylontechProtocol().feed(1.0, US2000_PWR.replace(b"14000  3377", b"90000  3377"))
    assert (sample["temperature_min_c"], sample["temperature_max_c"]) == (13.0, 90.0)


@pytest.mark.parametrize(
    ("name", "data", "soc", "remaining_ah"),
    [
        ("vedirect", BMV_DISCHARGING, 0.839, math.nan),
        (
            "vedirect",
            BMV_DISCHARGING.replace(b"SOC\t839", b"SOC\t---").replace(b"Checksum\tq", b"Checksum\t\x8e"),
            math.nan,
            math.nan,
        ),
        ("junctek", KH_CHARGING, math.nan, 7.421),
        ("pylontech", US5000_PWR, 0.81, math.nan),
        ("pylontech", US2000_PWR, 0.89, math.nan),
        ("pylontech", US5000_PWR.replace(b"81%", b"-"), math.nan, math.nan),
    ],
)
def test_soc_and_remaining_charge_by_the_device_are_decoded(
    name: str, data: bytes, soc: float, remaining_ah: float
) -> None:
    decoder = make_protocol(SensorSettings.model_validate({"protocol": name}))
    assert decoder.feed(1.0, data).size == 1
    assert isinstance(decoder, ReadingProtocol)
    assert decoder.last_reading is not None
    assert decoder.last_reading[-3:-1] == pytest.approx((soc, remaining_ah), nan_ok=True)


def test_current_sign_setting_corrects_a_reversed_shunt() -> None:
    sensor = SensorSettings.model_validate({"protocol": "vedirect", "current_sign": "discharge_positive"})
    assert make_protocol(sensor).feed(1.0, BMV_DISCHARGING)["current_a"].item() == pytest.approx(-7.625)


def test_protocol_sets_defaults_of_the_sensor_which_settings_override() -> None:
    shunt = SensorSettings.model_validate({"protocol": "vedirect"})
    assert (shunt.baud, shunt.current_sign, shunt.voltage_resolution_v) == (19_200, "charge_positive", 0.01)
    assert SensorSettings.model_validate({"protocol": "junctek", "baud": 9600}).baud == 9600
    assert SensorSettings().baud == SensorSettings(protocol="text").baud == 500_000


def test_history_and_hex_messages_between_blocks_are_ignored() -> None:
    decoder = VeDirectProtocol()
    block_with_hex_message = BMV_NEXT_SECOND.replace(b"\r\nSOC", VEDIRECT_HEX_MESSAGE + b"\r\nSOC")
    incomplete_first_block = BMV_DISCHARGING[9:]
    block = decoder.feed(
        1.0,
        incomplete_first_block
        + BMV_HISTORY
        + VEDIRECT_HEX_MESSAGE
        + BMV_NEXT_SECOND
        + BMV_HISTORY
        + block_with_hex_message,
    )
    assert voltages_and_currents(block) == [(12.065, 7.626)] * 2
    assert decoder.counters["checksum_errors"] == 0  # the incomplete first block does not count


@pytest.mark.parametrize(
    ("name", "valid", "damaged", "counter", "message"),
    [
        ("vedirect", BMV_DISCHARGING, BMV_DISCHARGING.replace(b"7625", b"7635"), "checksum_errors", "wrong checksum"),
        ("vedirect", BMV_DISCHARGING, bytes(range(128, 256)) * 20, "length_errors", "19200 baud"),
        ("junctek", KG_CHARGING, KG_CHARGING.replace(b"5410", b"5411"), "checksum_errors", "wrong checksum"),
        ("junctek", KG_CHARGING, KG_CHARGING[:30] + b"\r\n", "length_errors", "cut off"),
        ("junctek", KG_CHARGING, KG_CHARGING.replace(b"=1,", b"=2,"), "other_address", "address 2"),
        ("junctek", KG_CHARGING, b"\xff\x80\x81\n", "text_errors", "noise"),
        ("junctek", KG_CHARGING, bytes(range(128, 256)) * 3, "length_errors", "baud rate is 115200"),
        ("pylontech", US2000_PWR, US2000_PWR.replace(b"50673", b"5o673"), "text_errors", "cannot be parsed"),
        ("pylontech", US2000_PWR, US2000_PWR[:500] + b"pylon>", "length_errors", "cut off"),
        (
            "pylontech",
            US2000_PWR,
            b"pwr\r\nUnknown command 'pwr' - try 'help'\r\npylon>",
            "text_errors",
            "rejects the command",
        ),
        ("pylontech", US2000_PWR, bytes(range(128, 256)) * 200, "length_errors", "baud rate is 115200"),
    ],
)
def test_damaged_frame_is_counted_and_reported_until_a_valid_frame(
    name: str, valid: bytes, damaged: bytes, counter: str, message: str
) -> None:
    decoder = PROTOCOLS[name]()
    assert decoder.feed(1.0, valid).size == 1
    assert decoder.feed(2.0, damaged).size == 0
    assert decoder.counters[counter] == 1
    assert message in (decoder.fault or "")
    assert decoder.feed(3.0, b"\n" + valid + valid).size >= 1
    assert decoder.fault is None


STACK_CURRENT_A = 80.0
"""Current of four batteries with 20 A each [A]."""


def stack_response(rows: Sequence[str]) -> bytes:
    """Return the response to command ``pwr`` with these rows, in the format of a US5000."""
    head = US5000_PWR[: US5000_PWR.index(b"1     49874")]
    return head + "\r\r\n".join(rows).encode() + US2000_END


def battery_row(number: int) -> str:
    """Return the row of a battery that delivers 20 A."""
    values = f"{number:<5} 49874  -20000 19100  17000  8        17600  0        3324   2        3325   0        "
    return (
        values
        + "Dischg   Normal   Normal   Normal   81%      2025-03-18 05:58:51  Normal   Normal  18200    Normal   Normal"
    )


def absent_row(number: int) -> str:
    """Return the row of an absent battery."""
    return (
        f"{number:<5} -      -      -      -      -      -      -      Absent   -        -        -        -        -"
    )


STACK = [*map(battery_row, (1, 2, 3, 4)), *map(absent_row, (5, 6, 7, 8))]
INCOMPLETE = {
    "first row lost": (STACK[1:], "row 1 of a table is missing"),
    "middle row lost": ([*STACK[:2], *STACK[3:]], "row 3 of a table is missing"),
    "last rows lost": (STACK[:3], "no values of battery 4"),
    "rows merged by an overflow": (
        [STACK[0], STACK[1][:70] + STACK[2][20:], *STACK[3:]],
        "row 3 of a table is missing",
    ),
    "last rows merged by an overflow": ([*STACK[:2], STACK[2][:70] + STACK[3][20:]], "cannot be parsed"),
    "battery absent": ([*STACK[:3], absent_row(4), *STACK[4:]], "no values of battery 4"),
    "batteries absent": ([*STACK[:2], absent_row(3), absent_row(4), *STACK[4:]], "no values of battery 3 and 4"),
}
"""Rows of a table that lacks a part of the current, and part of the reported fault."""


@pytest.mark.parametrize(("rows", "message"), INCOMPLETE.values(), ids=INCOMPLETE)
def test_the_currents_of_an_incomplete_stack_are_not_summed(rows: list[str], message: str) -> None:
    decoder = PylontechProtocol()
    assert decoder.feed(1.0, stack_response(STACK))["current_a"].tolist() == [STACK_CURRENT_A]
    for second in range(2, 600, 2):
        assert decoder.feed(second, stack_response(rows)).size == 0
    assert message in (decoder.fault or "")
    assert decoder.counters["text_errors"] + decoder.counters["length_errors"] == 299
    assert decoder.feed(600.0, stack_response(STACK))["current_a"].tolist() == [STACK_CURRENT_A]
    assert decoder.fault is None


def test_a_battery_that_is_absent_from_the_first_table_on_is_noticed_by_the_settings(tmp_path: Path) -> None:
    settings = Settings.model_validate(
        {"pack": {"cell": "lfp", "capacity_ah": 100, "parallel": 4}, "sensor": {"protocol": "pylontech"}}
    )
    three = stack_response([*STACK[:3], absent_row(4), *STACK[4:]])
    decoder = make_protocol(settings.sensor)
    assert decoder.feed(0.0, three).size == 0
    assert "only battery 1, 2, 3, but pack.parallel is 4" in (decoder.fault or "")
    assert decoder.feed(4000.0, three).size == 0
    assert decoder.feed(4002.0, stack_response(STACK))["current_a"].tolist() == [STACK_CURRENT_A]
    with CaptureWriter(tmp_path / "capture.bms", make_header(settings.sensor)) as writer:
        writer.write(0.0, three)
    assert not list(RawCapture(tmp_path / "capture.bms"))


def test_a_battery_that_is_absent_for_an_hour_counts_as_removed_and_a_new_one_counts_at_once() -> None:
    decoder = PylontechProtocol()
    three = stack_response([*STACK[:3], absent_row(4), *STACK[4:]])
    assert decoder.feed(0.0, stack_response(STACK)).size == 1
    assert decoder.feed(3599.0, three).size == 0
    assert decoder.feed(3600.0, three)["current_a"].tolist() == [60.0]
    assert decoder.feed(3602.0, stack_response(STACK))["current_a"].tolist() == [STACK_CURRENT_A]


def test_a_stack_whose_master_leaves_out_the_soc_of_the_others_is_read() -> None:
    decoder = PylontechProtocol()
    without_soc = [STACK[0], *(row.replace("81%", "   ") for row in STACK[1:])]
    assert decoder.feed(1.0, stack_response(without_soc))["current_a"].tolist() == [STACK_CURRENT_A]
    assert decoder.last_reading is not None
    assert math.isnan(decoder.last_reading.soc)


def test_cells_of_newer_firmware_are_read() -> None:
    head = b"bat 1\n\r@\r\r\nBat  Volt Curr    Tempr   V.State T.State AH(mAH)             Bal\r\r\n"
    rows = [
        b"%-4d %d -144    18800   Normal  Normal   68%%      33819 mAH   N" % row for row in enumerate(US2000_CELLS_MV)
    ]
    decoder = PylontechProtocol()
    decoder.feed(1.0, head + b"\r\r\n".join(rows) + US2000_END + US5000_PWR)
    assert decoder.cells.tolist() == [pytest.approx([mv / 1000 for mv in US2000_CELLS_MV])]
    assert decoder.fault is None


def test_cells_of_a_table_with_a_lost_row_are_not_used() -> None:
    decoder = PylontechProtocol()
    complete = bat_response(1, US2000_CELLS_MV)
    row = b"%-8d %-8d" % (3, US2000_CELLS_MV[3])
    begin = complete.index(row)
    end = complete.index(b"%-8d %-8d" % (4, US2000_CELLS_MV[4]))
    decoder.feed(1.0, complete[:begin] + complete[end:] + US5000_PWR)
    assert decoder.cells.size == 0
    assert decoder.counters["length_errors"] == 1
    decoder.feed(2.0, complete + US5000_PWR)
    assert decoder.cells.shape == (1, 15)


def test_own_requests_that_the_adapter_of_a_junctek_returns_are_named() -> None:
    decoder = JunctekProtocol()
    for second in range(6):
        decoder.feed(second, decoder.next_output(second))
    assert decoder.fault == ECHO_FAULT
    assert decoder.feed(6.0, KG_CHARGING).size == 1
    assert decoder.fault is None


RS485_FRAME = b"~20024642E00202FD33\r"
UNIT_TABLE = b"Unit     Volt     Curr     Tempr\r\n1        49874    -642     19100\r\n"
UNEXPECTED = {
    "frames of the RS-485 port": (RS485_FRAME, "connect to the console port"),
    "table of another command": (
        b"@\r\n" + UNIT_TABLE + US2000_END,
        "Power, Volt of a master's console: Unit Volt Curr",
    ),
    "table without a prompt": (UNIT_TABLE, "another device or port? It begins: Unit Volt Curr Tempr"),
    "wrong baud rate": (bytes(range(128, 256)), "baud rate is 115200"),
}
"""Bytes that are no response of a Pylontech console, and part of the reported fault."""


@pytest.mark.parametrize(("data", "message"), UNEXPECTED.values(), ids=UNEXPECTED)
def test_other_bytes_than_those_of_a_pylontech_console_are_named(data: bytes, message: str) -> None:
    decoder = PylontechProtocol()
    for second in range(12):
        if decoder.next_output(second):
            decoder.feed(second, data)
    assert message in (decoder.fault or "")
    assert decoder.feed(12.0, b"\n\rpylon>" + US5000_PWR).size == 1
    assert decoder.fault is None


def test_vedirect_charger_is_rejected() -> None:
    body = vedirect_block("\nPID 0xA042\nV 12740\nI 800\nVPV 0\nPPV 0\nCS 0\nERR 0\nLOAD ON\nChecksum ")
    decoder = VeDirectProtocol()
    assert decoder.feed(1.0, body + bytes((-sum(body) & 0xFF,))).size == 0
    assert "product 0xA042 is no battery monitor" in (decoder.fault or "")


def test_cell_voltages_are_attached_once_all_batteries_have_reported_theirs() -> None:
    decoder = PylontechProtocol()
    decoder.feed(1.0, bat_response(1, US2000_CELLS_MV) + US2000_PWR)
    assert decoder.cells.size == 0
    block = decoder.feed(2.0, bat_response(2, [mv - 1 for mv in US2000_CELLS_MV]) + US2000_PWR)
    assert block.size == 1
    assert decoder.cells.shape == (1, 30)
    # cells 0 and 4 of the first battery, cell 0 of the second one, 1 mV lower
    assert decoder.cells[0, [0, 4, 15]].tolist() == pytest.approx([3.379, 3.381, 3.378])


def test_pylontech_console_is_polled_for_the_stack_and_for_each_battery_in_turn() -> None:
    decoder = PylontechProtocol()
    assert [decoder.next_output(now) for now in (0.0, 0.25)] == [b"pwr\n", b""]
    decoder.feed(0.3, US2000_PWR)
    assert decoder.next_output(0.5) == b"bat 2\n"
    decoder.feed(0.6, bat_response(2, US2000_CELLS_MV))
    assert [decoder.next_output(now) for now in (0.75, 2.0)] == [b"", b"pwr\n"]
    # the request of 2 s gets no response and is repeated
    assert [decoder.next_output(now) for now in (6.0, 7.0)] == [b"", b"pwr\n"]


def test_junctek_is_polled_each_second_and_after_reopening() -> None:
    decoder = JunctekProtocol()
    assert [decoder.next_output(now) for now in (0.0, 0.5, 1.0)] == [QUERY, b"", QUERY]
    decoder.on_port_opened()
    assert decoder.next_output(1.1) == QUERY


def test_cell_voltages_received_long_before_a_sample_are_not_attached_to_it() -> None:
    decoder = PylontechProtocol()
    decoder.feed(1.0, bat_response(1, US2000_CELLS_MV) + bat_response(2, US2000_CELLS_MV) + US2000_PWR)
    assert decoder.cells.shape == (1, 30)
    decoder.feed(60.0, bat_response(1, US2000_CELLS_MV) + US2000_PWR)
    assert decoder.cells.shape == (1, 30)
    assert decoder.feed(100.0, US2000_PWR).size == 1
    assert decoder.cells.size == 0


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("vedirect", BMV_DISCHARGING[40:] + BMV_NEXT_SECOND),
        ("junctek", KH_CHARGING[20:] + KG_DISCHARGING),
        ("pylontech", bat_response(1, US2000_CELLS_MV) + bat_response(2, US2000_CELLS_MV) + b"\rpyl" + US2000_PWR),
    ],
)
def test_samples_do_not_depend_on_reopenings_of_the_port(name: str, data: bytes) -> None:
    reads = [(0.01 * n, data[n : n + 7]) for n in range(0, len(data), 7)]
    sensor = SensorSettings.model_validate({"protocol": name})
    live, replayed = make_protocol(sensor), make_protocol(sensor)  # a replay knows nothing of reopenings
    for arrival_s, read in reads:
        live.on_port_opened()
        blocks = live.feed(arrival_s, read), replayed.feed(arrival_s, read)
        assert repr(blocks[0].tolist()) == repr(blocks[1].tolist())  # repr, because NaN does not equal NaN
        assert live.cells.tolist() == replayed.cells.tolist()
    assert live.counters == replayed.counters
    assert live.counters["frames_received"] > 0


FRAMES = {
    "vedirect": [BMV_DISCHARGING, BMV_HISTORY, BMV_CHARGING, VEDIRECT_HEX_MESSAGE],
    "junctek": [KH_CHARGING, KG_CHARGING, b":R50=1,2,1,\r\n", b":r00=1,217,2140,110,6,\r\n"],
    "pylontech": [US5000_PWR, US2000_PWR, bat_response(1, US2000_CELLS_MV), b"\n\rpylon>"],
}
cases = st.sampled_from(sorted(FRAMES)).flatmap(
    lambda name: st.tuples(
        st.just(name),
        st.lists(st.sampled_from(FRAMES[name]) | st.binary(max_size=40), max_size=8).map(b"".join),
        st.lists(st.integers(0, 8000), max_size=6),
        st.lists(st.tuples(st.integers(0, 8000), st.integers(0, 255)), max_size=3),
    )
)


@settings(max_examples=300)
@given(cases)
def test_no_bytes_raise_and_chunk_boundaries_do_not_change_the_values(
    case: tuple[str, bytes, list[int], list[tuple[int, int]]],
) -> None:
    name, data, cuts, changes = case
    damaged = bytearray(data)
    for at, value in changes:
        if damaged:
            damaged[at % len(damaged)] = value
    whole_decoder, cut_decoder = PROTOCOLS[name](), PROTOCOLS[name]()
    block, cells = whole_decoder.feed(1.0, bytes(damaged)), whole_decoder.cells
    edges = [0, *sorted(min(at, len(damaged)) for at in cuts), len(damaged)]
    blocks, cell_rows = [], 0
    for n, (a, b) in enumerate(itertools.pairwise(edges)):
        now_s = 1.0 + 0.1 * n  # before the timeout of a response, which is a fault
        blocks.append(cut_decoder.feed(now_s, bytes(damaged[a:b])))
        cell_rows += cut_decoder.cells.shape[0]
        cut_decoder.next_output(now_s)
    assert voltages_and_currents(np.concatenate(blocks)) == voltages_and_currents(block)
    # a block with any cell voltages has a row of them for each sample; a block without has no rows
    assert cell_rows <= cells.shape[0]
    assert whole_decoder.counters["frames_received"] == block.size
    assert (whole_decoder.fault is None) == (cut_decoder.fault is None)


@pytest.mark.parametrize(("name", "cell_count"), [("vedirect", 0), ("junctek", 0), ("pylontech", 15)])
async def test_simulated_device_is_read_by_the_serial_source(name: str, cell_count: int) -> None:
    with METERS[name](lambda _: Reading(current_a=-3.25, voltage_v=49.87, temperature_c=21.0), 1.0) as meter:
        sensor = SensorSettings.model_validate({"protocol": name, "port": meter.path})
        running = asyncio.create_task(meter.run())
        async with asyncio.timeout(LONG_S), SerialSource(sensor) as source:
            async for block, cells_v, *_ in source:
                assert voltages_and_currents(block) == [(49.87, -3.25)] * block.size
                assert set(block["temperature_c"]) == {21.0}
                if cells_v.shape[1] == cell_count:
                    break
            assert source.silence_reason is None
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        voltage_of_cells_v = 49.87 * cells_v.shape[0] if cell_count else 0.0
        assert cells_v.sum() == pytest.approx(voltage_of_cells_v, abs=0.01 * cell_count)


def test_silence_does_not_count_as_a_protocol_fault() -> None:
    for make_decoder in PROTOCOLS.values():
        decoder = make_decoder()
        assert decoder.feed(1.0, b"").size == 0
        assert (decoder.fault, decoder.description) == (None, None)
