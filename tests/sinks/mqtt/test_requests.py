"""Requests: responses to valid, invalid and too many requests."""

import json
from collections.abc import Mapping
from typing import Any

import pytest
import structlog
from hypothesis import given, strategies as st

from bms_estimator.model.errors import UserError
from bms_estimator.mqtt.connection import DeliveryStats
from bms_estimator.sinks.mqtt.requests import (
    COMMANDS,
    LOG_S,
    MAX_PAYLOAD_BYTES,
    MAX_READ_BYTES,
    READS,
    READS_PER_MIN,
    REQUESTS_PER_MIN,
    RequestDispatcher,
)


class RecordingDispatcher:
    """Dispatcher with a clock set by the test, and handlers that record their calls.

    Calling it sends a request, and returns the decoded response, or None without one.

    Attributes:
        granted: Names of the requests that reached a handler.
        now_s: Time of the clock [s].
    """

    def __init__(self, *allowed_commands: Any) -> None:
        self.delivery, self.now_s, self.granted = DeliveryStats(), 0.0, list[str]()
        self.requests = RequestDispatcher(self.delivery, allowed_commands, monotonic=lambda: self.now_s)
        for name in COMMANDS + READS:
            self.requests.register(name, self._handler(name))

    def _handler(self, name: str) -> Any:
        async def echo(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
            if arguments.get("refuse"):
                raise UserError("refused")
            if arguments.get("fail"):
                raise ZeroDivisionError
            self.granted.append(name)
            return {"x": arguments.get("x")}

        return echo

    async def __call__(self, name: str, payload: bytes = b"") -> Any:
        response = await self.requests.handle(name, payload)
        return None if response is None else json.loads(response, parse_constant=pytest.fail)


@pytest.mark.parametrize(
    ("payload", "status", "transaction"),
    [
        (b'{"transaction": "t1", "x": 2}', "ok", "t1"),
        (b"", "ok", None),
        (b'{"transaction": 7, "refuse": true}', "error", 7),
        (b"[1, 2]", "error", None),
        (b"\xff\xfe not json", "error", None),
        (b"[" * 4000, "error", None),
        (b'{"transaction": NaN}', "error", None),
        (b'{"transaction": [1e999], "x": 1}', "error", None),
        (b'{"transaction": "t2", "x": -Infinity}', "error", None),
        (b'{"transaction": 1.5}', "error", None),
        (b'{"transaction": true}', "error", None),
        (b'{"transaction": {"a": 1}}', "error", None),
    ],
)
async def test_request_gets_a_response_with_its_transaction(payload: bytes, status: str, transaction: object) -> None:
    dispatcher = RecordingDispatcher("publish_rate")
    response = await dispatcher("publish_rate", payload)
    assert set(response) == {"status", "data", "error", "transaction"}
    assert (response["status"], response["transaction"]) == (status, transaction)
    assert (response["data"] is None) == (status == "error")
    assert (response["error"] is None) == (status == "ok")
    assert dispatcher.delivery.requests == {"granted" if status == "ok" else "refused": 1}


async def test_exception_of_a_handler_gives_an_error_response() -> None:
    dispatcher = RecordingDispatcher("publish_rate")
    response = await dispatcher("publish_rate", b'{"fail": true, "transaction": "t"}')
    assert (response["status"], response["transaction"]) == ("error", "t")
    assert dispatcher.delivery.requests == {"failed": 1}


async def test_data_that_is_not_json_gives_an_error_response() -> None:
    dispatcher = RecordingDispatcher("publish_rate")

    async def return_nan(_: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"soc": float("nan")}

    dispatcher.requests.register("publish_rate", return_nan)
    assert (await dispatcher("publish_rate"))["status"] == "error"


@pytest.mark.parametrize("name", ["", "reboot", "State", "state/", "é", "x" * 65_000])
async def test_unknown_name_is_counted_and_gets_no_response(name: str) -> None:
    dispatcher = RecordingDispatcher()
    with structlog.testing.capture_logs() as logs:
        assert await dispatcher(name) is None
    assert dispatcher.delivery.requests == {"unknown": 1}
    assert len(str(logs)) < 300


async def test_payload_above_4096_bytes_is_rejected() -> None:
    dispatcher = RecordingDispatcher("publish_rate")
    padded = b'{"x": 1}' + b" " * MAX_PAYLOAD_BYTES
    assert (await dispatcher("publish_rate", padded[:MAX_PAYLOAD_BYTES]))["status"] == "ok"
    assert "4096 bytes" in (await dispatcher("publish_rate", padded))["error"]


async def test_read_needs_no_permission_and_may_be_longer_than_a_command() -> None:
    dispatcher = RecordingDispatcher()
    padded = b'{"x": 1}' + b" " * MAX_READ_BYTES
    assert (await dispatcher("forecast", padded[:MAX_READ_BYTES]))["status"] == "ok"
    assert f"{MAX_READ_BYTES} bytes" in (await dispatcher("forecast", padded))["error"]


async def test_reads_and_commands_have_separate_rate_limits() -> None:
    dispatcher = RecordingDispatcher("publish_rate")
    reads = [await dispatcher("forecast") for _ in range(int(READS_PER_MIN) + 1)]
    assert [response is None for response in reads] == [False] * int(READS_PER_MIN) + [True]
    assert (await dispatcher("publish_rate"))["status"] == "ok"


async def test_command_is_granted_only_if_the_settings_allow_it() -> None:
    for name in ("set_soc", "current_zero"):
        dispatcher = RecordingDispatcher()
        assert "mqtt.commands" in (await dispatcher(name))["error"]
        assert dispatcher.granted == []
        dispatcher = RecordingDispatcher(name)
        await dispatcher("set_soc")
        await dispatcher("current_zero")
        assert dispatcher.granted == [name]


async def test_rate_of_commands_is_limited() -> None:
    dispatcher = RecordingDispatcher("set_soc")
    for _ in range(1000):
        await dispatcher("set_soc")
    assert dispatcher.granted.count("set_soc") == REQUESTS_PER_MIN
    dispatcher.now_s = 30.0
    for _ in range(1000):
        await dispatcher("set_soc")
    assert dispatcher.granted.count("set_soc") == 1.5 * REQUESTS_PER_MIN  # after half a minute
    assert dispatcher.delivery.requests["too_many"] == 2000 - len(dispatcher.granted)


async def test_each_burst_is_logged_once() -> None:
    dispatcher = RecordingDispatcher("set_soc")
    with structlog.testing.capture_logs() as logs:
        for _ in range(10_000):
            await dispatcher("current_zero")
            await dispatcher("nonsense")
        assert [line["kind"] for line in logs] == ["refused", "unknown", "too_many"]
        dispatcher.now_s = LOG_S
        await dispatcher("nonsense")
    assert logs[-1]["so_far"] == 10_001  # all unknown requests


@given(name=st.sampled_from(COMMANDS) | st.text(), payload=st.binary() | st.text().map(str.encode))
async def test_no_request_raises(name: str, payload: bytes) -> None:
    dispatcher = RecordingDispatcher("set_soc", "current_zero")
    await dispatcher(name, payload)
    assert sum(dispatcher.delivery.requests.values()) == 1
