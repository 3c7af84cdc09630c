"""A broker that requires a client certificate, and errors of unusable certificates."""

import shutil
import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiomqtt
import pytest
import structlog

from bms_estimator.model.errors import TemporaryError, UserError
from bms_estimator.mqtt.connection import DeliveryStats, check, tls_context
from bms_estimator.settings.connections import MqttSettings
from bms_estimator.sinks.mqtt.requests import RequestDispatcher
from bms_estimator.sinks.mqtt.sink import MqttSink
from bms_estimator.store.outbox import Outbox
from tests.mosquitto import Broker, Listener
from tests.mqtt.certificates import Authority, openssl
from tests.patience import until
from tests.sinks.sink_helpers import STATE_TOPIC
from tests.sinks.snapshots import CELL_SNAPSHOT


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with certificates of an authority, a server and a pack, and of a client of another authority."""
    folder = tmp_path_factory.mktemp("certificates")
    authority = Authority(folder)
    authority.sign("server")
    authority.sign("pack")
    Authority(folder, "other-ca").sign("foreign")
    return folder


@pytest.fixture
def strict_broker(folder: Path, tmp_path: Path) -> Iterator[Broker]:
    """Start a broker that requires client certificates, and takes the user name from the certificate."""
    with Broker(
        tmp_path,
        f"cafile {folder / 'ca.crt'}\ncertfile {folder / 'server.crt'}\nkeyfile {folder / 'server.key'}\n"
        "require_certificate true\nuse_identity_as_username true",
    ) as broker:
        yield broker


def settings(broker: Broker, folder: Path, name: str | None) -> MqttSettings:
    """Return the settings of a client with the certificate ``name``; None: without a certificate."""
    client_files = {"cert_file": folder / f"{name}.crt", "key_file": folder / f"{name}.key"} if name else {}
    return MqttSettings(url=f"mqtts://127.0.0.1:{broker.port}", ca_file=folder / "ca.crt", **client_files)


def sink(settings: MqttSettings) -> MqttSink:
    delivery = DeliveryStats()
    return MqttSink(
        settings, "pack", RequestDispatcher(delivery), delivery, Outbox(None, max_messages=4), first_delay_s=0.1
    )


async def test_client_certificate_is_accepted(strict_broker: Broker, folder: Path) -> None:
    tls = aiomqtt.TLSParameters(*(str(folder / name) for name in ("ca.crt", "pack.crt", "pack.key")))
    async with (
        Listener(strict_broker, tls_params=tls) as live,
        sink(settings(strict_broker, folder, "pack")) as mqtt,
    ):
        mqtt.publish(CELL_SNAPSHOT)
        await live.wait(STATE_TOPIC)


@pytest.mark.parametrize(("name", "reason"), [(None, "certificate required"), ("foreign", "unknown ca")])
async def test_rejected_certificate_is_logged_with_the_reason(
    strict_broker: Broker, folder: Path, name: str | None, reason: str
) -> None:
    with structlog.testing.capture_logs() as logs:
        async with sink(settings(strict_broker, folder, name)):
            # a broker that closes before CONNECT is written gives no reason; a later attempt receives one
            await until(lambda: [line for line in logs if reason in line.get("reason", "")])
    assert {line["event"] for line in logs} == {"broker not reachable"}


async def test_replaced_certificate_is_used_without_restart(
    strict_broker: Broker, folder: Path, tmp_path: Path
) -> None:
    pack_folder = tmp_path / "pack"
    pack_folder.mkdir()
    for suffix in ("crt", "key"):
        shutil.copy(folder / f"foreign.{suffix}", pack_folder / f"pack.{suffix}")
    shutil.copy(folder / "ca.crt", pack_folder)
    with structlog.testing.capture_logs() as logs:
        async with sink(settings(strict_broker, pack_folder, "pack")):
            await until(lambda: [line for line in logs if line["event"] == "broker not reachable"])
            for suffix in ("crt", "key"):
                shutil.copy(folder / f"pack.{suffix}", pack_folder / f"pack.{suffix}")
            await until(lambda: [line for line in logs if line["event"] == "broker connected"])


def test_tls_below_version_1_2_is_not_offered(folder: Path) -> None:
    assert tls_context(MqttSettings(url="mqtts://host")).minimum_version is ssl.TLSVersion.TLSv1_2


def test_key_readable_by_every_user_causes_a_warning(folder: Path, tmp_path: Path) -> None:
    key = tmp_path / "open.key"
    shutil.copy(folder / "pack.key", key)
    configured = MqttSettings(url="mqtts://host", cert_file=folder / "pack.crt", key_file=key)
    assert check(configured) == []
    key.chmod(0o644)
    [warning] = check(configured)
    assert f"mqtt.key_file = {key}: every user" in warning


def test_relative_paths_are_found_in_the_credentials_directory_of_systemd(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(folder))
    assert check(MqttSettings(url="mqtts://host", cert_file=Path("pack.crt"), key_file=Path("pack.key"))) == []


@pytest.mark.parametrize(
    ("changes", "kind", "error"),
    [
        ({"key_file": "foreign.key"}, TemporaryError, r"mqtt\.key_file = .*foreign\.key: is not the key of mqtt\.cert_file = .*pack\.crt$"),
        ({"cert_file": "none.crt"}, TemporaryError, r"mqtt\.cert_file = .*none\.crt: cannot be read: No such file or directory$"),
        ({"key_file": "none.key"}, TemporaryError, r"mqtt\.key_file = .*none\.key: cannot be read: No such file or directory$"),
        ({"cert_file": "pack.key"}, TemporaryError, r"mqtt\.cert_file = .*pack\.key.*: must be a PEM certificate and its key"),
        ({"key_file": "pack.crt"}, TemporaryError, r"mqtt\.key_file = .*pack\.crt: must be a PEM certificate and its key"),
        ({"ca_file": "empty.crt"}, TemporaryError, r"mqtt\.ca_file = .*empty\.crt: no certificates can be read"),
        ({"key_file": "locked.key"}, UserError, r"mqtt\.key_file.*encrypted"),
        ({"cert_file": None}, UserError, r"mqtt\.key_file = .*: of no use without mqtt\.cert_file$"),
        ({"url": "mqtt://host"}, UserError, r"mqtt\.cert_file = .*: of no use without TLS: mqtt\.url must be mqtts://"),
    ],
)  # fmt: skip
def test_error_names_the_unusable_certificate(
    folder: Path, changes: dict[str, Any], kind: type[UserError], error: str
) -> None:
    openssl("ec", "-in", folder / "pack.key", "-aes128", "-passout", "pass:word", "-out", folder / "locked.key")
    (folder / "empty.crt").touch()
    values = {"url": "mqtts://host", "cert_file": "pack.crt", "key_file": "pack.key"} | changes
    files = {key: folder / str(name) for key, name in values.items() if key != "url" and name is not None}
    with pytest.raises(UserError, match=error) as raised:
        check(MqttSettings(url=values["url"], **files))
    assert type(raised.value) is kind
