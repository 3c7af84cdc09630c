"""``kind = "modbus"``: a Modbus device on the network or on a serial line, whose registers are polled.

Neighboring registers are read by one request.
"""

import asyncio
import logging
import math
import struct
import termios
from collections.abc import AsyncGenerator, Mapping, Sequence
from typing import Literal, NamedTuple

import structlog
from pymodbus import FramerType
from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException

from bms_estimator.protocols.base.reading import CONNECTED, Reading, sample_json_line
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sources.fieldbus import MAX_WORDS, ModbusSource, Register
from bms_estimator.sources.source import LineProducer, SourceUnavailableError

MAX_GAP_WORDS = 8
"""Maximum gap of unused registers in one request. One request reads the values on both sides at the same moment.
8 unused registers (16 bytes) take less time than a second request."""
DECIMALS = 5
"""Number of decimals of values, more than any register resolves. Rounding makes 259 * 0.01 exactly 2.59."""

Table = Literal["holding", "input"]
Words = Mapping[tuple[Table, int], int]
"""Contents of the registers by table and address."""

_FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f"}


class RegisterQuantity(NamedTuple):
    """Quantity of the battery, and the register that holds it."""

    quantity: str
    """Key within ``[source]``: ``voltage``, ``current``, ``temperature``, ``cells``."""
    register: Register

    @property
    def is_required(self) -> bool:
        """True if a reading needs this value."""
        return self.quantity in ("voltage", "current")


class Request(NamedTuple):
    """Request of consecutive registers."""

    table: Table
    address: int
    words: int
    values: tuple[RegisterQuantity, ...]
    """Values in the request, by address."""

    @property
    def description(self) -> str:
        """Description as text, e.g. ``source.voltage, source.current (holding registers 259 to 261)``."""
        quantities = ", ".join(dict.fromkeys(f"source.{value.quantity}" for value in self.values))
        last = f" to {self.address + self.words - 1}" if self.words > 1 else ""
        return f"{quantities} ({self.table} register{'s' if last else ''} {self.address}{last})"


def list_values(settings: ModbusSource) -> tuple[RegisterQuantity, ...]:
    """Return the values to read from the device."""
    values = [RegisterQuantity("voltage", settings.voltage), RegisterQuantity("current", settings.current)]
    values += [RegisterQuantity("temperature", register) for register in settings.temperature]
    optional = (("soc", settings.soc), ("capacity", settings.capacity))
    values += [RegisterQuantity(name, register) for name, register in optional if register is not None]
    if settings.cells is not None:
        values += [RegisterQuantity("cells", settings.cells.cell(number)) for number in range(settings.cells.count)]
    return tuple(values)


def plan_requests(values: Sequence[RegisterQuantity], *, max_gap: int = MAX_GAP_WORDS) -> tuple[Request, ...]:
    """Return the requests that read ``values``, as few as possible.

    A request reads one table, at most ``MAX_WORDS`` registers, and at most ``max_gap`` unused registers between two values.
    """
    requests: list[Request] = []
    for value in sorted(values, key=lambda value: (value.register.table, value.register.address)):
        register, end = value.register, value.register.address + value.register.words
        if requests:
            previous = requests[-1]
            is_near = (
                previous.table == register.table and register.address <= previous.address + previous.words + max_gap
            )
            if is_near and end - previous.address <= MAX_WORDS:
                words = max(previous.words, end - previous.address)
                requests[-1] = previous._replace(words=words, values=(*previous.values, value))
                continue
        requests.append(Request(register.table, register.address, register.words, (value,)))
    return tuple(requests)


def split_request(request: Request) -> tuple[Request, ...]:
    """Split a request by quantity and without gaps, to find the part that a device rejects.

    A request that cannot be split is returned alone.
    """
    quantities = dict.fromkeys(value.quantity for value in request.values)
    return tuple(
        part
        for quantity in quantities
        for part in plan_requests([value for value in request.values if value.quantity == quantity], max_gap=0)
    )


def decode(register: Register, words: Words) -> float:
    """Return the value of a register [V, A or degC]; NaN if it was not read, is ``absent``, or is itself NaN."""
    addresses = range(register.address, register.address + register.words)
    if any((register.table, address) not in words for address in addresses):
        return math.nan
    ordered = [words[register.table, address] for address in addresses]
    if register.low_word_first:
        ordered.reverse()
    data = b"".join(word.to_bytes(2, "big") for word in ordered)
    raw: float = struct.unpack(_FORMATS[register.type], data)[0]
    value = raw * register.scale + register.offset
    return math.nan if raw == register.absent or not math.isfinite(value) else round(value, DECIMALS)


def decode_reading(values: Sequence[RegisterQuantity], words: Words) -> Reading | None:
    """Return the reading with the device's sign of current; None without voltage or current."""
    decoded: dict[str, list[float]] = {}
    for quantity, register in values:
        decoded.setdefault(quantity, []).append(decode(register, words))
    voltage_v, current_a, soc, capacity_ah = (
        decoded.get(name, [math.nan])[0] for name in ("voltage", "current", "soc", "capacity")
    )
    if math.isnan(voltage_v) or math.isnan(current_a):
        return None
    cells_v = tuple(decoded.get("cells", ()))
    temperatures_c = tuple(decoded.get("temperature", ()))
    cells_v = () if all(map(math.isnan, cells_v)) else cells_v
    return Reading(voltage_v, current_a, temperatures_c, cells_v, soc=soc / 100.0, capacity_ah=capacity_ah)


Client = AsyncModbusSerialClient | AsyncModbusTcpClient

PERMANENT_EXCEPTIONS = (1, 2, 3)
"""Permanent exception codes (Modbus Application Protocol, section 7): illegal function, data address, data value."""
_EXCEPTION_TEXTS = {
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


class _ExceptionResponseError(Exception):
    """The device responded with an exception; ``code`` is its code."""

    def __init__(self, code: int) -> None:
        super().__init__(_EXCEPTION_TEXTS.get(code, f"exception {code}"))
        self.code = code


class ModbusProducer(LineProducer):
    """Line producer that polls the registers of a device.

    If the device rejects a request, the quantities of the request are requested separately. Rejected temperatures and cells
    are omitted. If voltage or current is rejected, there are no samples.

    Args:
        settings: Settings of the device.
    """

    def __init__(self, settings: ModbusSource) -> None:
        logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)  # LineSource logs the reason in one line
        self._settings, self._values = settings, list_values(settings)
        self._requests: Sequence[Request] = ()
        self._logged_omissions: set[str] = set()
        self._counters = {"refused": 0, "not_measured": 0}
        self._fault: str | None = None

    @property
    def name(self) -> str:
        """Address of the device."""
        return self._settings.short_description

    @property
    def counters(self) -> Mapping[str, int]:
        """Number of exception responses, and of readings without voltage or current, since start."""
        return self._counters

    @property
    def fault(self) -> str | None:
        """Fault of a device that responds without values."""
        return self._fault

    async def iter_lines(self) -> AsyncGenerator[bytes, None]:
        """Yield one line for each poll.

        After a late or missing response the connection is reopened, so that a late response is not assigned to a later request.
        """
        self._requests = plan_requests(self._values)
        client = _make_client(self._settings)
        try:
            await self._connect(client)
            words = await self._read(client)
            yield CONNECTED
            loop = asyncio.get_running_loop()
            next_poll_s = loop.time()
            while True:
                if line := self._line(words):
                    yield line
                next_poll_s = max(next_poll_s + self._settings.poll_s, loop.time())  # missed polls are not repeated
                await asyncio.sleep(next_poll_s - loop.time())
                words = await self._read(client)
        finally:
            client.close()

    async def _connect(self, client: Client) -> None:
        """Connect to the device.

        Raises:
            SourceUnavailableError: The connection or the port cannot be opened.
        """
        failure = "no connection" if self._settings.port is None else "the port cannot be opened"
        try:
            if not await client.connect():
                raise SourceUnavailableError(failure)
        except (ValueError, termios.error) as error:  # from pyserial: invalid baud rate, or not a serial port
            raise SourceUnavailableError(f"{failure}: {error}") from None

    def _line(self, words: Words) -> bytes | None:
        """Return the line of a sample; None without voltage or current."""
        reading = decode_reading(self._values, words)
        if reading is None:
            self._counters["not_measured"] += 1
            self._fault = "the device responds, but its voltage or current is absent or not a number"
            return None
        self._fault = None
        return sample_json_line(
            reading.voltage_v,
            reading.current_a,
            temperatures_c=reading.temperatures_c,
            cells_v=reading.cells_v,
            soc=reading.soc,
            capacity_ah=reading.capacity_ah,
        )

    async def _read(self, client: Client) -> Words:
        """Read the registers of all quantities.

        Raises:
            SourceUnavailableError: The device does not respond, or rejects voltage or current.
        """
        words: dict[tuple[Table, int], int] = {}
        pending, answered = list(self._requests), list[Request]()
        while pending:
            request = pending.pop(0)
            try:
                answer = await self._request(client, request)
            except _ExceptionResponseError as error:
                pending = [*self._replacements(request, error), *pending]
                continue
            words |= {(request.table, request.address + i): word for i, word in enumerate(answer)}
            answered.append(request)
        self._requests = answered
        return words

    def _replacements(self, request: Request, error: _ExceptionResponseError) -> Sequence[Request]:
        """Return the requests to send in place of one that the device rejected.

        Raises:
            SourceUnavailableError: The exception is temporary, or voltage or current is rejected.
        """
        self._counters["refused"] += 1
        if error.code in PERMANENT_EXCEPTIONS:
            parts = split_request(request)
            if parts != (request,):
                return parts
            if not any(value.is_required for value in request.values):
                self._log_omitted(request, error)
                return ()
        raise SourceUnavailableError(f"{request.description}: {error}")

    def _log_omitted(self, request: Request, error: _ExceptionResponseError) -> None:
        """Log an omitted request, unless it was logged before."""
        if request.description not in self._logged_omissions:
            self._logged_omissions.add(request.description)
            log.warning("quantity omitted", source=self.name, failure=request.description, reason=str(error))

    async def _request(self, client: Client, request: Request) -> Sequence[int]:
        """Send a request, and return the register contents.

        Raises:
            SourceUnavailableError: The device does not respond, or responds with another number of registers.
            _ExceptionResponseError: The device responds with an exception.
        """
        read = client.read_input_registers if request.table == "input" else client.read_holding_registers
        try:
            answer = await read(request.address, count=request.words, device_id=self._settings.unit)
        except ModbusException:
            timeout_s = self._settings.timeout_s
            raise SourceUnavailableError(
                f"no response within {timeout_s:g} s to a request of {request.description}"
            ) from None
        if answer.isError():
            raise _ExceptionResponseError(answer.exception_code)
        if len(answer.registers) != request.words:
            raise SourceUnavailableError(
                f"{len(answer.registers)} registers received, {request.words} requested for {request.description}"
            )
        return answer.registers


def _make_client(settings: ModbusSource) -> Client:
    """Create an unconnected client. It does not retry or reconnect, because ``LineSource`` does."""
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
    assert isinstance(settings.source, ModbusSource)  # noqa: S101 - KINDS maps "modbus" to ModbusSource
    return ModbusProducer(settings.source)
