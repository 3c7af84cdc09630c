"""Batteries of Pylontech, US2000 to US5000 and their like, on the console port of the master.

Text for people: ``pwr`` prints a table of all batteries in parallel, ``bat N`` one of the cells of battery N, each
followed by a prompt. Voltages in mV, currents in mA and positive on charge, temperatures in thousandths of a degree
Celsius.
There is no checksum: a table is accepted if it ends with the success message and each of its rows can be read.
"""

import itertools
import math
import re
from collections.abc import Iterator, Sequence

from bms_estimator.model.sample import CurrentSign
from bms_estimator.protocols.base.device import Device, Resolution
from bms_estimator.protocols.base.reading import Reading
from bms_estimator.protocols.base.reading_protocol import ReadingProtocol, RecentCellVoltages

ROUND_S = 2.0
"""Interval between queries of all batteries [s]; the cells of one battery are queried in between."""
ANSWER_S = 5.0
"""Timeout of a response [s]; then the query is repeated."""
ANSWER_BYTES = 16384
"""No answer is longer: 16 rows of less than 200 bytes."""
PROMPT = re.compile(rb"pylon\w*>")
ECHO = re.compile(r"\bbat\s+([0-9]{1,2})\b")
SUCCESS = "Command completed"
BATTERIES = 16
CELLS = 32
CELLS_S = 90.0
"""Maximum age of cell voltages [s]: two cycles of 16 batteries, with some lost responses."""
DIGITS = 9
ABSENT = "-"


class PylontechProtocol(ReadingProtocol):
    """Decoder of the console's tables: mean voltage, sum of the currents, mean temperature of the cells.

    The cells of all batteries follow each other, each battery's with its last recent values.

    Args:
        current_sign: Direction that the device calls positive: charge.
    """

    def __init__(self, *, current_sign: CurrentSign = "charge_positive") -> None:
        super().__init__(current_sign, ("text_errors", "length_errors"))
        self._rest = b""
        self._cells = dict[int, RecentCellVoltages]()
        self._batteries: tuple[int, ...] = ()
        self._answers = 0
        self._round_s = self._asked_s = -math.inf
        self._asked_at = -1  # number of responses at the last request
        self._asked = b""
        self._turn = 0  # battery whose cells are requested next

    @property
    def description(self) -> str | None:
        """Number of batteries, and the last values."""
        if self._last_reading is None:
            return None
        n = len(self._batteries)
        batteries = "1 battery" if n == 1 else f"{n} batteries"
        return f"Pylontech, {batteries}, {self._last_reading.voltage_v:g} V, {self._last_reading.current_a:g} A"

    def on_port_opened(self) -> None:
        """Poll at once. Decoded values stay, because a recording does not contain openings."""
        self._round_s = self._asked_s = -math.inf
        self._asked = b""

    def next_output(self, now_s: float) -> bytes:
        """``pwr`` each round, and when that is answered ``bat N``, each battery in its turn."""
        waits = self._asked and self._answers == self._asked_at
        if waits and now_s - self._asked_s < ANSWER_S:
            return b""
        if now_s - self._round_s >= ROUND_S or waits:
            self._round_s = now_s
            return self._ask(b"pwr\n", now_s)
        if self._asked == b"pwr\n" and self._batteries:
            self._turn = (self._turn + 1) % len(self._batteries)
            return self._ask(b"bat %d\n" % self._batteries[self._turn], now_s)
        return b""

    def _ask(self, command: bytes, now_s: float) -> bytes:
        self._asked, self._asked_s, self._asked_at = command, now_s, self._answers
        return command

    def _read(self, arrival_s: float, data: bytes) -> Iterator[Reading]:
        self._rest += data
        *answers, self._rest = PROMPT.split(self._rest)
        for answer in answers:
            self._answers += 1
            if (
                len(answer) <= ANSWER_BYTES
                and (reading := self._of(arrival_s, answer.decode("ascii", "replace"))) is not None
            ):
                yield reading
        if len(self._rest) > ANSWER_BYTES:
            self._rest = b""
            self._count_fault("length_errors", "bytes come, but no prompt of a Pylontech console: it has 115200 baud")

    def _of(self, arrival_s: float, answer: str) -> Reading | None:
        """Parse the response to ``pwr``; store that to ``bat`` for the next one."""
        lines = [line.split() for line in re.split(r"[\r\n]+", answer) if line.strip()]
        header = next((n for n, line in enumerate(lines) if line[:2] in (["Power", "Volt"], ["Battery", "Volt"])), None)
        if header is None:
            if "Unknown command" in answer or "Invalid" in answer:
                self._count_fault(
                    "text_errors", "the console does not know the command: is it that of a Pylontech master?"
                )
            return None
        rows = [line for line in lines[header + 1 :] if line[0].isdigit()]
        if SUCCESS not in answer or not rows:
            self._count_fault("length_errors", "a table that is cut off")
            return None
        try:
            if lines[header][0] == "Battery":
                self._store_cells(arrival_s, answer, rows)
                return None
            return self._stack(arrival_s, lines[header], rows)
        except (ValueError, LookupError):
            self._count_fault("text_errors", "a table with a row that cannot be read")
            return None

    def _store_cells(self, arrival_s: float, answer: str, rows: Sequence[Sequence[str]]) -> None:
        """Store the cell voltages of a response; raises ValueError or LookupError if a row cannot be parsed."""
        echo = ECHO.search(answer)
        battery = int(echo[1]) if echo else 1
        if not 1 <= battery <= BATTERIES or len(rows) > CELLS:
            raise ValueError(answer)
        cells_v = [1e-3 * _whole(row[1]) for row in rows]
        self._cells.setdefault(battery, RecentCellVoltages(CELLS_S)).store(arrival_s, cells_v)

    def _stack(self, arrival_s: float, names: Sequence[str], rows: Sequence[Sequence[str]]) -> Reading | None:
        """All batteries as one.

        Raises:
            ValueError, LookupError: A row cannot be read.
        """
        volt, amp, warm, low, high = (names.index(name) for name in ("Volt", "Curr", "Tempr", "Tlow", "Thigh"))
        present = [row for row in rows if row[volt] != ABSENT]
        if not present:
            self._count_fault("text_errors", "the console knows no battery that is present")
            return None
        voltages_v = [1e-3 * _whole(row[volt]) for row in present]
        currents_a = [1e-3 * _whole(row[amp]) for row in present]
        told = [[row[low], row[high]] if ABSENT not in (row[low], row[high]) else [row[warm]] for row in present]
        temperatures_c = [1e-3 * _whole(text) for texts in told for text in texts]
        self._batteries = tuple(int(row[0]) for row in present)
        told_v = [self._cells[battery].at(arrival_s) if battery in self._cells else () for battery in self._batteries]
        cells_v = tuple(itertools.chain(*told_v)) if all(told_v) else ()
        return Reading(_mean(voltages_v), sum(currents_a), _mean(temperatures_c), cells_v)


def _whole(text: str) -> int:
    """Parse an integer of the table.

    Raises:
        ValueError: It is not an integer.
    """
    if not re.fullmatch(rf"-?[0-9]{{1,{DIGITS}}}", text):
        raise ValueError(text)
    return int(text)


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


DEVICE = Device(
    "pylontech",
    lambda sign, _: PylontechProtocol(current_sign=sign),
    Resolution(115_200, "charge_positive", 2.0, 0.001, 0.01, 0.1),
)
"""The table has steps of 1 mV and 1 mA. In public captures the smallest current that is not 0 is 149 mA, beside many of 0."""
