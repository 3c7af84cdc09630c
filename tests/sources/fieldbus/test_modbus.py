"""Modbus source with a device simulated by pymodbus's server, over TCP and over a serial line."""

import asyncio
import json
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from pathlib import Path

import pytest
from pymodbus import FramerType
from pymodbus.constants import ExcCodes

from bms_estimator.protocols.base.reading import CONNECTED
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sources.fieldbus import ModbusSource
from bms_estimator.sources.factory import open_source
from bms_estimator.sources.fieldbus.modbus import ModbusProducer
from bms_estimator.sources.source import SourceUnavailableError
from tests.free_port import free_port
from tests.patience import LONG_S
from tests.sources.fieldbus.modbus_device import Registers, float_words, serial_device, tcp_device

UNIT = 5


def source(**options: object) -> ModbusSource:
    """Return validated settings with a short poll interval and a timeout that only a hang reaches."""
    defaults = {"kind": "modbus", "unit": UNIT, "poll_s": 0.02, "timeout_s": LONG_S / 4}
    return ModbusSource.model_validate(defaults | options)


def victron_registers() -> Registers:
    """Return the registers of a GX device that measures 52.34 V, 12.3 A of discharge and 21.5 degC."""
    return Registers({259: 5234, 261: 0x10000 - 123, 262: 215, 266: 620} | dict.fromkeys((260, 263, 264, 265), 0))


async def read_lines(producer: ModbusProducer, count: int) -> list[dict[str, object]]:
    """Return the first ``count`` lines of samples after the line ``CONNECTED``."""
    async with asyncio.timeout(LONG_S), aclosing(producer.iter_lines()) as lines:
        assert await anext(lines) == CONNECTED
        return [json.loads(await anext(lines)) for _ in range(count)]


async def failure_reason(producer: ModbusProducer) -> str:
    """Return the reason for which the source is unavailable."""
    with pytest.raises(SourceUnavailableError) as raised:
        await read_lines(producer, 1_000_000)  # more lines than arrive before the failure
    return str(raised.value)


async def test_device_with_a_profile_is_read_over_tcp_in_one_request() -> None:
    registers, port = victron_registers(), free_port()
    producer = ModbusProducer(source(profile="victron-gx", host="127.0.0.1", tcp_port=port))
    async with tcp_device(registers, UNIT, port):
        assert await read_lines(producer, 3) == 3 * [
            {"voltage_v": 52.34, "current_a": -12.3, "temperature_c": 21.5, "device_soc": 0.62}
        ]
    assert set(registers.requests) == {(3, 259, 8)}
    assert not any(producer.counters.values())


async def test_device_with_a_profile_is_read_over_a_serial_line(tmp_path: Path) -> None:
    registers = Registers(input_={0x1000 + i: 0 for i in range(17)} | {0x1100 + i: 3300 + i for i in range(26)})
    registers.input |= {
        0x1000: 5320,
        0x1001: 150,
        0x1003: 28_000,
        0x1005: 620,
        0x1009: 2981,
        0x100C: 3000,
        0x100D: 2971,
    }
    async with serial_device(registers, UNIT, tmp_path) as path:
        (line,) = await read_lines(ModbusProducer(source(profile="seplos-v3", unit=UNIT, port=str(path))), 1)
    assert line.pop("cells_v") == [round(3.3 + i / 1000, 3) for i in range(16)]
    assert line == {
        "voltage_v": 53.2,
        "current_a": 1.5,
        "temperatures_c": [24.95, 26.85, 23.95],
        "device_soc": 0.62,
        "device_capacity_ah": 280.0,
    }
    assert set(registers.requests) == {(4, 0x1000, 14), (4, 0x1100, 16)}


async def test_rtu_frames_over_tcp_are_read() -> None:
    port = free_port()
    async with tcp_device(victron_registers(), UNIT, port, FramerType.RTU):
        producer = ModbusProducer(source(profile="victron-gx", host="127.0.0.1", tcp_port=port, framing="rtu"))
        assert (await read_lines(producer, 1))[0]["voltage_v"] == 52.34


async def test_missing_register_of_the_temperature_is_omitted_and_of_the_current_is_reported() -> None:
    registers, port = victron_registers(), free_port()
    del registers.holding[260], registers.holding[262]  # 260 is not needed, and 262 is the temperature
    source_settings = source(profile="victron-gx", host="127.0.0.1", tcp_port=port)
    async with tcp_device(registers, UNIT, port):
        producer = ModbusProducer(source_settings)
        assert await read_lines(producer, 2) == 2 * [{"voltage_v": 52.34, "current_a": -12.3, "device_soc": 0.62}]
        assert producer.counters["refused"] == 2
        values = [(3, 259, 1), (3, 261, 1), (3, 262, 1), (3, 266, 1)]
        # the rejected request of all registers is split into one for each value; afterwards the temperature is left out
        assert registers.requests == [(3, 259, 8), *values, *(value for value in values if value[1] != 262)]
        del registers.holding[261]
        reason = await failure_reason(ModbusProducer(source_settings))
    assert reason == "source.current (holding register 261): illegal data address: the device has no such register"


async def test_wrong_unit_behind_a_gateway_is_reported() -> None:
    port = free_port()
    async with tcp_device(victron_registers(), UNIT, port):
        reason = await failure_reason(
            ModbusProducer(source(profile="victron-gx", unit=9, host="127.0.0.1", tcp_port=port))
        )
    assert reason.endswith("gateway target device failed to respond: is source.unit right?")


async def test_wrong_unit_on_a_serial_line_is_reported_as_a_timeout(tmp_path: Path) -> None:
    async with serial_device(victron_registers(), UNIT, tmp_path) as path:
        source_settings = source(profile="victron-gx", unit=9, port=str(path), timeout_s=0.2)
        reason = await failure_reason(ModbusProducer(source_settings))
    assert reason == (
        "no response within 0.2 s to a request of source.voltage, source.current, source.temperature, source.soc"
        " (holding registers 259 to 266)"
    )


async def test_missing_device_or_serial_port_is_reported(tmp_path: Path) -> None:
    absent = ModbusProducer(source(profile="victron-gx", host="127.0.0.1", tcp_port=free_port()))
    assert await failure_reason(absent) == "no connection"
    assert await failure_reason(ModbusProducer(source(profile="victron-gx", port=str(tmp_path / "none")))) == (
        "the port cannot be opened"
    )


@pytest.mark.parametrize(
    "answer",
    [
        b"\xff" * 40,
        b"HTTP/1.1 400 Bad Request\r\n\r\n",
        b"\0\1\0\0\0\3\5\3\x08",  # without registers, although it announces eight bytes of them
        b"\0\1\0\0\0\5\5\3\2\0\1",  # one register instead of four
        b"\0\1\0\0\0\4\5\1\1\0",  # coils instead of registers
        b"\0\1\0\0\0\3\5\x83\x2a",  # an undefined exception code
        b"",
    ],
    ids=[
        "noise",
        "HTTP",
        "no registers",
        "too few registers",
        "coils",
        "undefined exception",
        "closed connection",
    ],
)
async def test_invalid_response_makes_the_source_unavailable(answer: bytes) -> None:
    served = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(100)
        writer.write(answer)
        if answer:
            await reader.read()  # until the client closes the connection
        writer.close()
        await writer.wait_closed()
        served.set()

    server = await asyncio.start_server(serve, "127.0.0.1")
    async with server, asyncio.timeout(LONG_S):
        port = server.sockets[0].getsockname()[1]
        source_settings = source(profile="victron-gx", host="127.0.0.1", tcp_port=port, timeout_s=0.1)
        assert await failure_reason(ModbusProducer(source_settings))
        await served.wait()


async def read_until(lines: AsyncGenerator[bytes, None], condition: Callable[[], bool]) -> None:
    """Read lines until the condition is true."""
    async with asyncio.timeout(LONG_S):
        while not condition():
            await anext(lines)


async def test_lost_device_can_be_reconnected() -> None:
    registers, port = victron_registers(), free_port()
    producer = ModbusProducer(source(profile="victron-gx", host="127.0.0.1", tcp_port=port))
    async with aclosing(producer.iter_lines()) as lines:
        async with tcp_device(registers, UNIT, port):
            await read_until(lines, lambda: len(registers.requests) > 2)
        with pytest.raises(SourceUnavailableError):
            await read_until(lines, lambda: False)  # until the loss is noticed
    assert await failure_reason(producer) == "no connection"
    async with tcp_device(registers, UNIT, port):
        assert (await read_lines(producer, 1))[0]["voltage_v"] == 52.34


async def test_requests_to_a_busy_device_are_not_split() -> None:
    registers, port = victron_registers(), free_port()
    registers.refusal = ExcCodes.DEVICE_BUSY
    async with tcp_device(registers, UNIT, port):
        reason = await failure_reason(ModbusProducer(source(profile="victron-gx", host="127.0.0.1", tcp_port=port)))
    assert reason.endswith("server device busy")
    assert len(registers.requests) == 1


async def test_register_with_nan_as_current_gives_no_sample_until_it_has_a_value() -> None:
    port = free_port()
    registers = Registers(dict(enumerate((*float_words(13.25), *float_words(float("nan"))))))
    current = {"address": 2, "type": "float32"}
    source_settings = source(
        voltage={"address": 0, "type": "float32"}, current=current, host="127.0.0.1", tcp_port=port
    )
    producer = ModbusProducer(source_settings)
    async with tcp_device(registers, UNIT, port), aclosing(producer.iter_lines()) as lines, asyncio.timeout(LONG_S):
        assert await anext(lines) == CONNECTED
        next_line = asyncio.ensure_future(anext(lines))
        await registers.wait_for_requests(4)
        assert producer.counters["not_measured"] >= 2
        assert not next_line.done()
        assert producer.fault is not None
        registers.holding |= dict(zip((2, 3), float_words(-2.5), strict=True))
        assert json.loads(await next_line) == {"voltage_v": 13.25, "current_a": -2.5}
        assert producer.fault is None


async def test_samples_have_a_current_that_is_positive_on_discharge_and_continue_after_a_reconnection() -> None:
    registers, port = victron_registers(), free_port()
    table = {"kind": "modbus", "profile": "victron-gx", "host": "127.0.0.1", "tcp_port": port, "unit": UNIT}
    settings = Settings.model_validate({"source": table | {"poll_s": 0.02, "timeout_s": 1.0}})
    assert settings.sensor.voltage_resolution_v == 0.01
    line_source = open_source(settings)
    assert line_source is not None
    async with asyncio.timeout(LONG_S), line_source:
        blocks = aiter(line_source)
        async with tcp_device(registers, UNIT, port):
            block, *_ = await anext(blocks)
        assert block[["current_a", "voltage_v", "temperature_c"]].tolist() == [(12.3, 52.34, 21.5)]
        assert line_source.silence_reason is None
        async with tcp_device(registers, UNIT, port):
            while line_source.counters["reconnects"] == 0:
                await anext(blocks)
            await anext(blocks)
        assert line_source.counters["frames_received"] >= 2
