"""Detection of the device on a port, for all protocols. The probe sends only read requests."""

import contextlib
import os
import tty
from types import SimpleNamespace

import pytest

from bms_estimator.protocols.devices import daly, jbd, jk, junctek
from bms_estimator.protocols.devices.pylontech import PylontechProtocol
from bms_estimator.simulation.bms_responses import BMS_RESPONSES
from bms_estimator.simulation.simulated_meter import METERS
from bms_estimator.simulation.simulated_pack import SimulatedBms
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.sources.serial import device_detection, port_list
from bms_estimator.sources.serial.device_detection import DetectedDevice
from tests.device_line import running_device
from tests.patience import LONG_S


@pytest.fixture(autouse=True)
def short_query_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_detection, "QUERY_INTERVAL_S", 0.05)


def steady(_: float) -> Reading:
    return Reading(current_a=-3.2, voltage_v=26.4, temperature_c=21.0)


def bms(name: str) -> SimulatedBms:
    """Return a simulated BMS with 8 cells."""
    return SimulatedBms(name, steady, cells=8)


@pytest.mark.parametrize("name", [name for name in BMS_RESPONSES if name != "jk-pb"])
def test_bms_is_detected_with_its_number_of_cells(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_detection, "PROTOCOL_TIMEOUT_S", LONG_S)
    with running_device(bms(name)) as path:
        detected = device_detection.probe(path, 115_200)
    assert isinstance(detected, DetectedDevice)
    assert (detected.protocol, detected.baud, detected.cells) == (name, 115_200, 8)
    assert "8 cells" in str(detected)
    assert str(detected).endswith(f"; protocol {name}, 115200 baud")


@pytest.mark.parametrize("name", METERS)
def test_meter_is_detected(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_detection, "PROTOCOL_TIMEOUT_S", LONG_S)
    with running_device(METERS[name](steady, 1.0)) as path:
        detected = device_detection.probe(path, 115_200)
    assert isinstance(detected, DetectedDevice)
    assert detected.protocol == name


def test_bms_is_detected_without_a_given_baud_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_detection, "BOOT_TIMEOUT_S", 0.1)  # the probe waits for a board first
    monkeypatch.setattr(device_detection, "PROTOCOL_TIMEOUT_S", LONG_S)
    with running_device(bms("jk")) as path:
        detected = device_detection.probe(path)
    assert isinstance(detected, DetectedDevice)
    assert (detected.protocol, detected.baud) == ("jk", 115_200)


def test_newer_jk_is_not_detected_because_its_request_is_a_modbus_write(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(device_detection, "PROTOCOL_TIMEOUT_S", 0.1)
    monkeypatch.setattr(device_detection, "BOOT_TIMEOUT_S", 0.1)
    with running_device(bms("jk-pb")) as path:
        assert device_detection.probe(path) == "silent"


def test_silent_device_receives_only_read_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_detection, "PROTOCOL_TIMEOUT_S", 3.0)
    monkeypatch.setattr(device_detection, "BOOT_TIMEOUT_S", 1.0)
    # this clock advances by 1 s at each read, so that a delay of the test skips no request
    monkeypatch.setattr(device_detection, "time", SimpleNamespace(monotonic=iter(range(1000)).__next__))
    master, slave = os.openpty()
    tty.setraw(slave)
    try:
        assert device_detection.probe(os.ttyname(slave)) == "silent"
        sent = os.read(master, 1 << 16)
    finally:
        os.close(slave)
        os.close(master)
    assert jk.OLD_REQUEST in sent
    read_requests = [
        jk.OLD_REQUEST,
        junctek.QUERY,
        PylontechProtocol().next_output(0.0),
        *(jbd.request(register) for register in (jbd.NAME, jbd.CELLS, jbd.BASIC)),
        *(daly.request(host, command) for host in daly.HOSTS for command in (daly.STATUS, daly.CELLS, daly.PACK)),
    ]
    other_bytes = sent
    for request in read_requests:
        other_bytes = other_bytes.replace(request, b"")
    assert other_bytes == b""


def test_device_that_accepts_no_bytes_is_abandoned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port_list, "WRITE_TIMEOUT_S", 0.05)
    master, slave = os.openpty()
    try:
        tty.setraw(slave)
        os.set_blocking(slave, False)
        with contextlib.suppress(BlockingIOError):
            while True:  # until the buffer is full
                os.write(slave, b"x")
        assert device_detection.probe(os.ttyname(slave), 115_200) == "lost: Write timeout"
    finally:
        os.close(slave)
        os.close(master)
