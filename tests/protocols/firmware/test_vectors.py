"""The Python codec and the decoder against the vectors that hold the firmware as well."""

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
MAX_FRAME = 66
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
    "set_relay": lambda told: set_relay_command(Relay(*told)),
}
CLASSES: dict[str, type[SampleMessage | Hello | Ack]] = {"sample": SampleMessage, "hello": Hello, "ack": Ack}

Vector = dict[str, Any]


def name(vector: Vector) -> str:
    return "-".join(str(vector[key]) for key in ("message", "command", "argument", "what") if key in vector)


def message(vector: Vector) -> SampleMessage | Hello | Ack:
    fields = vector["fields"]
    if vector["message"] == "ack":
        fields = fields | {"result": AckResult(fields["result"])}
    return CLASSES[vector["message"]](**fields)


@pytest.mark.parametrize("vector", VECTORS["messages"], ids=name)
def test_a_message_is_encoded_and_decoded_byte_for_byte(vector: Vector) -> None:
    assert message(vector).encode().hex() == vector["frame"]
    assert unseal(bytes.fromhex(vector["frame"])).hex() == vector["packet"][:-4]
    assert CLASSES[vector["message"]].decode(bytes.fromhex(vector["packet"])[:-2]) == message(vector)


@pytest.mark.parametrize("vector", VECTORS["commands"], ids=name)
def test_a_command_is_encoded_byte_for_byte(vector: Vector) -> None:
    arguments = [] if vector["argument"] is None else [vector["argument"]]
    assert COMMANDS[vector["command"]](*arguments).hex() == vector["frame"]


@pytest.mark.parametrize("vector", VECTORS["bad_frames"], ids=name)
def test_a_bad_frame_is_refused_by_codec_and_decoder(vector: Vector) -> None:
    frame = bytes.fromhex(vector["frame"])
    if len(frame) <= MAX_FRAME:  # the length of a message is checked once its type is known
        with pytest.raises(ProtocolError):
            unseal(frame)
    decoder = FrameDecoder()
    assert decoder.feed(0.0, b"\0" + frame).size == 0
    counters = decoder.counters
    assert counters.crc_errors + counters.cobs_errors + counters.length_errors == 1


@pytest.mark.parametrize("vector", VECTORS["messages"], ids=name)
def test_the_decoder_takes_every_message(vector: Vector) -> None:
    decoder = FrameDecoder()
    hello = next(v for v in VECTORS["messages"] if v["what"] == "of a fresh board")
    decoder.feed(0.0, bytes.fromhex(hello["frame"]))
    samples = decoder.feed(1.0, bytes.fromhex(vector["frame"]))
    assert samples.size == (vector["message"] == "sample")
    if vector["message"] == "hello":
        assert decoder.hello == message(vector)
    if vector["message"] == "ack":
        assert decoder.pop_acks() == [message(vector)]
    counters = decoder.counters
    assert counters.crc_errors + counters.cobs_errors + counters.length_errors + counters.type_errors == 0
