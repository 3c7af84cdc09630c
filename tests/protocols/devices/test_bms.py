"""Polled BMS: values of published responses, counters of damaged responses, and times of the requests."""

import itertools
import math
from typing import cast

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from pydantic import ValidationError

from bms_estimator.model.arrays import NO_CELLS, SampleBlock
from bms_estimator.protocols.base.polled_protocol import (
    MAX_UNANSWERED_CYCLES,
    POLL_CYCLE_S,
    QUERY_INTERVAL_S,
    PolledProtocol,
)
from bms_estimator.protocols.base.reading_protocol import ECHO_FAULT
from bms_estimator.protocols.devices import daly, jbd, jk
from bms_estimator.protocols.devices.daly import with_checksum
from bms_estimator.protocols.registry import make_protocol
from bms_estimator.settings.sensor import SensorSettings
from tests.protocols import bms_frames as frames
from tests.protocols.bms_frames import PUBLISHED, PublishedCycle

PROTOCOLS = ("jbd", "daly", "jk")
ERROR_COUNTERS = (
    "crc_errors",
    "length_errors",
    "short_frames",
    "noise_bytes",
    "refused",
    "other_packs",
    "implausible",
    "implausible_cells",
)
POLL_CYCLES = {name: PUBLISHED[name].frames for name in ("jbd", "daly", "jk_old", "jk_newer")}
"""Responses of one poll cycle, by device."""
DALY_FRAME_BYTES = 13
LAST_RESPONSE_BYTES = 12
"""Number of bytes at the end of a poll cycle that belong to its last response, for all devices but the newer JK."""
PROTOCOL_OF = {"jbd": "jbd", "daly": "daly", "jk_old": "jk", "jk_newer": "jk"}

all_frames = st.sampled_from([published.frames for published in PUBLISHED.values()])
frames_with_a_changed_byte = st.builds(
    lambda data, at, value: bytes(value if i == at else byte for i, byte in enumerate(data)),
    all_frames,
    st.integers(0, 400),
    st.integers(0, 255),
)
truncated_frames = st.builds(lambda data, size: data[:size], all_frames, st.integers(0, 400))
frame_starts = st.sampled_from(
    [b"\xdd", b"\xdd\x03\x00", b"\xa5\x01\x95\x08", b"\xa5", b"NW\x01\xff", jk.START, jk.START + b"\x02"]
)
streams = st.lists(
    st.binary(max_size=30) | frame_starts | frames_with_a_changed_byte | truncated_frames | all_frames, max_size=8
).map(b"".join)


def make_decoder(protocol: str, **options: object) -> PolledProtocol:
    """Return the decoder for a protocol and further options of ``SensorSettings``."""
    return cast("PolledProtocol", make_protocol(SensorSettings.model_validate({"protocol": protocol, **options})))


def decode(decoder: PolledProtocol, *reads: bytes) -> tuple[SampleBlock, list[list[float]]]:
    """Return the samples of reads that arrive together, and their cell voltages."""
    blocks, cells = [], []
    for read in reads:
        blocks.append(decoder.feed(1.0, read))
        cells += [[v for v in row if not math.isnan(v)] for row in decoder.cells.tolist()] or [[]] * blocks[-1].size
    return np.concatenate(blocks), cells


def error_counts(decoder: PolledProtocol) -> dict[str, int]:
    """Return the error counters that are not zero."""
    return {name: count for name in ERROR_COUNTERS if (count := decoder.counters[name])}


@pytest.mark.parametrize("published", PUBLISHED.values(), ids=list(PUBLISHED))
def test_published_response_is_decoded_to_the_values_of_its_publisher(published: PublishedCycle) -> None:
    device = make_decoder(published.protocol)
    (sample,), cells = decode(device, published.frames)
    assert sample["voltage_v"] == published.voltage_v
    assert sample["current_a"] == published.current_a
    assert sample["temperature_c"] == pytest.approx(published.temperature_c, abs=1e-3)
    assert cells == [published.cells_v]
    assert device.description == published.description
    assert (device.fault, error_counts(device)) == (None, {})
    assert device.counters["bytes_received"] == len(published.frames)


@settings(max_examples=200)
@given(st.sampled_from(PROTOCOLS), streams, st.lists(st.integers(0, 3000), max_size=8))
def test_no_bytes_raise_and_chunk_boundaries_do_not_change_the_values(
    protocol: str, data: bytes, cuts: list[int]
) -> None:
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    whole_decoder, cut_decoder = make_decoder(protocol), make_decoder(protocol)
    block, cells = decode(whole_decoder, data)
    cut_block, cut_cells = decode(cut_decoder, *(data[a:b] for a, b in itertools.pairwise(edges)))
    for name in ("voltage_v", "current_a", "temperature_c"):
        assert block[name].tobytes() == cut_block[name].tobytes()
    assert cells == cut_cells
    assert whole_decoder.counters["frames_received"] == block.size
    for device in (whole_decoder, cut_decoder):
        assert 0 <= device.counters["noise_bytes"] <= len(data)
        device.next_output(2.0)
        _ = device.description, device.fault  # neither may raise


@pytest.mark.parametrize("name", POLL_CYCLES)
def test_response_with_one_changed_byte_is_rejected_and_the_next_one_decoded(name: str) -> None:
    valid = POLL_CYCLES[name]
    # Only bytes of the last response are changed, because it completes the sample. On the newer JK a record follows it.
    is_newer_jk = name == "jk_newer"
    response_bytes = len(frames.JK_NEWER_FRAME) if is_newer_jk else LAST_RESPONSE_BYTES
    response_end = len(valid) - (len(frames.JK_RECORD_OF_PACK_2) if is_newer_jk else 0)
    for distance_from_end in range(2, response_bytes):
        device = make_decoder(PROTOCOL_OF[name])
        damaged = bytearray(valid)
        damaged[response_end - distance_from_end] ^= 0x55
        assert decode(device, bytes(damaged))[0].size == 0
        assert device.counters["crc_errors"] + device.counters["length_errors"] + device.counters["noise_bytes"] > 0
        assert decode(device, valid)[0].size == 1
        assert device.fault is None


def test_wrong_checksum_is_counted_and_reported_until_a_valid_response() -> None:
    device = make_decoder("jbd")
    decode(device, frames.JBD_BASIC[:-3] + b"\0\0\x77")  # checksum 0, and the end byte
    assert device.counters["crc_errors"] == 1
    assert "wrong checksums" in (device.fault or "")
    decode(device, frames.JBD_BASIC)
    assert device.fault is None


@pytest.mark.parametrize("name", POLL_CYCLES)
def test_truncated_response_is_dropped_when_the_next_one_arrives(name: str) -> None:
    valid = POLL_CYCLES[name]
    device = make_decoder(PROTOCOL_OF[name])
    assert decode(device, valid[:-20])[0].size == 0
    block, _ = decode(device, valid)
    assert block["voltage_v"].tolist() == [PUBLISHED[name].voltage_v]
    assert device.counters["short_frames"] + device.counters["crc_errors"] == 1
    assert device.counters["noise_bytes"] > 0


@pytest.mark.parametrize(
    ("name", "response"),
    [("jbd", b"\xdd\x03\x00\xff"), ("daly", b"\xa5\x01\x90\x09"), ("jk_old", b"NW\x7f\xff" + bytes(8))],
)
def test_invalid_length_is_reported_and_the_next_response_decoded(name: str, response: bytes) -> None:
    device = make_decoder(PROTOCOL_OF[name])
    decode(device, response)
    assert device.counters["length_errors"] == 1
    assert "invalid lengths" in (device.fault or "")
    assert decode(device, POLL_CYCLES[name])[0].size == 1


@pytest.mark.parametrize("name", POLL_CYCLES)
def test_noise_between_responses_is_skipped_and_counted(name: str) -> None:
    noise = bytes(range(1, 60))
    device = make_decoder(PROTOCOL_OF[name])
    assert decode(device, noise, POLL_CYCLES[name], noise[:40], POLL_CYCLES[name])[0].size == 2
    assert error_counts(device) == {"noise_bytes": len(noise) + 40}


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_bytes_of_another_device_are_reported(protocol: str) -> None:
    device = make_decoder(protocol)
    decode(device, 20 * b"V=13.2 I=4.1\r\n")
    assert "wrong baud rate, or another sensor.protocol?" in (device.fault or "")


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_echoed_requests_are_not_decoded_as_responses(protocol: str) -> None:
    device = make_decoder(protocol)
    for tick in range(100):
        block = device.feed(0.1 * tick, device.next_output(0.1 * tick))
        assert block.size == 0
    assert device.description is None
    assert device.counters["crc_errors"] == 0


def test_cell_voltages_received_long_before_a_sample_are_not_attached_to_it() -> None:
    device = make_decoder("jbd")
    assert decode(device, frames.JBD_CELLS, frames.JBD_BASIC)[1] == [frames.JBD.cells_v]
    device.feed(10.0, frames.JBD_BASIC)
    assert device.cells is NO_CELLS or np.isnan(device.cells).all()


def test_request_rejected_by_jbd_is_reported() -> None:
    device = make_decoder("jbd")
    status_error, no_data = b"\x80", b"\0"
    decode(device, b"\xdd\x03" + status_error + no_data + jbd.checksum(status_error + no_data) + b"\x77")
    assert device.counters["refused"] == 1
    assert "rejects a request of register 0x03" in (device.fault or "")


def test_temperature_of_a_jbd_without_probes_is_nan() -> None:
    (sample,), _ = decode(make_decoder("jbd"), frames.JBD_WITHOUT_PROBES)
    assert np.isnan(sample["temperature_c"])
    assert sample["voltage_v"] == 0.0


def test_without_one_daly_frame_only_its_three_cells_are_nan() -> None:
    device = make_decoder("daly")
    without_second_frame = frames.DALY_CELLS[:DALY_FRAME_BYTES] + frames.DALY_CELLS[2 * DALY_FRAME_BYTES :]
    device.feed(1.0, frames.DALY_STATUS + without_second_frame + frames.DALY_PACK)
    np.testing.assert_equal(device.cells[0, :7], [3.383, 3.382, 3.380, np.nan, np.nan, np.nan, 3.380])
    assert device.cells.shape == (1, 16)


def test_daly_frames_numbered_from_zero_are_decoded() -> None:
    device = make_decoder("daly")
    cell_frames = b"".join(
        with_checksum(frame[:4] + bytes((number,)) + frame[5:-1])
        for number, frame in enumerate(
            frames.DALY_CELLS[i : i + DALY_FRAME_BYTES] for i in range(0, len(frames.DALY_CELLS), DALY_FRAME_BYTES)
        )
    )
    _, cells = decode(device, frames.DALY_STATUS + cell_frames + frames.DALY_PACK)
    assert cells == [frames.DALY.cells_v]


def test_daly_whose_cell_count_was_not_received_reports_its_cells() -> None:
    assert decode(make_decoder("daly"), frames.DALY_CELLS + frames.DALY_PACK)[1] == [frames.DALY.cells_v]


@pytest.mark.parametrize(
    ("version", "raw", "current_a"),
    [(1, 0x07D0, 20.0), (1, 0x87D0, -20.0), (0, 11000, 10.0), (0, 9500, -5.0)],
    ids=["discharge of 20 A", "charge of 20 A", "version 0, discharge of 10 A", "version 0, charge of 5 A"],
)
def test_older_jk_current_is_decoded_by_the_version_of_its_protocol(version: int, raw: int, current_a: float) -> None:
    """The values are the four examples in JK's description of the protocol."""
    frame = frames.JK_OLD.frames[:-4].replace(b"\x84\x80\xd0", b"\x84" + raw.to_bytes(2, "big"))  # register 0x84
    frame = frame.replace(b"\xc0\x01", bytes((0xC0, version)))  # register 0xC0: version of the protocol
    (sample,), _ = decode(make_decoder("jk"), jk.with_old_checksum(frame))
    assert sample["current_a"] == current_a


def test_older_jk_temperature_above_100_is_negative() -> None:
    raw_of_registers = {b"\x81\x00\x1e": b"\x81\x00\x69", b"\x82\x00\x1c": b"\x82\x00\x8c"}  # 105 and 140
    frame = frames.JK_OLD.frames[:-4]
    for published, changed in raw_of_registers.items():
        frame = frame.replace(published, changed)
    (sample,), _ = decode(make_decoder("jk"), jk.with_old_checksum(frame))
    assert sample["temperature_c"] == -5.0  # 105 means -5 degC; 140 means that the other probe is not connected


@pytest.mark.parametrize(("byte", "celsius"), [(99, 99.0), (100, 0.0), (101, -1.0)])
def test_byte_100_of_an_older_jk_is_minus_zero(byte: int, celsius: float) -> None:
    frame = frames.JK_OLD.frames[:-4].replace(b"\x82\x00\x1c", bytes((0x82, 0, byte)))
    device = make_decoder("jk")
    decode(device, jk.with_old_checksum(frame))
    assert device.probes["temperature_c"].tolist() == [[30.0, celsius]]


def with_hot_probe(protocol: str) -> bytes:
    """Return the published responses of a device with one of its probes at 90 degC."""
    match protocol:
        case "jbd":
            data = bytearray(frames.JBD_BASIC)
            data[-5:-3] = (jbd.ZERO_C + 900).to_bytes(2, "big")  # the last probe
            data[-3:-1] = jbd.checksum(data[2:-3])
            return bytes(data)
        case "daly":
            raw = bytes(daly.ZERO_C + celsius for celsius in (21, 21, 90, 22))
            body = bytes((daly.START, 0x01, daly.PROBES, 8, 1)) + raw + bytes(daly.PROBES_PER_FRAME - len(raw))
            return with_checksum(body) + frames.DALY_PACK
        case "jk_old":
            return jk.with_old_checksum(frames.JK_OLD.frames[:-4].replace(b"\x82\x00\x1c", b"\x82\x00\x5a"))
        case _:
            return newer_jk_response(0, deci_c_of_probe_5=900)


@pytest.mark.parametrize(
    ("name", "coldest_c"),
    [("jbd", 22.3), ("daly", 21.0), ("jk_old", 30.0), ("jk_newer", 17.7)],
    ids=lambda value: value,
)
def test_hottest_and_coldest_probe_are_part_of_the_sample(name: str, coldest_c: float) -> None:
    (sample,), _ = decode(make_decoder(PROTOCOL_OF[name]), with_hot_probe(name))
    assert (sample["temperature_max_c"], sample["temperature_min_c"]) == (90.0, coldest_c)


def test_probes_of_a_newer_jk_have_the_numbers_of_its_maker() -> None:
    device = make_decoder("jk")
    decode(device, frames.JK_NEWER.frames)
    np.testing.assert_equal(device.probes["temperature_c"], [[17.7, 17.7, np.nan, 17.9, 18.0]])
    decode(device, newer_jk_response(2, probe_bits=0b110))  # an older board
    np.testing.assert_equal(device.probes["temperature_c"], [[17.7, 17.7, np.nan, np.nan, np.nan]])


@pytest.mark.parametrize(
    ("name", "soc", "remaining_ah", "capacity_ah"),
    [
        ("jbd", 1.0, 4.98, 5.0),
        ("daly", 0.922, math.nan, math.nan),
        ("jk_old", 0.15, math.nan, 14.0),
        ("jk_newer", 0.52, 1.043, 2.0),
    ],
)
def test_soc_and_capacity_by_the_bms_are_decoded(
    name: str, soc: float, remaining_ah: float, capacity_ah: float
) -> None:
    device = make_decoder(PROTOCOL_OF[name])
    decode(device, PUBLISHED[name].frames)
    assert device.last_reading is not None
    assert device.last_reading[-3:] == pytest.approx((soc, remaining_ah, capacity_ah), nan_ok=True)


def newer_jk_response(address: int, **values: int) -> bytes:
    """Return the newer response of the pack with this address, with its ``millivolts``, ``milliamperes``, bits of the connected
    probes or temperature of probe 5 if given."""
    frame = bytearray(frames.JK_NEWER_FRAME)
    frame[214] = values.get("probe_bits", frame[214])
    if "deci_c_of_probe_5" in values:
        frame[258:260] = values["deci_c_of_probe_5"].to_bytes(2, "little")
    for name, offset in (("millivolts", 150), ("milliamperes", 158)):
        if name in values:
            frame[offset : offset + 4] = values[name].to_bytes(4, "little", signed=True)
    frame[-1] = sum(frame[:-1]) & 0xFF
    record = bytes((address, 0x10, 0x16, 0x20, 0, 1))  # as JK_RECORD_OF_PACK_2, with this address
    return bytes(frame) + record + jk.crc16(record)


def test_current_of_the_newer_jk_is_positive_on_charge() -> None:
    (sample,), _ = decode(make_decoder("jk"), newer_jk_response(0, milliamperes=-9241))
    assert sample["current_a"] == 9.241  # samples are positive on discharge


def test_of_several_packs_on_a_line_the_configured_one_or_else_the_first_is_used() -> None:
    responses = newer_jk_response(0, millivolts=51_000) + newer_jk_response(2, millivolts=52_000)
    without_address, with_address = make_decoder("jk"), make_decoder("jk", address=2)
    assert decode(without_address, responses, responses)[0]["voltage_v"].tolist() == [51.0, 51.0]
    assert decode(with_address, responses, responses)[0]["voltage_v"].tolist() == [52.0, 52.0]
    assert without_address.counters["other_packs"] == with_address.counters["other_packs"] == 2
    with_absent_address = make_decoder("jk", address=5)
    decode(with_absent_address, responses)
    assert with_absent_address.fault == "pack 0 responds, but pack 5 is selected: see sensor.address"


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_configured_sign_of_the_current_is_used(protocol: str) -> None:
    default_sign = SensorSettings(protocol=protocol).current_sign
    opposite_sign = "charge_positive" if default_sign == "discharge_positive" else "discharge_positive"
    published = {"jbd": frames.JBD_DISCHARGING, "daly": frames.DALY, "jk": frames.JK_OLD}[protocol]
    (default_sample,), _ = decode(make_decoder(protocol), published.frames)
    assert default_sample["current_a"] == published.current_a
    (opposite_sample,), _ = decode(make_decoder(protocol, current_sign=opposite_sign), published.frames)
    assert opposite_sample["current_a"] == -published.current_a


@pytest.mark.parametrize(("protocol", "baud"), [("jbd", 9600), ("daly", 9600), ("jk", 115_200), ("binary", 500_000)])
def test_baud_rate_is_that_of_the_protocol_unless_configured(protocol: str, baud: int) -> None:
    assert SensorSettings.model_validate({"protocol": protocol}).baud == baud
    assert SensorSettings.model_validate({"protocol": protocol, "baud": 19_200}).baud == 19_200


def poll(device: PolledProtocol, seconds: float, response: bytes = b"") -> list[tuple[float, bytes]]:
    """Poll a device, with 20 ticks a second, and respond to each request with ``response``.

    Return the times of the requests [s], and the requests.
    """
    times_and_requests = []
    for tick in range(round(20 * seconds)):
        now_s = tick / 20.0
        if request := device.next_output(now_s):
            times_and_requests.append((now_s, request))
            device.feed(now_s, response)
    return times_and_requests


def poll_requests(device: PolledProtocol, seconds: float, response: bytes = b"") -> list[bytes]:
    """Poll a device as ``poll`` does, and return the requests without their times."""
    return [request for _, request in poll(device, seconds, response)]


@pytest.mark.parametrize("name", ["jbd", "daly", "jk_old"])
def test_device_is_polled_each_second_whether_it_responds_or_not(name: str) -> None:
    times_s, requests = zip(*poll(make_decoder(PROTOCOL_OF[name]), 20.0, POLL_CYCLES[name]), strict=True)
    assert min(np.diff(times_s)) >= QUERY_INTERVAL_S
    assert requests.count(requests[-1]) == 20
    requests_to_silent_device = poll(make_decoder(PROTOCOL_OF[name]), 20.0)
    assert len(requests_to_silent_device) >= 20


def test_name_of_a_jbd_is_requested_only_once() -> None:
    requests = poll_requests(make_decoder("jbd"), 10.0, POLL_CYCLES["jbd"])
    assert requests.count(jbd.request(jbd.NAME)) == 1
    assert requests.count(jbd.request(jbd.BASIC)) == 10


def test_number_of_cells_of_a_daly_is_requested_once_and_again_after_reopening() -> None:
    device = make_decoder("daly")
    status_request = daly.request(daly.HOSTS[0], daly.STATUS)
    assert poll_requests(device, 5.0, POLL_CYCLES["daly"]).count(status_request) == 1
    device.on_port_opened()
    assert poll_requests(device, 5.0, POLL_CYCLES["daly"]).count(status_request) == 1


def test_next_request_variant_is_tried_after_unanswered_poll_cycles() -> None:
    requests = poll_requests(make_decoder("jk"), 20.0)
    assert requests[: MAX_UNANSWERED_CYCLES + 1] == [jk.OLD_REQUEST] * (MAX_UNANSWERED_CYCLES + 1)
    assert {jk.request(1), jk.request(0)} < set(requests)
    assert set(poll_requests(make_decoder("jk", address=7), 20.0)) == {jk.OLD_REQUEST, jk.request(7)}
    assert {request[1] for request in poll_requests(make_decoder("daly"), 20.0)} == set(daly.HOSTS)


@pytest.mark.parametrize(("address", "hosts"), [(None, {0x40, 0x80}), (1, {0x40, 0x80}), (2, {0x41}), (15, {0x4E})])
def test_board_number_of_a_daly_reaches_the_requests(address: int | None, hosts: set[int]) -> None:
    requests = poll_requests(make_decoder("daly", address=address), 20.0)
    assert {request[1] for request in requests} == hosts


def test_a_daly_with_another_board_number_is_read() -> None:
    device = make_decoder("daly", address=2)
    response = daly.with_checksum(bytes((0xA5, 2)) + frames.DALY_PACK[2:-1])
    assert decode(device, response)[0]["voltage_v"].tolist() == [53.0]
    assert decode(device, frames.DALY_PACK)[0].size == 0
    assert device.fault == "pack 1 responds, but pack 2 is selected: see sensor.address"


@pytest.mark.parametrize("protocol", ["binary", "jbd", "junctek", "pylontech", "text", "vedirect"])
def test_an_address_is_rejected_for_a_protocol_without_addresses(protocol: str) -> None:
    with pytest.raises(ValidationError, match=f"the protocol {protocol} has no addresses; remove address"):
        SensorSettings.model_validate({"protocol": protocol, "address": 2})


@pytest.mark.parametrize("address", [0, 64])
def test_a_board_number_beyond_the_protocol_is_rejected(address: int) -> None:
    with pytest.raises(ValidationError, match="daly has addresses 1 to 63"):
        SensorSettings.model_validate({"protocol": "daly", "address": address})


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("split", [1, 7, 1000])
def test_own_requests_that_the_adapter_returns_are_named(protocol: str, split: int) -> None:
    device = make_decoder(protocol)
    for tick in range(200):
        request = device.next_output(tick / 20.0)
        for at in range(0, len(request), split):
            device.feed(tick / 20.0, request[at : at + split])
    assert device.fault == ECHO_FAULT
    published = {"jbd": frames.JBD, "daly": frames.DALY, "jk": frames.JK_OLD}[protocol]
    assert decode(device, published.frames)[0].size == 1
    assert device.fault is None


def test_request_variant_that_got_a_response_is_used_from_then_on() -> None:
    device = make_decoder("jk")
    poll(device, (MAX_UNANSWERED_CYCLES + 1.5) * POLL_CYCLE_S)
    requests = set[bytes]()
    for second in range(20):
        now_s = 100.0 + second
        assert device.feed(now_s, newer_jk_response(1)).size
        requests.add(device.next_output(now_s))
    assert requests == {jk.request(1)}


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_probing_sends_no_request_that_changes_a_device(protocol: str) -> None:
    device = make_decoder(protocol)
    device.probing = True
    for request in poll_requests(device, 60.0):
        assert request[:2] in (
            b"\xdd\xa5",
            b"\xa5\x40",
            b"\xa5\x80",
            b"NW",
        )  # reads of JBD, Daly (two hosts) and old JK
        assert request[:2] != b"NW" or request == jk.OLD_REQUEST


def test_line_with_another_master_is_not_polled() -> None:
    device = make_decoder("jk")
    device.feed(0.0, newer_jk_response(0))
    requests = []
    for tick in range(300):
        now_s = tick / 10.0
        requests.append(device.next_output(now_s))
        if tick % 60 == 0:  # every 6 s the device responds to the other master
            assert device.feed(now_s, newer_jk_response(0)).size == 1
    assert not any(requests)
    assert device.allowed_silence_s > 6.0
    assert device.next_output(60.0) == jk.OLD_REQUEST  # the other master has been silent for 36 s


def test_reads_decoded_as_a_batch_give_the_same_samples_as_one_by_one() -> None:
    for name, data in POLL_CYCLES.items():
        reads = [data[i : i + 50] for i in range(0, len(data), 50)] * 2
        single_reads_decoder, batch_decoder = make_decoder(PROTOCOL_OF[name]), make_decoder(PROTOCOL_OF[name])
        blocks = [single_reads_decoder.feed(float(i), read) for i, read in enumerate(reads)]
        ends = np.cumsum([len(read) for read in reads])
        arrivals_s = np.arange(float(len(reads)))
        batch_block = batch_decoder.feed_reads(arrivals_s, ends, np.frombuffer(2 * data, dtype=np.uint8))
        np.testing.assert_array_equal(batch_block, np.concatenate(blocks))
        assert single_reads_decoder.counters == batch_decoder.counters


def test_daly_without_probe_count_averages_probes_at_and_below_zero() -> None:
    temperatures_c = (21, 0, -9)
    raw = bytes(daly.ZERO_C + celsius for celsius in temperatures_c)
    probes = with_checksum(bytes((daly.START, 0x01, daly.PROBES, 8, 1)) + raw + bytes(daly.PROBES_PER_FRAME - len(raw)))
    [sample], _ = decode(make_decoder("daly"), probes + frames.DALY_PACK)
    assert sample["temperature_c"] == 4.0
