"""Polled BMS: published responses are decoded as by their publishers, bad bytes are counted, polls keep their
period."""

import itertools
from typing import cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bms_estimator.model.sample import NO_CELLS, SampleBlock
from bms_estimator.protocols.base.polled_protocol import (
    MAX_UNANSWERED_CYCLES,
    POLL_CYCLE_S,
    QUERY_INTERVAL_S,
    PolledProtocol,
)
from bms_estimator.protocols.devices import daly, jbd, jk
from bms_estimator.protocols.devices.daly import with_checksum
from bms_estimator.protocols.registry import make_protocol
from bms_estimator.settings.sensor import SensorSettings
from tests.protocols import bms_frames as frames
from tests.protocols.bms_frames import PUBLISHED, Published

PROTOCOLS = ("jbd", "daly", "jk")
FAULTS = ("crc_errors", "length_errors", "short_frames", "noise_bytes", "refused", "other_packs", "implausible")
A_ROUND = {name: PUBLISHED[name].frames for name in ("jbd", "daly", "jk_old", "jk_newer")}
OF = {"jbd": "jbd", "daly": "daly", "jk_old": "jk", "jk_newer": "jk"}

damaged = st.tuples(st.sampled_from(sorted(PUBLISHED)), st.integers(0, 400), st.integers(0, 255)).map(
    lambda how: bytes(
        how[2] if i == how[1] else byte
        for i, byte in enumerate(PUBLISHED[how[0]].frames)  # one byte is another
    )
)
cut_short = st.tuples(st.sampled_from(sorted(PUBLISHED)), st.integers(0, 400)).map(
    lambda how: PUBLISHED[how[0]].frames[: how[1]]
)
starts = st.sampled_from(
    [b"\xdd", b"\xdd\x03\x00", b"\xa5\x01\x95\x08", b"\xa5", b"NW\x01\xff", jk.START, jk.START + b"\x02"]
)
streams = st.lists(
    st.binary(max_size=30) | starts | damaged | cut_short | st.sampled_from([p.frames for p in PUBLISHED.values()]),
    max_size=8,
).map(b"".join)


def decoder(protocol: str, **options: object) -> PolledProtocol:
    return cast("PolledProtocol", make_protocol(SensorSettings.model_validate({"protocol": protocol, **options})))


def fed(decoder: PolledProtocol, *reads: bytes, arrival_s: float = 1.0) -> tuple[SampleBlock, list[list[float]]]:
    """Return samples of reads that arrive at once, and their cells."""
    blocks, cells = [], []
    for read in reads:
        blocks.append(decoder.feed(arrival_s, read))
        cells += [[v for v in row if v == v] for row in decoder.cells.tolist()] or [[]] * blocks[-1].size
    return np.concatenate(blocks), cells


def faults(decoder: PolledProtocol) -> dict[str, int]:
    return {name: count for name in FAULTS if (count := decoder.counters[name])}


@pytest.mark.parametrize("published", PUBLISHED.values(), ids=list(PUBLISHED))
def test_published_response_is_decoded_as_by_its_publisher(published: Published) -> None:
    device = decoder(published.protocol)
    (sample,), cells = fed(device, published.frames)
    assert sample["voltage_v"] == published.voltage_v
    assert sample["current_a"] == published.current_a
    assert sample["temperature_c"] == pytest.approx(published.temperature_c, abs=1e-3)
    assert cells == [published.cells_v]
    assert device.description == published.described
    assert (device.fault, faults(device)) == (None, {})
    assert device.counters["bytes_received"] == len(published.frames)


@settings(max_examples=200)
@given(st.sampled_from(PROTOCOLS), streams, st.lists(st.integers(0, 3000), max_size=8))
def test_no_bytes_raise_and_the_division_into_reads_changes_no_value(
    protocol: str, data: bytes, cuts: list[int]
) -> None:
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    whole, cut = decoder(protocol), decoder(protocol)
    block, cells = fed(whole, data)
    cut_block, cut_cells = fed(cut, *(data[a:b] for a, b in itertools.pairwise(edges)))
    for name in ("voltage_v", "current_a", "temperature_c"):
        assert block[name].tobytes() == cut_block[name].tobytes()
    assert cells == cut_cells
    assert whole.counters["frames_received"] == block.size
    for device in (whole, cut):
        assert 0 <= device.counters["noise_bytes"] <= len(data)
        device.next_output(2.0)
        _ = device.description, device.fault


@pytest.mark.parametrize("name", A_ROUND)
def test_an_answer_with_one_wrong_byte_is_no_sample_and_the_next_one_is(name: str) -> None:
    good = A_ROUND[name]
    last = 300 if name == "jk_newer" else 12  # of the answer that makes the sample
    for back in range(2, last):
        device = decoder(OF[name])
        bad = bytearray(good)
        bad[len(good) - back - 8 * (name == "jk_newer")] ^= 0x55
        assert fed(device, bytes(bad))[0].size == 0
        assert device.counters["crc_errors"] + device.counters["length_errors"] + device.counters["noise_bytes"] > 0
        assert fed(device, good)[0].size == 1
        assert device.fault is None


def test_wrong_checksum_is_counted_and_reported() -> None:
    device = decoder("jbd")
    fed(device, frames.JBD_BASIC[:-3] + b"\0\0\x77")
    assert device.counters["crc_errors"] == 1
    assert "wrong checksums" in (device.fault or "")
    fed(device, frames.JBD_BASIC)
    assert device.fault is None


@pytest.mark.parametrize("name", A_ROUND)
def test_truncated_response_is_dropped_when_the_next_one_arrives(name: str) -> None:
    good = A_ROUND[name]
    device = decoder(OF[name])
    assert fed(device, good[: len(good) - 20])[0].size == 0
    block, _ = fed(device, good)
    assert block["voltage_v"].tolist() == [PUBLISHED[name].voltage_v]
    assert device.counters["short_frames"] + device.counters["crc_errors"] == 1
    assert device.counters["noise_bytes"] > 0


def test_response_with_an_invalid_length_blocks_nothing() -> None:
    for protocol, long in (
        ("jbd", b"\xdd\x03\x00\xff"),
        ("daly", b"\xa5\x01\x90\x09"),
        ("jk", b"NW\x7f\xff" + bytes(8)),
    ):
        device = decoder(protocol)
        fed(device, long)
        assert device.counters["length_errors"] == 1
        assert "invalid lengths" in (device.fault or "")
        assert fed(device, PUBLISHED[protocol if protocol != "jk" else "jk_old"].frames)[0].size == 1


@pytest.mark.parametrize("name", A_ROUND)
def test_noise_between_answers_is_skipped_and_counted(name: str) -> None:
    noise = bytes(range(1, 60))
    device = decoder(OF[name])
    assert fed(device, noise, A_ROUND[name], noise[:40], A_ROUND[name])[0].size == 2
    assert faults(device) == {"noise_bytes": 99}


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_bytes_of_another_device_are_reported(protocol: str) -> None:
    device = decoder(protocol)
    fed(device, 20 * b"V=13.2 I=4.1\r\n")
    assert "wrong baud rate, or another sensor.protocol?" in (device.fault or "")


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_echoed_requests_are_no_responses(protocol: str) -> None:
    device = decoder(protocol)
    for tick in range(100):
        block = device.feed(0.1 * tick, device.next_output(0.1 * tick))
        assert block.size == 0
    assert device.description is None
    assert device.counters["crc_errors"] == 0


def test_old_cells_are_not_attached() -> None:
    device = decoder("jbd")
    assert fed(device, frames.JBD_CELLS, frames.JBD_BASIC)[1] == [frames.JBD.cells_v]
    device.feed(10.0, frames.JBD_BASIC)
    assert device.cells is NO_CELLS or np.isnan(device.cells).all()


def test_request_rejected_by_jbd_is_reported() -> None:
    device = decoder("jbd")
    fed(device, bytes((0xDD, 0x03, 0x80, 0)) + jbd.checksum(b"\x80\0") + b"\x77")
    assert device.counters["refused"] == 1
    assert "rejects a request of register 0x03" in (device.fault or "")


def test_jbd_without_a_probe_has_no_temperature() -> None:
    (sample,), _ = fed(decoder("jbd"), frames.JBD_UNWIRED)
    assert np.isnan(sample["temperature_c"])
    assert sample["voltage_v"] == 0.0


def test_lost_daly_frame_loses_only_its_three_cells() -> None:
    device = decoder("daly")
    lost = frames.DALY_CELLS[:13] + frames.DALY_CELLS[26:]
    device.feed(1.0, frames.DALY_STATUS + lost + frames.DALY_PACK)
    np.testing.assert_equal(device.cells[0, :7], [3.383, 3.382, 3.380, np.nan, np.nan, np.nan, 3.380])
    assert device.cells.shape == (1, 16)


def test_daly_that_numbers_its_frames_from_zero_is_understood() -> None:
    device = decoder("daly")
    cells = b"".join(
        with_checksum(frames.DALY_CELLS[i : i + 4] + bytes((i // 13,)) + frames.DALY_CELLS[i + 5 : i + 12])
        for i in range(0, len(frames.DALY_CELLS), 13)
    )
    _, told = fed(device, frames.DALY_STATUS + cells + frames.DALY_PACK)
    assert told == [frames.DALY.cells_v]


def test_daly_without_cell_count_reports_its_cells() -> None:
    assert fed(decoder("daly"), frames.DALY_CELLS + frames.DALY_PACK)[1] == [frames.DALY.cells_v]


@pytest.mark.parametrize(
    ("version", "raw", "current_a"),
    [(1, 0x07D0, 20.0), (1, 0x87D0, -20.0), (0, 11000, 10.0), (0, 9500, -5.0)],
    ids=["discharge of 20 A", "charge of 20 A", "version 0, discharge of 10 A", "version 0, charge of 5 A"],
)
def test_older_jk_current_encodings(version: int, raw: int, current_a: float) -> None:
    """The four examples of JK's document."""
    frame = frames.JK_OLD.frames[:-4].replace(b"\x84\x80\xd0", b"\x84" + raw.to_bytes(2, "big"))
    frame = frame.replace(b"\xc0\x01", bytes((0xC0, version)))
    (sample,), _ = fed(decoder("jk"), jk.with_old_checksum(frame))
    assert sample["current_a"] == current_a


def test_older_jk_encodes_negative_temperatures_above_100() -> None:
    frame = (
        frames.JK_OLD.frames[:-4].replace(b"\x81\x00\x1e", b"\x81\x00\x69").replace(b"\x82\x00\x1c", b"\x82\x00\x8c")
    )
    (sample,), _ = fed(decoder("jk"), jk.with_old_checksum(frame))
    assert sample["temperature_c"] == -5.0  # the other probe is not there


def newer(address: int, **values: int) -> bytes:
    """The newer frame with a voltage or current [mV, mA], of a pack."""
    frame = bytearray(frames.JK_NEWER_FRAME)
    for name, at in (("millivolts", 150), ("milliamperes", 158)):
        if name in values:
            frame[at : at + 4] = values[name].to_bytes(4, "little", signed=True)
    frame[299] = sum(frame[:299]) & 0xFF
    record = bytes((address, 0x10, 0x16, 0x20, 0, 1))
    return bytes(frame) + record + jk.crc16(record)


def test_the_newer_jk_is_positive_on_charge() -> None:
    (sample,), _ = fed(decoder("jk"), newer(0, milliamperes=-9241))
    assert sample["current_a"] == 9.241


def test_first_or_configured_pack_of_a_line_is_used() -> None:
    two = newer(0, millivolts=51_000) + newer(2, millivolts=52_000)
    first, told = decoder("jk"), decoder("jk", address=2)
    assert fed(first, two, two)[0]["voltage_v"].tolist() == [51.0, 51.0]
    assert fed(told, two, two)[0]["voltage_v"].tolist() == [52.0, 52.0]
    assert first.counters["other_packs"] == told.counters["other_packs"] == 2
    only = decoder("jk", address=5)
    fed(only, two)
    assert only.fault == "pack 0 responds, but pack 5 is selected: see sensor.address"


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_sign_of_the_current_is_as_the_settings_say(protocol: str) -> None:
    device = SensorSettings(protocol=protocol)
    other = {"discharge_positive": "charge_positive", "charge_positive": "discharge_positive"}[device.current_sign]
    published = {"jbd": frames.JBD_DISCHARGING, "daly": frames.DALY, "jk": frames.JK_OLD}[protocol]
    assert fed(decoder(protocol), published.frames)[0]["current_a"].tolist() == [published.current_a]
    assert fed(decoder(protocol, current_sign=other), published.frames)[0]["current_a"].tolist() == [
        -published.current_a
    ]


@pytest.mark.parametrize(("protocol", "baud"), [("jbd", 9600), ("daly", 9600), ("jk", 115_200), ("binary", 500_000)])
def test_baud_rate_is_that_of_the_protocol_unless_configured(protocol: str, baud: int) -> None:
    assert SensorSettings.model_validate({"protocol": protocol}).baud == baud
    assert SensorSettings.model_validate({"protocol": protocol, "baud": 19_200}).baud == 19_200


def questions(device: PolledProtocol, seconds: float, answer: bytes = b"") -> list[tuple[float, bytes]]:
    """Return the times of the requests, checked 20 times a second; each request gets a response."""
    asked = []
    for tick in range(round(20 * seconds)):
        now_s = tick / 20.0
        if question := device.next_output(now_s):
            asked.append((now_s, question))
            device.feed(now_s, answer)
    return asked


@pytest.mark.parametrize("name", ["jbd", "daly", "jk_old"])
def test_devices_are_polled_each_second_even_if_silent(name: str) -> None:
    asked = questions(decoder(OF[name]), 20.0, A_ROUND[name])
    assert min(np.diff([at_s for at_s, _ in asked])) >= QUERY_INTERVAL_S
    assert [question for _, question in asked].count(asked[-1][1]) == 20
    assert len(questions(decoder(OF[name]), 20.0)) >= 20


def test_known_properties_are_not_requested_again() -> None:
    asked = [question for _, question in questions(decoder("jbd"), 10.0, A_ROUND["jbd"])]
    assert asked.count(jbd.request(jbd.NAME)) == 1
    assert asked.count(jbd.request(jbd.BASIC)) == 10


def test_number_of_cells_is_requested_again_after_reopening() -> None:
    device = decoder("daly")
    status = daly.request(daly.HOSTS[0], daly.STATUS)
    assert [question for _, question in questions(device, 5.0, A_ROUND["daly"])].count(status) == 1
    device.on_port_opened()
    assert [question for _, question in questions(device, 5.0, A_ROUND["daly"])].count(status) == 1


def test_silence_selects_the_next_query_variant() -> None:
    asked = [question for _, question in questions(decoder("jk"), 20.0)]
    assert asked[: MAX_UNANSWERED_CYCLES + 1] == [jk.OLD_REQUEST] * (MAX_UNANSWERED_CYCLES + 1)
    assert {jk.request(1), jk.request(0)} < set(asked)
    assert {question for _, question in questions(decoder("jk", address=7), 20.0)} == {
        jk.OLD_REQUEST,
        jk.request(7),
    }
    assert {question[1] for _, question in questions(decoder("daly"), 20.0)} == {0x40, 0x80}


def test_answered_query_variant_is_kept() -> None:
    device = decoder("jk")
    questions(device, (MAX_UNANSWERED_CYCLES + 1.5) * POLL_CYCLE_S)
    answered = [device.next_output(100.0 + tick) for tick in range(20) if device.feed(100.0 + tick, newer(1)).size]
    assert set(answered) == {jk.request(1)}


def test_probing_sends_no_request_that_changes_a_device() -> None:
    for protocol in PROTOCOLS:
        device = decoder(protocol)
        device.probing = True
        for _, question in questions(device, 60.0):
            assert question[:2] in (b"\xdd\xa5", b"\xa5\x40", b"\xa5\x80", b"NW")
            assert question[:2] != b"NW" or question == jk.OLD_REQUEST


def test_line_with_another_master_is_not_polled() -> None:
    device = decoder("jk")
    device.feed(0.0, newer(0))
    asked = []
    for tick in range(300):  # the other has its answer every 6 s
        now_s = tick / 10.0
        asked.append(device.next_output(now_s))
        if tick % 60 == 0:
            assert device.feed(now_s, newer(0)).size == 1
    assert not any(asked)
    assert device.allowed_silence_s > 6.0
    assert device.next_output(60.0) == jk.OLD_REQUEST


def test_batch_of_reads_gives_the_same_samples_and_cells() -> None:
    for name, data in A_ROUND.items():
        reads = [data[i : i + 50] for i in range(0, len(data), 50)] * 2
        one, many = decoder(OF[name]), decoder(OF[name])
        blocks = [one.feed(float(i), read) for i, read in enumerate(reads)]
        ends = np.cumsum([len(read) for read in reads])
        block = many.feed_reads(np.arange(float(len(reads))), ends, np.frombuffer(2 * data, dtype=np.uint8))
        np.testing.assert_array_equal(block, np.concatenate(blocks))
        assert one.counters == many.counters
