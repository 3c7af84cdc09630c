"""Protocol of the firmware's board: decodes its frames, and sends it commands."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import CurrentSign, SampleBlock
from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.probe_check import ProbeCheck
from bms_estimator.protocols.base.reading_protocol import Command, DeviceProtocol
from bms_estimator.protocols.base.relay import Relay
from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.protocols.firmware.messages import (
    AckResult,
    Hello,
    hello_command,
    relay_word,
    set_rate_command,
    set_relay_command,
    unseal,
    zero_current_command,
)

RETRY_S = 0.5
"""Retry interval of an unanswered command [s]."""
_HELLO = hello_command()


@dataclass
class _PendingCommand(Command):
    """Pending command. It is done when it is acknowledged. A command that changes the hello also needs a new hello."""

    frame: bytes = b""
    retry_s: float = RETRY_S
    hint: str = ""
    """Possible cause of a rejection, which is appended to the error text."""
    changes_hello: bool = True
    acknowledged: bool = False


@dataclass
class _RelayCommand(_PendingCommand):
    """Pending relay command. It is sent right after a requested hello, so that it does not reach a board after a reset."""

    changes_hello: bool = False
    hint: str = "; firmware before 0.2.0 has no relay pin"
    word: int = 0
    """Setting that the board must confirm."""
    boots: int = 0
    """Number of boots of the board when the command was queued."""
    hellos: int = 0
    """Number of received hellos when the command was queued or last sent."""


class BoardProtocol(DeviceProtocol):
    """Protocol of a board. It samples by itself, and nothing is sent before its first complete frame has arrived.

    Args:
        current_sign: Direction of positive current of the board; samples are positive on discharge.
        rate_hz: Sample rate that the board is set to [Hz]; None: unchanged.
    """

    def __init__(self, *, current_sign: CurrentSign = "discharge_positive", rate_hz: int | None = None) -> None:
        self._decoder, self._probe_check = FrameDecoder(current_sign=current_sign), ProbeCheck()
        self._rate_hz = rate_hz
        self._frame_end_at_opening = 0
        self._last_output, self._output_s = b"", -math.inf
        self._command: _PendingCommand | None = None

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters of the decoder."""
        counts = self._decoder.counters.as_dict()
        return counts | {"implausible": counts["implausible"] + self._probe_check.faults}

    @property
    def fault(self) -> str | None:
        """Fault of the line as a whole."""
        return fault.value if (fault := self._decoder.fault) else None

    @property
    def hello(self) -> Hello | None:
        """Hello of the board since the last opening of the port, reset or command; None before it."""
        return self._decoder.hello

    @property
    def board(self) -> Mapping[str, str]:
        """Fields of the board's hello."""
        return self._decoder.board

    @property
    def clock_ppm(self) -> float | None:
        """Rate error of the board's clock relative to the arrival times [1e-6]; None if unknown."""
        return self._decoder.clock_ppm

    @property
    def boots(self) -> int:
        """Number of resets and exchanges of the board since the first hello."""
        return self._decoder.boots

    @property
    def description(self) -> str | None:
        """Firmware, serial number and sample rate; None before a hello."""
        if self.hello is None:
            return None
        serial_number = f", serial {self.hello.serial:08x}" if self.hello.serial else ""
        return f"board, firmware {self.hello.firmware}{serial_number}, {self.hello.rate_hz} Hz"

    @property
    def reference_v(self) -> float:
        """Full range of the board's converter [V]; NaN before it is known."""
        return self._decoder.reference_v

    def serial_number_in(self, data: bytes) -> str | None:
        """Return the serial number of the last hello in ``data``."""
        return self._decoder.serial_number_in(data)

    def on_port_opened(self) -> None:
        """Discard the hello and a pending command. Samples use the last scaling until the next hello."""
        self._decoder.discard_hello()
        self._frame_end_at_opening = self._decoder.last_frame_end
        if self._command is not None and not self._command.done:
            self._command.refusal = "the line was lost before the board answered, and another board may be there now"
            self._command.done = True

    def _decode(self, arrival_s: float, data: bytes) -> SampleBlock:
        """Decode the bytes of one read; for ``time_s`` see ``FrameDecoder.feed``."""
        block = self._decoder.feed(arrival_s, data)
        self._probe_check.apply_to_single_probe(block)
        if self._command is not None:
            self._update_command(self._command)
        return block

    def _decode_reads(
        self, arrivals_s: NDArray[np.float64], ends: NDArray[np.int64], data: NDArray[np.uint8]
    ) -> SampleBlock:
        """Decode many reads at once."""
        block = self._decoder.feed_reads(arrivals_s, ends, data)
        self._probe_check.apply_to_single_probe(block)
        return block

    def next_output(self, now_s: float) -> bytes:
        """Return a request for the hello, then the pending command, then the rate command. Each is repeated until answered."""
        output, retry_s = self._choose_output()
        relay = self._command if isinstance(self._command, _RelayCommand) else None
        is_repeated = output == self._last_output or (relay is not None and self._last_output == relay.frame)
        if is_repeated and now_s - self._output_s < retry_s:
            return b""
        if relay is not None and output == relay.frame:
            relay.hellos = self._decoder.hellos
        self._last_output, self._output_s = output, now_s
        return output

    def command(self, name: str) -> Command:
        """Queue ``current_zero``, which makes the board store the present current as zero.

        Raises:
            UserError: ``name`` is another command.
        """
        if name != "current_zero":
            raise UserError(f"the board has no command {name}")
        hint = "; is the sensor connected, and no current flowing?"
        # not repeated, because the board measures for a second before it answers
        return self._queue(_PendingCommand(frame=zero_current_command(), retry_s=math.inf, hint=hint))

    def relay(self, relay: Relay) -> Command:
        """Queue the command that sets the level of the relay pin. It fails if the board is reset before it confirms."""
        decoder, frame = self._decoder, set_relay_command(relay)
        return self._queue(
            _RelayCommand(frame=frame, word=relay_word(relay), boots=decoder.boots, hellos=decoder.hellos)
        )

    def send(self, frame: bytes) -> Command:
        """Queue a command that may be repeated."""
        return self._queue(_PendingCommand(frame=frame))

    def _queue(self, command: _PendingCommand) -> Command:
        self._decoder.pop_acks()  # discards acknowledgments of the previous command
        self._last_output = b""
        self._command = command
        return command

    def _choose_output(self) -> tuple[bytes, float]:
        """Return the next bytes to send, and their retry interval [s]."""
        hello = self._decoder.hello
        if hello is None:
            return _HELLO if self._decoder.last_frame_end > self._frame_end_at_opening else b"", RETRY_S
        if self._command is not None and not self._command.done:
            if isinstance(self._command, _RelayCommand) and self._command.hellos == self._decoder.hellos:
                return _HELLO, RETRY_S
            return self._command.frame, self._command.retry_s
        if self._rate_hz is not None and self._rate_hz != hello.rate_hz:
            return set_rate_command(self._rate_hz) + _HELLO, RETRY_S
        return b"", RETRY_S

    def _update_command(self, command: _PendingCommand) -> None:
        """Update the pending command from received acknowledgments and hellos."""
        for ack in self._decoder.pop_acks():
            message_type = unseal(command.frame)[1]
            if ack.command != message_type:
                continue
            if ack.result == AckResult.OK and isinstance(command, _RelayCommand) and ack.value != command.word:
                command.refusal = f"the board reports the relay setting {ack.value:#x} instead of {command.word:#x}"
                command.done = True
            elif ack.result == AckResult.OK:
                command.acknowledged = True
                if not command.changes_hello:
                    continue
                self._decoder.discard_hello()  # the next hello has the new values; if it is lost, it is requested again
            else:
                command.refusal = f"the board refuses: {ack.result.name.lower().replace('_', ' ')}{command.hint}"
                command.done = True
        if isinstance(command, _RelayCommand) and command.boots != self._decoder.boots:
            command.refusal, command.done = "the board was reset before it answered", True
        if command.acknowledged and self._decoder.hello is not None:
            command.done = True
        if command.done:
            self._command = None
