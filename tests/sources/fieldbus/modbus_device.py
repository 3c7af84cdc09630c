"""Simulated Modbus devices over TCP or a serial line: pymodbus's server with registers that a test sets."""

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
"""Register values by address."""
READ_INPUT_REGISTERS = 4
"""Code of the Modbus function that reads input registers."""


class Registers:
    """Registers of a device.

    Attributes:
        holding: Holding registers by address.
        input: Input registers by address.
        requests: Function, address and count of the received requests.
        refusal: Exception code of all responses; None: the registers are returned.
    """

    def __init__(self, holding: Table | None = None, input_: Table | None = None) -> None:
        self.holding, self.input = holding or {}, input_ or {}
        self.requests: list[tuple[int, int, int]] = []
        self.refusal: ExcCodes | None = None
        self._new_request = asyncio.Condition()

    async def wait_for_requests(self, count: int) -> None:
        """Wait until ``count`` requests have arrived."""
        async with self._new_request:
            await self._new_request.wait_for(lambda: len(self.requests) >= count)

    async def answer(
        self, function: int, start: int, address: int, count: int, registers: list[int], _: object
    ) -> ExcCodes | None:
        """Write the requested values into ``registers``, whose first address is ``start``.

        pymodbus calls this for each request. Return the exception code of the response, or None to return the values.
        """
        self.requests.append((function, address, count))
        async with self._new_request:
            self._new_request.notify_all()
        if self.refusal is not None:
            return self.refusal
        table = self.input if function == READ_INPUT_REGISTERS else self.holding
        for i in range(address, address + count):
            if i not in table:
                return ExcCodes.ILLEGAL_ADDRESS
            registers[i - start] = table[i]
        return None

    def device(self, unit: int) -> SimDevice:
        """Return a device of pymodbus that has these registers."""
        all_addresses = SimData(0, count=0x10000, values=0, datatype=DataType.REGISTERS)
        return SimDevice(unit, simdata=[all_addresses], action=self.answer)


def float_words(value: float) -> tuple[int, int]:
    """Return the two registers of a float32, the high word first."""
    high, low = struct.unpack(">HH", struct.pack(">f", value))
    return high, low


@asynccontextmanager
async def tcp_device(
    registers: Registers, unit: int, port: int, framer: FramerType = FramerType.SOCKET
) -> AsyncIterator[None]:
    """Run a device behind a gateway at 127.0.0.1. The gateway rejects requests to other units."""
    others = Registers()
    others.refusal = ExcCodes.GATEWAY_NO_RESPONSE
    devices = [registers.device(unit), others.device(0)]  # pymodbus uses device 0 for all undefined units
    server = ModbusTcpServer(devices, framer=framer, address=("127.0.0.1", port))
    await server.serve_forever(background=True)
    try:
        yield
    finally:
        await server.shutdown()


@asynccontextmanager
async def serial_device(registers: Registers, unit: int, folder: Path) -> AsyncIterator[Path]:
    """Run a device on a serial line that ignores requests to other units. Yield the path of the host's port."""
    (host, host_port), (device, device_port) = os.openpty(), os.openpty()
    loop, path = asyncio.get_running_loop(), folder / "modbus"

    def forward(reader: int, writer: int) -> None:
        data = os.read(reader, 4096)
        if reader == device or data[0] == unit:  # a request begins with the unit
            os.write(writer, data)

    for reader, writer, port in ((host, device, host_port), (device, host, device_port)):
        tty.setraw(port)
        loop.add_reader(reader, forward, reader, writer)
    path.symlink_to(os.ttyname(host_port))
    server = ModbusSerialServer(registers.device(unit), port=os.ttyname(device_port), baudrate=9600)
    await server.serve_forever(background=True)
    try:
        yield path
    finally:
        await server.shutdown()
        path.unlink()
        for reader, port in ((host, host_port), (device, device_port)):
            loop.remove_reader(reader)
            os.close(reader)
            os.close(port)
