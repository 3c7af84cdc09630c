"""Identifies the device on a serial port, and requests a board's hello and settings."""

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self, TypeVar

from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.device_protocol import DeviceProtocol
from bms_estimator.protocols.devices.text import TextProtocol
from bms_estimator.protocols.firmware.frame_decoder import FrameFault
from bms_estimator.protocols.firmware.messages import BAUD, Hello, set_rate_command
from bms_estimator.protocols.firmware.protocol import ASK_AGAIN_S, BoardProtocol
from bms_estimator.protocols.registry import PROTOCOLS, make_protocol
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.serial.port_list import NoPortError, open_port

if TYPE_CHECKING:
    import serial

BOOT_TIMEOUT_S = 3.0
"""A board that was reset by the opening of its port spends two seconds in its boot loader [s]."""
PROTOCOL_TIMEOUT_S = 1.5
"""Time added to a baud rate for each protocol that is tried at it in turn [s]."""
QUERY_INTERVAL_S = 0.3
"""Time for a response before the next protocol's query [s]."""
READ_S = 0.1
"""Timeout of a read [s]."""
READ_BYTES = 4096
REFERENCE_RATE_HZ = 100
"""The firmware's own: the bandgap is measured in every second sample, or in each without an NTC."""
REFERENCE_SAMPLES = 300
"""Number of bandgap readings: the noise of their mean is 0.03 %."""
REFERENCE_S = 10.0
"""Timeout of these readings [s]."""

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class DetectedDevice:
    """Device that responds on a port."""

    protocol: str
    baud: int
    described: str
    """Description as text."""
    cells: int | None = None
    """Cells in series, if reported."""

    def __str__(self) -> str:
        """Describe the device, and how to reach it unless it is a board at the firmware's own rate."""
        usual = self.baud == BAUD and self.protocol in ("binary", "text")
        return self.described if usual else f"{self.described}; protocol {self.protocol}, {self.baud} baud"


def probe(port: str, baud: int | None = None) -> DetectedDevice | str:
    """Detect the device on ``port``; return it, or the reason why it is unknown.

    A board of the firmware is looked for first. Then every protocol of ``sensor.protocol`` is tried at its own baud
    rate, one request at a time. The requests change nothing.

    Args:
        port: Device path; opened for ourselves alone.
        baud: Try everything at this rate [1/s]; None: each at its own.
    """
    rates = _rates() if baud is None else {baud: list(PROTOCOLS)}
    silence = "silent"
    BoardProtocol().feed(0.0, b"\0\n")  # loads its kernel: nothing compiles while an answer is waited for
    try:
        with open_port(port, next(iter(rates)), READ_S) as line:
            for rate, protocols in rates.items():
                line.baudrate = rate
                line.reset_input_buffer()
                decoders = {name: _prober(name) for name in protocols}
                patience_s = BOOT_TIMEOUT_S if rate == BAUD and baud is None else PROTOCOL_TIMEOUT_S * len(decoders)
                if (found := _ask_in_turns(line, decoders, patience_s)) is not None:
                    return DetectedDevice(found, rate, *_described(decoders[found]))
                if silence == "silent":
                    silence = _silence(list(decoders.values()))
    except NoPortError as error:
        return str(error).removeprefix(f"{port}: ")
    except OSError as error:
        return f"lost: {error}"
    return silence


def _rates() -> Mapping[int, Sequence[str]]:
    """Protocols by baud rate, the firmware's first, then from the fastest down; text is read at any."""
    rates: dict[int, list[str]] = {BAUD: []}
    for name in PROTOCOLS:
        rates.setdefault(SensorSettings.model_validate({"protocol": name}).baud, []).append(name)
    for protocols in rates.values():
        if "text" not in protocols:
            protocols.append("text")
    return {rate: rates[rate] for rate in sorted(rates, key=lambda rate: (rate != BAUD, -rate))}


def _prober(protocol: str) -> DeviceProtocol:
    decoder = make_protocol(SensorSettings.model_validate({"protocol": protocol}))
    decoder.probing = True
    return decoder


def _ask_in_turns(line: "serial.Serial", decoders: Mapping[str, DeviceProtocol], patience_s: float) -> str | None:
    """Pass received bytes to all protocols, and let one of them poll at a time.

    Returns the first protocol that identifies the device.

    Raises:
        OSError: The port is lost.
    """
    turns, next_s = itertools.cycle(decoders.values()), 0.0
    end_s = time.monotonic() + patience_s
    while (now_s := time.monotonic()) < end_s:
        if now_s >= next_s:
            questions = (decoder.next_output(now_s) for decoder in itertools.islice(turns, len(decoders)))
            if question := next(filter(None, questions), b""):
                line.write(question)
                next_s = now_s + QUERY_INTERVAL_S
        data = line.read(max(1, min(line.in_waiting, READ_BYTES)))
        for name, decoder in decoders.items():
            decoder.feed(now_s, data)
            if decoder.description:
                return name
    return None


def _described(decoder: DeviceProtocol) -> tuple[str, int | None]:
    """Return the device's description and its number of cells."""
    return decoder.description or "", decoder.cells.shape[1] or None


class BoardClient:
    """A board that does nothing but answer; a context manager.

    Args:
        port: Device path; opened for ourselves alone.
        baud: Baud rate of the board [1/s].

    Raises:
        NoPortError: The port cannot be opened.
    """

    def __init__(self, port: str, baud: int = BAUD) -> None:
        self._port, self._line = port, open_port(port, baud, ASK_AGAIN_S)
        self._board, self._text = BoardProtocol(), TextProtocol()

    def __enter__(self) -> Self:
        """Return the board client."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the port."""
        self._line.close()

    def hello(self) -> Hello:
        """Return the board's hello after the last command.

        Raises:
            UserError: No board answers; the message describes the device found.
        """
        return self._ask([self._board, self._text], lambda: self._board.hello)

    def tell(self, frame: bytes) -> Hello:
        """Give a command that may be given twice. Returns the hello after it.

        Raises:
            UserError: The board refuses, or does not answer.
        """
        command = self._board.tell(frame)
        self._ask([self._board, self._text], lambda: command.done or None)
        if command.refusal:
            raise UserError(f"{self._port}: {command.refusal}")
        return self.hello()

    def reference_v(self) -> float:
        """Full range of its converter by the present bandgap reading [V]; the reading at its reset may be old.

        The board samples at ``REFERENCE_RATE_HZ`` from then on.

        Raises:
            UserError: As ``tell``.
        """
        hello = self.tell(set_rate_command(REFERENCE_RATE_HZ))
        now = BoardProtocol()
        now.feed(0.0, replace(hello, bandgap_sum=0, bandgap_count=0).encode())

        def measured() -> float | None:
            return now.reference_v if now.counters["frames_received"] >= REFERENCE_SAMPLES else None

        return self._ask([now], measured, REFERENCE_S)

    def _ask(
        self, decoders: Sequence[DeviceProtocol], answer: Callable[[], Answer | None], patience_s: float | None = None
    ) -> Answer:
        """Wait for a response.

        Raises:
            UserError: It does not exist.
        """

        def answer_or_text() -> Answer | None:
            if self._text.description:
                raise UserError(f"{self._port}: {FrameFault.TEXT.value}; it takes no commands")
            return answer()

        try:
            answered = _converse(self._line, decoders, answer_or_text, patience_s)
        except OSError as error:
            raise UserError(f"{self._port}: lost: {error}") from None
        if answered is None:
            raise UserError(f"{self._port}: {_silence(decoders)}")
        return answered


def _converse(
    line: "serial.Serial",
    decoders: Sequence[DeviceProtocol],
    answer: Callable[[], Answer | None],
    patience_s: float | None = None,
) -> Answer | None:
    """Let decoders receive and poll until there is an answer; None without one.

    Raises:
        OSError: The port is lost.
    """
    end_s = time.monotonic() + (BOOT_TIMEOUT_S if patience_s is None else patience_s)
    while (now_s := time.monotonic()) < end_s:
        if (answered := answer()) is not None:
            return answered
        for decoder in decoders:
            line.write(decoder.next_output(now_s))
        data = line.read(max(1, min(line.in_waiting, READ_BYTES)))
        for decoder in decoders:
            decoder.feed(now_s, data)
    return answer()


def _silence(decoders: Sequence[DeviceProtocol]) -> str:
    """Why no protocol identifies the device."""
    if not decoders[0].counters["bytes_received"]:
        return "silent"
    return next((decoder.fault for decoder in decoders if decoder.fault), "no board answers")
