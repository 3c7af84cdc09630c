"""Consistency of the wiring diagram and its table with each other, the firmware and a full pack."""

import math
import re
import xml.etree.ElementTree as ET

import pytest

from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.simulation.virtual_adc import FULL_SCALE, BoardParts
from tests.simavr_board import FIRMWARE, ROOT

TABLE = (ROOT / "docs" / "pack" / "board.md").read_text(encoding="utf-8")
DRAWING = " ".join(ET.parse(ROOT / "docs" / "images" / "wiring.svg").getroot().itertext())
MIN_AVCC_V = 4.5
FULL_PACK_V = 6 * 4.2
TOLERANCE = 0.01
UNITS = {"kΩ": 1e3, "nF": 1e-9, "Ω": 1.0}


def value(part: str) -> float:
    """Of a part, by the table."""
    row = re.search(rf"^\| [^|]*\b{part}\b[^|]*\| (\S+) (\S+?)[, ]", TABLE, re.MULTILINE)
    assert row, part
    return float(row[1]) * UNITS[row[2]]


def constant(pattern: str) -> int:
    """Of the firmware's settings."""
    found = re.search(pattern, (FIRMWARE / "bms_board" / "settings.cpp").read_text())
    assert found, pattern
    return int(found[1])


R1, R2, R3 = value("R1"), value("R2"), value("R3")


def test_a_full_pack_is_within_range_at_the_lowest_supply_with_the_worst_resistors() -> None:
    worst = 1.0 + R1 * (1.0 - TOLERANCE) / (R2 * (1.0 + TOLERANCE))
    assert MIN_AVCC_V * worst > 1.05 * FULL_PACK_V


def test_the_firmware_and_the_virtual_board_are_built_as_drawn() -> None:
    divider = (R1 + R2) / R2
    assert constant(r"DIVIDER_MAX_PPM, (\d+)\}") == round(divider * 1e6)
    assert constant(r"CURRENT_MAX_UV_PER_A, (\d+)\}") == 100_000
    assert (BoardParts().divider, BoardParts().volts_per_ampere) == (divider, 0.1)
    assert f"#define DIVIDER {divider:g}\n" in (FIRMWARE / "sim" / "sensors.c").read_text()
    assert f"{divider:g} : 1" in DRAWING


def test_documented_step_matches_the_default_resolution() -> None:
    assert f"{5.0 * (R1 + R2) / R2 / FULL_SCALE * 1e3:.1f} mV" in TABLE
    assert f"{SensorSettings().voltage_resolution_v * 1e3:.1f} mV unless set" in TABLE


@pytest.mark.parametrize(
    ("resistance_ohm", "capacitor"), [(R1 * R2 / (R1 + R2), "C1"), (R3, "C2")], ids=["voltage", "current"]
)
def test_corner_and_delay_of_the_filters_are_the_documented_ones(resistance_ohm: float, capacitor: str) -> None:
    delay_s = resistance_ohm * value(capacitor)
    assert f"{0.5 / math.pi / delay_s:.0f} Hz, {delay_s * 1e3:.2f} ms" in TABLE
    assert f"{0.5 / math.pi / delay_s:.0f} Hz" in DRAWING
    assert resistance_ohm < 10e3, "more than the converter's data sheet wants"


def test_the_measuring_resistor_of_the_thesis_sensor_gives_the_documented_slope() -> None:
    assert value("RM") / 1000 == pytest.approx(0.1)
    assert "`--volts-per-ampere 0.1 --absolute`" in TABLE


def test_every_part_of_the_table_is_in_the_drawing() -> None:
    names = [name for row in re.findall(r"^\| ([A-Z][A-Z0-9, ]+) \|", TABLE, re.MULTILINE) for name in row.split(", ")]
    assert len(names) >= 16
    assert [name for name in names if not re.search(rf"\b{name}\b", DRAWING)] == []
