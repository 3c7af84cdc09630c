"""The packs of a real service in a real Home Assistant."""

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

from bms_estimator.model.payloads import Snapshot
from bms_estimator.mqtt.message import Message
from bms_estimator.settings.home_assistant import HomeAssistantSettings
from bms_estimator.sinks.home_assistant.discovery import DiscoveryInputs, discovery
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState
from bms_estimator.telemetry.rest_detector import REST_S
from tests.home_assistant.conftest import DASHBOARD
from tests.home_assistant.instance import ENVIRONMENT, HomeAssistant
from tests.home_assistant.packs import Packs
from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S
from tests.sinks.home_assistant.test_discovery import CELLS, MAX_ROWS_PER_MIN, noisy, restless, rows
from tests.sinks.home_assistant.test_discovery import described as shown

SOC, SET_SOC, LOW = "sensor.bms_pack_soc_percent", "number.bms_pack_set_soc", "binary_sensor.bms_pack_alarm_soc_low"
NOT_GRANTED = '"event": "request not granted", "pack": "bench"'
NOT_OURS = ("Skipping pip installation", "zlib_ng and isal are not available")
"""Warnings of this Home Assistant about itself."""
CARDS = {"conditional", "entities", "entity-filter", "gauge", "history-graph", "statistics-graph", "tile"}


def number(states: dict[str, Any], entity: str) -> float:
    state = states[entity]["state"]
    return float(state) if re.fullmatch(r"-?[0-9.]+", state) else float("nan")


def told(broker: Broker, topic: str, wanted: Callable[[Any], bool] = bool) -> Any:
    """The first message on a topic that is wanted."""

    async def read() -> Any:
        async with Listener(broker, topic) as live:
            return await live.wait_json(topic, wanted)

    return asyncio.run(read())


def test_all_entities_are_there_as_they_were_told(home: HomeAssistant, broker: Broker) -> None:
    registry = {entry["entity_id"]: entry for entry in home.command("config/entity_registry/list")}
    states = home.states()
    components = shown(told(broker, "homeassistant/device/bms_pack/config"))
    for component in components.values():
        entity = component["default_entity_id"]
        assert registry[entity]["entity_category"] == component.get("entity_category")
        assert (entity in states) == component.get("enabled_by_default", True)
        if entity in states:
            attributes = states[entity]["attributes"]
            for option in ("device_class", "state_class", "unit_of_measurement"):
                assert attributes.get(option) == component.get(option), entity
    ours = {entity for entity in registry if ".bms_pack_" in entity}
    assert ours == {component["default_entity_id"] for component in components.values()}


def test_states_are_what_the_board_measures(home: HomeAssistant, packs: Packs) -> None:
    states = home.states()
    measured = {"voltage_v": 13.19, "current_a": 2.0, "power_w": 26.4, "temperature_c": 21.5, "cell_lowest_v": 3.28}
    assert {name: number(states, f"sensor.bms_pack_{name}") for name in measured} == measured
    assert states["sensor.bms_pack_current_a"]["attributes"]["positive"] == "discharge"
    assert number(states, "sensor.bms_pack_time_to_empty_h") > 1.0
    assert number(states, "sensor.bms_pack_soc_std_percent") > 0.0
    assert states["sensor.bms_pack_time_to_full_h"]["state"] == "unknown"
    assert number(states, "sensor.bms_pack_energy_out_kwh") >= 0.0


def test_what_home_assistant_names_stands_in_its_owners_language(home: HomeAssistant) -> None:
    names = {entity: state["attributes"].get("friendly_name") for entity, state in home.states().items()}
    german = {"voltage_v": "Spannung", "current_a": "Stromstärke", "power_w": "Leistung", "soc_percent": "Batterie"}
    assert {key: names[f"sensor.bms_pack_{key}"] for key in german} == {k: f"pack {name}" for k, name in german.items()}
    assert names["sensor.bms_pack_energy_in_kwh"] == "pack Energy in"


def test_the_soc_is_set_and_the_alarm_that_follows_says_why(home: HomeAssistant) -> None:
    home.call("number.set_value", entity_id=SET_SOC, value=5)
    states = home.until(lambda states: states[LOW]["state"] == "on" and number(states, SOC) < 10.0)
    attributes = states[LOW]["attributes"]
    assert (attributes["severity"], attributes["device_class"]) == ("warning", "battery")
    assert "0.1" in attributes["reason"] or "10" in attributes["reason"]
    home.call("number.set_value", entity_id=SET_SOC, value=50)
    states = home.until(lambda states: states[LOW]["state"] == "off" and number(states, SOC) > 30.0)
    assert states[LOW]["attributes"]["reason"] == ""


def test_the_publish_rate_is_set(home: HomeAssistant) -> None:
    home.call("number.set_value", entity_id="number.bms_pack_publish_rate", value=2.5)
    home.until(lambda states: states["number.bms_pack_publish_rate"]["state"] == "2.5")


def test_statistics_have_no_issue_and_the_energy_dashboard_takes_the_pack(home: HomeAssistant) -> None:
    found = {each["statistic_id"]: each for each in home.command("recorder/list_statistic_ids")}
    for name in ("energy_in_kwh", "energy_out_kwh"):
        statistic = found[f"sensor.bms_pack_{name}"]
        assert (statistic["has_sum"], statistic["unit_class"]) == (True, "energy")
    means = {"voltage_v", "current_a", "power_w", "temperature_c", "soc_percent", "soh_percent", "remaining_energy_wh"}
    assert all(found[f"sensor.bms_pack_{name}"]["has_mean"] for name in means)
    assert home.command("recorder/validate_statistics") == {}
    battery = {
        "type": "battery",
        "stat_energy_from": "sensor.bms_pack_energy_out_kwh",
        "stat_energy_to": "sensor.bms_pack_energy_in_kwh",
    }
    home.command("energy/save_prefs", energy_sources=[battery])
    issues = chain.from_iterable(home.command("energy/validate")["energy_sources"])
    assert {issue["type"] for issue in issues} <= {"statistics_not_defined"}  # it makes them each five minutes


def cards(part: Any) -> Iterator[dict[str, Any]]:
    """All cards of a part of a dashboard."""
    for each in part if isinstance(part, list) else []:
        yield from cards(each)
    if isinstance(part, dict):
        if isinstance(part.get("type"), str):
            yield part
        for each in part.values():
            yield from cards(each)


def test_the_dashboard_has_only_cards_and_entities_that_there_are(home: HomeAssistant) -> None:
    dashboard = home.command("lovelace/config", url_path="the-pack")
    assert [view["title"] for view in dashboard["views"]] == ["Battery"]
    assert {card["type"] for card in cards(dashboard["views"])} == CARDS
    frontend = ENVIRONMENT / "venv/lib/python3.13/site-packages/hass_frontend/frontend_latest"
    shown = b"".join(path.read_bytes() for path in frontend.glob("*.js") if b"-card" in path.read_bytes())
    assert [card for card in CARDS if f"hui-{card}-card".encode() not in shown] == []
    named = set(re.findall(r"\w+\.bms_pack_\w+", DASHBOARD.read_text()))
    assert len(named) > 30
    assert named - set(home.states()) == set()


def play(broker: Broker, device: str, stream: Iterator[tuple[float, Snapshot]], home: HomeAssistant) -> None:
    """Publish a pack's messages as fast as the broker accepts them, once Home Assistant has its entities."""
    messages, sent, said = MessageBuilder("bms", device), PublishedState(), list[Message]()
    for now_s, each in stream:
        info = each.info.model_copy(update={"device": device})
        due, sent = messages.live_messages(sent, each._replace(info=info), now_s)
        said += due
    first = [*messages.birth_messages(), *(message for message in said if message.retain)]
    values = [message for message in said if message.topic == f"bms/{device}/home_assistant"]

    async def say(what: list[Message]) -> None:
        async with aiomqtt.Client("127.0.0.1", broker.port) as client:
            for message in what:
                await client.publish(message.topic, message.payload, 1, message.retain)

    asyncio.run(say(first))
    last = json.loads(values[-1].payload)
    voltage = f"sensor.bms_{device}_voltage_v"

    def shown(states: dict[str, Any]) -> bool:
        """Home Assistant reads a topic some time after its discovery."""
        asyncio.run(say(values[:1]))
        ours = [state["state"] for entity, state in states.items() if entity.startswith(f"sensor.bms_{device}_")]
        return "unavailable" not in ours and voltage in states

    home.until(shown)
    asyncio.run(say(values))
    home.until(lambda states: number(states, voltage) == last["voltage_v"])


def test_what_a_pack_has_no_more_is_removed(home: HomeAssistant, broker: Broker) -> None:
    info = next(noisy(1.0))[1].info.model_copy(update={"device": "changed"})
    topic, entity = "homeassistant/device/bms_changed/config", "number.bms_changed_set_soc"

    async def tell(told: DiscoveryInputs) -> None:
        payload = json.dumps(discovery(HomeAssistantSettings(), told, "bms/changed", 0.0))
        async with aiomqtt.Client("127.0.0.1", broker.port) as client:
            await client.publish(topic, payload, 1, retain=True)

    asyncio.run(tell(DiscoveryInputs(info, commands=("set_soc",))))
    home.until(lambda states: entity in states)
    asyncio.run(tell(DiscoveryInputs(info)))
    home.until(lambda states: entity not in states and "sensor.bms_changed_voltage_v" in states)
    assert entity not in {entry["entity_id"] for entry in home.command("config/entity_registry/list")}


@pytest.mark.parametrize(("device", "stream"), [("noisy", noisy), ("restless", restless)])
def test_its_recorder_writes_at_most_20_rows_a_minute_for_a_pack(
    home: HomeAssistant, broker: Broker, device: str, stream: Callable[[float], Iterator[tuple[float, Snapshot]]]
) -> None:
    minutes = 10
    play(broker, device, stream(60.0 * minutes), home)
    info = next(stream(1.0))[1].info
    described = DiscoveryInputs(info, CELLS if stream is restless else 0)
    wanted = len(rows(stream(60.0 * minutes), shown(discovery(HomeAssistantSettings(), described, "bms/pack", 0.0))))
    assert 100 < wanted <= MAX_ROWS_PER_MIN * minutes
    deadline = time.monotonic() + LONG_S
    while (written := changes(home, device)) < wanted:  # it writes a moment later
        assert time.monotonic() < deadline, written
        time.sleep(0.1)
    assert written == wanted


def changes(home: HomeAssistant, device: str) -> int:
    """Rows of the device's numbers beside the first of each."""
    found = Counter(entity for entity, state in home.rows(f"sensor.bms_{device}_%") if state != "unavailable")
    return sum(count - 1 for count in found.values())


def test_the_present_current_becomes_zero_by_its_button(home: HomeAssistant, packs: Packs, broker: Broker) -> None:
    told(broker, "bms/bench/health", lambda health: health["uptime_s"] > REST_S + 5.0)
    deadline, granted = time.monotonic() + LONG_S, '"present current taken as zero on request", "pack": "bench"'
    refused = -1
    while granted not in packs.log:
        assert time.monotonic() < deadline, packs.log[-2000:]
        if packs.log.count(NOT_GRANTED) > refused:  # a busy machine loses frames, and what was watched begins anew
            refused = packs.log.count(NOT_GRANTED)
            home.call("button.press", entity_id="button.bms_bench_current_zero")
        time.sleep(1.0)


def test_a_pack_whose_service_was_killed_is_unavailable_until_it_is_back(home: HomeAssistant, packs: Packs) -> None:
    def ours(states: dict[str, Any]) -> set[str]:
        return {state["state"] for entity, state in states.items() if ".bms_pack_" in entity}

    packs.kill()
    home.until(lambda states: ours(states) == {"unavailable"})
    packs.start()
    states = home.until(lambda states: "unavailable" not in ours(states))
    assert number(states, SOC) == pytest.approx(50.0, abs=20.0)


def test_a_board_that_falls_silent_makes_its_alarms_unavailable_and_never_off(
    home: HomeAssistant, packs: Packs
) -> None:
    packs.silent.set()
    home.until(lambda states: {states[SOC]["state"], states[LOW]["state"]} == {"unavailable"})
    packs.silent.clear()
    states = home.until(lambda states: "unavailable" not in (states[SOC]["state"], states[LOW]["state"]))
    assert states[LOW]["state"] == "off"


def test_home_assistant_has_logged_nothing_of_us(home: HomeAssistant) -> None:
    lines = [line for line in home.log.splitlines() if re.search(r" (WARNING|ERROR|CRITICAL) ", line)]
    assert [line for line in lines if not any(known in line for known in NOT_OURS)] == []
