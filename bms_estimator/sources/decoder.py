"""From the settings of a sensor to the decoder of its bytes: the same for a live line and its recording."""

from collections.abc import Mapping
from typing import Protocol

from bms_estimator.model.sample import SampleBlock
from bms_estimator.model.settings import SensorSettings
from bms_estimator.sources.frames import FrameCounters, FrameDecoder, FrameFault
from bms_estimator.sources.protocol import Ack, Hello
from bms_estimator.sources.text_lines import TextDecoder


class Decoder(Protocol):
    """Bytes with arrival times to samples. Never raises on bytes; faults are counted by kind."""

    @property
    def hello(self) -> Hello | None:
        """The board's last; None when there was none since its reset, or it prints text."""

    @property
    def board(self) -> Mapping[str, str]:
        """What the board said of itself, for people."""

    @property
    def clock_ppm(self) -> float | None:
        """How much faster the board's clock runs than that of the arrivals [1e-6]; None while unknown."""

    @property
    def counters(self) -> FrameCounters:
        """Since start."""

    @property
    def fault(self) -> FrameFault | None:
        """What is wrong with the line as a whole."""

    def forget_hello(self) -> None:
        """There is none until the next comes; samples keep the scaling of the last."""

    def take_acks(self) -> list[Ack]:
        """Answers to commands that came since the last call."""

    def feed(self, arrival_s: float, data: bytes) -> SampleBlock:
        """Decode one read of the line."""


def make_decoder(sensor: SensorSettings) -> Decoder:
    """The decoder that ``[sensor]`` asks for; it turns the sign of the current."""
    if sensor.protocol == "text":
        return TextDecoder(current_sign=sensor.current_sign)
    return FrameDecoder(current_sign=sensor.current_sign)
