"""Registry of protocols: one new file makes a device available in sensor settings and in the fleet."""

import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import ValidationError

from bms_estimator.fleet.packs.pack_row import PackSpec
from bms_estimator.protocols.registry import BOARD, DEVICES, PROTOCOLS
from bms_estimator.settings.sensor import SensorSettings
from tests.patience import LONG_S

SHUNT_MODULE = """
from bms_estimator.protocols.base.polled_protocol import Device, SensorDefaults
from bms_estimator.protocols.devices.text import TextProtocol

DEVICE = Device(
    "shunt",
    lambda sensor: TextProtocol(current_sign=sensor.current_sign),
    SensorDefaults(2400, "charge_positive", 5.0, 0.05, 0.02, 0.3),
)
"""
"""Module that registers protocol ``shunt``: 2400 baud, a period of 5 s and a current dead band of 0.3 A."""
USE_SHUNT_SCRIPT = """
import sys
from bms_estimator.protocols import devices
devices.__path__.append(sys.argv[1])
from bms_estimator.fleet.packs.pack_row import PackSpec
from bms_estimator.protocols.registry import make_protocol
from bms_estimator.settings.sensor import SensorSettings
sensor = SensorSettings.model_validate({"protocol": "shunt", "baud": 9600})
samples = make_protocol(sensor).feed(1.0, b"V=3.7 I=0.2\\n")
spec = PackSpec.model_validate({"cell": "leaf", "protocol": "shunt"})
print(sensor.baud, sensor.period_s, sensor.current_dead_band_a, samples["current_a"].tolist(), spec.protocol)
"""
"""Program that reads a line with protocol ``shunt`` at 9600 baud. Argument: folder of the module."""


def test_new_file_in_the_folder_of_devices_registers_a_protocol(tmp_path: Path) -> None:
    (tmp_path / "shunt.py").write_text(SHUNT_MODULE)
    process = subprocess.run(
        [sys.executable, "-c", USE_SHUNT_SCRIPT, tmp_path], capture_output=True, text=True, timeout=LONG_S, check=False
    )
    # -0.2 A, because 0.2 A of charge is negative in samples
    assert process.stdout == "9600 5.0 0.3 [-0.2] shunt\n", process.stderr


def test_schemas_of_settings_and_fleet_list_all_protocols() -> None:
    assert SensorSettings.model_json_schema()["properties"]["protocol"]["enum"] == list(PROTOCOLS)
    assert PackSpec.model_json_schema()["properties"]["protocol"]["enum"] == list(DEVICES)
    assert set(PROTOCOLS) >= {BOARD, "daly", "jbd", "jk", "junctek", "pylontech", "text", "vedirect"}


def test_unknown_protocol_is_rejected_with_the_list_of_protocols() -> None:
    with pytest.raises(ValidationError, match="must be one of binary, "):
        SensorSettings.model_validate({"protocol": "x"})
