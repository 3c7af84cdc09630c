"""Pack of a real service in a real Home Assistant."""

import asyncio
import json
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any

import aiomqtt
import pytest

from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.mqtt.connection import Message
from bms_estimator.settings.connections import HomeAssistantSettings
from bms_estimator.sinks.home_assistant.discovery import DiscoveryInputs, discovery
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState
from bms_estimator.telemetry.state import UNKNOWN_SOC
from tests.home_assistant.conftest import DASHBOARD
from tests.home_assistant.instance import ENVIRONMENT, HomeAssistant
from tests.home_assistant.running_pack import RunningPack
from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S
from tests.sinks.home_assistant.test_discovery import (
    CELL_COUNT,
    MAX_ROWS_PER_MIN,
    all_values_changing,
    cleared_alarm,
    components_of,
    noisy_cell,
    row_times,
)
from tests.sinks.snapshots import CELL_SNAPSHOT

SOC_ENTITY, SET_SOC_ENTITY, SOC_LOW_ENTITY = (
    "sensor.bms_pack_soc_percent",
    "number.bms_pack_set_soc",
    "binary_sensor.bms_pack_alarm_soc_low",
)
UNRELATED_WARNINGS = ("Skipping pip installation", "zlib_ng and isal are not available")
"""Warnings of Home Assistant about its own installation."""
CARDS = {"conditional", "entities", "entity-filter", "gauge", "history-graph", "statistics-graph", "tile"}
"""Types of the cards in the dashboard."""


def number_state(states: dict[str, Any], entity: str) -> float:
    """Return the state of an entity as a number; NaN for ``unknown`` and ``unavailable``."""
    state = states[entity]["state"]
    return float(state) if re.fullmatch(r"-?[0-9.]+", state) else float("nan")


def first_message(broker: Broker, topic: str) -> Any:
    """Return the decoded payload of the first message on a topic."""

    async def read() -> Any:
        async with Listener(broker, topic) as live:
            return await live.wait_json(topic)

    return asyncio.run(read())


def test_entity_registry_agrees_with_the_discovery_message(home: HomeAssistant, broker: Broker) -> None:
    registry = {entry["entity_id"]: entry for entry in home.websocket_command("config/entity_registry/list")}
    states = home.states()
    components = components_of(first_message(broker, "homeassistant/device/bms_pack/config"))
    for component in components.values():
        entity = component["default_entity_id"]
        assert registry[entity]["entity_category"] == component.get("entity_category")
        assert (entity in states) == component.get("enabled_by_default", True)
        if entity in states:
            attributes = states[entity]["attributes"]
            for option in ("device_class", "state_class", "unit_of_measurement"):
                assert attributes.get(option) == component.get(option), entity
    registered = {entity for entity in registry if ".bms_pack_" in entity}
    assert registered == {component["default_entity_id"] for component in components.values()}


def test_states_equal_the_measured_values(home: HomeAssistant) -> None:
    states = home.states()
    # the values that the text board prints; the power is rounded
    measured = {"voltage_v": 13.19, "current_a": 2.0, "power_w": 26.4, "temperature_c": 21.5, "cell_lowest_v": 3.28}
    assert {name: number_state(states, f"sensor.bms_pack_{name}") for name in measured} == measured
    assert states["sensor.bms_pack_current_a"]["attributes"]["positive"] == "discharge"
    assert number_state(states, "sensor.bms_pack_soc_std_percent") > 0.0
    assert states["sensor.bms_pack_time_to_full_h"]["state"] == "unknown"
    # a new pack without a long load: the SOC is not known yet, and its alarm is neither on nor off
    assert (states[SOC_ENTITY]["state"], states[SOC_LOW_ENTITY]["state"]) == ("unknown", "unknown")
    assert states[SOC_LOW_ENTITY]["attributes"]["reason"] == UNKNOWN_SOC
    assert number_state(states, "sensor.bms_pack_energy_out_kwh") >= 0.0


def test_names_by_device_class_are_in_the_configured_language(home: HomeAssistant) -> None:
    names = {entity: state["attributes"].get("friendly_name") for entity, state in home.states().items()}
    german = {"voltage_v": "Spannung", "current_a": "Stromstärke", "power_w": "Leistung", "soc_percent": "Batterie"}
    assert {key: names[f"sensor.bms_pack_{key}"] for key in german} == {k: f"pack {name}" for k, name in german.items()}
    assert names["sensor.bms_pack_energy_in_kwh"] == "pack Energy in"


def test_set_soc_raises_and_clears_the_soc_alarm(home: HomeAssistant) -> None:
    home.call_service("number.set_value", entity_id=SET_SOC_ENTITY, value=5)
    # the voltages contradict this SOC, so that it may soon be unknown
    states = home.until(lambda states: states[SOC_LOW_ENTITY]["state"] == "on")
    attributes = states[SOC_LOW_ENTITY]["attributes"]
    assert (attributes["severity"], attributes["device_class"]) == ("warning", "battery")
    assert "0.1" in attributes["reason"] or "10" in attributes["reason"]
    home.call_service("number.set_value", entity_id=SET_SOC_ENTITY, value=50)
    states = home.until(
        lambda states: states[SOC_LOW_ENTITY]["state"] == "off" and number_state(states, SOC_ENTITY) > 30.0
    )
    assert states[SOC_LOW_ENTITY]["attributes"]["reason"] == ""


def test_publish_rate_is_set_by_its_number_entity(home: HomeAssistant) -> None:
    home.call_service("number.set_value", entity_id="number.bms_pack_publish_rate", value=2.5)
    home.until(lambda states: states["number.bms_pack_publish_rate"]["state"] == "2.5")


def test_statistics_are_valid_and_the_energy_dashboard_accepts_the_pack(home: HomeAssistant) -> None:
    statistics = {each["statistic_id"]: each for each in home.websocket_command("recorder/list_statistic_ids")}
    for name in ("energy_in_kwh", "energy_out_kwh"):
        statistic = statistics[f"sensor.bms_pack_{name}"]
        assert (statistic["has_sum"], statistic["unit_class"]) == (True, "energy")
    means = {"voltage_v", "current_a", "power_w", "temperature_c", "soc_percent", "soh_percent", "remaining_energy_wh"}
    assert all(statistics[f"sensor.bms_pack_{name}"]["has_mean"] for name in means)
    assert home.websocket_command("recorder/validate_statistics") == {}
    battery = {
        "type": "battery",
        "stat_energy_from": "sensor.bms_pack_energy_out_kwh",
        "stat_energy_to": "sensor.bms_pack_energy_in_kwh",
    }
    home.websocket_command("energy/save_prefs", energy_sources=[battery])
    issues = chain.from_iterable(home.websocket_command("energy/validate")["energy_sources"])
    # statistics are computed every five minutes, and may not exist yet
    assert {issue["type"] for issue in issues} <= {"statistics_not_defined"}


def cards(part: Any) -> Iterator[dict[str, Any]]:
    """Yield all cards in a part of a dashboard."""
    for each in part if isinstance(part, list) else []:
        yield from cards(each)
    if isinstance(part, dict):
        if isinstance(part.get("type"), str):
            yield part
        for each in part.values():
            yield from cards(each)


def test_dashboard_contains_only_existing_cards_and_entities(home: HomeAssistant) -> None:
    dashboard = home.websocket_command("lovelace/config", url_path="the-pack")
    assert [view["title"] for view in dashboard["views"]] == ["Battery"]
    assert {card["type"] for card in cards(dashboard["views"])} == CARDS
    frontend = ENVIRONMENT / "venv/lib/python3.13/site-packages/hass_frontend/frontend_latest"
    frontend_code = b"".join(path.read_bytes() for path in frontend.glob("*.js") if b"-card" in path.read_bytes())
    assert [card for card in CARDS if f"hui-{card}-card".encode() not in frontend_code] == []
    entities = set(re.findall(r"\w+\.bms_pack_\w+", DASHBOARD.read_text()))
    assert len(entities) > 30
    assert entities - set(home.states()) == {"binary_sensor.bms_pack_alarm_hook_failed"}  # the pack has no hook


def publish_fast(broker: Broker, device: str, stream: Iterator[tuple[float, Snapshot]], home: HomeAssistant) -> None:
    """Publish the messages of a stream of snapshots as fast as the broker accepts them.

    The stream begins once Home Assistant has the entities of the device. Return once it has the last voltage.
    """
    builder, published, messages = MessageBuilder("bms", device), PublishedState(), list[Message]()
    for now_s, each in stream:
        info = each.info.model_copy(update={"device": device})
        due, published = builder.live_messages(published, each._replace(info=info), now_s)
        messages += due
    retained = [*builder.birth_messages(), *(message for message in messages if message.retain)]
    values = [message for message in messages if message.topic == f"bms/{device}/home_assistant"]

    async def publish(batch: list[Message]) -> None:
        async with aiomqtt.Client("127.0.0.1", broker.port) as client:
            for message in batch:
                await client.publish(message.topic, message.payload, 1, message.retain)

    asyncio.run(publish(retained))
    last_values = json.loads(values[-1].payload)
    voltage = f"sensor.bms_{device}_voltage_v"

    def is_available(states: dict[str, Any]) -> bool:
        """Publish the first values again, because Home Assistant subscribes some time after the discovery message."""
        asyncio.run(publish(values[:1]))
        device_states = [
            state["state"] for entity, state in states.items() if entity.startswith(f"sensor.bms_{device}_")
        ]
        return "unavailable" not in device_states and voltage in states

    home.until(is_available)
    asyncio.run(publish(values))
    home.until(lambda states: number_state(states, voltage) == last_values["voltage_v"])


def test_a_forecast_has_the_time_to_the_cut_off_in_hours_and_the_probability(
    home: HomeAssistant, broker: Broker
) -> None:
    publish_fast(broker, "forecast", iter([(0.0, CELL_SNAPSHOT)]), home)
    shown = {"time_to_cutoff_h": 1.83, "cutoff_within_15min_percent": 1.0}
    states = home.until(lambda states: number_state(states, "sensor.bms_forecast_time_to_cutoff_h") == 1.83)
    assert {name: number_state(states, f"sensor.bms_forecast_{name}") for name in shown} == shown
    registry = {entry["entity_id"]: entry for entry in home.websocket_command("config/entity_registry/list")}
    assert registry["sensor.bms_forecast_time_to_cutoff_p05_h"]["disabled_by"] == "integration"


def test_entity_of_a_withdrawn_command_is_removed(home: HomeAssistant, broker: Broker) -> None:
    info = next(noisy_cell(1.0))[1].info.model_copy(update={"device": "changed"})
    topic, entity = "homeassistant/device/bms_changed/config", "number.bms_changed_set_soc"

    async def publish_discovery(inputs: DiscoveryInputs) -> None:
        payload = json.dumps(discovery(HomeAssistantSettings(), inputs, "bms/changed", 0.0))
        async with aiomqtt.Client("127.0.0.1", broker.port) as client:
            await client.publish(topic, payload, 1, retain=True)

    asyncio.run(publish_discovery(DiscoveryInputs(info, commands=("set_soc",))))
    home.until(lambda states: entity in states)
    asyncio.run(publish_discovery(DiscoveryInputs(info)))
    home.until(lambda states: entity not in states and "sensor.bms_changed_voltage_v" in states)
    assert entity not in {entry["entity_id"] for entry in home.websocket_command("config/entity_registry/list")}


@pytest.mark.parametrize(("device", "stream"), [("noisy", noisy_cell), ("restless", all_values_changing)])
def test_recorder_writes_at_most_20_rows_a_minute(
    home: HomeAssistant, broker: Broker, device: str, stream: Callable[[float], Iterator[tuple[float, Snapshot]]]
) -> None:
    minutes = 10
    publish_fast(broker, device, stream(60.0 * minutes), home)
    info = next(stream(1.0))[1].info
    inputs = DiscoveryInputs(info, CELL_COUNT if stream is all_values_changing else 0)
    expected = len(
        row_times(stream(60.0 * minutes), components_of(discovery(HomeAssistantSettings(), inputs, "bms/pack", 0.0)))
    )
    assert 100 < expected <= MAX_ROWS_PER_MIN * minutes
    deadline = time.monotonic() + LONG_S
    while (written := count_changes(home, device)) < expected:  # rows are written with a delay
        assert time.monotonic() < deadline, written
        time.sleep(0.1)
    assert written == expected


def count_changes(home: HomeAssistant, device: str) -> int:
    """Return the number of rows of the device's sensors, without the first row of each sensor."""
    rows_by_entity = Counter(
        entity for entity, state in home.recorder_rows(f"sensor.bms_{device}_%") if state != "unavailable"
    )
    return sum(count - 1 for count in rows_by_entity.values())


def test_collapse_risk_is_unknown_until_its_first_value(home: HomeAssistant, broker: Broker) -> None:
    cleared = cleared_alarm("collapse_risk")
    without_value = cleared.model_copy(update={"unknown_reason": "no value yet"})
    publish_fast(broker, "early", iter([(0.0, CELL_SNAPSHOT._replace(alarms=(without_value,)))]), home)
    entity = "binary_sensor.bms_early_alarm_collapse_risk"
    home.until(lambda states: states[entity]["state"] == "unknown")
    payload = cleared.json_bytes

    async def publish() -> None:
        async with aiomqtt.Client("127.0.0.1", broker.port) as client:
            await client.publish("bms/early/alarm/collapse_risk", payload, 1, retain=True)

    asyncio.run(publish())
    home.until(lambda states: states[entity]["state"] == "off")


def test_silent_board_makes_alarms_unavailable_and_not_off(home: HomeAssistant, pack: RunningPack) -> None:
    pack.silent.set()
    home.until(lambda states: {states[SOC_ENTITY]["state"], states[SOC_LOW_ENTITY]["state"]} == {"unavailable"})
    pack.silent.clear()
    states = home.until(
        lambda states: "unavailable" not in (states[SOC_ENTITY]["state"], states[SOC_LOW_ENTITY]["state"])
    )
    assert states[SOC_LOW_ENTITY]["state"] == "off"


def test_home_assistant_logs_no_warning_about_the_pack(home: HomeAssistant) -> None:
    lines = [line for line in home.log.splitlines() if re.search(r" (WARNING|ERROR|CRITICAL) ", line)]
    assert [line for line in lines if not any(known in line for known in UNRELATED_WARNINGS)] == []
