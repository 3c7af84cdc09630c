"""Relay pin of the firmware in simavr, where it disconnects the load that the board measures."""

import math
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from bms_estimator.protocols.base.relay import Relay
from bms_estimator.protocols.firmware.messages import AckResult, MessageType, command, relay_word, set_relay_command
from tests.firmware.host import Host
from tests.simavr_board import SimavrBoard, write_readings

pytestmark = pytest.mark.usefixtures("firmware")

LOAD_A = 5.0
LSB_PER_A = 1024 * 0.1 / 5.0
"""Conversion per current [LSB/A]: 10 bits, a slope of 0.1 V/A and a reference of 5 V."""
ZERO_LSB = 512.0
"""Conversion at zero current."""


@pytest.fixture
def host(tmp_path: Path) -> Iterator[Host]:
    """Start a board with a load of ``LOAD_A``, which its relay disconnects while the pin is high. Return its host."""
    file = write_readings(tmp_path / "readings.csv", [(0.0, LOAD_A, 22.2, 25.0)])
    with SimavrBoard(file, speed=math.inf, relay=True) as board, Host(board.path) as host:
        yield host


def current_a(host: Host) -> float:
    """Return the current of the third sample from now [A]. In the first two the pin may have changed."""
    host.next_samples(2)
    sample = host.next_samples(1)[0]
    return (sample.current_sum / sample.count - ZERO_LSB) / LSB_PER_A


def test_relay_pin_is_low_after_reset_and_follows_commands(host: Host) -> None:
    assert current_a(host) == pytest.approx(LOAD_A, abs=0.1)
    for high in (True, False, True):
        relay = Relay(high=high, high_when_silent=None)
        ack = host.send_command(set_relay_command(relay))
        assert (ack.command, ack.result, ack.value) == (MessageType.COMMAND_SET_RELAY, AckResult.OK, relay_word(relay))
        assert current_a(host) == pytest.approx(0.0 if high else LOAD_A, abs=0.1)
    host.send_command(command(MessageType.COMMAND_RESTART))
    host.next_hello()
    assert current_a(host) == pytest.approx(LOAD_A, abs=0.1)


def test_invalid_relay_word_changes_nothing(host: Host) -> None:
    host.send_command(set_relay_command(Relay(high=True, high_when_silent=None)))
    # an unknown bit; an unknown fallback; fallbacks with a delay of 0 s and of more than an hour; an unknown bit
    for word in (2, 1 | 3 << 8, 1 << 8, 2 << 8 | 3601 << 16, 0x00000080):
        ack = host.send_command(command(MessageType.COMMAND_SET_RELAY, struct.pack("<I", word)))
        assert (ack.result, ack.value) == (AckResult.BAD_VALUE, 1)
    assert host.send_command(command(MessageType.COMMAND_SET_RELAY, b"\1")).result == AckResult.UNKNOWN_COMMAND
    assert current_a(host) == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize("high", [True, False])
def test_pin_has_its_fallback_level_after_the_host_was_silent_for_the_configured_time(host: Host, high: bool) -> None:
    host.send_command(set_relay_command(Relay(high=high, high_when_silent=None, silent_s=2)))
    host.next_samples(400)  # 4 s; without a fallback the level remains
    assert current_a(host) == pytest.approx(0.0 if high else LOAD_A, abs=0.1)
    samples_before_command = len(host.samples)
    host.send_command(set_relay_command(Relay(high=high, high_when_silent=not high, silent_s=3)))
    samples_before_ack = len(host.samples)
    samples = (*host.samples[samples_before_command:], *host.next_samples(450))
    disconnected = [abs(s.current_sum / s.count - ZERO_LSB) < 0.5 * LOAD_A * LSB_PER_A for s in samples]
    assert set(disconnected[2:290]) == {high}
    assert set(disconnected[-100:]) == {not high}
    samples_before_change = samples_before_command + disconnected.index(not high, 2)
    # The board received the command between its sending and its acknowledgment. 3 s are 300 samples.
    assert samples_before_command + 300 <= samples_before_change <= samples_before_ack + 310
