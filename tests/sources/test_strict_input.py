"""Strict parsing: input is a valid number or is rejected. Errors report file, line and reason."""

import binascii
import gzip
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.model.decimal_text import measured, number
from bms_estimator.model.errors import UserError
from bms_estimator.protocols.devices.text import TextProtocol
from bms_estimator.protocols.firmware.protocol import BoardProtocol
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.captures.curves import read_curve
from bms_estimator.sources.captures.raw_capture import (
    MAGIC,
    CaptureHeader,
    CaptureWriter,
    make_header,
    read_capture,
    read_header,
    read_sensor_settings,
)
from bms_estimator.sources.captures.replay import Replay, load_capture, open_capture
from tests.protocols.firmware.board_messages import HELLO, NTC_STATUS, encode_hello, encode_sample

CSV_HEADER = "time_s,current_a,voltage_v,temperature_c\n"


@pytest.mark.parametrize("text", ["3.9", " 3.9\r", "+3.9", "39e-1", "003.9"])
def test_decimal_number_is_accepted(text: str) -> None:
    assert number(text) == 3.9


@pytest.mark.parametrize(
    "text",
    ["3_9", "", " ", "٣", "\uff13", "nan", "inf", "1e999", "0x1f", "1d5", "3,9", "3.9V", "--3", "1e", ".", "1 2"],
)
def test_text_that_is_no_decimal_number_is_rejected(text: str) -> None:
    with pytest.raises(ValueError, match="no decimal number"):
        number(text)


def test_word_for_a_missing_value_is_read_as_nan() -> None:
    assert all(math.isnan(measured(text)) for text in ("nan", "NaN", "-nan", "inf", "-Infinity", "ovf"))


@pytest.mark.parametrize("entry", ["3_9", "٣", "0x10", "True"])
def test_table_entry_that_is_a_number_only_to_python_is_rejected(tmp_path: Path, entry: str) -> None:
    path = tmp_path / "odd.csv"
    path.write_text(f"{CSV_HEADER}0,1,3.7,25\n1,1,{entry},25\n", encoding="utf-8")
    with pytest.raises(UserError, match=rf"odd\.csv: line 3: voltage_v = '{entry}': must be a number"):
        load_capture(path)


@pytest.mark.parametrize("word", ["nan", "inf", "", "-Infinity", "1e999"])
async def test_missing_and_implausible_temperatures_of_a_table_are_nan(tmp_path: Path, word: str) -> None:
    path = tmp_path / "hot.csv"
    third_word = "nan" if word == "1e999" else word  # 1e999 is no number and would be an error
    path.write_text(f"{CSV_HEADER}0,1,3.7,1e308\n1,1,3.7,-61\n2,1,3.7,{third_word}\n3,1,3.7,25\n")
    replay = Replay(open_capture(path))
    blocks = [block async for block, *_ in replay]
    assert np.concatenate(blocks)["temperature_c"].tolist() == pytest.approx(
        [math.nan, math.nan, math.nan, 25], nan_ok=True
    )
    # 1e308 and -61 degC are implausible; infinite values count as implausible, too, and missing ones do not
    assert replay.counters["implausible"] == (3 if "inf" in third_word.lower() else 2)


@pytest.mark.parametrize("column", [["3_9", "3.7"], ["3.7", "3.7"], [b"1", b"2"], [1j, 2j], [[1], [2]], [True, False]])
def test_column_without_numbers_is_rejected(column: list[object]) -> None:
    with pytest.raises(UserError, match="the table: column voltage_v holds"):
        load_capture({"time_s": [0.0, 1.0], "current_a": [0, 0], "voltage_v": column})


def test_none_in_a_column_is_nan() -> None:
    columns = load_capture({"time_s": [0, 1], "current_a": [None, 1], "voltage_v": [3.7, 3.7]})
    assert columns["current_a"].tolist() == pytest.approx([math.nan, 1.0], nan_ok=True)


def test_curve_with_an_entry_that_is_no_decimal_number_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "ocv.csv"
    path.write_text("soc,ocv_v\n0,3.0\n1,4_2\n")
    with pytest.raises(UserError, match=r"ocv\.csv: line 3: ocv_v = '4_2': must be a number"):
        read_curve(path)


def write_header(path: Path, text: bytes) -> Path:
    """Write a capture that has only a header: ``text`` with a valid CRC. Return its path."""
    crc = binascii.crc_hqx(text, 0xFFFF)
    path.write_bytes(MAGIC + len(text).to_bytes(4, "little") + text + crc.to_bytes(2, "little"))
    return path


@pytest.mark.parametrize(
    "text",
    [
        *(b"", b"[]", b"{}", b"null", b"1", b'"x"', b"{", b"\xff", 5000 * b"["),
        *(b'{"version": true}', b'{"version": "1"}', b'{"version": 1' + 5000 * b"0" + b"}"),
        *(b'{"version": 1, "mode": 7}', b'{"version": 1, "baud": "fast"}', b'{"version": 1, "port": null}'),
        b'{"version": 1, "started": 1e999}',
    ],
    ids=lambda text: text[:24].decode("latin-1"),
)
@pytest.mark.parametrize("compressed", [False, True])
def test_capture_with_invalid_header_is_rejected_with_its_path(tmp_path: Path, text: bytes, compressed: bool) -> None:
    path = write_header(tmp_path / "odd.bms", text)
    if compressed:
        path = tmp_path / "odd.bms.gz"
        path.write_bytes(gzip.compress((tmp_path / "odd.bms").read_bytes()))
    for read in (read_header, lambda path: list(read_capture(path)), open_capture):
        with pytest.raises(UserError, match=rf"^{path}: its header is not valid: "):
            read(path)


def test_capture_of_a_later_version_or_of_an_unknown_protocol_is_rejected(tmp_path: Path) -> None:
    path = write_header(tmp_path / "new.bms", b'{"version": 2, "mode": {"any": "thing"}}')
    with pytest.raises(UserError, match=r"new\.bms: version 2, this program reads version 1"):
        read_header(path)
    path = write_header(path, json.dumps({"version": 1, "mode": "modbus", "more": [1]}).encode())
    with pytest.raises(UserError, match=r"new\.bms: recorded with mode 'modbus'"):
        open_capture(path)


def test_damaged_end_of_a_compressed_capture_raises_no_error(tmp_path: Path) -> None:
    path = tmp_path / "line.bms"
    with CaptureWriter(path, CaptureHeader()) as writer:
        writer.write(1.0, HELLO)
    compressed = bytearray(gzip.compress(path.read_bytes()))
    compressed[-6] ^= 1  # the last eight bytes are CRC and size of the uncompressed data
    damaged = path.with_suffix(".bms.gz")
    damaged.write_bytes(compressed)
    assert sum(batch.ends.size for batch in read_capture(damaged)) <= 1  # number of reads


def test_implausible_temperature_and_cell_voltages_of_a_text_line_are_dropped_and_counted() -> None:
    decoder = TextProtocol()
    block = decoder.feed(0.0, b"\nV=7.2 I=1 T=1e308 cells=3.6,1e308\nV=7.2 I=1 T=25 cells=3.6,3.6\n")
    assert block["temperature_c"].tolist() == pytest.approx([math.nan, 25.0], nan_ok=True)
    assert decoder.cells[0].tolist() == pytest.approx([3.6, math.nan], nan_ok=True)
    assert (decoder.counters["implausible"], decoder.counters["implausible_cells"]) == (1, 1)


def test_implausible_temperature_of_a_board_is_dropped_and_counted() -> None:
    """The NTC's beta value is far too small, which gives a temperature outside the plausible range."""
    decoder = BoardProtocol()
    ntc_samples = [encode_sample(i, 10_000 * (i + 1), aux_sum=60, status=NTC_STATUS) for i in range(3)]
    block = decoder.feed(0.0, encode_hello(ntc_beta_k=200) + b"".join(ntc_samples))
    assert np.isnan(block["temperature_c"]).all()
    assert decoder.counters["implausible"] == 3


@pytest.mark.parametrize(("protocol", "recorded", "used"), [("jbd", 2, None), ("daly", 2, 2), ("daly", 200, None)])
def test_a_recorded_address_that_settings_reject_is_ignored(
    tmp_path: Path, protocol: str, recorded: int, used: int | None
) -> None:
    path, sensor = tmp_path / "capture.bms", SensorSettings.model_validate({"protocol": protocol})
    CaptureWriter(path, replace(make_header(sensor), address=recorded)).close()
    assert read_sensor_settings(path).address == used
