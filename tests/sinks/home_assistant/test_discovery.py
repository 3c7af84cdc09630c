"""Home Assistant: discovery messages, and rates and delays of published values."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bms_estimator.calibration.fuel_cell_fit import KEYS
from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads.snapshot import Alarm, Parameter, Snapshot
from bms_estimator.settings.alarms import ALARMS
from bms_estimator.settings.connections import HomeAssistantSettings
from bms_estimator.sinks.home_assistant.discovery import DiscoveryInputs, discovery
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState
from tests.sinks.snapshots import CELL_SNAPSHOT, STACK_SNAPSHOT

TOPIC_ROOT = "bms/pack"
SETTINGS = HomeAssistantSettings()
DASHBOARD = Path(__file__).parents[3] / "deploy" / "home-assistant" / "dashboard.yaml"


def components_of(message: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the components of a discovery message, without removed ones, which have only their platform."""
    return {key: component for key, component in message["components"].items() if set(component) != {"platform"}}


COMPONENTS = components_of(discovery(SETTINGS, DiscoveryInputs(CELL_SNAPSHOT.info), TOPIC_ROOT, 0.0))
ENABLED_BY_DEFAULT = {key for key, component in COMPONENTS.items() if component.get("enabled_by_default", True)}
MAX_ROWS_PER_MIN = 20
"""Maximum number of rows that Home Assistant's recorder may write per minute for one pack."""
CAPACITY_AH = 2.7
"""Capacity of the cell in ``noisy_cell``."""


STACK_COMPONENTS = components_of(discovery(SETTINGS, DiscoveryInputs(STACK_SNAPSHOT.info), TOPIC_ROOT, 0.0))


def cell_snapshot_with(**values: float | None) -> Snapshot:
    """Return the cell's snapshot with changed values of its estimate."""
    assert CELL_SNAPSHOT.estimate
    return CELL_SNAPSHOT._replace(estimate=CELL_SNAPSHOT.estimate.model_copy(update=values))


def noisy_cell(seconds: float, period_s: float = 1.0) -> Iterator[tuple[float, Snapshot]]:
    """Yield times and snapshots of an 18650 cell with noise, under a load that changes every 20 s."""
    rng, soc, load_a = np.random.default_rng(5), 0.9, 0.0
    for i in range(round(seconds / period_s)):
        now_s = i * period_s
        if i % round(20.0 / period_s) == 0:
            load_a = float(rng.uniform(0.0, 3.0))
        soc -= load_a * period_s / 3600.0 / CAPACITY_AH
        current_a = load_a + float(rng.normal(0.0, 0.02))
        voltage_v = 3.2 + soc - 0.07 * load_a + float(rng.normal(0.0, 0.003))
        yield (
            now_s,
            cell_snapshot_with(
                voltage_v=voltage_v,
                current_a=current_a,
                power_w=voltage_v * current_a,
                temperature_c=25.0 + float(rng.normal(0.0, 0.1)),
                soc_percent=100.0 * soc + float(rng.normal(0.0, 0.05)),
                remaining_capacity_ah=CAPACITY_AH * soc,
                remaining_energy_wh=CAPACITY_AH * soc * 3.6,
                time_to_cutoff_s=3600.0 * CAPACITY_AH * soc / 1.5 + 60.0 * float(rng.normal()),
                innovation_v=float(rng.normal(0.0, 0.003)),
                frames_lost=i // 50,
            ),
        )


CELL_COUNT = 4
"""Number of cells with a voltage in ``all_values_changing``."""
SOURCE_FIELDS = ("soc_std", "time_to_cutoff_s", "cutoff_within_15min", "time_to_full_s", "cell_lowest", "cell_lowest_v")
"""Fields of the estimate from which entities with other names are computed."""


def all_values_changing(
    seconds: float, period_s: float = 0.1, base: Snapshot = CELL_SNAPSHOT
) -> Iterator[tuple[float, Snapshot]]:
    """Yield times and snapshots. Every value changes with each snapshot."""
    assert base.estimate
    names = [key for key in (*ENABLED_BY_DEFAULT, *SOURCE_FIELDS) if hasattr(base.estimate, key)]
    for i in range(round(seconds / period_s)):
        elements = {key: e.model_copy(update={"value": float(i)}) for key, e in base.parameters.elements.items()}
        health = {"capacity": Parameter(value=float(i), std=float(i), valid=True, source="identified")}
        parameters = base.parameters.model_copy(update={"elements": elements, "state_of_health": health})
        estimate = base.estimate.model_copy(update=dict.fromkeys(names, i) | {"cells_v": [float(i)] * CELL_COUNT})
        yield i * period_s, base._replace(estimate=estimate, parameters=parameters)


def home_assistant_messages(stream: Iterator[tuple[float, Snapshot]]) -> Iterator[tuple[float, str, dict[str, object]]]:
    """Yield time, topic and payload of the messages to Home Assistant."""
    messages, sent = MessageBuilder("bms", "pack"), PublishedState()
    for now_s, each in stream:
        due, sent = messages.live_messages(sent, each, now_s)
        for message in due:
            if message.topic.startswith(f"{TOPIC_ROOT}/home_assistant"):
                yield now_s, message.topic, json.loads(message.payload)


def row_times(
    stream: Iterator[tuple[float, Snapshot]], components: dict[str, dict[str, object]] = COMPONENTS
) -> list[float]:
    """Return the times at which Home Assistant's recorder writes a row, for changed states or attributes of entities."""
    last_values: dict[str, object] = {}
    row_times_s = []
    enabled = {key for key, component in components.items() if component.get("enabled_by_default", True)}
    for now_s, topic, payload in home_assistant_messages(stream):
        for key in enabled & set(payload):
            assert components[key]["state_topic"] == topic
            if key in last_values and last_values[key] != payload[key]:
                row_times_s.append(now_s)
            last_values[key] = payload[key]
    assert enabled <= set(last_values)
    return row_times_s


CELL_COMPONENTS = components_of(discovery(SETTINGS, DiscoveryInputs(CELL_SNAPSHOT.info, CELL_COUNT), TOPIC_ROOT, 0.0))


@pytest.mark.parametrize(
    ("stream", "components"),
    [
        (noisy_cell(900.0), COMPONENTS),
        (all_values_changing(900.0), CELL_COMPONENTS),
        (all_values_changing(900.0, base=STACK_SNAPSHOT), STACK_COMPONENTS),
    ],
)
def test_home_assistant_records_at_most_20_rows_in_any_minute(
    stream: Iterator[tuple[float, Snapshot]], components: dict[str, dict[str, Any]]
) -> None:
    row_times_s = np.array(row_times(stream, components))
    assert row_times_s.size > 100
    assert max(np.count_nonzero((row_times_s >= t) & (row_times_s < t + 60.0)) for t in row_times_s) <= MAX_ROWS_PER_MIN


def test_fuel_cell_has_its_own_entities() -> None:
    values = next(payload for _, topic, payload in home_assistant_messages(iter([(0.0, STACK_SNAPSHOT)])))
    sensors = {key for key, component in STACK_COMPONENTS.items() if component["platform"] == "sensor"}
    assert sensors == set(values)
    assert {key for key, value in values.items() if value is None} == {"temperature_c"}
    assert set(KEYS) <= sensors
    assert values["r_ohm"] == pytest.approx(0.1677, abs=1e-3)  # r_ohm of the model pem_30w
    assert STACK_COMPONENTS["r_ohm"]["unit_of_measurement"] == "Ω"


def test_noise_at_rest_causes_no_rows() -> None:
    rng = np.random.default_rng(2)
    stream = (
        (
            float(i),
            cell_snapshot_with(voltage_v=3.705 + float(rng.normal(0.0, 0.002)), current_a=float(rng.normal(0.0, 0.01))),
        )
        for i in range(600)
    )
    assert row_times(stream) == []


@pytest.mark.parametrize("rate_hz", [0.1, 0.7, 1.0, 4.0, 10.0])
def test_values_never_expire_while_estimates_arrive_up_to_a_period_late(rate_hz: float) -> None:
    info = CELL_SNAPSHOT.info.model_copy(update={"publish_rate_hz": rate_hz})
    components = discovery(SETTINGS, DiscoveryInputs(info), TOPIC_ROOT, 0.0)["components"].values()
    expiry_s = min(c["expire_after"] for c in components if "expire_after" in c)
    rng = np.random.default_rng(3)
    delays_s = [float(rng.uniform(0.0, 0.9 / rate_hz)) for _ in range(round(600 * rate_hz))]
    stream = ((i / rate_hz + delay_s, CELL_SNAPSHOT) for i, delay_s in enumerate(delays_s))
    times_s = [now_s for now_s, topic, _ in home_assistant_messages(stream) if topic == f"{TOPIC_ROOT}/home_assistant"]
    assert times_s[-1] > 550.0  # of 600 s
    assert max(np.diff(times_s)) < expiry_s


def test_values_are_not_repeated_without_estimates_so_that_they_expire() -> None:
    silent = CELL_SNAPSHOT._replace(estimate=None)
    times_s = [t for t, _, _ in home_assistant_messages((float(i), silent if i else CELL_SNAPSHOT) for i in range(60))]
    assert times_s == [0.0]


@pytest.mark.parametrize(("name", "before"), [("current_a", 0.0), ("temperature_c", None), ("soc_std", 0.2)])
def test_a_rare_change_and_a_first_value_are_published_within_five_seconds(name: str, before: float | None) -> None:
    stream = ((t, cell_snapshot_with(**{name: before if t < 43.0 else 3.0})) for t in map(float, range(60)))
    values = {"soc_std_percent": 300.0} if name == "soc_std" else {name: 3.0}
    published_s = next(t for t, _, payload in home_assistant_messages(stream) if values.items() <= payload.items())
    assert published_s <= 48.0


def test_values_are_rounded_to_their_resolution() -> None:
    values = cell_snapshot_with(voltage_v=3.7049999, soc_percent=56.7890123, remaining_energy_wh=1.23456789)
    payload = next(p for _, _, p in home_assistant_messages(iter([(0.0, values)])))
    assert (payload["voltage_v"], payload["soc_percent"], payload["remaining_energy_wh"]) == (3.7, 56.8, 1.2)
    assert payload["temperature_c"] is None


def test_only_alarms_and_signed_values_have_attributes() -> None:
    for component in COMPONENTS.values():
        assert not component["state_topic"].endswith(("/health", "/state", "/parameters"))
        if "json_attributes_template" in component:
            names = set(re.findall(r"'(\w+)':", component["json_attributes_template"]))
            assert names <= {"reason", "severity", "positive", "hint"}


def test_observer_values_are_disabled_by_default() -> None:
    observer_values = {
        "delta_1",
        "delta_2",
        "adaptive_gain_k",
        "nussbaum_gain",
        "adaptation_gain_hz",
        "innovation_v",
        "sample_rate_hz",
        "r_ts_ohm",
    }
    assert not ENABLED_BY_DEFAULT & observer_values
    assert observer_values < set(COMPONENTS)
    assert {"voltage_v", "current_a", "soc_percent", "time_to_cutoff_h", "r_s_mohm"} <= ENABLED_BY_DEFAULT


def test_discovery_describes_every_entity_with_both_availabilities() -> None:
    message = discovery(SETTINGS, DiscoveryInputs(CELL_SNAPSHOT.info), TOPIC_ROOT, 0.0)
    assert (message["device"]["identifiers"], message["device"]["serial_number"]) == (["bms_pack"], "A1")
    assert message["origin"]["name"] == "bms_estimator"
    assert message["availability_mode"] == "all"
    assert [a["topic"] for a in message["availability"]] == ["bms/pack/availability", "bms/pack/sensor/availability"]
    soc, current = COMPONENTS["soc_percent"], COMPONENTS["current_a"]
    assert (soc["device_class"], soc["unit_of_measurement"], soc["expire_after"]) == ("battery", "%", 30)
    assert "'positive': 'discharge'" in current["json_attributes_template"]
    assert "device_class" not in COMPONENTS["r_s_mohm"]
    assert len({component["unique_id"] for component in COMPONENTS.values()}) == len(COMPONENTS)


@pytest.mark.parametrize(("rate_hz", "sample_period_s", "expire_s"), [(0.1, 1.0, 30), (10.0, 1.0, 30), (1.0, 25.0, 75)])
def test_values_expire_after_three_periods_or_30_s(rate_hz: float, sample_period_s: float, expire_s: int) -> None:
    info = CELL_SNAPSHOT.info.model_copy(update={"publish_rate_hz": rate_hz})
    components = discovery(SETTINGS, DiscoveryInputs(info), TOPIC_ROOT, sample_period_s)["components"].values()
    assert {c["expire_after"] for c in components if "expire_after" in c} == {expire_s}


def discoveries(*snapshots: Snapshot, commands: tuple[str, ...] = (), **settings: Any) -> list[dict[str, Any]]:
    """Publish the snapshots, 10 s apart. Return the payloads of the discovery messages."""
    messages, sent = MessageBuilder("bms", "pack", home_assistant=HomeAssistantSettings(**settings)), PublishedState()
    messages.commands = commands
    payloads = []
    for i, each in enumerate(snapshots):
        due, sent = messages.live_messages(sent, each, 10.0 * i)
        payloads += [json.loads(m.payload or "null") for m in due if m.topic.endswith("/device/bms_pack/config")]
    return payloads


def test_cells_are_added_with_their_first_voltages_and_never_removed() -> None:
    cells = cell_snapshot_with(cells_v=[3.3, None, 3.31], cell_lowest=1, cell_lowest_v=3.3)
    before, after = discoveries(CELL_SNAPSHOT, cells, CELL_SNAPSHOT)
    new = set(after["components"]) - set(before["components"])
    assert new == {
        "cell_lowest",
        "cell_lowest_v",
        "cell_highest",
        "cell_highest_v",
        "weakest_cell",
        "cell_soc_spread",
        "cell_r_spread",
        *(f"cell_{n}_v" for n in (1, 2, 3)),
    }
    cell = after["components"]["cell_2_v"]
    assert (cell["entity_category"], cell["enabled_by_default"], cell["name"]) == ("diagnostic", False, "Cell 2")


def test_allowed_commands_have_controls() -> None:
    [without_commands] = discoveries(CELL_SNAPSHOT)
    assert not any("command_topic" in component for component in components_of(without_commands).values())
    [with_commands] = discoveries(
        CELL_SNAPSHOT, commands=("set_soc", "current_zero", "acknowledge_alarm", "publish_rate", "forget_pack")
    )
    platforms = {key: c["platform"] for key, c in with_commands["components"].items() if "command_topic" in c}
    assert platforms == {
        "set_soc": "number",
        "current_zero": "button",
        "acknowledge_alarm": "button",
        "publish_rate": "number",
        "forget_pack": "button",
    }


def test_entities_of_an_earlier_configuration_are_removed() -> None:
    messages = MessageBuilder("bms", "pack", alarms=[name for name in ALARMS if name != "soc_low"])
    messages.commands = ("set_soc",)
    due, _ = messages.live_messages(PublishedState(), CELL_SNAPSHOT, 0.0)
    [message] = [json.loads(m.payload) for m in due if m.topic.endswith("/device/bms_pack/config")]
    removed = {key: c["platform"] for key, c in message["components"].items() if key not in components_of(message)}
    assert removed == {
        "alarm_soc_low": "binary_sensor",
        "r_s_ohm": "sensor",
        "current_zero": "button",
        "acknowledge_alarm": "button",
        "publish_rate": "number",
        "forget_pack": "button",
    }


def cleared_alarm(name: str) -> Alarm:
    """Return the payload of an alarm that is not raised."""
    return Alarm(
        name=name,
        severity="warning",
        active=False,
        latched=False,
        since=None,
        value=None,
        limit=None,
        unit=None,
        text="",
    )


def test_monitored_alarms_stay_available_while_the_sensor_is_silent() -> None:
    [message] = discoveries(CELL_SNAPSHOT._replace(alarms=(cleared_alarm("soc_low"),)))
    component = message["components"]["alarm_soc_low"]
    assert (component["platform"], component["device_class"]) == ("binary_sensor", "battery")
    assert component["state_topic"] == "bms/pack/alarm/soc_low"
    service_availability, alarm_availability = component["availability"]
    assert service_availability == {"topic": "bms/pack/availability"}
    assert (alarm_availability["topic"], component["availability_mode"]) == ("bms/pack/alarm/soc_low", "all")
    assert alarm_availability["value_template"] == (
        "{{ 'online' if value_json.watched or value_json.active else 'offline' }}"
    )


def test_entity_ids_do_not_depend_on_configured_names() -> None:
    cells = cell_snapshot_with(cells_v=[3.3])
    [english] = discoveries(cells)
    [german] = discoveries(cells, name="Hausbatterie", names={"voltage_v": "Klemmenspannung", "cell_v": "Zelle"})
    english_components, german_components = components_of(english), components_of(german)
    assert {key for key, component in english_components.items() if "name" not in component} == {
        "voltage_v",
        "current_a",
        "power_w",
        "temperature_c",
        "soc_percent",
    }
    assert [german_components[key]["name"] for key in ("voltage_v", "cell_1_v")] == ["Klemmenspannung", "Zelle 1"]
    assert (german["device"]["name"], english["device"]["name"]) == ("Hausbatterie", "pack")
    ids = [
        {component["default_entity_id"] for component in each.values()}
        for each in (english_components, german_components)
    ]
    assert ids[0] == ids[1]


def test_the_dashboard_shows_all_alarms_that_are_enabled_by_default() -> None:
    components = discovery(SETTINGS, DiscoveryInputs(CELL_SNAPSHOT.info, alarms=ALARMS), TOPIC_ROOT, 0.0)["components"]
    alarms = [component for key, component in components.items() if key.startswith("alarm_")]
    expert, owner = (
        [a["default_entity_id"] for a in alarms if a.get("enabled_by_default", True) is on] for on in (False, True)
    )
    assert expert == ["binary_sensor.bms_pack_alarm_stability_margin_low"]
    assert set(re.findall(r"binary_sensor\.\w+", DASHBOARD.read_text(encoding="utf-8"))) == set(owner)


def test_error_on_an_unknown_name_lists_the_entities() -> None:
    with pytest.raises(UserError, match=r"home_assistant\.names\.volts: there is no such entity; .*voltage_v"):
        discoveries(names={"volts": "Spannung"})


def test_current_sign_is_configurable() -> None:
    messages = MessageBuilder("bms", "pack", home_assistant=HomeAssistantSettings(current_sign="charge_positive"))
    due, _ = messages.live_messages(
        PublishedState(), cell_snapshot_with(current_a=2.0, power_w=8.0, voltage_v=4.0), 0.0
    )
    values = next(json.loads(m.payload) for m in due if m.topic == f"{TOPIC_ROOT}/home_assistant")
    assert (values["current_a"], values["power_w"], values["voltage_v"]) == (-2.0, -8.0, 4.0)


def test_disabled_discovery_removes_the_device() -> None:
    messages = MessageBuilder("bms", "pack", home_assistant=HomeAssistantSettings(enabled=False, discovery_prefix="ha"))
    due, _ = messages.live_messages(PublishedState(), CELL_SNAPSHOT, 0.0)
    discovery_messages = [m for m in due if "home_assistant" in m.topic or not m.topic.startswith("bms/")]
    assert [(m.topic, m.payload, m.retain) for m in discovery_messages] == [("ha/device/bms_pack/config", b"", True)]


@pytest.mark.parametrize(("limit_a", "is_marked"), [(None, True), (100.0, False)])
def test_an_available_power_within_an_assumed_current_limit_is_marked(limit_a: float | None, is_marked: bool) -> None:
    info = CELL_SNAPSHOT.info.model_copy(update={"max_charge_a": limit_a, "max_discharge_a": 50.0})
    components = discovery(SETTINGS, DiscoveryInputs(info), TOPIC_ROOT, 0.0)["components"]
    attributes = {key for key, each in components.items() if "assumed" in each.get("json_attributes_template", "")}
    assert attributes == ({f"available_charge_power_{time}_w" for time in ("10s", "60s")} if is_marked else set())
