"""Selection of the board's port with ``port = "auto"``."""

from pathlib import Path

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from bms_estimator.sources.serial import port_list
from bms_estimator.sources.serial.port_list import NoPortError, resolve_port
from tests.serial_line import usb_port


@pytest.fixture
def ports(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[ListPortInfo]:
    """Return the list of the connected ports, to which a test adds ports."""
    ports: list[ListPortInfo] = []
    monkeypatch.setattr(list_ports, "comports", lambda: ports)
    monkeypatch.setattr(port_list, "BY_ID", tmp_path)
    return ports


@pytest.mark.parametrize(
    ("vid", "pid", "product"),
    [
        (0x1A86, 0x7523, "USB Serial"),
        (0x1A86, 0x55D4, "USB Single Serial"),
        (0x0403, 0x6001, "FT232R USB UART"),
        (0x10C4, 0xEA60, "CP2102 USB to UART Bridge Controller"),
        (0x067B, 0x2303, "USB-Serial Controller"),
        (0x2341, 0x0043, "Arduino Uno"),
        (0x2A03, 0x0043, "Arduino Uno"),
    ],
)
def test_auto_selects_a_port_with_a_usb_chip_of_boards(
    ports: list[ListPortInfo], vid: int, pid: int, product: str
) -> None:
    ports.append(usb_port("/dev/ttyUSB7", vid, pid, product))
    assert resolve_port("auto") == "/dev/ttyUSB7"


@pytest.mark.parametrize(
    ("vid", "pid", "product"),
    [
        (0x10C4, 0xEA60, "Sonoff Zigbee 3.0 USB Dongle Plus"),
        (0x1A86, 0x55D4, "SONOFF Zigbee 3.0 USB Dongle Plus V2"),
        (0x10C4, 0xEA60, "SkyConnect v1.0"),
        (0x10C4, 0xEA60, "HubZ Smart Home Controller"),
        (0x10C4, 0xEA60, "slae.sh cc2652rb stick - slaesh's iot stuff"),
        (0x1A86, 0x55D4, "800 Series Z-Wave Stick"),
        (0x1CF1, 0x0030, "ConBee II"),
        (0x0658, 0x0200, "n/a"),
    ],
)
def test_auto_ignores_ports_of_radio_sticks_and_of_unknown_chips(
    ports: list[ListPortInfo], vid: int, pid: int, product: str
) -> None:
    ports.append(usb_port("/dev/ttyUSB0", vid, pid, product))
    with pytest.raises(NoPortError, match="no port of a known board is connected") as raised:
        resolve_port("auto")
    assert f"/dev/ttyUSB0 ({product})" in str(raised.value)


def test_auto_selects_the_stable_link_of_the_board_next_to_a_radio_stick(
    ports: list[ListPortInfo], tmp_path: Path
) -> None:
    ports += [usb_port("/dev/ttyUSB0", 0x10C4, 0xEA60, "SkyConnect v1.0"), usb_port("/dev/ttyUSB1")]
    stable_link = tmp_path / "usb-1a86_USB_Serial-if00-port0"
    stable_link.symlink_to("/dev/ttyUSB1")
    assert resolve_port("auto") == str(stable_link)
