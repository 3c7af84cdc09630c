"""Battery monitors of Victron Energy, BMV and SmartShunt: the text half of the VE.Direct protocol.

The device sends a block each second. Each line is CR LF, label, tab and value. The value of the last line, ``Checksum``,
is one byte that makes the sum of all bytes of the block 0 modulo 256 (Victron's VE.Direct protocol and its FAQ). The labels
are V [mV], I [mA, positive on charge] and T [degrees Celsius, only with a sensor], and
SOC [0.1 %]. A second block contains history. HEX messages, from ``:`` to the end of the
line, may appear in between and are not part of the checksum.
"""

import re
from collections.abc import Iterator, Mapping
from math import nan

from bms_estimator.model.arrays import CurrentSign
from bms_estimator.model.decimal_text import number
from bms_estimator.protocols.base.polled_protocol import Device, SensorDefaults
from bms_estimator.protocols.base.reading import Reading
from bms_estimator.protocols.base.reading_protocol import ReadingProtocol

MAX_BLOCK_BYTES = 2048
"""Maximum length of a block [bytes]: 22 fields of at most 44 bytes each, with a margin."""
HEX = re.compile(rb":[0-9A-Fa-f]*\r?\n")
"""HEX message."""
END = b"Checksum\t"
"""Label of the last line of a block."""
UNKNOWN = "---"
"""Value of an unknown quantity: the temperature without a sensor, or the SOC before the first synchronization."""


class VeDirectProtocol(ReadingProtocol):
    """Protocol of a battery monitor, which sends blocks unsolicited and receives nothing.

    Args:
        current_sign: Direction of positive current. Victron's documentation states charge.
    """

    def __init__(self, *, current_sign: CurrentSign = "charge_positive") -> None:
        super().__init__(current_sign, ("checksum_errors", "length_errors", "text_errors"))
        self._unparsed = b""
        self._synchronized = False  # True once a block has ended, because earlier bytes may be half a block
        self._product = ""

    @property
    def description(self) -> str | None:
        """Product and last values; None before the first reading."""
        if self.last_reading is None:
            return None
        return f"VE.Direct battery monitor {self._product}, {self.last_reading.voltage_v:g} V, {self.last_reading.current_a:g} A"

    def _read(self, arrival_s: float, data: bytes) -> Iterator[Reading]:  # noqa: ARG002 - the base class adds the time
        self._unparsed += data
        while (at := self._unparsed.find(END)) >= 0 and len(self._unparsed) > at + len(END):
            end = at + len(END) + 1
            block, self._unparsed = self._unparsed[:end], self._unparsed[end:]
            is_complete, self._synchronized = self._synchronized, True
            head = HEX.sub(b"", block[:at])
            if len(head) > MAX_BLOCK_BYTES:
                self._count_fault("length_errors", "blocks arrive that are too long for VE.Direct text")
            elif sum(head) + sum(block[at:]) & 0xFF:
                if is_complete:
                    self._count_fault(
                        "checksum_errors", "VE.Direct blocks with a wrong checksum arrive: is the cable too long?"
                    )
            elif (reading := self._parse(head)) is not None:
                yield reading
        if len(self._unparsed) > MAX_BLOCK_BYTES and at < 0:
            self._unparsed = self._unparsed[-len(END) :]
            self._count_fault(
                "length_errors", "bytes arrive that are no VE.Direct text: its line setting is 19200 baud, 8N1"
            )

    def _parse(self, head: bytes) -> Reading | None:
        """Parse a complete block; None for a history block and for a device other than a battery monitor."""
        text = head.decode("ascii", "replace")
        fields = dict(line.split("\t", 1) for line in text.split("\r\n") if "\t" in line)
        if "V" not in fields:
            return None
        self._product = fields.get("BMV") or fields.get("PID", "")
        if "I" not in fields or not fields.keys() & {"SOC", "CE", "TTG"}:  # only battery monitors send one of these
            device = f"product {fields['PID']}" if "PID" in fields else "the device"
            self._count_fault(
                "text_errors", f"{device} is no battery monitor: the current that it reports is not the battery's"
            )
            return None
        return self._make_reading(fields)

    def _make_reading(self, fields: Mapping[str, str]) -> Reading | None:
        try:
            temperature = fields.get("T", UNKNOWN)
            return Reading(
                1e-3 * number(fields["V"]),
                1e-3 * number(fields["I"]),
                () if temperature == UNKNOWN else (number(temperature),),
                soc=nan if (soc := fields.get("SOC", UNKNOWN)) == UNKNOWN else 1e-3 * number(soc),
            )
        except ValueError as error:
            self._count_fault("text_errors", f"a VE.Direct block without a voltage or a current: {error}")
            return None


DEVICE = Device(
    "vedirect",
    lambda sensor: VeDirectProtocol(current_sign=sensor.current_sign),
    SensorDefaults(
        baud=19_200,
        current_sign="charge_positive",
        period_s=1.0,
        voltage_resolution_v=0.01,
        current_resolution_a=0.01,
    ),
)
"""The text has steps of 1 mV and 1 mA; the data sheets of BMV and SmartShunt specify 10 mV and 10 mA."""
