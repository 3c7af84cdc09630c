"""Modbus devices for tests: pymodbus's own server with registers that a test sets, over TCP or a serial line."""

import asyncio
import os
import struct
import tty
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from pymodbus import FramerType
from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

Table = dict[int, int]


class Registers:
    """What the device holds, and which requests came: (function, address, count)."""

    def __init__(self, holding: Table | None = None, input_: Table | None = None) -> None:
        self.holding, self.input = holding or {}, input_ or {}
        self.asked: list[tuple[int, int, int]] = []
        self.refusal: ExcCodes | None = None
        self._asked = asyncio.Condition()

    async def was_asked(self, times: int) -> None:
        """As soon as so many requests came."""
        async with self._asked:
            await self._asked.wait_for(lambda: len(self.asked) >= times)

    async def answer(
        self, function: int, start: int, address: int, count: int, current: list[int], _: object
    ) -> ExcCodes | None:
        self.asked.append((function, address, count))
        async with self._asked:
            self._asked.notify_all()
        if self.refusal is not None:
            return self.refusal
        table = self.input if function == 4 else self.holding
        for i in range(address, address + count):
            if i not in table:
                return ExcCodes.ILLEGAL_ADDRESS
            current[i - start] = table[i]
        return None

    def device(self, unit: int) -> SimDevice:
        block = SimData(0, count=0x10000, values=0, datatype=DataType.REGISTERS)
        return SimDevice(unit, simdata=[block], action=self.answer)


def float_words(value: float) -> tuple[int, int]:
    high, low = struct.unpack(">HH", struct.pack(">f", value))
    return high, low


@asynccontextmanager
async def tcp_device(
    registers: Registers, unit: int, port: int, framer: FramerType = FramerType.SOCKET
) -> AsyncIterator[None]:
    """A device behind a gateway at 127.0.0.1 that finds no other unit."""
    others = Registers()
    others.refusal = ExcCodes.GATEWAY_NO_RESPONSE
    devices = [registers.device(unit), others.device(0)]
    server = ModbusTcpServer(devices, framer=framer, address=("127.0.0.1", port))
    await server.serve_forever(background=True)
    try:
        yield
    finally:
        await server.shutdown()


@asynccontextmanager
async def serial_device(registers: Registers, unit: int, folder: Path) -> AsyncIterator[Path]:
    """A device on a serial line that is silent to other units; its other end is a port at the path while it is there."""
    (host, host_port), (device, device_port) = os.openpty(), os.openpty()
    loop, path = asyncio.get_running_loop(), folder / "modbus"

    def carry(one: int, other: int) -> None:
        data = os.read(one, 4096)
        if one == device or data[0] == unit:
            os.write(other, data)

    for one, other, port in ((host, device, host_port), (device, host, device_port)):
        tty.setraw(port)
        loop.add_reader(one, carry, one, other)
    path.symlink_to(os.ttyname(host_port))
    server = ModbusSerialServer(registers.device(unit), port=os.ttyname(device_port), baudrate=9600)
    await server.serve_forever(background=True)
    try:
        yield path
    finally:
        await server.shutdown()
        path.unlink()
        for one, port in ((host, host_port), (device, device_port)):
            loop.remove_reader(one)
            os.close(one)
            os.close(port)
