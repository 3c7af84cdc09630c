"""Mutants of the service, each with a fault that the simulation must find."""

import contextlib
import math
import os
from collections.abc import Iterator
from typing import Any

import pytest

from bms_estimator.checkpoint.state_files import CheckpointFile
from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.sinks.mqtt.messages import MessageBuilder
from bms_estimator.sources.serial.board_check import BoardCheck
from bms_estimator.store.outbox_queue import OutboxQueue


@contextlib.contextmanager
def no_resend_after_reconnect() -> Iterator[None]:
    """Do not resend messages that were in flight when a connection broke."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OutboxQueue, "rewind", lambda _: None)
        yield


@contextlib.contextmanager
def no_fsync() -> Iterator[None]:
    """Rename a checkpoint before its bytes are synced."""
    original = CheckpointFile.save

    def save(self: CheckpointFile, *arguments: Any, **named: Any) -> None:
        original_fsync, os.fsync = os.fsync, lambda _: None
        try:
            original(self, *arguments, **named)
        finally:
            os.fsync = original_fsync

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CheckpointFile, "save", save)
        yield


@contextlib.contextmanager
def no_sensor_availability() -> Iterator[None]:
    """Publish a silent sensor as online."""
    original = MessageBuilder._sensor

    def sensor(self: MessageBuilder, health: Any) -> Any:
        return original(self, health.model_copy(update={"sensor_online": True}))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MessageBuilder, "_sensor", sensor)
        yield


@contextlib.contextmanager
def no_retry_after_disk_full() -> Iterator[None]:
    """Do not retry to save the serial number of the board after a disk error."""
    original = BoardCheck._store_board

    def store_board(self: BoardCheck, now_s: float) -> None:
        if not self._store_failed:
            original(self, now_s)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BoardCheck, "_store_board", store_board)
        yield


@contextlib.contextmanager
def no_check_of_board_clock() -> Iterator[None]:
    """Accept samples whose board time is ahead of their arrival."""
    original = FrameDecoder._decode

    def decode(self: FrameDecoder, *arguments: Any) -> Any:
        self._state["min_delay_s"] = -math.inf  # no sample counts as early
        self._state["period_us"] = 1e12  # any step of the clock agrees with the sequence number
        return original(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FrameDecoder, "_decode", decode)
        yield
