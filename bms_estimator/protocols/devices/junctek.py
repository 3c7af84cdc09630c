"""Battery monitors of Junctek (Juntek), series KG-F, KH-F and KL-F, on their RS-485 or TTL port: lines of ASCII.

A monitor answers ``:R50=ADDRESS,2,1,`` with ``:r50=ADDRESS,CHECKSUM,VALUE,...,``; the checksum is 1 plus the sum of
the
values modulo 255 (the manuals' chapters on the protocol). Of the values: voltage [10 mV] first, current [10 mA] second,
temperature plus 100 [degC] seventh, direction tenth: 0 discharge, 1 charge. The monitor's own display polls on the
same line; its responses are used as well.
"""

import math
from collections.abc import Iterator

from bms_estimator.model.decimal_text import PRINTABLE
from bms_estimator.model.sample import CurrentSign
from bms_estimator.protocols.base.device import Device, Resolution
from bms_estimator.protocols.base.reading import Reading
from bms_estimator.protocols.base.reading_protocol import ReadingProtocol

ADDRESS = 1
"""Factory default address."""
ASK = b":R50=%d,2,1,\r\n" % ADDRESS
ASK_S = 1.0
"""Poll interval [s]."""
LINE_BYTES = 256
VOLTAGE, CURRENT, TEMPERATURE, DIRECTION = 0, 1, 6, 9
"""Places of the values."""
ZERO_C = 100
VALUE_DIGITS = 12
"""No value has more."""
TOO_LONG = "bytes come that are no lines of a Junctek monitor: it has 115200 baud"


class JunctekProtocol(ReadingProtocol):
    """Lines of a battery monitor to samples. It is polled once a second.

    Args:
        current_sign: Direction of positive current; by its documentation charge.
    """

    def __init__(self, *, current_sign: CurrentSign = "charge_positive") -> None:
        super().__init__(current_sign, ("checksum_errors", "length_errors", "text_errors", "other_address"))
        self._rest = b""
        self._overlong = False
        self._in_step = False
        self._asked_s = -math.inf

    @property
    def description(self) -> str | None:
        """The last values."""
        if self._last_reading is None:
            return None
        return f"Junctek battery monitor, {self._last_reading.voltage_v:g} V, {self._last_reading.current_a:g} A"

    def on_port_opened(self) -> None:
        """Poll at once. Decoded values stay, because a recording does not contain openings."""
        self._asked_s = -math.inf

    def next_output(self, now_s: float) -> bytes:
        """Return the query, once a second."""
        if now_s - self._asked_s < ASK_S:
            return b""
        self._asked_s = now_s
        return ASK

    def _read(self, arrival_s: float, data: bytes) -> Iterator[Reading]:  # noqa: ARG002 - a line carries no time
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            skipped, self._overlong = self._overlong, False
            counted, self._in_step = self._in_step, True
            if len(line) > LINE_BYTES:
                self._count_fault("length_errors", TOO_LONG)
            elif not skipped and (reading := self._of(line.strip(b"\r\0"), counted)) is not None:
                yield reading
        if len(self._rest) > LINE_BYTES:
            self._count_fault("length_errors", TOO_LONG)
            self._overlong = True
        if self._overlong:
            self._rest = b""

    def _of(self, line: bytes, counted: bool) -> Reading | None:
        """Parse a line; None if it is not a response with values. A partial first line is not counted as a fault."""
        at = line.rfind(b":")
        if not line or line[at:].startswith(
            (b":R", b":W", b":w", b":r00=", b":r51=")
        ):  # the display's, or other answers
            return None
        if at < 0 or not line[at:].startswith(b":r50="):
            if counted:
                text = not line.translate(None, PRINTABLE)
                shown = repr(line[:40])[1:]
                self._count_fault(
                    "text_errors", f"{'a line' if text else 'noise'} that is no answer of a Junctek: {shown}"
                )
            return None
        values = line[at + 5 :].strip().split(b",")
        if not values[-1]:
            values.pop()
        if not all(0 < len(v) <= VALUE_DIGITS and v.isdigit() for v in values) or len(values) < DIRECTION + 3:
            self._count_fault("length_errors", "an answer that is cut off, or has no numbers")
            return None
        address, checksum, *told = map(int, values)
        if checksum != sum(told) % 255 + 1:
            self._count_fault(
                "checksum_errors", "answers come whose checksum is wrong: are A and B of the RS-485 line twisted?"
            )
            return None
        if address != ADDRESS:
            self._count_fault("other_address", f"a monitor at address {address} answers: set its address to {ADDRESS}")
            return None
        current_a = 0.01 * told[CURRENT]
        return Reading(
            0.01 * told[VOLTAGE], current_a if told[DIRECTION] == 1 else -current_a, float(told[TEMPERATURE] - ZERO_C)
        )


DEVICE = Device(
    "junctek",
    lambda sign, _: JunctekProtocol(current_sign=sign),
    Resolution(115_200, "charge_positive", 1.0, 0.01, 0.1),
)
"""The protocol has steps of 10 mV and 10 mA; the makers specify 0.1 A."""
