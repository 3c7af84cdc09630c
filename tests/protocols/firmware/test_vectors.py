"""Python codec and decoder, compared with the test vectors that are shared with the firmware."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bms_estimator.protocols.base.relay import Relay
from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.protocols.firmware.messages import (
    Ack,
    AckResult,
    Hello,
    MessageType,
    ProtocolError,
    SampleMessage,
    command,
    hello_command,
    set_bandgap_command,
    set_current_slope_command,
    set_divider_command,
    set_rate_command,
    set_ratiometric_command,
    set_relay_command,
    set_serial_command,
    unseal,
    zero_current_command,
)

VECTORS = json.loads((Path(__file__).parents[3] / "firmware" / "test_vectors.json").read_text())
MAX_FRAME_BYTES = 66
"""Maximum size of a COBS frame without its delimiter [bytes]."""
COMMANDS: dict[str, Callable[..., bytes]] = {
    "hello": hello_command,
    "zero_current": zero_current_command,
    "restart": lambda: command(MessageType.COMMAND_RESTART),
    "set_rate": set_rate_command,
    "set_serial": set_serial_command,
    "set_bandgap": set_bandgap_command,
    "set_divider": set_divider_command,
    "set_current_slope": set_current_slope_command,
    "set_ratiometric": set_ratiometric_command,
    "set_relay": lambda fields: set_relay_command(Relay(*fields)),
}
MESSAGE_CLASSES: dict[str, type[SampleMessage | Hello | Ack]] = {"sample": SampleMessage, "hello": Hello, "ack": Ack}

Vector = dict[str, Any]


def vector_id(vector: Vector) -> str:
    """Return the id of a test vector, from the fields that describe it."""
    return "-".join(str(vector[key]) for key in ("message", "command", "argument", "what") if key in vector)


def make_message(vector: Vector) -> SampleMessage | Hello | Ack:
    """Return the message with the fields of the vector."""
    fields = vector["fields"]
    if vector["message"] == "ack":
        fields = fields | {"result": AckResult(fields["result"])}
    return MESSAGE_CLASSES[vector["message"]](**fields)


@pytest.mark.parametrize("vector", VECTORS["messages"], ids=vector_id)
def test_message_is_encoded_and_decoded_byte_for_byte(vector: Vector) -> None:
    packet_without_crc = bytes.fromhex(vector["packet"])[:-2]
    assert make_message(vector).encode().hex() == vector["frame"]
    assert unseal(bytes.fromhex(vector["frame"])) == packet_without_crc
    assert MESSAGE_CLASSES[vector["message"]].decode(packet_without_crc) == make_message(vector)


@pytest.mark.parametrize("vector", VECTORS["commands"], ids=vector_id)
def test_command_is_encoded_byte_for_byte(vector: Vector) -> None:
    arguments = [] if vector["argument"] is None else [vector["argument"]]
    assert COMMANDS[vector["command"]](*arguments).hex() == vector["frame"]


@pytest.mark.parametrize("vector", VECTORS["bad_frames"], ids=vector_id)
def test_invalid_frame_is_rejected_by_unseal_and_decoder(vector: Vector) -> None:
    frame = bytes.fromhex(vector["frame"])
    if len(frame) <= MAX_FRAME_BYTES:  # unseal does not check the length, which depends on the message type
        with pytest.raises(ProtocolError):
            unseal(frame)
    decoder = FrameDecoder()
    assert decoder.feed(0.0, b"\0" + frame).size == 0
    counters = decoder.counters
    assert counters.crc_errors + counters.cobs_errors + counters.length_errors == 1


@pytest.mark.parametrize("vector", VECTORS["messages"], ids=vector_id)
def test_decoder_accepts_every_message_after_a_hello(vector: Vector) -> None:
    decoder = FrameDecoder()
    hello = next(v for v in VECTORS["messages"] if v["what"] == "of a fresh board")
    decoder.feed(0.0, bytes.fromhex(hello["frame"]))
    samples = decoder.feed(1.0, bytes.fromhex(vector["frame"]))
    assert samples.size == (vector["message"] == "sample")
    if vector["message"] == "hello":
        assert decoder.hello == make_message(vector)
    if vector["message"] == "ack":
        assert decoder.pop_acks() == [make_message(vector)]
    counters = decoder.counters
    assert counters.crc_errors + counters.cobs_errors + counters.length_errors + counters.type_errors == 0
