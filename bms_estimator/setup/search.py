"""Search for devices: serial ports, MQTT publishers, Modbus, Bluetooth."""

import asyncio
import contextlib
import importlib.util
import secrets
from collections.abc import Sequence
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from bms_estimator.model.config_file import without_secrets
from bms_estimator.model.errors import UserError
from bms_estimator.mqtt.connection import BrokerConnectionError, ConnectOptions, LoginError, brokers, check
from bms_estimator.mqtt.reconnect_loop import BrokerConnector
from bms_estimator.settings.connections import MqttSettings
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.settings.sources.fieldbus import MODBUS_PROFILES
from bms_estimator.setup.broker_login import BrokerLogin
from bms_estimator.setup.found_device import NAME_SEPARATOR, FoundDevice, with_pairs
from bms_estimator.setup.measurement import measure
from bms_estimator.setup.mqtt_recognition import PublisherRecognition
from bms_estimator.sources.serial.device_detection import DetectedDevice, probe
from bms_estimator.sources.serial.port_list import board_ports

LISTEN_DURATION_S = 12.0
"""Time for which MQTT messages are received [s]. The publishers with default settings send at least every 10 s."""
MODBUS_TIMEOUT_S = 3.0
"""Time within which a Modbus device sends its first sample [s]. It answers a request within a second."""
MAX_WAITING = 10_000
"""Maximum number of received messages that wait to be read. A broker sends all retained messages at once."""
BROKER_HINT = "a broker is searched by mqtt://HOST:PORT"
"""Hint for a place without mqtt://, which is searched as a Modbus device."""
BLUETOOTH = "bluetooth"
"""Place that represents all Bluetooth devices nearby."""
MODBUS = "Modbus host"
"""Kind of place that represents a host name of a Modbus device."""
PLACES = ("serial port", "mqtt://host", MODBUS, BLUETOOTH)
"""Kinds of places to search."""
OPTIONAL_PACKAGES = {
    MODBUS: ("pymodbus", "pip install 'bms_estimator[modbus]'"),
    BLUETOOTH: ("aiobmsble", "pip install 'bms_estimator[ble]' (Python 3.12 or later)"),
}
"""Packages that some kinds of places need, and the commands that install them."""
DEFAULT_BROKER = str(MqttSettings.model_fields["url"].default)
"""URL of the broker that is searched by default."""


@dataclass
class SearchResult:
    """Found devices, and the reasons why other places have none."""

    devices: list[FoundDevice] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    """Places without a device, each with the reason."""
    broker: BrokerLogin | None = None
    """Broker that answered; None: no broker."""
    login_required: list[BrokerLogin] = field(default_factory=list)
    """Brokers that require another user name or password."""

    @property
    def choices(self) -> list[FoundDevice]:
        """Devices, and pairs of a battery monitor and a BMS, of which the user chooses one."""
        return with_pairs(self.devices)


def missing_packages() -> dict[str, str]:
    """Return the commands that install missing packages, by the kinds of places that cannot be searched without them."""
    return {
        kind: command
        for kind, (package, command) in OPTIONAL_PACKAGES.items()
        if importlib.util.find_spec(package) is None
    }


def default_places() -> list[str]:
    """Return the places that are searched by default: ports that may belong to a board or BMS, a local broker, Bluetooth.

    Bluetooth is not one of them if its package is missing.
    """
    return [*board_ports(), DEFAULT_BROKER, *([] if BLUETOOTH in missing_packages() else [BLUETOOTH])]


async def search(places: Sequence[str]) -> SearchResult:
    """Search all places at the same time.

    Args:
        places: Paths of serial ports, addresses of MQTT brokers with or without user name and password, ``BLUETOOTH``, and Modbus devices as ``host`` or ``host:port``.

    Returns:
        The devices. A place that cannot be searched is one of the failures, whatever exception its search raised.
    """
    result = SearchResult()
    await asyncio.gather(*(_search_or_report(place, result) for place in places))
    result.devices.sort(key=lambda device: device.broker is not None)  # serial devices first
    return result


async def _search_or_report(place: str, result: SearchResult) -> None:
    """Search a place, and add an exception to the failures."""
    try:
        await _search_place(place, result)
    except UserError as error:  # names the place
        result.failures.append(str(error))
    except Exception as error:  # noqa: BLE001 - one place must not end the search of the others
        result.failures.append(f"{without_secrets(place)}: cannot be searched: {type(error).__name__}: {error}")


async def _search_place(place: str, result: SearchResult) -> None:
    if place == BLUETOOTH:
        await _search_bluetooth(result)
    elif "://" in place:
        await _search_mqtt(place, result)
    elif "/" in place:
        await _search_serial_port(place, result)
    else:
        await _search_modbus_host(place, result)


async def _search_serial_port(port: str, result: SearchResult) -> None:
    """Identify the device on a serial port. A silent device is polled with each Modbus profile."""
    found = await asyncio.to_thread(probe, port)
    if isinstance(found, DetectedDevice):
        result.devices.append(serial_device(port, found))
        return
    result.failures.append(f"{port}: {found}")
    if found == "silent":
        await _search_modbus({"port": port}, port, result)


def serial_device(port: str, found: DetectedDevice) -> FoundDevice:
    """Return the device on a serial port with its settings."""
    sensor: dict[str, object] = {"port": port, "protocol": found.protocol}
    if found.baud != SensorSettings.model_validate(sensor).baud:
        sensor["baud"] = found.baud
    return FoundDevice(port, str(found), {"sensor": sensor}, found.cells)


async def _search_mqtt(address: str, result: SearchResult) -> None:
    """Listen to all messages of a broker, and find the publishers of known profiles.

    Raises:
        UserError: The URL cannot be used.
    """
    try:
        login = BrokerLogin.parse(address)
    except ValueError as error:
        raise UserError(f"{without_secrets(address)}: {error}") from None
    url, settings = login.url, MqttSettings.model_validate(login.temporary_settings)
    check(settings)
    recognition = PublisherRecognition()
    options = ConnectOptions(
        f"bms-search-{secrets.token_hex(4)}", will=None, on_message_lost=lambda *_: None, max_waiting=MAX_WAITING
    )
    try:
        async with BrokerConnector(settings)(brokers(settings)[0], options) as connection:
            result.broker = login
            if denied := await connection.subscribe(None, ["#"]):
                result.failures.append(f"{url}: not allowed to read #: {denied['#']}")
                return
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LISTEN_DURATION_S):
                    while True:
                        message = await connection.receive()
                        recognition.add_message(message.topic, message.payload, retained=message.retain)
    except LoginError:
        reason = "requires a user name and a password" if login.username is None else "user name or password wrong"
        result.failures.append(f"{url}: {reason}")
        result.login_required.append(login)
    except BrokerConnectionError as error:
        result.failures.append(f"{url}: {error}")
    else:
        found = recognition.devices(login)
        result.devices += found
        if not found:
            result.failures.append(f"{url}: no message of a known publisher within {LISTEN_DURATION_S:g} s")


async def _search_modbus_host(place: str, result: SearchResult) -> None:
    """Poll a Modbus TCP device or gateway, ``host``, ``host:port`` or ``[IPv6 address]:port``, with each profile.

    Raises:
        UserError: The place has another form.
    """
    try:
        url = urlsplit(f"//{place}")
        host, port = url.hostname, url.port
    except ValueError:  # an invalid port or IPv6 address
        host = port = None
    if not host or port == 0 or url.netloc != place or "@" in place:
        raise UserError(
            f"{without_secrets(place)}: must be a host, host:port or [IPv6 address]:port, with a port of 1 to 65535"
        )
    await _search_modbus({"host": host} | ({"tcp_port": port} if port else {}), place, result)


async def _search_modbus(address: dict[str, object], name: str, result: SearchResult) -> None:
    if command := missing_packages().get(MODBUS):
        if "host" in address:  # a serial port is reported already
            result.failures.append(f"{name}: Modbus was not searched: {command}; {BROKER_HINT}")
        return
    is_serial = "port" in address
    profiles = [name for name, table in MODBUS_PROFILES.items() if not is_serial or "baud" in table]
    reasons = list[str]()
    for profile in profiles:
        source = {"kind": "modbus", "profile": profile, **address}
        device = FoundDevice(
            f"{profile}{NAME_SEPARATOR}{name}", f"Modbus device {profile} at {name}", {"source": source}
        )
        try:
            values = await measure(device.settings, MODBUS_TIMEOUT_S)
        except UserError as error:
            reasons.append(f"{name}: {profile}: {error}")
        else:
            result.devices.append(
                FoundDevice(
                    device.name, device.description, device.tables, voltage_v=values.voltage_v, values=str(values)
                )
            )
    if not is_serial:
        result.failures += reasons
        if len(reasons) == len(profiles):
            result.failures.append(f"{name}: no Modbus device; {BROKER_HINT}")


async def _search_bluetooth(result: SearchResult) -> None:
    """Find BMS by their Bluetooth advertisements, if the optional package is installed."""
    if command := missing_packages().get(BLUETOOTH):
        result.failures.append(f"Bluetooth: not searched: {command}")
        return
    from bms_estimator.sources.bluetooth.client import discover  # noqa: PLC0415 - needs an optional package

    try:
        found = await discover()
    except UserError as error:
        result.failures.append(f"Bluetooth: {error}")
        return
    result.devices += [
        FoundDevice(
            bms.address, f"Bluetooth BMS {bms.name}, {bms.kind}", {"source": {"kind": "ble", "address": bms.address}}
        )
        for bms in found
    ]
    if not found:
        result.failures.append("Bluetooth: no BMS advertises")
