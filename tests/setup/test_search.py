"""Search of Modbus devices and brokers."""

import pytest

from bms_estimator.setup import search as search_module
from bms_estimator.setup.broker_login import BrokerLogin
from bms_estimator.setup.search import search
from tests.free_port import free_port
from tests.mosquitto import Broker
from tests.patience import LONG_S


async def test_a_modbus_device_is_found_by_the_registers_of_its_profile(monkeypatch) -> None:
    modbus = pytest.importorskip("tests.sources.fieldbus.modbus_device", reason="pymodbus is not installed")
    monkeypatch.setattr(search_module, "MODBUS_TIMEOUT_S", LONG_S)
    monkeypatch.setattr(search_module, "MODBUS_PROFILES", {"victron-gx": {}})
    registers, port = modbus.Registers({259: 5234, 260: 1200, 261: 0x10000 - 123, 262: 215}), free_port()
    async with modbus.tcp_device(registers, 225, port):
        (device,) = (await search([f"127.0.0.1:{port}"])).devices
    assert (device.name, device.values) == (f"victron-gx:127.0.0.1:{port}", "52.34 V, 12.30 A, discharging")
    assert device.tables == {
        "source": {"kind": "modbus", "profile": "victron-gx", "host": "127.0.0.1", "tcp_port": port}
    }


async def test_a_broker_without_a_known_publisher_is_reported_and_offered_for_publishing(
    broker: Broker, monkeypatch
) -> None:
    monkeypatch.setattr(search_module, "LISTEN_DURATION_S", 0.5)
    result = await search([broker.url])
    assert result.devices == []
    assert result.failures == [f"{broker.url}: no message of a known publisher within 0.5 s"]
    assert result.broker == BrokerLogin(broker.url)


async def test_a_host_without_a_scheme_is_reported_with_the_form_of_a_broker(monkeypatch) -> None:
    monkeypatch.setattr(search_module, "MODBUS_PROFILES", {"victron-gx": {}})
    monkeypatch.setattr(search_module, "MODBUS_TIMEOUT_S", 0.1)
    *_, reason = (await search([f"127.0.0.1:{free_port()}"])).failures
    assert reason.endswith("; a broker is searched by mqtt://HOST:PORT")


async def test_each_invalid_place_is_reported_without_its_password_and_ends_no_other_search(tmp_path) -> None:
    addresses = ["ftp://x", "mqtt://user:secret@x", "mqtt://user:secret", "mqtt://x:0", "mqtt://x:70000", "mqtt://[::1"]
    hosts = ["gx:port", "gx:0", "gx:70000", "::1", "user:secret@gx", ""]
    missing = f"mqtt://127.0.0.1:{free_port()}"
    result = await search([*addresses, *hosts, str(tmp_path), missing])
    reasons = "\n".join(result.failures)
    assert (result.broker, len(result.failures)) == (None, len(addresses) + len(hosts) + 2), reasons
    assert "secret" not in reasons
    assert "Traceback" not in reasons
    assert f"{missing}: " in reasons
    assert "gx:0: must be a host, host:port or [IPv6 address]:port, with a port of 1 to 65535" in reasons


async def test_an_unexpected_exception_of_one_search_is_reported(monkeypatch, tmp_path) -> None:
    def fail(port: str) -> None:
        raise ArithmeticError(f"{port} has no number")

    monkeypatch.setattr(search_module, "probe", fail)
    result = await search(["/dev/a", str(tmp_path / "b")])
    assert [reason.partition(" cannot be searched: ")[2] for reason in result.failures] == [
        f"ArithmeticError: {port} has no number" for port in ("/dev/a", tmp_path / "b")
    ]
