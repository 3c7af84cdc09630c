"""Devices that the search found: pairs of a battery monitor and a BMS, and their settings."""

from dataclasses import replace

from bms_estimator.model.config_file import parse_toml
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.settings_template import settings_file
from bms_estimator.setup.answers import Answers
from bms_estimator.setup.broker_login import BrokerLogin
from bms_estimator.setup.found_device import FoundDevice, with_pairs

LOGIN = BrokerLogin("mqtt://localhost:1883", "owner", "secret")
SHUNT = FoundDevice("/dev/ttyUSB0", "SmartShunt", {"sensor": {"port": "/dev/ttyUSB0", "protocol": "vedirect"}})
NODE = FoundDevice(
    "esphome-jk:jk",
    "esphome-jk",
    {"source": {"kind": "mqtt", "profile": "esphome-jk", "prefix": "jk"}},
    cells=16,
    voltage_v=52.8,
    broker=LOGIN,
)


def test_a_battery_monitor_and_a_bms_are_offered_together_for_one_pack_only() -> None:
    (shunt, node, pair) = with_pairs([SHUNT, NODE])
    assert (shunt, node) == (SHUNT, NODE)
    assert (pair.name, pair.cells, pair.broker) == ("/dev/ttyUSB0+esphome-jk:jk", 16, LOGIN)
    venus = FoundDevice(
        "venus", "venus", {"source": {"kind": "mqtt", "profile": "venus"}}, voltage_v=52.9, broker=LOGIN
    )
    assert len(with_pairs([venus, NODE])) == 3
    assert len(with_pairs([replace(venus, voltage_v=26.4), NODE])) == 2
    assert len(with_pairs([replace(venus, broker=BrokerLogin("mqtt://other")), NODE])) == 2
    assert len(with_pairs([NODE, replace(NODE, name="esphome-jk:2")])) == 2
    ble = FoundDevice("C8:47", "Bluetooth BMS", {"source": {"kind": "ble", "address": "C8:47:80:00:00:01"}})
    assert [each.name for each in with_pairs([SHUNT, ble])][2:] == ["/dev/ttyUSB0+C8:47"]


def test_the_settings_of_a_pair_have_both_devices_and_the_login_of_the_broker() -> None:
    answers = Answers(with_pairs([SHUNT, NODE])[2], None, "house", "lfp", 100.0, 16, 1)
    settings = parse_toml(settings_file(Settings, answers.tables), Settings, "pack.toml")
    assert (settings.sensor.protocol, settings.source) == ("vedirect", None)
    bms = settings.bms_settings
    assert bms
    assert bms.source
    assert (bms.source.kind, bms.sensor.protocol, bms.bms) == ("mqtt", "text", None)
    assert bms.source.model_dump(include={"prefix", "url", "username", "password_file"}, mode="json") == {
        "prefix": "jk",
        "url": LOGIN.url,
        "username": "owner",
        "password_file": "house-source.password",
    }
