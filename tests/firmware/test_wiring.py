"""Wiring diagram and table of parts: they agree with each other, with the firmware, and with the voltage of a full pack."""

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
"""Minimum supply behind a USB port and the Nano's diode (docs/pack/board.md) [V]."""
FULL_PACK_V = 6 * 4.2
"""Voltage of the six full cells of the documented pack [V]."""
RANGE_MARGIN = 1.05
"""Minimum ratio of the measuring range to the voltage of a full pack."""
RESISTOR_TOLERANCE = 0.01
TURNS_RATIO = 1000
"""Ratio of the measured current to the output current of the LA 25-NP (U2), which flows through RM."""
SI_UNITS = {"kΩ": 1e3, "nF": 1e-9, "Ω": 1.0}


def part_value(part: str) -> float:
    """Return the value of a part in the table of docs/pack/board.md, in SI units."""
    row = re.search(rf"^\| [^|]*\b{part}\b[^|]*\| (\S+) (\S+?)[, ]", TABLE, re.MULTILINE)
    assert row, part
    return float(row[1]) * SI_UNITS[row[2]]


def firmware_setting(pattern: str) -> int:
    """Return the integer that ``pattern`` captures in the firmware's settings.cpp."""
    match = re.search(pattern, (FIRMWARE / "bms_board" / "settings.cpp").read_text())
    assert match, pattern
    return int(match[1])


R1, R2, R3 = part_value("R1"), part_value("R2"), part_value("R3")


def test_full_pack_is_within_range_at_the_minimum_supply_with_the_worst_resistors() -> None:
    min_divider = 1.0 + R1 * (1.0 - RESISTOR_TOLERANCE) / (R2 * (1.0 + RESISTOR_TOLERANCE))
    assert MIN_AVCC_V * min_divider > RANGE_MARGIN * FULL_PACK_V


def test_firmware_and_virtual_board_have_the_divider_and_slope_of_the_drawing() -> None:
    divider = (R1 + R2) / R2
    assert firmware_setting(r"DIVIDER_MAX_PPM, (\d+)\}") == round(divider * 1e6)
    assert firmware_setting(r"CURRENT_MAX_UV_PER_A, (\d+)\}") == 100_000
    assert (BoardParts().divider, BoardParts().volts_per_ampere) == (divider, 0.1)
    assert f"#define DIVIDER {divider:g}\n" in (FIRMWARE / "sim" / "sensors.c").read_text()
    assert f"{divider:g} : 1" in DRAWING


def test_documented_voltage_steps_are_those_of_the_board_and_of_the_default_setting() -> None:
    assert f"{5.0 * (R1 + R2) / R2 / FULL_SCALE * 1e3:.1f} mV" in TABLE
    assert f"Its default, {SensorSettings().voltage_resolution_v:.4f}," in TABLE


@pytest.mark.parametrize(
    ("resistance_ohm", "capacitor"), [(R1 * R2 / (R1 + R2), "C1"), (R3, "C2")], ids=["voltage", "current"]
)
def test_corner_and_delay_of_the_filters_match_the_documentation(resistance_ohm: float, capacitor: str) -> None:
    delay_s = resistance_ohm * part_value(capacitor)
    corner_hz = 1.0 / (2.0 * math.pi * delay_s)
    assert f"{corner_hz:.0f} Hz, {delay_s * 1e3:.2f} ms" in TABLE
    assert f"{corner_hz:.0f} Hz" in DRAWING
    assert resistance_ohm < 10e3, "the source resistance is above the maximum in the converter's data sheet"


def test_measuring_resistor_of_the_thesis_s_current_sensor_gives_the_documented_slope() -> None:
    assert part_value("RM") / TURNS_RATIO == pytest.approx(0.1)
    assert "`--volts-per-ampere 0.1 --absolute`" in TABLE


def test_every_part_of_the_table_is_in_the_drawing() -> None:
    names = [name for row in re.findall(r"^\| ([A-Z][A-Z0-9, ]+) \|", TABLE, re.MULTILINE) for name in row.split(", ")]
    assert len(names) >= 16, "the pattern does not match the table"
    assert [name for name in names if not re.search(rf"\b{name}\b", DRAWING)] == []
