"""Linux sensors in a simulated sysfs: values in SI units, and files that fail, vanish, hang or contain no number."""

import os
import threading
from collections.abc import AsyncGenerator
from contextlib import aclosing
from pathlib import Path
from typing import Any

import pytest

from bms_estimator.protocols.base.reading import CONNECTED, Reading, read_line
from bms_estimator.settings.sources.source import LinuxSource
from bms_estimator.sources.linux.linux_sensor import LinuxSensor
from bms_estimator.sources.source import SourceUnavailableError
from tests.patience import LONG_S
from tests.sources.linux.sysfs_folder import hwmon, iio

INA226 = {"in0_input": 25, "in1_input": 13280, "curr1_input": -2510, "shunt_resistor": 10000, "update_interval": 2}
"""Files of an INA226: shunt and bus voltage [mV], current [mA], shunt [uohm], update interval [ms]."""
UNREADABLE_FILE = Path("/proc/self/mem")
"""File whose beginning gives an input/output error when it is read."""


def sensor(root: Path, read_timeout_s: float = LONG_S, **settings: Any) -> LinuxSensor:
    """Return a sensor in the simulated /sys ``root``, polled every 10 ms."""
    return LinuxSensor(
        LinuxSource.model_validate({"kind": "linux", "interval_s": 0.01} | settings), root, read_timeout_s
    )


async def read_first(lines: AsyncGenerator[bytes, None]) -> Reading:
    """Return the first reading, after a check that ``CONNECTED`` precedes it."""
    async with aclosing(lines):
        assert await anext(lines) == CONNECTED
        return _reading(await anext(lines))


async def _drain(lines: AsyncGenerator[bytes, None]) -> None:
    async for _ in lines:
        pass


def _reading(line: bytes) -> Reading:
    reading = read_line(line)
    assert reading
    return reading


@pytest.mark.parametrize("chip", ["ina226", "1-0040"])
async def test_ina226_is_found_by_name_or_bus_address(chip: str, tmp_path: Path):
    hwmon(tmp_path, "cpu_thermal", "thermal", number=0, temp1_input=48312)
    hwmon(tmp_path, **INA226)
    reading = await read_first(sensor(tmp_path, chip=chip).iter_lines())
    assert (reading.voltage_v, reading.current_a) == (13.28, -2.51)


@pytest.mark.parametrize(
    ("settings", "voltage_v", "current_a"),
    [
        ({"voltage_scale": 4.0, "voltage_offset_v": 0.1}, 53.22, -2.51),
        ({"shunt_ohm": 0.0005}, 13.28, -50.2),  # the driver assumes 10 mohm
        ({"current": "in0_input", "shunt_ohm": 0.0005}, 13.28, 50.0),  # 25 mV
        ({"current_scale": 1.02, "current_offset_a": 0.01}, 13.28, -2.5502),
    ],
)
async def test_configured_scales_and_shunt_are_applied(
    settings: dict[str, Any], voltage_v: float, current_a: float, tmp_path: Path
):
    hwmon(tmp_path, **INA226)
    reading = await read_first(sensor(tmp_path, **settings).iter_lines())
    assert (reading.voltage_v, reading.current_a) == (voltage_v, current_a)


async def test_voltage_and_current_of_an_ads1115_and_temperature_of_another_chip(tmp_path: Path):
    scales = {"in_voltage0-voltage1_scale": 0.0078125, "in_voltage_scale": 0.125}
    iio(tmp_path, in_voltage2_raw=26560, **{"in_voltage0-voltage1_raw": -640}, **scales)
    hwmon(tmp_path, "lm75", "1-0049", number=5, temp1_input=21500)
    reading = await read_first(
        sensor(
            tmp_path,
            chip="ads1115",
            voltage="in_voltage2",
            current="in_voltage0-voltage1",
            temperature="lm75/temp1_input",
            voltage_scale=16.0,
            shunt_ohm=0.00075,
        ).iter_lines()
    )
    # 26,560 of 0.125 mV by the divider of 16; -640 of 7.8125 uV across 0.75 mohm
    assert reading == Reading(voltage_v=53.12, current_a=-6.666667, temperatures_c=(21.5,))


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"chip": "ina228"}, "ina228: no such chip in hwmon or iio; present: ina219, ina226. Is its driver loaded?"),
        ({"chip": "ina219"}, "ina219: 2 chips have this name (1-0041, 1-0042); set the bus address of one of them"),
        ({"chip": "/nowhere"}, "/nowhere: no such folder; is the driver loaded?"),
        ({"current": "curr2_input"}, "curr2_input: no such file; the chip has curr1_input, in0_input, in1_input"),
        ({"current": "in0_input"}, "in0_input: a voltage; set source.shunt_ohm to the resistance of its shunt"),
        (
            {"chip": "1-0041", "shunt_ohm": 0.1},
            "set the ratio in source.current_scale instead of source.shunt_ohm",
        ),
    ],
)
async def test_missing_chip_or_file_is_reported_with_a_remedy(settings: dict[str, Any], reason: str, tmp_path: Path):
    hwmon(tmp_path, **INA226)
    for number, place in ((4, "1-0041"), (5, "1-0042")):
        hwmon(tmp_path, "ina219", place, number, in1_input=1, curr1_input=1)
    with pytest.raises(SourceUnavailableError) as caught:
        await read_first(sensor(tmp_path, **settings).iter_lines())
    assert str(caught.value).endswith(reason)


async def test_file_without_a_number_loses_a_sample_and_is_reported_until_it_has_one(tmp_path: Path):
    folder = hwmon(tmp_path, **INA226)
    ina = sensor(tmp_path)
    voltage, current = folder / "in1_input", folder / "curr1_input"
    faults = {
        "no number: b'busy'": lambda: current.write_text("busy"),
        "no number: b''": lambda: current.write_text(""),
        "no number: b'\\xff\\x00": lambda: current.write_bytes(b"\xff\x00" * 4000),
        "curr1_input: Input/output error": lambda: (current.unlink(), current.symlink_to(UNREADABLE_FILE)),
        "curr1_input: Is a directory": lambda: (current.unlink(), current.mkdir()),
    }
    async with aclosing(ina.iter_lines()) as lines:
        assert await anext(lines) == CONNECTED
        await anext(lines)
        for reason, make_fault in faults.items():
            make_fault()
            no_line = b""
            assert ina._sample(await ina._read(ina._find_channels)) == no_line
            assert reason in (ina.fault or "")
        current.rmdir()
        current.write_text("1500\n")
        voltage.write_text("12000\n")
        while (reading := _reading(await anext(lines))).current_a != 1.5:
            pass
        assert reading.voltage_v == 12.0
        assert ina.fault is None
        assert ina.counters["value_errors"] >= 3
        assert ina.counters["read_errors"] >= 2
        voltage.unlink()  # as after the removal of the driver
        with pytest.raises(FileNotFoundError):
            await _drain(lines)


async def test_hung_bus_is_reported_and_not_read_by_a_second_thread_until_it_answers(tmp_path: Path):
    folder = hwmon(tmp_path, **INA226)
    (folder / "curr1_input").unlink()
    os.mkfifo(folder / "curr1_input")  # opening a FIFO blocks until another process opens it for writing
    ina = sensor(tmp_path, read_timeout_s=0.05)
    threads_before = set(threading.enumerate())
    for _ in range(3):
        with pytest.raises(SourceUnavailableError, match=r"the bus has not answered for 0.05 s"):
            await read_first(ina.iter_lines())
    assert len(set(threading.enumerate()) - threads_before) == 1
    writer = os.open(folder / "curr1_input", os.O_RDWR | os.O_NONBLOCK)
    (folder / "curr1_input").unlink()
    (folder / "curr1_input").write_text("1500\n")
    os.close(writer)  # the blocked reader returns
    ina._read_timeout_s = LONG_S
    assert (await read_first(ina.iter_lines())).current_a == 1.5


async def test_temperature_that_is_no_number_loses_no_sample(tmp_path: Path):
    hwmon(tmp_path, **INA226, temp1_input="nonsense")
    ina = sensor(tmp_path, temperature="temp1_input")
    reading = await read_first(ina.iter_lines())
    assert reading.temperatures_c == ()
    assert ina.counters == {"read_errors": 0, "value_errors": 1}


@pytest.mark.parametrize(("update_interval", "interval_s"), [("2", 0.1), ("2253", 2.253), ("no number", 1.0)])
def test_poll_interval_is_the_update_interval_of_the_chip_of_at_least_0_1_s(
    update_interval: str, interval_s: float, tmp_path: Path
):
    hwmon(tmp_path, **INA226 | {"update_interval": update_interval})
    assert sensor(tmp_path, interval_s=None)._find_channels().interval_s == interval_s


async def test_chip_slower_than_the_sample_period_is_reported_with_the_setting(tmp_path: Path):
    hwmon(tmp_path, **INA226 | {"update_interval": "17000"})
    with pytest.raises(SourceUnavailableError, match=r"measures only every 17 s; .*source\.interval_s = 17$"):
        await read_first(sensor(tmp_path, interval_s=None).iter_lines())
    assert await read_first(sensor(tmp_path, interval_s=17.0).iter_lines())
