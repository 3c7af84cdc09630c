"""The relay pin of the firmware: in simavr it cuts the load that the board measures."""

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

LOAD_A, STEPS_PER_A = 5.0, 1024 * 0.1 / 5.0


@pytest.fixture
def host(tmp_path: Path) -> Iterator[Host]:
    file = write_readings(tmp_path / "readings.csv", [(0.0, LOAD_A, 22.2, 25.0)])
    with SimavrBoard(file, speed=math.inf, relay=True) as board, Host(board.path) as host:
        yield host


def current_a(host: Host) -> float:
    """Once the window in which the pin may have moved is over."""
    host.take(2)
    sample = host.take(1)[0]
    return (sample.current_sum / sample.count - 512.0) / STEPS_PER_A


def test_relay_pin_is_low_after_reset_and_follows_commands(host: Host) -> None:
    assert current_a(host) == pytest.approx(LOAD_A, abs=0.1)
    for high in (True, False, True):
        relay = Relay(high, None)
        ack = host.ask(set_relay_command(relay))
        assert (ack.command, ack.result, ack.value) == (MessageType.COMMAND_SET_RELAY, AckResult.OK, relay_word(relay))
        assert current_a(host) == pytest.approx(0.0 if high else LOAD_A, abs=0.1)
    host.ask(command(MessageType.COMMAND_RESTART))
    host.hello()
    assert current_a(host) == pytest.approx(LOAD_A, abs=0.1)


def test_invalid_relay_word_changes_nothing(host: Host) -> None:
    host.ask(set_relay_command(Relay(high=True, high_when_silent=None)))
    for word in (2, 1 | 3 << 8, 1 << 8, 2 << 8 | 3601 << 16, 0x00000080):
        ack = host.ask(command(MessageType.COMMAND_SET_RELAY, struct.pack("<I", word)))
        assert (ack.result, ack.value) == (AckResult.BAD_VALUE, 1)
    assert host.ask(command(MessageType.COMMAND_SET_RELAY, b"\1")).result == AckResult.UNKNOWN_COMMAND
    assert current_a(host) == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize("high", [True, False])
def test_silent_host_sets_the_fallback_level(host: Host, high: bool) -> None:
    host.ask(set_relay_command(Relay(high=high, high_when_silent=None, silent_s=2)))
    host.take(400)
    assert current_a(host) == pytest.approx(0.0 if high else LOAD_A, abs=0.1)
    sent = len(host.samples)
    host.ask(set_relay_command(Relay(high=high, high_when_silent=not high, silent_s=3)))
    heard = len(host.samples)
    samples = (*host.samples[sent:], *host.take(450))
    cut = [abs(s.current_sum / s.count - 512.0) < 0.5 * LOAD_A * STEPS_PER_A for s in samples]
    assert set(cut[2:290]) == {high}
    assert set(cut[-100:]) == {not high}
    turned = sent + cut.index(not high, 2)
    assert sent + 300 <= turned <= heard + 310  # the board has heard it between the two
