"""A CAN source on python-can's virtual bus, on a USB adapter that speaks slcan (a PTY), and on the kernel's vcan."""

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
from bms_estimator.settings.can_source import CanSource
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.factory import open_line_source
from bms_estimator.sources.fieldbus.can import BUS_OFF, CanProducer
from bms_estimator.sources.line_source import SourceUnavailableError
from tests.patience import LONG_S
from tests.serial_line import Line

PYLONTECH = can.Message(arbitration_id=0x356, is_extended_id=False, data=bytes.fromhex("721485ffd700"))
"""52.34 V, -12.3 A (charge is positive), 21.5 degC."""
SLCAN = b"t3566721485FFD700\r"
"""The same as an adapter writes it."""
TOLD = {"voltage_v": 52.34, "current_a": -12.3, "temperature_c": 21.5}


def source(**told: object) -> CanSource:
    return CanSource.model_validate({"kind": "can", "profile": "pylontech-can"} | told)


def slcan(line: Line) -> CanSource:
    return source(interface="slcan", channel=str(line.path), options={"sleep_after_open": 0.0})


async def next_of(brought: AsyncGenerator[bytes, None]) -> bytes:
    async with asyncio.timeout(LONG_S):
        return await anext(brought)


@pytest.fixture
def channel(request: pytest.FixtureRequest) -> str:
    """One that no other test listens to."""
    return str(request.node.name)


@pytest.fixture
def sender(channel: str) -> Iterator[can.BusABC]:
    """The battery's end of the virtual bus."""
    with can.Bus(interface="virtual", channel=channel, ignore_config=True) as bus:
        yield bus


async def test_frames_of_a_bus_become_lines(channel: str, sender: can.BusABC) -> None:
    producer = CanProducer(source(interface="virtual", channel=channel))
    async with aclosing(producer.iter_lines()) as brought:
        assert await next_of(brought) == CONNECTED
        assert producer.fault is not None
        assert "source.voltage (frame 0x356)" in producer.fault
        for message in (
            can.Message(arbitration_id=0x355, is_extended_id=False, data=b"\x64\x00\x63\x00"),
            can.Message(arbitration_id=0x356, is_extended_id=True, data=PYLONTECH.data),
            can.Message(arbitration_id=0x356, is_extended_id=False, is_remote_frame=True, dlc=6),
            can.Message(arbitration_id=0x356, is_extended_id=False, data=b"\x72\x14"),
            PYLONTECH,
        ):
            sender.send(message)
        assert json.loads(await next_of(brought)) == TOLD
    assert producer.counters == {"short_frames": 1, "not_measured": 0, "error_frames": 0, "junk": 0}


async def test_a_controller_that_is_bus_off_is_said_until_it_is_back(channel: str, sender: can.BusABC) -> None:
    producer = CanProducer(source(interface="virtual", channel=channel))
    async with aclosing(producer.iter_lines()) as brought:
        assert await next_of(brought) == CONNECTED
        assert PYLONTECH.arbitration_id & BUS_OFF  # the virtual bus filters error frames, too
        sender.send(can.Message(arbitration_id=0x356, is_extended_id=False, is_error_frame=True))
        async with asyncio.timeout(LONG_S):
            while producer.counters["error_frames"] == 0:  # noqa: ASYNC110 - it has no event for it
                await asyncio.sleep(0.001)
        assert "bus off" in (producer.fault or "")
        sender.send(PYLONTECH)
        await next_of(brought)
        assert "bus off" not in (producer.fault or "")


async def test_an_adapter_that_is_unplugged_and_plugged_in_again(line: Line) -> None:
    producer = CanProducer(slcan(line))
    with pytest.raises(SourceUnavailableError, match=r"cannot be opened: .*No such file"):
        async with aclosing(producer.iter_lines()) as brought:
            await next_of(brought)
    for _ in range(2):
        line.plug()
        async with aclosing(producer.iter_lines()) as brought:
            assert await next_of(brought) == CONNECTED
            line.write(SLCAN)
            assert json.loads(await next_of(brought)) == TOLD
            line.unplug()
            with pytest.raises(SourceUnavailableError, match="lost: "):
                await next_of(brought)


async def test_junk_of_an_adapter_is_no_frame(line: Line) -> None:
    line.plug()
    producer = CanProducer(slcan(line))
    async with aclosing(producer.iter_lines()) as brought:
        assert await next_of(brought) == CONNECTED
        line.write(b"t35z6zz\r\a" + b"t3568721485FF\r" + SLCAN)  # of the second, bytes are missing
        assert json.loads(await next_of(brought)) == TOLD
        assert producer.counters["junk"] == 2
        line.write(b"\xff\xfe\r")
        with pytest.raises(SourceUnavailableError, match="lost: "):
            await next_of(brought)
    async with aclosing(producer.iter_lines()) as brought:
        assert await next_of(brought) == CONNECTED
        line.write(SLCAN)
        assert json.loads(await next_of(brought)) == TOLD


async def test_samples_are_positive_on_discharge(channel: str, sender: can.BusABC) -> None:
    told = {"kind": "can", "profile": "pylontech-can", "interface": "virtual", "channel": channel}
    reports = open_line_source(Settings.model_validate({"source": told}))
    assert reports is not None
    async with asyncio.timeout(LONG_S), reports:
        blocks = aiter(reports)
        coming = asyncio.ensure_future(anext(blocks))
        while "connected" not in (reports.message or ""):  # noqa: ASYNC110 - it has no event for it
            await asyncio.sleep(0.001)
        sender.send(PYLONTECH)
        block = await coming
        assert block[["current_a", "voltage_v", "temperature_c"]].tolist() == [(12.3, 52.34, 21.5)]
        assert reports.message is None


async def test_an_option_that_the_interface_does_not_have() -> None:
    producer = CanProducer(source(interface="socketcand", channel="can0", options={"hots": "127.0.0.1"}))
    with pytest.raises(SourceUnavailableError, match=r"cannot be opened: .*host"):
        async with aclosing(producer.iter_lines()) as brought:
            await next_of(brought)


def test_an_interface_that_python_can_does_not_have() -> None:
    with pytest.raises(UserError, match=r"source.interface = 'canbus': python-can has .*socketcan"):
        CanProducer(source(interface="canbus"))


@pytest.fixture
def vcan() -> Iterator[str]:
    """A virtual interface of the kernel."""
    name = f"vcan{time.monotonic_ns() % 1_000_000}"
    made = subprocess.run(
        ["ip", "link", "add", "dev", name, "type", "vcan"], check=False, capture_output=True, text=True
    )
    if made.returncode:
        pytest.skip(f"the kernel gives no vcan here: {made.stderr.strip()}")
    subprocess.run(["ip", "link", "set", name, "up"], check=True)
    yield name
    subprocess.run(["ip", "link", "delete", name], check=True)


async def test_an_interface_of_the_kernel_that_goes_down(vcan: str) -> None:
    producer = CanProducer(source(channel=vcan))
    async with aclosing(producer.iter_lines()) as brought:
        assert await next_of(brought) == CONNECTED
        with can.Bus(interface="socketcan", channel=vcan, ignore_config=True) as bus:
            bus.send(PYLONTECH)
            assert json.loads(await next_of(brought)) == TOLD
        await asyncio.to_thread(subprocess.run, ["ip", "link", "set", vcan, "down"], check=True)
        with pytest.raises(SourceUnavailableError, match="lost: "):
            await next_of(brought)
