"""Battery monitors of Junctek (Juntek), series KG-F, KH-F and KL-F, on their RS-485 or TTL port: lines of ASCII.

A monitor answers ``:R50=ADDRESS,2,1,`` with ``:r50=ADDRESS,CHECKSUM,VALUE,...,``; the checksum is 1 plus the sum of
the values modulo 255 (the manuals' chapters on the protocol). The first value is the voltage [10 mV], the second the
current [10 mA], the third the remaining charge [mAh], the seventh the temperature plus 100 [degC], the tenth the direction: 0 discharge, 1 charge. The monitor's own display polls on the
same line; its responses are used as well.
"""

import math
from collections.abc import Iterator

from bms_estimator.model.arrays import CurrentSign
from bms_estimator.model.decimal_text import PRINTABLE
from bms_estimator.protocols.base.polled_protocol import Device, SensorDefaults
from bms_estimator.protocols.base.reading import Reading
from bms_estimator.protocols.base.reading_protocol import ECHO_FAULT, ReadingProtocol

ADDRESS = 1
"""Factory default address."""
QUERY = b":R50=%d,2,1,\r\n" % ADDRESS
MAX_ECHOES = 3
"""Number of own queries that may arrive without a response before they are reported as a fault."""
POLL_INTERVAL_S = 1.0
"""Poll interval [s]."""
MAX_LINE_BYTES = 256
"""Maximum length of a line [bytes]."""
VOLTAGE, CURRENT, REMAINING, TEMPERATURE, DIRECTION = 0, 1, 2, 6, 9
"""Indices of the values in a response."""
MIN_VALUES = DIRECTION + 3
"""Minimum number of values of a response: address, checksum, and values up to the direction."""
RESPONSE = b":r50="
"""Beginning of a response with measured values."""
MAX_SHOWN_BYTES = 40
"""Maximum number of characters of an invalid line that are shown."""
ZERO_C = 100
"""Value at 0 degC [degC]."""
MAX_VALUE_DIGITS = 12
"""Maximum number of digits of a value."""
TOO_LONG = "bytes arrive that are no lines of a Junctek monitor: its baud rate is 115200"


class JunctekProtocol(ReadingProtocol):
    """Protocol of a battery monitor, which is polled once a second.

    Args:
        current_sign: Direction of positive current. The manuals state charge.
    """

    def __init__(self, *, current_sign: CurrentSign = "charge_positive") -> None:
        super().__init__(current_sign, ("checksum_errors", "length_errors", "text_errors", "other_address"))
        self._unparsed = b""
        self._overlong = False
        self._synchronized = False
        self._query_s = -math.inf
        self._echoes = 0  # number of own queries that arrived since the last response

    @property
    def fault(self) -> str | None:
        """First fault since the last reading; None without one."""
        return super().fault or (ECHO_FAULT if self._echoes > MAX_ECHOES else None)

    @property
    def description(self) -> str | None:
        """Name and last values; None before the first reading."""
        if self.last_reading is None:
            return None
        return f"Junctek battery monitor, {self.last_reading.voltage_v:g} V, {self.last_reading.current_a:g} A"

    def on_port_opened(self) -> None:
        """Poll immediately. Decoded values are not reset, because a capture does not contain the openings of the port."""
        self._query_s = -math.inf

    def next_output(self, now_s: float) -> bytes:
        """Return the query, once a second."""
        if now_s - self._query_s < POLL_INTERVAL_S:
            return b""
        self._query_s = now_s
        return QUERY

    def _read(self, arrival_s: float, data: bytes) -> Iterator[Reading]:  # noqa: ARG002 - a line carries no time
        *lines, self._unparsed = (self._unparsed + data).split(b"\n")
        for line in lines:
            skipped, self._overlong = self._overlong, False
            is_complete, self._synchronized = self._synchronized, True
            if len(line) > MAX_LINE_BYTES:
                self._count_fault("length_errors", TOO_LONG)
            elif not skipped and (reading := self._parse(line.strip(b"\r\0"), is_complete)) is not None:
                yield reading
        if len(self._unparsed) > MAX_LINE_BYTES:
            self._count_fault("length_errors", TOO_LONG)
            self._overlong = True
        if self._overlong:
            self._unparsed = b""

    def _parse(self, line: bytes, is_complete: bool) -> Reading | None:
        """Parse a line; None if it is not a response with values.

        Args:
            line: Received line.
            is_complete: False for the first line, which may be partial and is therefore not counted as a fault.
        """
        begin = line.rfind(b":")
        self._echoes = self._echoes + 1 if line == QUERY.strip() else 0
        if not line or line[begin:].startswith(
            (b":R", b":W", b":w", b":r00=", b":r51=")
        ):  # queries of the display, or other responses
            return None
        if begin < 0 or not line[begin:].startswith(RESPONSE):
            if is_complete:
                is_text = not line.translate(None, PRINTABLE)
                shown = repr(line[:MAX_SHOWN_BYTES])[1:]
                self._count_fault(
                    "text_errors", f"{'a line' if is_text else 'noise'} that is no response of a Junctek: {shown}"
                )
            return None
        values = line[begin + len(RESPONSE) :].strip().split(b",")
        if not values[-1]:
            values.pop()
        if not all(0 < len(v) <= MAX_VALUE_DIGITS and v.isdigit() for v in values) or len(values) < MIN_VALUES:
            self._count_fault("length_errors", "a response is cut off or contains no numbers")
            return None
        address, checksum, *measured = map(int, values)
        if checksum != sum(measured) % 255 + 1:
            self._count_fault(
                "checksum_errors", "responses with a wrong checksum arrive: are A and B of the RS-485 line swapped?"
            )
            return None
        if address != ADDRESS:
            self._count_fault("other_address", f"a monitor at address {address} responds: set its address to {ADDRESS}")
            return None
        current_a = 0.01 * measured[CURRENT]
        return Reading(
            0.01 * measured[VOLTAGE],
            current_a if measured[DIRECTION] == 1 else -current_a,
            (float(measured[TEMPERATURE] - ZERO_C),),
            remaining_ah=1e-3 * measured[REMAINING],
        )


DEVICE = Device(
    "junctek",
    lambda sensor: JunctekProtocol(current_sign=sensor.current_sign),
    SensorDefaults(
        baud=115_200,
        current_sign="charge_positive",
        period_s=1.0,
        voltage_resolution_v=0.01,
        current_resolution_a=0.1,
    ),
)
"""The protocol has steps of 10 mV and 10 mA; the makers specify 0.1 A."""
