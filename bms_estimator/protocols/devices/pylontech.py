"""Batteries of Pylontech, US2000 to US5000 and their like, on the console port of the master.

The console prints text: ``pwr`` a table of all batteries in parallel, ``bat N`` a table of the cells of battery N. A
prompt follows each table. Voltages in mV, currents in mA and positive on charge, temperatures in thousandths of a degree
Celsius.
There is no checksum, and a reading is a sum over batteries. A table is therefore accepted only if it ends with the success
message, its rows are numbered without a gap, no row has more columns than the header, and no battery is missing that was
present before, or that the settings name.
"""

import itertools
import math
import re
from collections.abc import Iterator, Sequence

from bms_estimator.model.arrays import CurrentSign
from bms_estimator.model.decimal_text import PRINTABLE
from bms_estimator.protocols.base.polled_protocol import Device, SensorDefaults
from bms_estimator.protocols.base.reading import Reading
from bms_estimator.protocols.base.reading_protocol import ReadingProtocol, RecentCellVoltages

POLL_CYCLE_S = 2.0
"""Duration of a poll cycle [s]: a query of all batteries, then one of the cells of a single battery."""
RESPONSE_TIMEOUT_S = 5.0
"""Timeout of a response [s]; after it the query is repeated."""
MAX_RESPONSE_BYTES = 16384
"""Maximum length of a response [bytes]: 16 rows of less than 200 bytes, with a margin."""
PROMPT = re.compile(rb"pylon\w*>")
"""Prompt of the console, which follows each response."""
RS485_FRAME = re.compile(rb"~[0-9A-F]{12,}\r")
"""Frame of the protocol on the RS-485 port."""
ECHO = re.compile(r"\bbat\s+([0-9]{1,2})\b")
"""Echo of a query of cells, with the number of the battery."""
MAX_SHOWN_BYTES = 60
"""Maximum number of characters of an unexpected text that are shown."""
STACK, CELLS = "Power", ("Battery", "Bat")
"""First column of the table of ``pwr``, and of those of ``bat`` by older and newer firmware."""
SUCCESS = "Command completed"
"""Beginning of the success message."""
MAX_BATTERIES = 16
"""Maximum number of batteries in parallel."""
MAX_CELLS = 32
"""Maximum number of cells of a battery."""
MAX_CELLS_AGE_S = 90.0
"""Maximum age of cell voltages [s]: two cycles of 16 batteries, with some lost responses."""
MAX_DIGITS = 9
"""Maximum number of digits of a value."""
SOC = "Coulomb"
"""Column of the SOC [%]."""
TIME = "Time"
"""Column with a date and a time, which a split at spaces separates."""
MAX_MISSING_S = 3600.0
"""Time after which a battery that was present before counts as removed [s]."""
ABSENT = "-"
"""Value of a battery or cell that is absent."""


class PylontechProtocol(ReadingProtocol):
    """Protocol of the console. A reading has the mean voltage, the sum of the currents, and the lowest and highest temperature of each battery.

    The cells of all batteries are concatenated, each with its last recent voltage.

    Args:
        current_sign: Direction of positive current. The device reports charge as positive.
        batteries: Number of batteries of the stack; None: as many as the first table has.
    """

    def __init__(self, *, current_sign: CurrentSign = "charge_positive", batteries: int | None = None) -> None:
        super().__init__(current_sign, ("text_errors", "length_errors"))
        self._unparsed = b""
        self._cells = dict[int, RecentCellVoltages]()
        self._batteries: tuple[int, ...] = ()
        self._expected = batteries
        self._table_s = -math.inf  # arrival time of the last complete table
        self._responses = 0
        self._cycle_s = self._query_s = -math.inf
        self._responses_at_query = -1  # number of responses when the last query was sent
        self._query = b""
        self._battery_index = 0  # index of the battery whose cells were queried last
        self._unprompted: str | None = None  # fault of bytes that arrived instead of a response and its prompt

    @property
    def fault(self) -> str | None:
        """First fault since the last reading; None without one."""
        return super().fault or self._unprompted

    @property
    def description(self) -> str | None:
        """Number of batteries and last values; None before the first reading."""
        if self.last_reading is None:
            return None
        n = len(self._batteries)
        batteries = "1 battery" if n == 1 else f"{n} batteries"
        return f"Pylontech, {batteries}, {self.last_reading.voltage_v:g} V, {self.last_reading.current_a:g} A"

    def on_port_opened(self) -> None:
        """Poll immediately. Decoded values are not reset, because a capture does not contain the openings of the port."""
        self._cycle_s = self._query_s = -math.inf
        self._query = b""

    def next_output(self, now_s: float) -> bytes:
        """Return ``pwr`` in each poll cycle, and after its response ``bat N`` for the next battery in turn."""
        is_unanswered = self._query and self._responses == self._responses_at_query
        if is_unanswered and now_s - self._query_s < RESPONSE_TIMEOUT_S:
            return b""
        if is_unanswered and self._unparsed:
            self._unprompted = _describe_unprompted(self._unparsed)
        if now_s - self._cycle_s >= POLL_CYCLE_S or is_unanswered:
            self._cycle_s = now_s
            return self._send_query(b"pwr\n", now_s)
        if self._query == b"pwr\n" and self._batteries:
            self._battery_index = (self._battery_index + 1) % len(self._batteries)
            return self._send_query(b"bat %d\n" % self._batteries[self._battery_index], now_s)
        return b""

    def _send_query(self, command: bytes, now_s: float) -> bytes:
        self._query, self._query_s, self._responses_at_query = command, now_s, self._responses
        return command

    def _read(self, arrival_s: float, data: bytes) -> Iterator[Reading]:
        self._unparsed, rs485_frames = RS485_FRAME.subn(b"", self._unparsed + data)
        if rs485_frames:
            self._count_fault(
                "text_errors", "frames of the RS-485 protocol arrive: connect to the console port of the master battery"
            )
        *answers, self._unparsed = PROMPT.split(self._unparsed)
        for answer in answers:
            self._responses, self._unprompted = self._responses + 1, None
            if (
                len(answer) <= MAX_RESPONSE_BYTES
                and (reading := self._parse(arrival_s, answer.decode("ascii", "replace"))) is not None
            ):
                yield reading
        if len(self._unparsed) > MAX_RESPONSE_BYTES:
            self._count_fault("length_errors", _describe_unprompted(self._unparsed))
            self._unparsed = b""

    def _parse(self, arrival_s: float, answer: str) -> Reading | None:
        """Parse a response: return the reading of ``pwr``; store the cells of ``bat`` and return None."""
        lines = [line.split() for line in re.split(r"[\r\n]+", answer) if line.strip()]
        header = next((n for n, line in enumerate(lines) if line[0] in (STACK, *CELLS) and line[1:2] == ["Volt"]), None)
        if header is None:
            if "Unknown command" in answer or "Invalid" in answer:
                self._count_fault(
                    "text_errors", "the console rejects the command: is it the console of a Pylontech master?"
                )
            elif SUCCESS in answer:
                shown = next((line for line in lines if "Volt" in line), lines[0])
                self._count_fault(
                    "text_errors",
                    "a table does not begin with the columns Power, Volt of a master's console: "
                    + " ".join(shown)[:MAX_SHOWN_BYTES],
                )
            return None
        rows = [line for line in lines[header + 1 :] if line[0].isdigit()]
        if SUCCESS not in answer or not rows:
            self._count_fault("length_errors", "a table is cut off")
            return None
        # batteries are numbered from 1, cells from 0 or 1
        first = 0 if lines[header][0] in CELLS and rows[0][0] == "0" else 1
        if (lost := next((n for n, row in enumerate(rows, first) if row[0] != str(n)), None)) is not None:
            self._count_fault("length_errors", f"row {lost} of a table is missing")
            return None
        try:
            if lines[header][0] in CELLS:
                self._store_cells(arrival_s, answer, rows)
                return None
            return self._stack_reading(arrival_s, lines[header], rows)
        except (ValueError, LookupError):
            self._count_fault("text_errors", "a table has a row that cannot be parsed")
            return None

    def _store_cells(self, arrival_s: float, answer: str, rows: Sequence[Sequence[str]]) -> None:
        """Store the cell voltages of a response; raises ValueError or LookupError if a row cannot be parsed."""
        echo = ECHO.search(answer)
        battery = int(echo[1]) if echo else 1
        if not 1 <= battery <= MAX_BATTERIES or len(rows) > MAX_CELLS:
            raise ValueError(answer)
        cells_v = [1e-3 * _parse_integer(row[1]) for row in rows]
        self._cells.setdefault(battery, RecentCellVoltages(MAX_CELLS_AGE_S)).store(arrival_s, cells_v)

    def _stack_reading(self, arrival_s: float, names: Sequence[str], rows: Sequence[Sequence[str]]) -> Reading | None:
        """Return the reading of all batteries in parallel; None if none is present, or if one is missing.

        Raises:
            ValueError, LookupError: A row cannot be parsed, or has more columns than the header.
        """
        columns = (names.index(name) for name in ("Volt", "Curr", "Tempr", "Tlow", "Thigh"))
        voltage, current, temperature, lowest_temperature, highest_temperature = columns
        present = [row for row in rows if row[voltage] != ABSENT]
        if not present:
            self._count_fault("text_errors", "the console reports no present battery")
            return None
        if max(map(len, present)) > len(names) + names.count(TIME):  # a master may leave the SOC of other batteries out
            raise ValueError(names)
        batteries = tuple(int(row[0]) for row in present)
        if (missing := set(self._batteries) - set(batteries)) and arrival_s - self._table_s < MAX_MISSING_S:
            absent = " and ".join(map(str, sorted(missing)))
            self._count_fault(
                "text_errors", f"the table has no values of battery {absent}: the sum would lack a part of the current"
            )
            return None
        if self._expected is not None and len(batteries) < self._expected:
            numbers = ", ".join(map(str, batteries))
            self._count_fault(
                "text_errors",
                f"the table has only battery {numbers}, but pack.parallel is {self._expected}: connect the others, or set "
                "pack.parallel to the number of batteries",
            )
            return None
        voltages_v = [1e-3 * _parse_integer(row[voltage]) for row in present]
        currents_a = [1e-3 * _parse_integer(row[current]) for row in present]
        cell_temperatures = [[row[lowest_temperature], row[highest_temperature]] for row in present]
        temperature_texts = [
            texts if ABSENT not in texts else [row[temperature]]
            for texts, row in zip(cell_temperatures, present, strict=True)
        ]
        temperatures_c = tuple(1e-3 * _parse_integer(text) for texts in temperature_texts for text in texts)
        self._batteries, self._table_s = batteries, arrival_s
        battery_cells_v = [
            self._cells[battery].at(arrival_s) if battery in self._cells else () for battery in self._batteries
        ]
        cells_v = tuple(itertools.chain(*battery_cells_v)) if all(battery_cells_v) else ()
        return Reading(_mean(voltages_v), sum(currents_a), temperatures_c, cells_v, soc=_stack_soc(names, present))


def _describe_unprompted(data: bytes) -> str:
    """Return the fault of received bytes without a prompt."""
    if data.translate(None, PRINTABLE):
        return "bytes arrive, but no prompt of a Pylontech console: its baud rate is 115200"
    shown = " ".join(data.decode("ascii").split())[:MAX_SHOWN_BYTES]
    return f"text without the prompt of a Pylontech console arrives: is it another device or port? It begins: {shown}"


def _stack_soc(names: Sequence[str], rows: Sequence[Sequence[str]]) -> float:
    """Return the mean SOC of batteries in parallel, 0..1; NaN if one of them reports none."""
    if SOC not in names:
        return math.nan
    texts = [row[names.index(SOC)] for row in rows]
    if not all(text.endswith("%") and text[:-1].isdecimal() for text in texts):
        return math.nan
    return _mean([float(text[:-1]) / 100 for text in texts])


def _parse_integer(text: str) -> int:
    """Parse an integer of the table.

    Raises:
        ValueError: The text is not an integer.
    """
    if not re.fullmatch(rf"-?[0-9]{{1,{MAX_DIGITS}}}", text):
        raise ValueError(text)
    return int(text)


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


DEVICE = Device(
    "pylontech",
    lambda sensor: PylontechProtocol(current_sign=sensor.current_sign, batteries=sensor.batteries),
    SensorDefaults(
        baud=115_200,
        current_sign="charge_positive",
        period_s=2.0,
        voltage_resolution_v=0.001,
        current_resolution_a=0.01,
        current_dead_band_a=0.1,
    ),
    max_batteries=MAX_BATTERIES,
)
"""The table has steps of 1 mV and 1 mA. In public captures the smallest nonzero current is 149 mA, next to many zeros."""
