"""The service with a fault built in: what a simulation that finds nothing must still find."""

import contextlib
import math
import os
from collections.abc import Iterator
from typing import Any

import pytest

from bms_estimator.checkpoint.checkpoint_file import CheckpointFile
from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.sinks.mqtt.messages import MessageBuilder
from bms_estimator.sources.serial.board_check import BoardCheck
from bms_estimator.store.outbox_queue import Queue


@contextlib.contextmanager
def no_rewind() -> Iterator[None]:
    """What was on its way when a connection broke is not sent again."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Queue, "rewind", lambda _: None)
        yield


@contextlib.contextmanager
def no_fsync() -> Iterator[None]:
    """A checkpoint takes its name before its bytes are on the disk."""
    written = CheckpointFile._write

    def write(self: CheckpointFile, *arguments: Any) -> None:
        kept, os.fsync = os.fsync, lambda _: None
        try:
            written(self, *arguments)
        finally:
            os.fsync = kept

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CheckpointFile, "_write", write)
        yield


@contextlib.contextmanager
def no_sensor_availability() -> Iterator[None]:
    """That the sensor has gone silent is not said."""
    said = MessageBuilder._sensor

    def sensor(self: MessageBuilder, health: Any) -> Any:
        return said(self, health.model_copy(update={"sensor_online": True}))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MessageBuilder, "_sensor", sensor)
        yield


@contextlib.contextmanager
def no_second_try() -> Iterator[None]:
    """A disk that did not take the board once is not asked again."""
    asked = BoardCheck._store_board

    def remember(self: BoardCheck, now_s: float) -> None:
        if not self._store_failed:
            asked(self, now_s)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BoardCheck, "_store_board", remember)
        yield


@contextlib.contextmanager
def board_clock_believed() -> Iterator[None]:
    """A board's clock that runs ahead of the arrivals is right."""
    decoded = FrameDecoder._decode

    def decode(self: FrameDecoder, *arguments: Any) -> Any:
        self._state["least_late_s"], self._state["period_us"] = -math.inf, 1e12  # no sample is ever early, or in haste
        return decoded(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FrameDecoder, "_decode", decode)
        yield
