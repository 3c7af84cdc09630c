"""Whatever the size, no line is too long, and what matters is whole."""

import io
from typing import Any

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console

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
from bms_estimator.sinks.terminal.panels import Screen
from bms_estimator.sinks.terminal.scene import BrokerOutage, PackView, ScreenState
from bms_estimator.sinks.terminal.text_line import line
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


def scene(snapshot: Snapshot, topics: dict[str, Any] | None = None, **told: Any) -> ScreenState:
    """What a subscriber sees, with some topics changed."""
    device, published = snapshot.info.device, TopicCache("bms")
    messages = MessageBuilder("bms", device)
    for message in (
        *messages.birth_messages(),
        *messages.must_deliver(None, snapshot),
        *messages.live_messages(PublishedState(), snapshot, NOW)[0],
    ):
        published.take(message.topic, message.payload, NOW)
    return ScreenState(device, published.devices[device].topics | (topics or {}), NOW, told.pop("now_s", NOW), **told)


def text_of(scene: ScreenState, columns: int = 100, rows: int = 40) -> str:
    return " ".join(" ".join(drawn(scene, columns, rows)).split())


def drawn(scene: ScreenState, columns: int, rows: int) -> list[str]:
    console = Console(file=io.StringIO(), width=columns, height=rows, force_terminal=True, color_system=None)
    with console.capture() as capture:
        console.print(Screen(scene))
    return capture.get().splitlines()


@pytest.mark.parametrize("wrong", [False, True])
@pytest.mark.parametrize(("columns", "rows"), [(32, 8), (40, 15), (60, 20), (80, 12), (80, 24), (120, 40), (200, 60)])
def test_no_line_is_longer_than_the_screen_and_what_matters_is_whole(
    snapshot: Snapshot, columns: int, rows: int, *, wrong: bool
) -> None:
    if wrong:
        rows = max(rows, 15)
        told = {"sensor_online": False, "sensor_message": SILENT, "suspects": SUSPECTS}
        snapshot = snapshot._replace(health=snapshot.health.model_copy(update=told))
    history = tuple(np.linspace(20.0, 25.0, 300))
    shown = scene(snapshot, voltage_v=history, current_a=history, log=LOG, hint=HINT, true_soc=0.5)
    lines = drawn(shown, columns, rows)
    assert len(lines) <= rows
    assert max(map(cell_len, lines)) <= columns
    text = " ".join(" ".join(lines).split())
    e = snapshot.estimate
    assert e is not None
    assert e.soc is not None
    assert e.soc_std is not None
    assert f"SOC {e.soc:.2%} ± {2.0 * e.soc_std:.2%}" in text
    assert "24.123 V" in text
    assert "+12.500 A" in text
    for message in [SILENT, *SUSPECTS] if wrong else ["health good"]:
        assert "".join(message.split()) in "".join(lines).replace(" ", "")  # a path may be longer than a line


@pytest.mark.parametrize(("columns", "rows"), [(60, 30), (80, 24), (120, 40)])
def test_of_a_fuel_cell_what_is_learned_is_shown_and_no_charge(columns: int, rows: int) -> None:
    text = " ".join(" ".join(drawn(scene(STACK), columns, rows)).split())
    for shown in ("r 167.7 ±", "i_0 0.92", "i_n 6", "C 0.067 ±", "13.000 V"):
        assert shown in text, text
    for absent in ("SOC", "State of charge", "░", "empty in", "R_ts"):
        assert absent not in text


def test_before_the_first_sample_there_is_a_screen_too(snapshot: Snapshot) -> None:
    lines = drawn(scene(snapshot._replace(estimate=None)), 80, 24)
    assert max(map(cell_len, lines)) <= 80
    assert "SOC -" in " ".join(lines)


@pytest.mark.parametrize(("rows", "observer", "log"), [(40, True, True), (12, True, False), (7, False, False)])
def test_a_low_screen_drops_the_log_first_and_the_observer_later(
    snapshot: Snapshot, rows: int, *, observer: bool, log: bool
) -> None:
    text = "\n".join(drawn(scene(snapshot, log=LOG), 60, rows))
    assert ("observer" in text, LOG[-1][:30] in text) == (observer, log)


def test_alarms_cells_and_energy_are_shown_where_they_are_published(snapshot: Snapshot) -> None:
    assert snapshot.estimate
    state = snapshot.estimate.model_dump(mode="json") | {
        "cells_v": [3.301, None, 3.250],
        "cell_lowest_v": 3.25,
        "cell_highest_v": 3.301,
        "cell_lowest": 3,
        "cell_highest": 1,
        "energy_out_kwh": 12.3456,
        "energy_in_kwh": 13.5,
        "equivalent_cycles": 4.25,
        "time_to_empty_s": None,
        "time_to_full_s": 4800.0,
    }
    alarms = {
        f"alarm/{name}": {"name": name, "severity": severity, "active": active, "text": f"{name}: do something"}
        for name, severity, active in [
            ("soc_low", "warning", True),
            ("cell_over_voltage", "critical", True),
            ("link_lost", "critical", False),
        ]
    }
    text = text_of(scene(snapshot, alarms | {"state": state}))
    assert "cells 3 lowest 3.250 V (cell 3) highest 3.301 V (cell 1) apart 51 mV" in text
    assert "energy 12.35 kWh out 13.50 kWh in 4.2 cycles" in text
    little = state | {"energy_out_kwh": 0.0123, "energy_in_kwh": 0.0}
    assert "energy 12.30 Wh out 0.00 Wh in" in text_of(scene(snapshot, {"state": little}))
    assert "full in 1 h 20 min at this current" in text
    assert text.index("critical: cell_over_voltage: do something") < text.index("warning: soc_low: do something")
    assert "link_lost" not in text
    small = text_of(scene(snapshot, alarms), 40, 15)
    assert "cell_over_voltage" in small
    assert "+12.500 A" in small


def test_it_says_since_when_values_are_stale_and_why(snapshot: Snapshot) -> None:
    assert snapshot.estimate
    at = snapshot.estimate.time[11:19]
    assert "● live" in text_of(scene(snapshot, {"sensor/availability": "online"}))
    assert f"stale since {at}Z" in text_of(scene(snapshot, {"sensor/availability": "offline"}))
    made = snapshot.health.publish_time[11:19]
    assert f"service offline since {made}Z" in text_of(scene(snapshot, {"availability": "offline"}))
    assert "silent since 22:13:20Z" in text_of(scene(snapshot, now_s=NOW + 11.0))
    gone = text_of(scene(snapshot, lost=BrokerOutage(NOW - 60.0, "the connection broke")))
    assert "no broker since 22:12:20Z: the connection broke" in gone
    assert "live" not in gone


def test_several_packs_are_listed_and_one_is_in_full(snapshot: Snapshot) -> None:
    packs = [scene(snapshot._replace(info=snapshot.info.model_copy(update={"device": f"p{n}"}))) for n in range(20)]
    shown = packs[15]
    listed = ScreenState(shown.device, shown.topics, NOW, NOW, packs=packs)
    lines = drawn(listed, 100, 40)
    rows = [row for row in lines if " V " in row and "live" in row and "cell" not in row]
    assert [row.split()[0] for row in rows] == ["p11", "p12", "p13", "p14", "▸", "p16", "p17", "p18"]
    assert max(map(cell_len, drawn(listed, 32, 8))) <= 32


@pytest.mark.parametrize(
    "garbage", [None, "text", 5, [], {}, {"soc": "full", "voltage_v": [1], "suspects": 3, "a": {}}]
)
def test_whatever_is_published_there_is_a_screen_and_nothing_controls_the_terminal(garbage: Any) -> None:
    topics = ["state", "health", "info", "parameters", "availability", "alarm/x"]
    evil = {"text": "\x1b[2J\x07evil", "active": True, "severity": 7, "cell": "\x1b[31m", "sensor_message": "\x1b]0;x"}
    for payload in (garbage, evil, {"elements": {"r_s_ohm": garbage}}, {"time_to_empty_s": 10**400}):
        pack = ScreenState("pack", dict.fromkeys(topics, payload), NOW, NOW)
        text = "".join(drawn(ScreenState(pack.device, pack.topics, NOW, NOW, packs=[pack, PackView("other")]), 80, 24))
        assert all(character.isprintable() for character in text)
        for topic in topics:
            told = line(DeviceMessage("pack", topic, payload))
            assert told is None or told.isprintable()


def test_without_a_pack_there_is_a_screen_too() -> None:
    text = text_of(ScreenState(hint="bms/# at mqtt://localhost:1883"))
    assert "no pack has published anything yet" in text
    assert "bms/# at mqtt://localhost:1883" in text
