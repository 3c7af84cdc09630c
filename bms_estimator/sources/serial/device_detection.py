"""Detection of the device on a serial port, and a client for a board's settings."""

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self, TypeVar

from bms_estimator.model.cell_slots import is_live
from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.reading_protocol import DeviceProtocol
from bms_estimator.protocols.devices.text import TextProtocol
from bms_estimator.protocols.firmware.frame_decoder import FrameFault
from bms_estimator.protocols.firmware.messages import BAUD, Hello, set_rate_command
from bms_estimator.protocols.firmware.protocol import RETRY_S, BoardProtocol
from bms_estimator.protocols.registry import PROTOCOLS, make_protocol
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.serial.port_list import NoPortError, open_port

if TYPE_CHECKING:
    import serial

BOOT_TIMEOUT_S = 3.0
"""Timeout for a board [s]. Opening the port may reset it, and its boot loader then takes two seconds."""
PROTOCOL_TIMEOUT_S = 1.5
"""Timeout for each protocol that is tried at a baud rate [s]."""
QUERY_INTERVAL_S = 0.3
"""Interval between the queries of two protocols [s]."""
READ_TIMEOUT_S = 0.1
"""Timeout of a read [s]."""
READ_BYTES = 4096
"""Maximum size of a read [bytes]."""
REFERENCE_RATE_HZ = 100
"""Default sample rate of the firmware [Hz]. Every sample has a bandgap reading, or every second one if an NTC is fitted."""
REFERENCE_SAMPLES = 300
"""Number of samples for the mean of the bandgap. Its noise is then 0.03 %."""
REFERENCE_TIMEOUT_S = 10.0
"""Timeout of the bandgap measurement [s]."""

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class DetectedDevice:
    """Device that responds on a port."""

    protocol: str
    baud: int
    description: str
    cells: int | None = None
    """Number of cells in series, if reported."""

    def __str__(self) -> str:
        """Describe the device; add protocol and baud rate unless it is a board at the default rate."""
        is_default = self.baud == BAUD and self.protocol in ("binary", "text")
        return self.description if is_default else f"{self.description}; protocol {self.protocol}, {self.baud} baud"


def probe(port: str, baud: int | None = None) -> DetectedDevice | str:
    """Detect the device on ``port``; return it, or the reason why it is unknown.

    The firmware's protocol is tried first. Then every other protocol is tried at its default baud rate, one request at a
    time. The requests change nothing in any device.

    Args:
        port: Device path; opened exclusively.
        baud: Baud rate of all protocols [1/s]; None: the default of each.
    """
    protocols_by_baud = _protocols_by_baud() if baud is None else {baud: list(PROTOCOLS)}
    reason = "silent"
    BoardProtocol().feed(0.0, b"\0\n")  # compiles its kernel before the timeouts begin
    try:
        with open_port(port, next(iter(protocols_by_baud)), READ_TIMEOUT_S) as line:
            for rate, protocols in protocols_by_baud.items():
                line.baudrate = rate
                line.reset_input_buffer()
                decoders = {name: _probing_decoder(name) for name in protocols}
                timeout_s = BOOT_TIMEOUT_S if rate == BAUD and baud is None else PROTOCOL_TIMEOUT_S * len(decoders)
                if (found := _query_in_turn(line, decoders, timeout_s)) is not None:
                    return DetectedDevice(found, rate, *_describe(decoders[found]))
                if reason == "silent":  # the first other reason is reported
                    reason = _failure_reason(list(decoders.values()))
    except NoPortError as error:
        return str(error).removeprefix(f"{port}: ")
    except OSError as error:
        return f"lost: {error}"
    return reason


def _protocols_by_baud() -> Mapping[int, Sequence[str]]:
    """Return the protocols to try at each baud rate: the firmware's rate first, then descending. Text is tried at each."""
    protocols_by_baud: dict[int, list[str]] = {BAUD: []}
    for name in PROTOCOLS:
        protocols_by_baud.setdefault(SensorSettings.model_validate({"protocol": name}).baud, []).append(name)
    for protocols in protocols_by_baud.values():
        if "text" not in protocols:
            protocols.append("text")
    return {rate: protocols_by_baud[rate] for rate in sorted(protocols_by_baud, key=lambda rate: (rate != BAUD, -rate))}


def _probing_decoder(protocol: str) -> DeviceProtocol:
    decoder = make_protocol(SensorSettings.model_validate({"protocol": protocol}))
    decoder.probing = True
    return decoder


def _query_in_turn(line: "serial.Serial", decoders: Mapping[str, DeviceProtocol], timeout_s: float) -> str | None:
    """Feed received bytes to all protocols, and let one of them poll at a time.

    Return the name of the first protocol that identifies the device; None if none does in time.

    Raises:
        OSError: The port is lost.
    """
    pollers, next_s = itertools.cycle(decoders.values()), 0.0
    end_s = time.monotonic() + timeout_s
    while (now_s := time.monotonic()) < end_s:
        if now_s >= next_s:
            queries = (decoder.next_output(now_s) for decoder in itertools.islice(pollers, len(decoders)))
            if query := next(filter(None, queries), b""):
                line.write(query)
                next_s = now_s + QUERY_INTERVAL_S
        data = line.read(max(1, min(line.in_waiting, READ_BYTES)))
        for name, decoder in decoders.items():
            decoder.feed(now_s, data)
            if decoder.description:
                return name
    return None


def _describe(decoder: DeviceProtocol) -> tuple[str, int | None]:
    """Return the device's description and its number of cells."""
    return decoder.description or "", int(is_live(decoder.cells[-1:]).sum()) or None


class BoardClient:
    """Client for the commands of a board on a serial port; a context manager.

    Args:
        port: Device path; opened exclusively.
        baud: Baud rate of the board [1/s].

    Raises:
        NoPortError: The port cannot be opened.
    """

    def __init__(self, port: str, baud: int = BAUD) -> None:
        self._port, self._line = port, open_port(port, baud, RETRY_S)  # reads end in time to repeat a command
        self._board, self._text = BoardProtocol(), TextProtocol()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._line.close()

    def hello(self) -> Hello:
        """Return the board's hello after the last command.

        Raises:
            UserError: No board answers; the message describes the device found.
        """
        return self._wait_for([self._board, self._text], lambda: self._board.hello)

    def send(self, frame: bytes) -> Hello:
        """Send a command, repeatedly if necessary; return the hello after it.

        Raises:
            UserError: The board rejects the command, or does not answer.
        """
        command = self._board.send(frame)
        self._wait_for([self._board, self._text], lambda: command.done or None)
        if command.refusal:
            raise UserError(f"{self._port}: {command.refusal}")
        return self.hello()

    def zero_current(self) -> None:
        """Make the board store the present current as its zero, after it has measured for a second.

        Raises:
            UserError: The board rejects the command, or does not answer.
        """
        self.hello()
        command = self._board.command("current_zero")
        self._wait_for([self._board, self._text], lambda: command.done or None)
        if command.refusal:
            raise UserError(f"{self._port}: {command.refusal}")

    def reference_v(self) -> float:
        """Measure the full range of the board's converter against its bandgap [V].

        The value in the hello was measured at the last reset and may be old. The sample rate of the board is changed to
        ``REFERENCE_RATE_HZ``.

        Raises:
            UserError: The board rejects the command, or does not answer.
        """
        hello = self.send(set_rate_command(REFERENCE_RATE_HZ))
        decoder = BoardProtocol()
        # a hello without a measurement, so that only the samples count
        decoder.feed(0.0, replace(hello, bandgap_sum=0, bandgap_count=0).encode())

        def measured() -> float | None:
            return decoder.reference_v if decoder.counters["frames_received"] >= REFERENCE_SAMPLES else None

        return self._wait_for([decoder], measured, REFERENCE_TIMEOUT_S)

    def _wait_for(
        self, decoders: Sequence[DeviceProtocol], answer: Callable[[], Answer | None], timeout_s: float | None = None
    ) -> Answer:
        """Wait for a response.

        Raises:
            UserError: No response arrives in time, the port is lost, or the device prints text.
        """

        def answer_or_text() -> Answer | None:
            if self._text.description:
                raise UserError(f"{self._port}: {FrameFault.TEXT.value}; it takes no commands")
            return answer()

        try:
            result = _exchange(self._line, decoders, answer_or_text, timeout_s)
        except OSError as error:
            raise UserError(f"{self._port}: lost: {error}") from None
        if result is None:
            raise UserError(f"{self._port}: {_failure_reason(decoders)}")
        return result


def _exchange(
    line: "serial.Serial",
    decoders: Sequence[DeviceProtocol],
    answer: Callable[[], Answer | None],
    timeout_s: float | None = None,
) -> Answer | None:
    """Let decoders poll and receive until ``answer`` returns a result; None if it does not in time.

    Raises:
        OSError: The port is lost.
    """
    end_s = time.monotonic() + (BOOT_TIMEOUT_S if timeout_s is None else timeout_s)
    while (now_s := time.monotonic()) < end_s:
        if (result := answer()) is not None:
            return result
        for decoder in decoders:
            line.write(decoder.next_output(now_s))
        data = line.read(max(1, min(line.in_waiting, READ_BYTES)))
        for decoder in decoders:
            decoder.feed(now_s, data)
    return answer()


def _failure_reason(decoders: Sequence[DeviceProtocol]) -> str:
    """Return the reason why no protocol identifies the device."""
    if not decoders[0].counters["bytes_received"]:
        return "silent"
    return next((decoder.fault for decoder in decoders if decoder.fault), "no board answers")
