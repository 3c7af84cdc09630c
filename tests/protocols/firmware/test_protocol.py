"""Protocol of the board without a serial line: requests, retries and responses."""

from dataclasses import replace

import pytest
from hypothesis import given, strategies as st

from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.relay import Relay
from bms_estimator.protocols.firmware.messages import (
    Ack,
    AckResult,
    Hello,
    MessageType,
    hello_command,
    relay_word,
    set_rate_command,
    set_relay_command,
    zero_current_command,
)
from bms_estimator.protocols.firmware.protocol import RETRY_S, BoardProtocol
from tests.service.test_bad_line import HELLO, frames, sample

ZERO_CURRENT = MessageType.COMMAND_ZERO_CURRENT
ASH_RESET = b"\x1a\xc1\x02\x0b\x0a\x52\x7e"
"""Bytes that a Zigbee stick sends after its reset."""


def protocol_after_hello(hello: Hello = HELLO, rate_hz: int = 100) -> BoardProtocol:
    """Return a protocol that has received the board's hello."""
    protocol = BoardProtocol(rate_hz=rate_hz)
    protocol.feed(0.0, b"\0" + hello.encode())
    return protocol


def test_nothing_is_sent_to_a_device_before_its_first_valid_frame() -> None:
    protocol = BoardProtocol(rate_hz=100)
    assert protocol.next_output(0.0) == b""
    protocol.feed(1.0, ASH_RESET + sample(0).encode()[:-4])
    assert protocol.next_output(1.0) == b""
    protocol.feed(2.0, b"\0" + sample(1).encode())
    assert protocol.next_output(2.0) == hello_command()


def test_unanswered_request_is_repeated_after_the_retry_interval() -> None:
    protocol = BoardProtocol(rate_hz=100)
    protocol.feed(0.0, b"\0" + sample(0).encode())
    assert protocol.next_output(0.0) == hello_command()
    assert protocol.next_output(0.9 * RETRY_S) == b""
    assert protocol.next_output(1.1 * RETRY_S) == hello_command()


def test_rate_is_set_if_the_board_reports_another_rate() -> None:
    assert protocol_after_hello(rate_hz=100).next_output(0.0) == b""
    protocol = protocol_after_hello(rate_hz=250)
    assert protocol.next_output(0.0) == set_rate_command(250) + hello_command()
    protocol.feed(0.1, replace(HELLO, rate_hz=250).encode())
    assert protocol.next_output(10.0) == b""


def test_after_reopening_nothing_is_sent_before_a_valid_frame() -> None:
    protocol = protocol_after_hello()
    protocol.on_port_opened()
    assert protocol.next_output(1.0) == b""
    assert protocol.board == {}
    protocol.feed(2.0, sample(0).encode())
    assert protocol.next_output(2.0) == hello_command()
    protocol.feed(2.1, replace(HELLO, serial=7).encode())
    assert protocol.board["serial"] == "00000007"


def test_command_is_done_when_a_hello_arrives_after_its_acknowledgement() -> None:
    protocol = protocol_after_hello()
    command = protocol.command("current_zero")
    assert protocol.next_output(0.0) == zero_current_command()
    assert protocol.next_output(3.0) == b""  # the board still measures and would reject a second command as busy
    protocol.feed(3.0, Ack(ZERO_CURRENT, AckResult.OK, 510_000).encode())
    assert (command.done, protocol.next_output(3.0)) == (False, hello_command())
    protocol.feed(3.1, replace(HELLO, current_zero_ppm=510_000).encode())
    assert (command.done, command.refusal) == (True, None)


def test_rejected_command_gives_the_reason_of_the_board() -> None:
    protocol = protocol_after_hello()
    command = protocol.command("current_zero")
    protocol.feed(1.0, Ack(ZERO_CURRENT, AckResult.BAD_VALUE, 0).encode())
    assert command.done
    assert command.refusal == "the board refuses: bad value; is the sensor connected, and no current flowing?"


def test_cancelled_command_is_not_sent() -> None:
    protocol = BoardProtocol()
    command = protocol.command("current_zero")
    command.done = True
    protocol.feed(0.0, b"\0" + HELLO.encode())
    assert protocol.next_output(0.0) == b""


def test_command_is_cancelled_when_the_line_is_lost() -> None:
    protocol = protocol_after_hello()
    command = protocol.command("current_zero")
    protocol.next_output(0.0)
    protocol.on_port_opened()
    protocol.feed(1.0, b"\0" + HELLO.encode())
    assert protocol.next_output(1.0) == b""
    assert (command.done, "the line was lost" in (command.refusal or "")) == (True, True)


def test_unknown_command_is_rejected() -> None:
    with pytest.raises(UserError, match="no command fly"):
        BoardProtocol().command("fly")


messages = (
    st.binary(max_size=80)
    | st.integers(0, 9).map(lambda n: frames(n, 1))
    | st.just(HELLO.encode())
    | st.sampled_from(AckResult).map(lambda result: Ack(ZERO_CURRENT, result, 1).encode())
)


@given(st.lists(messages, max_size=20))
def test_no_bytes_raise_an_error(reads: list[bytes]) -> None:
    protocol = BoardProtocol(rate_hz=250)
    for second, data in enumerate(reads):
        if second % 5 == 2:  # a command every five seconds
            protocol.command("current_zero")
        protocol.feed(float(second), data)
        protocol.next_output(float(second))
    assert protocol.counters["bytes_received"] <= sum(map(len, reads))


def test_relay_command_follows_a_requested_hello_and_is_repeated_until_acknowledged() -> None:
    protocol, relay = protocol_after_hello(), Relay(high=True, high_when_silent=False, silent_s=30)
    command = protocol.relay(relay)
    for sent_s in (0.0, 2.0 * RETRY_S):
        assert protocol.next_output(sent_s) == hello_command()
        assert protocol.next_output(sent_s + 0.5 * RETRY_S) == b""
        protocol.feed(sent_s, HELLO.encode())
        assert protocol.next_output(sent_s) == set_relay_command(relay)
        assert protocol.next_output(sent_s + 0.5 * RETRY_S) == b""
    protocol.feed(1.0, Ack(MessageType.COMMAND_SET_RELAY, AckResult.OK, relay_word(relay)).encode())
    assert (command.done, command.refusal) == (True, None)
    assert protocol.next_output(4.0) == b""
    assert protocol.hello == HELLO


def test_relay_command_is_not_sent_to_a_board_that_was_reset() -> None:
    protocol = protocol_after_hello()
    command = protocol.relay(Relay(high=True, high_when_silent=None))
    assert protocol.next_output(0.0) == hello_command()
    protocol.feed(0.1, replace(HELLO, boot_id=HELLO.boot_id + 1).encode())
    assert (command.done, command.refusal) == (True, "the board was reset before it answered")
    assert protocol.next_output(0.2) == b""
    assert protocol.boots == 1


@pytest.mark.parametrize(
    "hello", [HELLO, replace(HELLO, serial=1), replace(HELLO, boot_id=0), replace(HELLO, sequence=2**32 - 1)]
)
def test_every_other_boot_or_board_counts_even_without_samples_and_across_openings_of_the_port(hello: Hello) -> None:
    protocol = protocol_after_hello()
    protocol.on_port_opened()
    protocol.feed(1.0, b"\0" + hello.encode())
    assert protocol.boots == (hello != HELLO)


def test_relay_setting_that_differs_from_the_command_is_an_error() -> None:
    protocol = protocol_after_hello()
    command = protocol.relay(Relay(high=True, high_when_silent=None))
    protocol.feed(1.0, Ack(MessageType.COMMAND_SET_RELAY, AckResult.OK, 0).encode())
    assert command.refusal == "the board reports the relay setting 0x0 instead of 0x1"


def test_relay_command_to_a_firmware_without_relay_gives_the_reason() -> None:
    protocol = protocol_after_hello()
    command = protocol.relay(Relay(high=True, high_when_silent=None))
    protocol.feed(1.0, Ack(MessageType.COMMAND_SET_RELAY, AckResult.UNKNOWN_COMMAND, 0).encode())
    assert command.done
    assert command.refusal == "the board refuses: unknown command; firmware before 0.2.0 has no relay pin"
