"""Decoding of Modbus registers to a reading, and planning of the requests. No I/O."""

import math
import struct
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

from bms_estimator.protocols.base.reading import Reading
from bms_estimator.settings.sources.modbus import MAX_WORDS, ModbusSource, Register

GAP_WORDS = 8
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
    def described(self) -> str:
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


def plan_requests(values: Sequence[RegisterQuantity], *, gap: int = GAP_WORDS) -> tuple[Request, ...]:
    """Return the requests that read ``values``, as few as possible.

    A request reads one table, at most ``MAX_WORDS`` registers, and at most ``gap`` unused registers between two values.
    """
    requests: list[Request] = []
    for value in sorted(values, key=lambda value: (value.register.table, value.register.address)):
        register, end = value.register, value.register.address + value.register.words
        if requests:
            previous = requests[-1]
            is_near = previous.table == register.table and register.address <= previous.address + previous.words + gap
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
        for part in plan_requests([value for value in request.values if value.quantity == quantity], gap=0)
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
