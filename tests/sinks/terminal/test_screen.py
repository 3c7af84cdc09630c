"""Screen of the terminal view: content by size, alarms, stale values, and payloads of any kind."""

from typing import Any

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console
from rich.screen import Screen

from bms_estimator.model.cell import load_cell
from bms_estimator.model.clock import Clock
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.payloads import Snapshot
from bms_estimator.model.sample import SAMPLE
from bms_estimator.mqtt.topic_cache import DeviceMessage, TopicCache
from bms_estimator.service.live_loop import new_estimator
from bms_estimator.service.publisher import Publisher
from bms_estimator.settings.pack import Settings
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState
from bms_estimator.sinks.terminal.screen import MAX_MESSAGES, build_screen
from bms_estimator.sinks.terminal.text_line import text_line
from bms_estimator.sinks.terminal.view_state import BrokerOutage, PackView, ViewState
from tests.collector import Collector
from tests.scripted_source import ScriptedSource
from tests.sinks.snapshots import NOW, STACK

SILENT = (
    "/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0-port0 at 500000 baud: bytes come, but no valid frame among them"
)
SUSPECTS = [suspect.text for suspect in InputFault][:1]
LOG = [f"12:00:0{n}Z [warning] faults on the line frames_lost={n} crc_errors={n} overruns={n}" for n in range(5)]
HINT = "firmware in simavr; in a second terminal: mosquitto_sub -p 18833 -t 'bms/#' -v"


@pytest.fixture(scope="module")
def snapshot() -> Snapshot:
    """Of 24 V and 12.5 A, after a second."""
    cell = load_cell("thunder_power_6s")
    estimator, sink = new_estimator(Settings(), cell), Collector()
    publisher = Publisher(Settings(), cell, estimator, source=ScriptedSource(), sinks=[sink], clock=Clock())
    block = np.zeros(100, dtype=SAMPLE)
    block["time_s"], block["voltage_v"], block["current_a"] = np.arange(100) / 100.0, 24.123, 12.5
    block["temperature_c"] = np.nan
    publisher.add(block, estimator.run(block))
    publisher.publish()
    return next(each for each in sink.snapshots if each.estimate)


def pack_view(snapshot: Snapshot, topics: dict[str, Any] | None = None, device: str = "pack") -> PackView:
    """Return the pack as a subscriber sees it, with some topics changed."""
    published, messages = TopicCache("bms"), MessageBuilder("bms", device)
    for message in (
        *messages.birth_messages(),
        *messages.must_deliver(None, snapshot),
        *messages.live_messages(PublishedState(), snapshot, NOW)[0],
    ):
        published.take(message.topic, message.payload, NOW)
    online = {"sensor/availability": "online"}
    return PackView(device, published.devices[device].topics | online | (topics or {}), NOW)


def alarm(name: str, severity: str, *, active: bool = True) -> dict[str, Any]:
    payload = {"name": name, "severity": severity, "active": active, "since": "2024-05-01T12:00:00.000Z"}
    return {f"alarm/{name}": payload | {"text": f"{name}: 12.3 % is below the limit; charge the pack soon"}}


def lines_of(view: ViewState, columns: int = 100, rows: int = 40) -> list[str]:
    """Return the lines as the terminal shows them, cropped to its size."""
    console = Console(width=columns, height=rows, force_terminal=True, color_system=None)
    with console.capture() as capture:
        console.print(Screen(build_screen(view, columns, rows)), end="")
    return capture.get().splitlines()


def text_of(*packs: PackView, now_s: float = NOW, outage: BrokerOutage | None = None) -> str:
    return " ".join(" ".join(lines_of(ViewState(now_s, packs, outage))).split())


@pytest.mark.parametrize(("columns", "rows"), [(32, 8), (40, 15), (60, 20), (80, 12), (80, 24), (120, 40), (200, 60)])
def test_a_screen_of_any_size_shows_the_soc_and_no_line_is_too_long(
    snapshot: Snapshot, columns: int, rows: int
) -> None:
    lines = lines_of(ViewState(NOW, [pack_view(snapshot)], None, LOG, HINT, 0.5), columns, rows)
    assert len(lines) == rows
    assert max(map(cell_len, lines)) <= columns
    e = snapshot.estimate
    assert e
    assert e.soc_percent
    assert e.soc_std
    assert f"pack {e.soc_percent:.2f} ± {200.0 * e.soc_std:.2f}" in " ".join(" ".join(lines).split())


def test_80_by_24_cells_show_a_pack_with_three_alarms_and_the_log_and_the_hint(snapshot: Snapshot) -> None:
    alarms = alarm("soc_low", "warning") | alarm("cell_over_voltage", "critical") | alarm("cell_imbalance", "warning")
    ended = alarm("link_lost", "critical", active=False)
    view = ViewState(NOW, [pack_view(snapshot, alarms | ended)], None, LOG, HINT, 0.5)
    text = " ".join(" ".join(lines_of(view, 80, 24)).split())
    for shown in ("24.123", "+12.500", "+301.54", " 50.00 live ", LOG[-1][:50], HINT):
        assert shown in text, text
    critical = text.index("pack: critical since 2024-05-01T12:00:00.000Z: cell_over_voltage: 12.3 % is below the limit")
    assert critical < text.index("pack: warning since 2024-05-01T12:00:00.000Z: soc_low:") < text.index("imbalance:")
    assert "link_lost" not in text


def test_a_fuel_cell_has_no_soc() -> None:
    text = text_of(pack_view(STACK))
    assert "pack - live 13.000" in text


def test_a_pack_without_a_sample_has_no_values(snapshot: Snapshot) -> None:
    assert "pack - live - - - - -" in text_of(pack_view(snapshot._replace(estimate=None)))


def test_stale_values_have_a_reason_and_a_time(snapshot: Snapshot) -> None:
    assert snapshot.estimate
    measured, published = snapshot.estimate.time[11:19], snapshot.health.publish_time[11:19]
    health = snapshot.health.model_copy(update={"sensor_online": False, "sensor_message": SILENT, "suspects": SUSPECTS})
    silent = text_of(pack_view(snapshot._replace(health=health), {"sensor/availability": "offline"}))
    assert f"pack: stale since {measured}Z: {SILENT}" in silent.replace("- ", "-")  # a path may be broken at a hyphen
    assert f"pack: suspected: {SUSPECTS[0]}" in silent
    assert f"pack: offline since {published}Z" in text_of(pack_view(snapshot, {"availability": "offline"}))
    assert "pack: silent since 22:13:20Z" in text_of(pack_view(snapshot), now_s=NOW + 11.0)
    gone = text_of(pack_view(snapshot), outage=BrokerOutage(NOW - 60.0, "the connection broke"))
    assert "no broker since 22:12:20Z: the connection broke" in gone
    for text in (silent, gone):
        assert "live" not in text


def test_of_many_packs_those_with_alarms_come_first_and_the_rest_is_counted(snapshot: Snapshot) -> None:
    packs = [pack_view(snapshot, device=f"p{n}") for n in range(29)]
    alarms = alarm("soc_low", "warning") | {f"alarm/{n}": {"active": True, "severity": "critical"} for n in range(5)}
    view = ViewState(NOW, [*packs, pack_view(snapshot, alarms, "last")], hint=HINT)
    lines = [line.rstrip() for line in lines_of(view, 100, 24)]
    names = [line.split()[0] for line in lines if " live " in line]
    assert names == ["last", *(f"p{n}" for n in range(len(names) - 1))]
    assert f"packs not shown: {30 - len(names)}" in lines
    assert [line.split(":")[0] for line in lines].count("last") == MAX_MESSAGES
    assert "alarms and faults not shown: 1" in lines
    assert HINT in lines


@pytest.mark.parametrize(
    "garbage", [None, "text", 5, [], {}, {"soc": "full", "voltage_v": [1], "suspects": 3, "a": {}}]
)
def test_no_payload_breaks_the_screen_or_controls_the_terminal(garbage: Any) -> None:
    topics = ["state", "health", "info", "parameters", "availability", "alarm/x"]
    evil = {"text": "\x1b[2J\x07evil", "active": True, "severity": 7, "since": "\x1b[31m", "sensor_message": "\x1b]0;x"}
    for payload in (garbage, evil, {"suspects": [garbage, "\x1b[2J"]}, {"voltage_v": 10**400}):
        pack = PackView("pack", dict.fromkeys(topics, payload), NOW)
        assert "".join(lines_of(ViewState(NOW, [pack, PackView("other", {}, NOW)]))).isprintable()
        for topic in topics:
            line = text_line(DeviceMessage("pack", topic, payload))
            assert line is None or line.isprintable()


def test_a_screen_without_a_pack() -> None:
    text = " ".join(lines_of(ViewState(NOW, hint=HINT)))
    assert "no pack has published anything yet" in text
    assert HINT in text
