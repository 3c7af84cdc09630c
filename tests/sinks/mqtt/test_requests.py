"""Requests: responses to valid, invalid and too many requests."""

import json
from collections.abc import Mapping
from typing import Any

import pytest
import structlog
from hypothesis import given
from hypothesis import strategies as st

from bms_estimator.model.errors import UserError
from bms_estimator.mqtt.delivery_stats import DeliveryStats
from bms_estimator.sinks.mqtt.requests import (
    COMMANDS,
    FORMER_READS,
    LOG_S,
    MAX_PAYLOAD_BYTES,
    REQUESTS_PER_MIN,
    RequestDispatcher,
)


class Asked:
    """Dispatcher with a clock set by the test, and handlers that record their calls."""

    def __init__(self, *commands: Any) -> None:
        self.delivery, self.now_s, self.granted = DeliveryStats(), 0.0, list[str]()
        self.requests = RequestDispatcher(self.delivery, commands, monotonic=lambda: self.now_s)
        for name in COMMANDS:
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
async def test_request_gets_a_response(payload: bytes, status: str, transaction: object) -> None:
    asked = Asked("publish_rate")
    response = await asked("publish_rate", payload)
    assert set(response) == {"status", "data", "error", "transaction"}
    assert (response["status"], response["transaction"]) == (status, transaction)
    assert (response["data"] is None) == (status == "error")
    assert (response["error"] is None) == (status == "ok")
    assert asked.delivery.requests == {"granted" if status == "ok" else "refused": 1}


async def test_exception_of_a_handler_gives_an_error_response() -> None:
    asked = Asked("publish_rate")
    response = await asked("publish_rate", b'{"fail": true, "transaction": "t"}')
    assert (response["status"], response["transaction"]) == ("error", "t")
    assert asked.delivery.requests == {"failed": 1}


async def test_data_that_is_not_json_gives_an_error_response() -> None:
    asked = Asked("publish_rate")

    async def broken(_: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"soc": float("nan")}

    asked.requests.register("publish_rate", broken)
    assert (await asked("publish_rate"))["status"] == "error"


@pytest.mark.parametrize("name", ["", "reboot", "State", "state/", "é", "x" * 65_000])
async def test_unknown_name_is_counted_and_gets_no_response(name: str) -> None:
    asked = Asked()
    with structlog.testing.capture_logs() as logs:
        assert await asked(name) is None
    assert asked.delivery.requests == {"unknown": 1}
    assert len(str(logs)) < 300


async def test_payload_above_4_kb_is_rejected() -> None:
    asked = Asked("publish_rate")
    padded = b'{"x": 1}' + b" " * MAX_PAYLOAD_BYTES
    assert (await asked("publish_rate", padded[:MAX_PAYLOAD_BYTES]))["status"] == "ok"
    assert "4096 bytes" in (await asked("publish_rate", padded))["error"]


async def test_commands_need_a_permission() -> None:
    for name in ("set_soc", "current_zero"):
        asked = Asked()
        assert "mqtt.commands" in (await asked(name))["error"]
        assert asked.granted == []
        asked = Asked(name)
        await asked("set_soc")
        await asked("current_zero")
        assert asked.granted == [name]


async def test_commands_are_few_a_minute_and_do_not_wait_for_former_requests() -> None:
    asked = Asked("set_soc")
    for _ in range(1000):
        await asked("set_soc")
        await asked("state")
    assert asked.granted.count("set_soc") == REQUESTS_PER_MIN
    assert asked.delivery.requests["refused"] == REQUESTS_PER_MIN
    asked.now_s = 30.0
    for _ in range(1000):
        await asked("set_soc")
    assert asked.granted.count("set_soc") == 1.5 * REQUESTS_PER_MIN
    assert asked.delivery.requests["too_many"] == 3000 - len(asked.granted) - REQUESTS_PER_MIN


async def test_each_burst_is_logged_once() -> None:
    asked = Asked("set_soc")
    with structlog.testing.capture_logs() as logs:
        for _ in range(10_000):
            await asked("current_zero")
            await asked("nonsense")
        assert [line["kind"] for line in logs] == ["refused", "unknown", "too_many"]
        asked.now_s = LOG_S
        await asked("nonsense")
    assert logs[-1]["so_far"] == 10_001


@given(name=st.sampled_from(COMMANDS + FORMER_READS) | st.text(), payload=st.binary() | st.text().map(str.encode))
async def test_no_request_raises(name: str, payload: bytes) -> None:
    asked = Asked("set_soc", "current_zero")
    await asked(name, payload)
    assert sum(asked.delivery.requests.values()) == 1
