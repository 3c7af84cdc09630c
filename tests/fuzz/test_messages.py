"""Edited requests, published messages and USB descriptions cause no exception, and no unprintable text is shown."""

import asyncio
import contextlib
import io
import json
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from serial.tools.list_ports_common import ListPortInfo

from bms_estimator.mqtt.connection import DeliveryStats
from bms_estimator.mqtt.topic_cache import TopicCache
from bms_estimator.sinks.mqtt.requests import RequestDispatcher, number
from bms_estimator.sinks.terminal.sink import build_screen, text_line
from bms_estimator.sinks.terminal.view_state import PackView, ViewState
from bms_estimator.sources.serial.port_list import NoPortError, may_be_board, resolve_port
from tests.fuzz.edited_seeds import edited_seeds

JSON_TOKENS = (b"null", b'"version"', b": [", b'{"a":', b"\\ud800", b'"soc"', b'"transaction"')
TOPICS = ("state", "health", "info", "parameters", "availability", "alarm/soc_low")
CONSOLE = Console(file=io.StringIO(), width=80, height=24, force_terminal=True, color_system=None)


@edited_seeds("requests", *JSON_TOKENS)
def test_each_request_is_counted_and_answered_with_json(data: bytes) -> None:
    stats = DeliveryStats()
    requests = RequestDispatcher(stats, ("set_soc",))

    async def set_soc(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"soc": number(arguments, "soc", 0.0, 1.0)}

    requests.register("set_soc", set_soc)
    json.loads(asyncio.run(requests.handle("set_soc", data)) or "null")
    assert stats.requests.total() == 1
    assert not stats.requests["failed"]


@edited_seeds("published", *JSON_TOKENS, b"\\u001b[2J", b'"active":true', b'"text":"', b'"cells_v":[')
def test_published_messages_are_shown_as_printable_text_only(data: bytes) -> None:
    cache = TopicCache("bms")
    for topic in TOPICS:
        message = cache.add_message(f"bms/pack/{topic}", data, 0.0)
        line = text_line(message) if message else None
        assert line is None or line.isprintable()
    if data:
        view = ViewState(0.0, PackView("pack", cache.devices["pack"].topics))
        text = "".join(segment.text for segment in CONSOLE.render(build_screen(view, CONSOLE.width)))
        assert text.replace("\n", "").isprintable()


@edited_seeds("ports", b"zigbee", b"auto", b"/dev/", b"../")
def test_port_descriptions_cause_no_exception(data: bytes) -> None:
    text = data.decode("utf-8", "surrogateescape")
    port = ListPortInfo("ttyUSB0")
    port.vid, port.pid, port.manufacturer, port.product, port.description = 0x1A86, 0x7523, text, text, text
    may_be_board(port)
    with contextlib.suppress(NoPortError):
        resolve_port(text)
