"""The board of firmware/: frames in, hello, rate and commands out."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import CurrentSign, SampleBlock
from bms_estimator.protocols.base.device_protocol import Command, DeviceProtocol
from bms_estimator.protocols.base.relay import Relay
from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.protocols.firmware.messages import (
    AckResult,
    Hello,
    hello_command,
    set_rate_command,
    set_relay_command,
    unseal,
    zero_current_command,
)

ASK_AGAIN_S = 0.5
"""Retry interval of an unanswered command [s]."""
_HELLO = hello_command()


@dataclass
class _Told(Command):
    """A pending command: sent, acknowledged, and completed by the hello with the new values."""

    frame: bytes = b""
    again_s: float = ASK_AGAIN_S
    hint: str = ""
    changes_hello: bool = True
    acknowledged: bool = False


class BoardProtocol(DeviceProtocol):
    """The conversation with a board. It samples by itself: nothing is sent before a complete frame has arrived.

    Args:
        current_sign: What the board calls positive; samples are positive on discharge.
        rate_hz: Sample rate that the board is set to [Hz]; None: unchanged.
    """

    def __init__(self, *, current_sign: CurrentSign = "discharge_positive", rate_hz: int | None = None) -> None:
        self._decoder = FrameDecoder(current_sign=current_sign)
        self._rate_hz = rate_hz
        self._unheard_at = 0
        self._asked, self._asked_s = b"", -math.inf
        self._told: _Told | None = None

    @property
    def counters(self) -> Mapping[str, int]:
        """The decoder's."""
        return self._decoder.counters.as_dict()

    @property
    def fault(self) -> str | None:
        """Fault of the line as a whole."""
        return fault.value if (fault := self._decoder.fault) else None

    @property
    def hello(self) -> Hello | None:
        """The board's, since the port was opened, its reset or a command."""
        return self._decoder.hello

    @property
    def board(self) -> Mapping[str, str]:
        """Fields of the board's hello."""
        return self._decoder.board

    @property
    def clock_ppm(self) -> float | None:
        """Rate of the board's clock over that of arrivals [1e-6]."""
        return self._decoder.clock_ppm

    @property
    def description(self) -> str | None:
        """Firmware, serial number and rate."""
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
        """Reset: there is no hello until the next one, and no command is repeated; samples keep the last scaling."""
        self._decoder.forget_hello()
        self._unheard_at = self._decoder.heard_at
        if self._told is not None and not self._told.done:
            self._told.refusal = "the line was lost before the board answered, and another board may be there now"
            self._told.done = True

    def feed(self, arrival_s: float, data: bytes) -> SampleBlock:
        """Decode one read of the line; ``time_s`` is that of ``FrameDecoder.feed``."""
        block = self._decoder.feed(arrival_s, data)
        if self._told is not None:
            self._follow(self._told)
        return block

    def feed_reads(
        self, arrivals_s: NDArray[np.float64], ends: NDArray[np.int64], data: NDArray[np.uint8]
    ) -> SampleBlock:
        """Decode many reads of the line at once."""
        return self._decoder.feed_reads(arrivals_s, ends, data)

    def next_output(self, now_s: float) -> bytes:
        """Ask for the hello, then give the command, then set the rate: each again until it is answered."""
        wanted, again_s = self._wanted()
        if wanted == self._asked and now_s - self._asked_s < again_s:
            return b""
        self._asked, self._asked_s = wanted, now_s
        return wanted

    def command(self, name: str) -> Command:
        """``current_zero``: take the present current as zero, stored permanently.

        Raises:
            UserError: Any other.
        """
        if name != "current_zero":
            raise UserError(f"the board knows no command {name}")
        hint = "; is the sensor connected, and no current flowing?"
        return self._tell(zero_current_command(), again_s=math.inf, hint=hint)  # it measures for a second

    def relay(self, relay: Relay) -> Command:
        """Set the level of the relay pin."""
        hint = "; firmware before 0.2.0 has no relay pin"
        return self._tell(set_relay_command(relay), hint=hint, changes_hello=False)

    def send(self, frame: bytes) -> Command:
        """Have ``next_output`` send a command that may be given twice."""
        return self._tell(frame)

    def _tell(
        self, frame: bytes, *, again_s: float = ASK_AGAIN_S, hint: str = "", changes_hello: bool = True
    ) -> Command:
        self._decoder.take_acks()  # of the previous request
        self._asked = b""
        self._told = _Told(frame=frame, again_s=again_s, hint=hint, changes_hello=changes_hello)
        return self._told

    def _wanted(self) -> tuple[bytes, float]:
        """Return the command that the board still needs, and its retry interval [s]."""
        hello = self._decoder.hello
        if hello is None:
            return _HELLO if self._decoder.heard_at > self._unheard_at else b"", ASK_AGAIN_S
        if self._told is not None and not self._told.done:
            return self._told.frame, self._told.again_s
        if self._rate_hz is not None and self._rate_hz != hello.rate_hz:
            return set_rate_command(self._rate_hz) + _HELLO, ASK_AGAIN_S
        return b"", ASK_AGAIN_S

    def _follow(self, told: _Told) -> None:
        """Match received data to a pending command: its acknowledgment, or the hello after it."""
        for ack in self._decoder.take_acks():
            if ack.command != unseal(told.frame)[1]:
                continue
            if ack.result == AckResult.OK:
                told.acknowledged = True
                if not told.changes_hello:
                    continue
                self._decoder.forget_hello()  # the next one contains the new values; a lost one is requested again
            else:
                told.refusal = f"the board refuses: {ack.result.name.lower().replace('_', ' ')}{told.hint}"
                told.done = True
        if told.acknowledged and self._decoder.hello is not None:
            told.done = True
        if told.done:
            self._told = None
