"""A Modbus device, on the network or on a serial line, polled for its registers."""

import asyncio
import logging
import termios
from collections.abc import AsyncGenerator, Mapping, Sequence

import structlog
from pymodbus import FramerType
from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException

from bms_estimator.protocols.base.reading import CONNECTED, sample_json_line
from bms_estimator.settings.modbus_source import ModbusSource
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.fieldbus.modbus_registers import Request, Table, plan, reading_of, split, values_of
from bms_estimator.sources.line_source import LineProducer, SourceUnavailableError

Client = AsyncModbusSerialClient | AsyncModbusTcpClient

NO_SUCH_REGISTER = (1, 2, 3)
"""Exceptions of the protocol, section 7, that asking again does not mend: illegal function, data address, data value."""
_EXCEPTIONS = {
    1: "illegal function: the device has no registers of this table",
    2: "illegal data address: the device has no such register",
    3: "illegal data value: the device does not give so many registers",
    4: "server device failure",
    5: "acknowledged, but not done yet",
    6: "server device busy",
    8: "memory parity error",
    10: "gateway path unavailable: is source.unit right?",
    11: "gateway target device failed to respond: is source.unit right?",
}

log = structlog.get_logger(__name__)


class _RefusedError(Exception):
    """The device answers with an exception: its code."""

    def __init__(self, code: int) -> None:
        super().__init__(_EXCEPTIONS.get(code, f"exception {code}"))
        self.code = code


class ModbusProducer(LineProducer):
    """Polls a device for its registers.

    Quantities that a device rejects are found by separate requests: without voltage or current there are no samples;
    temperature and cells are left out.

    Args:
        settings: Settings of the device.
    """

    def __init__(self, settings: ModbusSource) -> None:
        logging.getLogger("pymodbus.logging").setLevel(
            logging.CRITICAL
        )  # its log lines are replaced by one of this module
        self._settings, self._values = settings, values_of(settings)
        self._requests: Sequence[Request] = ()
        self._refused: set[str] = set()
        self._counters = {"refused": 0, "not_measured": 0}
        self._fault: str | None = None

    @property
    def name(self) -> str:
        """Address of the device."""
        return self._settings.described

    @property
    def counters(self) -> Mapping[str, int]:
        """Since start: answers that were exceptions, readings without voltage or current."""
        return self._counters

    @property
    def fault(self) -> str | None:
        """Fault of a device that responds without values."""
        return self._fault

    async def iter_lines(self) -> AsyncGenerator[bytes, None]:
        """Yield one line for each poll.

        After a late or missing response the connection is reopened, so that responses are not mixed up.
        """
        self._requests = plan(self._values)
        client = _client(self._settings)
        try:
            await self._connect(client)
            words = await self._read(client)
            yield CONNECTED
            loop = asyncio.get_running_loop()
            next_s = loop.time()
            while True:
                if line := self._line(words):
                    yield line
                next_s = max(next_s + self._settings.poll_s, loop.time())  # polls that were missed are not made up for
                await asyncio.sleep(next_s - loop.time())
                words = await self._read(client)
        finally:
            client.close()

    async def _connect(self, client: Client) -> None:
        """Connect to the device; raises SourceUnavailableError if that fails."""
        what = "no connection" if self._settings.port is None else "the port cannot be opened"
        try:
            if not await client.connect():
                raise SourceUnavailableError(what)
        except (ValueError, termios.error) as error:  # pyserial, of a baud rate or a device that is no serial port
            raise SourceUnavailableError(f"{what}: {error}") from None

    def _line(self, words: Mapping[tuple[Table, int], int]) -> bytes | None:
        """Return the line of a sample; None without voltage and current."""
        reading = reading_of(self._values, words)
        if reading is None:
            self._counters["not_measured"] += 1
            self._fault = "it answers, but measures no voltage or no current (absent, or not a number)"
            return None
        self._fault = None
        return sample_json_line(
            reading.voltage_v, reading.current_a, temperature_c=reading.temperature_c, cells_v=reading.cells_v
        )

    async def _read(self, client: Client) -> Mapping[tuple[Table, int], int]:
        """Read all wanted registers.

        Raises:
            SourceUnavailableError: No answer, or none with voltage and current.
        """
        words: dict[tuple[Table, int], int] = {}
        waiting, done = list(self._requests), list[Request]()
        while waiting:
            request = waiting.pop(0)
            try:
                answer = await self._ask(client, request)
            except _RefusedError as error:
                waiting = [*self._instead(request, error), *waiting]
                continue
            words |= {(request.table, request.address + i): word for i, word in enumerate(answer)}
            done.append(request)
        self._requests = done
        return words

    def _instead(self, request: Request, error: _RefusedError) -> Sequence[Request]:
        """Return the requests to send instead of one that was refused.

        Raises:
            SourceUnavailableError: There is no reading without it.
        """
        self._counters["refused"] += 1
        if error.code in NO_SUCH_REGISTER:
            parts = split(request)
            if parts != (request,):
                return parts
            if not any(value.needed for value in request.values):
                self._leave_out(request, error)
                return ()
        raise SourceUnavailableError(f"{request.described}: {error}")

    def _leave_out(self, request: Request, error: _RefusedError) -> None:
        """Log this once."""
        if request.described not in self._refused:
            self._refused.add(request.described)
            log.warning("left out", source=self.name, what=request.described, reason=str(error))

    async def _ask(self, client: Client, request: Request) -> Sequence[int]:
        """Send a request; raises SourceUnavailableError without a response, _RefusedError for an exception response."""
        read = client.read_input_registers if request.table == "input" else client.read_holding_registers
        try:
            answer = await read(request.address, count=request.words, device_id=self._settings.unit)
        except ModbusException:
            timeout_s = self._settings.timeout_s
            raise SourceUnavailableError(f"no answer within {timeout_s:g} s, asked for {request.described}") from None
        if answer.isError():
            raise _RefusedError(answer.exception_code)
        if len(answer.registers) != request.words:
            raise SourceUnavailableError(f"{len(answer.registers)} registers came, asked for {request.described}")
        return answer.registers


def _client(settings: ModbusSource) -> Client:
    """Make an unconnected client without its own retries and reconnects."""
    if settings.port is None:
        return AsyncModbusTcpClient(
            settings.host or "",
            port=settings.tcp_port,
            framer=FramerType.RTU if settings.framing == "rtu" else FramerType.SOCKET,
            timeout=settings.timeout_s,
            reconnect_delay=0,
            retries=0,
        )
    return AsyncModbusSerialClient(
        settings.port,
        baudrate=settings.baud,
        parity=settings.parity[0].upper(),
        stopbits=settings.stop_bits,
        timeout=settings.timeout_s,
        reconnect_delay=0,
        retries=0,
    )


def producer(settings: Settings) -> ModbusProducer:
    """Make the line producer of ``[source]``."""
    assert isinstance(settings.source, ModbusSource)  # noqa: S101 - as KINDS has it
    return ModbusProducer(settings.source)
