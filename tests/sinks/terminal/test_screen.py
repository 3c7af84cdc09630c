"""Screen of the terminal view: content by size, alarms, stale values, and payloads of any kind."""

from typing import Any

import pytest
from rich.cells import cell_len
from rich.console import Console
from rich.screen import Screen

from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.mqtt.topic_cache import DeviceMessage, TopicCache
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState
from bms_estimator.sinks.terminal.sink import MAX_MESSAGES, build_screen, text_line
from bms_estimator.sinks.terminal.view_state import PackView, ViewState
from tests.sinks.snapshots import CELL_SNAPSHOT, NOW, SNAPSHOT_WITHOUT_SAMPLES, STACK_SNAPSHOT

LOG = [
    f"12:00:0{n}Z [warning] faults on the line frames_lost={n} crc_errors={n} overruns={n} bytes={n}" for n in range(5)
]
HINT = "live page: http://127.0.0.1:8765/; in a second terminal: mosquitto_sub -p 18833 -t 'bms/#' -v"
ESTIMATE = {
    "soc_percent": 50.0,
    "soc_std": 0.02,
    "voltage_v": 24.123,
    "current_a": 12.5,
    "power_w": 301.54,
    "innovation_v": -0.0543,
    "tracking_error_v": 0.0027,
}


def pack_view(topics: dict[str, Any] | None = None, snapshot: Snapshot = CELL_SNAPSHOT) -> PackView:
    """Return a pack as a subscriber sees it, with some payloads changed. ``topics`` has the changes by topic."""
    published, messages = TopicCache("bms"), MessageBuilder("bms", "pack")
    for message in (
        *messages.birth_messages(),
        *messages.guaranteed_messages(None, snapshot),
        *messages.live_messages(PublishedState(), snapshot, NOW)[0],
    ):
        published.add_message(message.topic, message.payload, NOW)
    return PackView("pack", published.devices["pack"].topics | {"sensor/availability": "online"} | (topics or {}))


def alarm(name: str, severity: str, *, active: bool = True) -> dict[str, Any]:
    """Return topic and payload of an alarm."""
    payload = {"name": name, "severity": severity, "active": active, "since": "2024-05-01T12:00:00.000Z"}
    return {f"alarm/{name}": payload | {"text": f"{name}: 12.3 % is below the limit; charge the pack soon"}}


def lines_of(view: ViewState, columns: int = 100, rows: int = 40) -> list[str]:
    """Return the lines as the terminal shows them, cropped to its size."""
    console = Console(width=columns, height=rows, force_terminal=True, color_system=None)
    with console.capture() as capture:
        console.print(Screen(build_screen(view, columns)), end="")
    return capture.get().splitlines()


def text_of(pack: PackView) -> str:
    """Return the text of the screen, with one space between words."""
    return " ".join(" ".join(lines_of(ViewState(NOW, pack))).split())


@pytest.mark.parametrize(("columns", "rows"), [(32, 8), (60, 20), (80, 12), (80, 24), (200, 60)])
def test_a_screen_of_any_size_shows_the_soc_and_no_line_is_too_long(columns: int, rows: int) -> None:
    lines = lines_of(ViewState(NOW, pack_view({"state": ESTIMATE}), LOG, HINT, true_soc=0.5), columns, rows)
    assert len(lines) == rows
    assert max(map(cell_len, lines)) <= columns
    assert "pack 50.00 ± 4.00" in " ".join(" ".join(lines).split())


def test_an_soc_that_is_not_known_is_not_shown_as_a_number() -> None:
    state = ESTIMATE | {"soc_known": False}
    assert "pack not known live" in text_of(pack_view({"state": state}))
    line = text_line(DeviceMessage("pack", "state", state))
    assert line is not None
    assert "soc not known  24.123 V" in line
    assert "soc 50.00 ± 4.00 %" in (text_line(DeviceMessage("pack", "state", state | {"soc_known": True})) or "")


def test_a_line_of_text_has_the_lock_and_the_error_under_the_name_of_the_observer() -> None:
    line = text_line(DeviceMessage("pack", "state", ESTIMATE | {"lock": True, "converged": False})) or ""
    assert "  innovation -54.30 mV  observer in lock, converging, e +2.70 mV  " in line


def test_80_by_24_cells_show_a_pack_with_three_alarms_and_the_log_and_the_hint() -> None:
    alarms = alarm("soc_low", "warning") | alarm("cell_over_voltage", "critical") | alarm("cell_imbalance", "warning")
    topics = alarms | alarm("link_lost", "critical", active=False) | {"state": ESTIMATE}
    view = ViewState(NOW, pack_view(topics), LOG, HINT, true_soc=0.497)
    text = " ".join(" ".join(lines_of(view, 80, 24)).split())
    values = "pack 50.00 ± 4.00 49.70 live 24.123 +12.500 +301.54 - -54.3"
    assert [part for part in (values, LOG[-1], HINT) if part not in text] == []
    critical_at = text.index("critical since 2024-05-01T12:00:00.000Z: cell_over_voltage: 12.3 % is below the limit")
    assert critical_at < text.index("warning since 2024-05-01T12:00:00.000Z: soc_low:") < text.index("imbalance:")
    assert "link_lost" not in text


def test_the_band_of_the_time_to_the_cut_off_is_shown_on_a_narrow_screen_in_place_of_the_remaining_charge() -> None:
    narrow, wide = ("\n".join(lines_of(ViewState(NOW, pack_view()), columns)) for columns in (80, 100))
    assert "1:23-2:45" in narrow
    assert "To 0 %" not in narrow
    assert "1:23-2:45" in wide
    assert "To 0 %" in wide


def test_a_line_of_text_has_the_time_to_the_cut_off_with_its_band() -> None:
    assert CELL_SNAPSHOT.estimate
    state = CELL_SNAPSHOT.estimate.model_dump()
    assert "  to cut-off 1:50 h (1:23 to 2:45)  " in (text_line(DeviceMessage("pack", "state", state)) or "")


def test_unknown_values_are_dashes() -> None:
    assert "pack - live 13.000" in text_of(pack_view(snapshot=STACK_SNAPSHOT))
    assert "pack - live - - - - - -" in text_of(pack_view(snapshot=SNAPSHOT_WITHOUT_SAMPLES))


def test_stale_values_have_a_reason_and_a_time() -> None:
    health = {"sensor_message": "bytes come, but no valid frame", "suspects": ["reversed sign"]}
    topics = {"state": {"time": "2024-05-01T12:00:00.000Z"}, "health": health, "sensor/availability": "offline"}
    stale = text_of(pack_view(topics))
    assert "stale since 12:00:00Z: bytes come, but no valid frame suspected: reversed sign" in stale
    assert "live" not in stale


def test_alarms_beyond_the_screen_are_counted() -> None:
    alarms = alarm("soc_low", "warning") | {f"alarm/{n}": {"active": True, "severity": "critical"} for n in range(5)}
    lines = [line.rstrip() for line in lines_of(ViewState(NOW, pack_view(alarms), hint=HINT), 100, 24)]
    assert [line.split()[0] for line in lines if line].count("critical") == MAX_MESSAGES
    assert {"alarms and faults not shown: 1", HINT} <= set(lines)


@pytest.mark.parametrize(
    "garbage", [None, "text", 5, [], {}, {"soc": "full", "voltage_v": [1], "suspects": 3, "a": {}}]
)
def test_no_payload_breaks_the_screen_or_controls_the_terminal(garbage: Any) -> None:
    topics = ["state", "health", "info", "parameters", "availability", "alarm/x"]
    control_characters = {
        "text": "\x1b[2J\x07evil",
        "active": True,
        "severity": 7,
        "since": "\x1b[31m",
        "sensor_message": "\x1b]0;x",
    }
    for payload in (garbage, control_characters, {"suspects": [garbage, "\x1b[2J"]}, {"voltage_v": 10**400}):
        for pack in (PackView("pack", dict.fromkeys(topics, payload)), PackView("pack", {})):
            assert "".join(lines_of(ViewState(NOW, pack))).isprintable()
        for topic in topics:
            line = text_line(DeviceMessage("pack", topic, payload))
            assert line is None or line.isprintable()


def test_screen_without_a_pack_shows_the_hint() -> None:
    text = " ".join(lines_of(ViewState(NOW, hint=HINT)))
    assert [part for part in ("nothing has been published yet", HINT) if part not in text] == []
