"""CAN source on python-can's virtual bus, on a simulated slcan adapter behind a PTY, and on the kernel's vcan."""

import asyncio
import json
import subprocess
import time
from collections.abc import AsyncGenerator, Iterator
from contextlib import aclosing

import can
import pytest

from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.reading import CONNECTED
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sources.fieldbus import CanSource
from bms_estimator.sources.factory import open_source
from bms_estimator.sources.fieldbus.can import BUS_OFF_BIT, CanProducer
from bms_estimator.sources.source import SourceUnavailableError
from tests.patience import LONG_S, until
from tests.serial_line import Line

PYLONTECH_FRAME = can.Message(arbitration_id=0x356, is_extended_id=False, data=bytes.fromhex("721485ffd700"))
"""Frame with 52.34 V, -12.3 A (charge is positive) and 21.5 degC."""
SLCAN_FRAME = b"t3566721485FFD700\r"
"""Frame ``PYLONTECH_FRAME`` in the format of an slcan adapter."""
PYLONTECH_SAMPLE = {"voltage_v": 52.34, "current_a": -12.3, "temperature_c": 21.5}
"""Content of the line that the source yields for the frame."""


def source(**options: object) -> CanSource:
    return CanSource.model_validate({"kind": "can", "profile": "pylontech-can"} | options)


def slcan_source(line: Line) -> CanSource:
    return source(interface="slcan", channel=str(line.path), options={"sleep_after_open": 0.0})


async def next_line(lines: AsyncGenerator[bytes, None]) -> bytes:
    async with asyncio.timeout(LONG_S):
        return await anext(lines)


@pytest.fixture
def channel(request: pytest.FixtureRequest) -> str:
    """Return the name of a channel that no other test uses."""
    return str(request.node.name)


@pytest.fixture
def sender(channel: str) -> Iterator[can.BusABC]:
    """Return the battery's end of the virtual bus."""
    with can.Bus(interface="virtual", channel=channel, ignore_config=True) as bus:
        yield bus


async def test_of_several_frames_only_the_valid_one_with_the_identifier_of_the_profile_gives_a_line(
    channel: str, sender: can.BusABC
) -> None:
    producer = CanProducer(source(interface="virtual", channel=channel))
    async with aclosing(producer.iter_lines()) as lines:
        assert await next_line(lines) == CONNECTED
        assert producer.fault is not None
        assert "source.voltage (frame 0x356)" in producer.fault
        for message in (
            can.Message(arbitration_id=0x355, is_extended_id=False, data=b"\x64\x00\x63\x00"),
            can.Message(arbitration_id=0x356, is_extended_id=True, data=PYLONTECH_FRAME.data),
            can.Message(arbitration_id=0x356, is_extended_id=False, is_remote_frame=True, dlc=6),
            can.Message(arbitration_id=0x356, is_extended_id=False, data=b"\x72\x14"),
            PYLONTECH_FRAME,
        ):
            sender.send(message)
        assert json.loads(await next_line(lines)) == PYLONTECH_SAMPLE | {"device_soc": 1.0}
    assert producer.counters == {"short_frames": 1, "not_measured": 0, "error_frames": 0, "junk": 0}


async def test_bus_off_is_reported_until_the_next_valid_frame(channel: str, sender: can.BusABC) -> None:
    producer = CanProducer(source(interface="virtual", channel=channel))
    async with aclosing(producer.iter_lines()) as lines:
        assert await next_line(lines) == CONNECTED
        # the virtual bus also filters error frames by identifier; this identifier includes the bit that means bus off
        assert PYLONTECH_FRAME.arbitration_id & BUS_OFF_BIT
        sender.send(can.Message(arbitration_id=0x356, is_extended_id=False, is_error_frame=True))
        await until(lambda: producer.counters["error_frames"] != 0)
        assert "bus off" in (producer.fault or "")
        sender.send(PYLONTECH_FRAME)
        await next_line(lines)
        assert "bus off" not in (producer.fault or "")


async def test_unplugged_adapter_is_reported_as_lost_and_can_be_reopened(line: Line) -> None:
    producer = CanProducer(slcan_source(line))
    with pytest.raises(SourceUnavailableError, match=r"cannot be opened: .*No such file"):
        async with aclosing(producer.iter_lines()) as lines:
            await next_line(lines)
    for _ in range(2):
        line.plug()
        async with aclosing(producer.iter_lines()) as lines:
            assert await next_line(lines) == CONNECTED
            line.write(SLCAN_FRAME)
            assert json.loads(await next_line(lines)) == PYLONTECH_SAMPLE
            line.unplug()
            with pytest.raises(SourceUnavailableError, match="lost: "):
                await next_line(lines)


async def test_invalid_frames_of_an_adapter_are_counted_and_bytes_that_are_no_text_end_the_connection(
    line: Line,
) -> None:
    line.plug()
    producer = CanProducer(slcan_source(line))
    async with aclosing(producer.iter_lines()) as lines:
        assert await next_line(lines) == CONNECTED
        line.write(b"t35z6zz\r\a" + b"t3568721485FF\r" + SLCAN_FRAME)  # an invalid, a truncated and a valid frame
        assert json.loads(await next_line(lines)) == PYLONTECH_SAMPLE
        assert producer.counters["junk"] == 2
        line.write(b"\xff\xfe\r")  # no text
        with pytest.raises(SourceUnavailableError, match="lost: "):
            await next_line(lines)
    async with aclosing(producer.iter_lines()) as lines:
        assert await next_line(lines) == CONNECTED
        line.write(SLCAN_FRAME)
        assert json.loads(await next_line(lines)) == PYLONTECH_SAMPLE


async def test_samples_of_a_profile_have_a_current_that_is_positive_on_discharge(
    channel: str, sender: can.BusABC
) -> None:
    table = {"kind": "can", "profile": "pylontech-can", "interface": "virtual", "channel": channel}
    line_source = open_source(Settings.model_validate({"source": table}))
    assert line_source is not None
    async with asyncio.timeout(LONG_S), line_source:
        blocks = aiter(line_source)
        next_block = asyncio.ensure_future(anext(blocks))
        while "connected" not in (line_source.silence_reason or ""):  # noqa: ASYNC110 - it has no event for it
            await asyncio.sleep(0.001)
        sender.send(PYLONTECH_FRAME)
        block, *_ = await next_block
        assert block[["current_a", "voltage_v", "temperature_c"]].tolist() == [(12.3, 52.34, 21.5)]
        assert line_source.silence_reason is None


async def test_unknown_option_of_the_interface_is_reported() -> None:
    producer = CanProducer(source(interface="socketcand", channel="can0", options={"hots": "127.0.0.1"}))
    with pytest.raises(SourceUnavailableError, match=r"cannot be opened: .*host"):
        async with aclosing(producer.iter_lines()) as lines:
            await next_line(lines)


def test_unknown_interface_is_rejected() -> None:
    with pytest.raises(UserError, match=r"source.interface = 'canbus': python-can has .*socketcan"):
        CanProducer(source(interface="canbus"))


@pytest.fixture
def vcan() -> Iterator[str]:
    """Create a virtual CAN interface of the kernel. Return its name."""
    name = f"vcan{time.monotonic_ns() % 1_000_000}"
    process = subprocess.run(
        ["ip", "link", "add", "dev", name, "type", "vcan"], check=False, capture_output=True, text=True
    )
    if process.returncode:
        pytest.skip(f"the kernel gives no vcan here: {process.stderr.strip()}")
    subprocess.run(["ip", "link", "set", name, "up"], check=True)
    yield name
    subprocess.run(["ip", "link", "delete", name], check=True)


async def test_kernel_interface_that_goes_down_is_reported_as_lost(vcan: str) -> None:
    producer = CanProducer(source(channel=vcan))
    async with aclosing(producer.iter_lines()) as lines:
        assert await next_line(lines) == CONNECTED
        with can.Bus(interface="socketcan", channel=vcan, ignore_config=True) as bus:
            bus.send(PYLONTECH_FRAME)
            assert json.loads(await next_line(lines)) == PYLONTECH_SAMPLE
        await asyncio.to_thread(subprocess.run, ["ip", "link", "set", vcan, "down"], check=True)
        with pytest.raises(SourceUnavailableError, match="lost: "):
            await next_line(lines)
