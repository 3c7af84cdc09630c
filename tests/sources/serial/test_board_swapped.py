"""Replacement of the pack's board by another running board, while the port stays open.

The other board scales the voltage differently and sends no hello by itself, because it is not reset.
"""

import numpy as np
import pytest

from bms_estimator.model.arrays import SampleBlock, SampleStatus
from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.protocols.firmware.framing import MAX_DOUBT_S
from bms_estimator.protocols.firmware.protocol import BoardProtocol
from bms_estimator.simulation.virtual_adc import BoardParts, Reading
from bms_estimator.simulation.virtual_board import VirtualBoard
from bms_estimator.sources.serial.board_check import MAX_PENDING_READS, BoardCheck, OtherBoardError

PACK_V = 22.2
PERIOD_S = 0.01
BEGIN_S = 1_700_000_000.0
OUR_SERIAL, OTHER_SERIAL = 1, 2
OUR_DIVIDER, OTHER_DIVIDER = 6.1, 9.0
"""Ratio of the voltage divider of each board, with which the host scales its samples."""


class RunningBoard:
    """Board that has run for ``age_s`` and sent ``sequence`` samples."""

    def __init__(self, serial: int, divider: float, sequence: int = 0, age_s: float = 0.0) -> None:
        self._board = VirtualBoard(
            lambda _: Reading(current_a=0.5, voltage_v=PACK_V, temperature_c=25.0),
            serial=serial,
            parts=BoardParts(divider=divider),
        )
        self._board._sequence, self._board._clock_ns = sequence, int(age_s * 1e9)

    def hello(self) -> bytes:
        """Return the frame of the board's hello."""
        return self._board._hello().encode()

    def frames(self, count: int) -> list[bytes]:
        """Return the frames of the next ``count`` samples."""
        frames = []
        for _ in range(count):
            self._board._unsent.clear()
            self._board._take_sample()
            frames.append(bytes(self._board._unsent))
        return frames


def feed_frames(decoder: FrameDecoder, begin_s: float, frames: list[bytes]) -> SampleBlock:
    """Feed frames that arrive at the sample period from ``begin_s`` on. Return the samples."""
    return np.concatenate([decoder.feed(begin_s + PERIOD_S * i, frame) for i, frame in enumerate(frames)])


def decoder_of_our_board() -> FrameDecoder:
    """Return a decoder that has received samples of our board for a second."""
    decoder, board = FrameDecoder(), RunningBoard(OUR_SERIAL, OUR_DIVIDER)
    decoder.feed(BEGIN_S, board.hello())
    assert feed_frames(decoder, BEGIN_S + PERIOD_S, board.frames(100))["voltage_v"] == pytest.approx(PACK_V, abs=0.1)
    return decoder


@pytest.mark.parametrize(
    ("sequence", "age_s", "away_s"),
    [(50_000, 900.0, 1.0), (101, 900.0, 1.0), (50_000, 2.0, 1.0), (700_000, 3500.0, 3600.0), (3000, 30.0, 3600.0)],
    ids=[
        "sequence and clock ahead",
        "only its clock ahead",
        "only its sequence ahead",
        "ahead, after an hour",
        "started in the hour without samples",
    ],
)
def test_samples_that_do_not_continue_those_of_the_board_are_dropped_until_a_hello(
    sequence: int, age_s: float, away_s: float
) -> None:
    """The other board is connected ``away_s`` after the last sample of ours."""
    decoder, other = decoder_of_our_board(), RunningBoard(OTHER_SERIAL, OTHER_DIVIDER, sequence, age_s)
    begin_s = BEGIN_S + 1.0 + away_s
    assert feed_frames(decoder, begin_s, other.frames(100)).size == 0
    assert decoder.hello is None
    decoder.feed(begin_s + 1.0, other.hello())
    block = feed_frames(decoder, begin_s + 1.0 + PERIOD_S, other.frames(100))
    assert block.size == 100
    assert block["voltage_v"] == pytest.approx(PACK_V, abs=0.1)
    assert decoder.board["serial"] == "00000002"


def test_samples_of_the_same_board_after_a_loss_are_decoded_without_a_hello() -> None:
    decoder, board = decoder_of_our_board(), RunningBoard(OUR_SERIAL, OUR_DIVIDER, 100, 1.0)
    board.frames(12_345)
    block = feed_frames(decoder, BEGIN_S + 1.0 + 123.46, board.frames(10))  # 12,345 samples take 123.45 s
    assert block.size == 10
    assert decoder.hello
    assert decoder.counters.frames_lost == 12_345


def test_samples_that_do_not_continue_are_accepted_after_a_time_without_a_hello() -> None:
    """The line may have no direction to the board, so that a hello cannot be requested."""
    decoder, board = decoder_of_our_board(), RunningBoard(OUR_SERIAL, OUR_DIVIDER, 100, 900.0)
    block = feed_frames(decoder, BEGIN_S + 2.0, board.frames(1000))
    assert block.size == decoder.counters.frames_received - 100 == 1000 - MAX_DOUBT_S / PERIOD_S
    assert decoder.counters.before_hello == MAX_DOUBT_S / PERIOD_S
    assert decoder.hello is None
    new_decoder = decoder_of_our_board()
    block = feed_frames(new_decoder, BEGIN_S + 2.0, RunningBoard(OUR_SERIAL, OUR_DIVIDER, 50_000, 900.0).frames(1000))
    assert block["status"][0] & SampleStatus.GAP
    assert not block["status"][1:].any()


def check_of_our_board() -> tuple[BoardCheck, BoardProtocol]:
    """Return a check that accepts our board only, and a protocol that has received its hello."""
    protocol, check = BoardProtocol(), BoardCheck(BoardProtocol)
    protocol.feed(BEGIN_S, RunningBoard(OUR_SERIAL, OUR_DIVIDER).hello())
    check.remember_board(protocol.board, 0.0)
    return check, protocol


def test_rejected_board_is_blocked_until_the_port_is_reopened() -> None:
    """Reads of the rejected board that contain no hello are rejected, too."""
    own, other = RunningBoard(OUR_SERIAL, OUR_DIVIDER), RunningBoard(OTHER_SERIAL, OTHER_DIVIDER)
    check, protocol = check_of_our_board()
    with pytest.raises(OtherBoardError):
        check.accept((BEGIN_S, other.hello()), protocol)
    frame = other.frames(1)[0]
    assert check.accept((BEGIN_S, frame), protocol) == ()
    assert check.rejected_bytes == len(other.hello() + frame)
    check.on_port_opened()
    assert len(check.accept((BEGIN_S, own.hello()), protocol)) == 1


def test_each_byte_received_before_the_hello_is_passed_on_once_or_counted_as_rejected() -> None:
    board = RunningBoard(OUR_SERIAL, OUR_DIVIDER)
    check, protocol = check_of_our_board()
    reads = [(BEGIN_S, frame) for frame in board.frames(MAX_PENDING_READS + 5)]
    check.on_port_opened()
    assert not any(check.accept(read, protocol) for read in reads[:7])
    check.on_port_opened()  # the port was lost
    assert check.rejected_bytes == sum(len(data) for _, data in reads[:7])
    assert not any(check.accept(read, protocol) for read in reads)
    hello = BEGIN_S, board.hello()
    # of MAX_PENDING_READS + 6 reads, including the hello, the first six are dropped
    assert check.accept(hello, protocol) == [*reads[6:], hello]
    check.on_port_opened()
    assert check.rejected_bytes == sum(len(data) for _, data in reads[:7] + reads[:6])
