"""Simulated BlueZ on a private D-Bus, with one JBD BMS in range, for tests with bleak.

The interfaces and properties are those of BlueZ's documentation (doc/org.bluez.*.rst). The radio is not simulated.
"""

import asyncio
import os
import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from dbus_fast import Message, MessageType, Variant
from dbus_fast.aio import MessageBus

from tests.protocols.bms_frames import JBD_DISCHARGING

ADDRESS, NAME = "A5:C2:37:00:00:00", "DP04S007L4S100A"
ADAPTER_PATH = "/org/bluez/hci0"
DEVICE_PATH = f"{ADAPTER_PATH}/dev_{ADDRESS.replace(':', '_')}"
SERVICE_PATH, NOTIFY_PATH, WRITE_PATH = (
    f"{DEVICE_PATH}/service0010",
    f"{DEVICE_PATH}/service0010/char0011",
    f"{DEVICE_PATH}/service0010/char0013",
)
CELLS, BASIC = JBD_DISCHARGING.frames[:15], JBD_DISCHARGING.frames[15:]
"""Responses to the requests of registers 0x04 (cell voltages) and 0x03 (pack values)."""
ADVERTISE_S = 0.02
"""Interval of the advertisements [s]."""
PACKET_BYTES = 20
"""Maximum size of a notification [bytes], which is the MTU without the 3 bytes of its header."""


def uuid(short: str) -> str:
    """Return the full UUID of a 16-bit UUID."""
    return f"0000{short}-0000-1000-8000-00805f9b34fb"


def variants(**values: Any) -> dict[str, Variant]:
    """Return D-Bus values with the types of the Python values."""
    signatures = {str: "s", bool: "b", int: "n", list: "as", bytes: "ay"}
    return {name: Variant(signatures[type(value)], value) for name, value in values.items()}


class BlueZ:
    """Service ``org.bluez`` on a bus.

    Attributes:
        in_range: True: the BMS advertises and accepts connections.
        requests: Bytes that were written to the BMS.
    """

    def __init__(self, bus: MessageBus) -> None:
        self._bus = bus
        self.in_range, self._discovering = True, False
        self.requests: list[bytes] = []
        bus.add_message_handler(self._handle)

    def objects(self) -> dict[str, dict[str, dict[str, Variant]]]:
        """Return the properties of each interface of each object, by object path and interface."""
        device = variants(Address=ADDRESS, Alias=NAME, Name=NAME, UUIDs=[uuid("ff00")], Connected=False)
        device |= variants(Paired=False, Trusted=False, ServicesResolved=False, AddressType="public")
        service = {
            "Device": Variant("o", DEVICE_PATH),
            "UUID": Variant("s", uuid("ff00")),
            "Primary": Variant("b", True),
        }
        characteristics = {
            path: {
                "org.bluez.GattCharacteristic1": {
                    "Service": Variant("o", SERVICE_PATH),
                    "MTU": Variant("q", PACKET_BYTES + 3),
                    **variants(UUID=uuid(short), Flags=flags, Value=b""),
                }
            }
            for path, short, flags in (
                (NOTIFY_PATH, "ff01", ["read", "notify"]),
                (WRITE_PATH, "ff02", ["write", "write-without-response"]),
            )
        }
        adapter = variants(Address="00:00:00:00:00:01", Name="hci0", Powered=True, Roles=["central"])
        return {
            ADAPTER_PATH: {"org.bluez.Adapter1": adapter},
            DEVICE_PATH: {"org.bluez.Device1": {**device, "Adapter": Variant("o", ADAPTER_PATH)}},
            SERVICE_PATH: {"org.bluez.GattService1": service},
            **characteristics,
        }

    def send_properties(self, path: str, interface: str, **values: Any) -> None:
        """Signal changed properties of an object."""
        body = [interface, variants(**values), []]
        self._bus.send(
            Message.new_signal(path, "org.freedesktop.DBus.Properties", "PropertiesChanged", "sa{sv}as", body)
        )

    def _advertise(self) -> None:
        """Advertise the BMS periodically during a discovery."""
        if self._discovering:
            if self.in_range:
                self.send_properties(DEVICE_PATH, "org.bluez.Device1", RSSI=-50)
            asyncio.get_running_loop().call_later(ADVERTISE_S, self._advertise)

    def leave(self) -> None:
        """Move the BMS out of range."""
        self.in_range = False
        self.send_properties(DEVICE_PATH, "org.bluez.Device1", Connected=False, ServicesResolved=False)

    def _handle(self, message: Message) -> Message | None:
        """Return the response to a method call; its effects follow in the next cycle of the event loop."""
        if message.message_type != MessageType.METHOD_CALL or not (message.path or "").startswith(("/org/bluez", "/")):
            return None
        if message.member == "GetManagedObjects":
            return Message.new_method_return(message, "a{oa{sa{sv}}}", [self.objects()])
        if message.member == "Connect" and not self.in_range:
            return Message.new_error(message, "org.bluez.Error.Failed", "le-connection-abort-by-peer")
        asyncio.get_running_loop().call_soon(self._execute, message)
        return Message.new_method_return(message)

    def _execute(self, message: Message) -> None:
        """Change the properties as BlueZ does after a method call."""
        if message.member == "StartDiscovery":
            self._discovering = True
            self.send_properties(ADAPTER_PATH, "org.bluez.Adapter1", Discovering=True)
            self._advertise()
        elif message.member == "StopDiscovery":
            self._discovering = False
            self.send_properties(ADAPTER_PATH, "org.bluez.Adapter1", Discovering=False)
        elif message.member in ("Connect", "Disconnect"):
            connected = message.member == "Connect"
            self.send_properties(DEVICE_PATH, "org.bluez.Device1", Connected=connected, ServicesResolved=connected)
        elif message.member == "WriteValue":
            self.requests.append(bytes(message.body[0]))
            register = self.requests[-1][2]
            answer = {0x03: BASIC, 0x04: CELLS}.get(register, b"")
            for start in range(0, len(answer), PACKET_BYTES):
                packet = answer[start : start + PACKET_BYTES]
                self.send_properties(NOTIFY_PATH, "org.bluez.GattCharacteristic1", Value=packet)


@asynccontextmanager
async def system_bus(folder: Path) -> AsyncIterator[MessageBus]:
    """Start a private D-Bus. ``DBUS_SYSTEM_BUS_ADDRESS`` makes it the system bus of this process."""
    program = shutil.which("dbus-daemon")
    assert program is not None
    process = await asyncio.create_subprocess_exec(
        *(program, "--session", "--nofork", "--print-address", f"--address=unix:path={folder / 'bus'}"),
        stdout=asyncio.subprocess.PIPE,
    )
    assert process.stdout is not None
    before = os.environ.get("DBUS_SYSTEM_BUS_ADDRESS")
    os.environ["DBUS_SYSTEM_BUS_ADDRESS"] = (await process.stdout.readline()).decode().strip()
    try:
        bus = await MessageBus(bus_address=os.environ["DBUS_SYSTEM_BUS_ADDRESS"]).connect()
        yield bus
        bus.disconnect()
    finally:
        if before is None:
            del os.environ["DBUS_SYSTEM_BUS_ADDRESS"]
        else:
            os.environ["DBUS_SYSTEM_BUS_ADDRESS"] = before
        process.kill()
        await process.wait()
