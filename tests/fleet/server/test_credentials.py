"""Permissions on the real server: what edges, workers, readers and dashboards of two tenants may do."""

import asyncio
import base64
import json
import os
import signal
import stat
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import aiomqtt
import nats
import numpy as np
import pytest
from nats.aio.client import Client
from nats.errors import Error as NatsError

from bms_estimator.edge import subjects
from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointPointer
from bms_estimator.fleet.nats.dead_letters import DeadLetter
from bms_estimator.fleet.nats.dead_packs import DeadPackReader
from bms_estimator.fleet.nats.streams import consumer, make_streams
from bms_estimator.fleet.packs.pack_bucket import put_new
from bms_estimator.fleet.server import credentials
from bms_estimator.fleet.server.jwt_claims import Role
from bms_estimator.fleet.server.nats_config import Accounts, configuration
from bms_estimator.fleet.worker.worker import Options, work
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.errors import UserError
from bms_estimator.settings.fleet import TenantSettings
from tests.command_line import run
from tests.fleet.nats_cluster import NatsCluster, running
from tests.patience import LONG_S

NOW = datetime.now(UTC) - timedelta(minutes=1)
TENANTS = {"acme": TenantSettings(), "other": TenantSettings()}


@dataclass
class Fleet:
    """Server with two tenants that have streams."""

    cluster: NatsCluster
    keys: Path

    def token(self, pack: str, tenant: str = "acme", issued: datetime = NOW, expires: datetime | None = None) -> str:
        """Return the token of an edge."""
        return credentials.edge_tokens(self.keys, tenant, [pack], issued, expires)[pack]

    def edge(self, token: str, **options: object) -> aiomqtt.Client:
        """Return an MQTT client that authenticates with a token."""
        port = self.cluster.mqtt_port
        return aiomqtt.Client("127.0.0.1", port, username="any", password=token, timeout=LONG_S, **options)  # type: ignore[arg-type]

    @asynccontextmanager
    async def program(self, role: Role, tenant: str = "acme") -> AsyncIterator[tuple[Client, list[str]]]:
        """Connect with the credentials of a program. Yield the connection and the list of the server's rejections."""
        rejections: list[str] = []

        async def on_error(error: Exception) -> None:
            rejections.append(str(error))

        file = credentials.credentials_file(self.keys, tenant, role)
        nc = await nats.connect(
            self.cluster.url, user_credentials=file, error_cb=on_error, allow_reconnect=False, connect_timeout=LONG_S
        )
        try:
            yield nc, rejections
        finally:
            await nc.close()

    def reload(self, accounts: Accounts) -> None:
        """Reload the server with other claims."""
        self.cluster.accounts_changed(accounts)
        self.cluster.conf(0).write_text(configuration(self.cluster.nodes[0]))
        os.kill(self.cluster.pid(0), signal.SIGHUP)

    async def stored(self, tenant: str = "acme") -> list[tuple[str, bytes]]:
        """Return pack and data of each block in the stream of a tenant."""
        async with self.program(Role.READER, tenant) as (nc, _):
            js = nc.jetstream(timeout=LONG_S)
            last = (await js.stream_info(subjects.RAW_STREAM)).state.last_seq
            messages = [await js.get_msg(subjects.RAW_STREAM, seq) for seq in range(1, last + 1)]
            return [((message.subject or "").rpartition(".")[2], message.data or b"") for message in messages]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    folder = tmp_path_factory.mktemp("fleet")
    keys = folder / "keys"
    accounts = credentials.make_accounts(keys, TENANTS, NOW)
    with running(folder, accounts=accounts) as cluster:
        started = Fleet(cluster, keys)
        asyncio.run(_make_streams(started))
        yield started


async def _make_streams(fleet: Fleet) -> None:
    for tenant in TENANTS:
        async with fleet.program(Role.ADMIN, tenant) as (nc, rejections):
            await make_streams(nc, partitions=4, raw_bytes=1 << 30)
            assert rejections == []


async def is_accepted(client: aiomqtt.Client) -> bool:
    """Return True if the server accepts the connection."""
    try:
        async with client:
            return True
    except aiomqtt.MqttError:
        return False


async def connect_with(url: str, token: str) -> None:
    """Connect over the NATS protocol, which programs use, with the token of an edge."""
    nc = Client()
    try:
        await nc.connect(
            url,
            user_jwt_cb=token.encode,
            signature_cb=lambda _: b"",
            allow_reconnect=False,
            connect_timeout=LONG_S,
        )
    finally:
        if nc._transport:
            nc._transport.close()
        await nc.close()


async def is_disconnected(client: aiomqtt.Client, act: Callable[[], None]) -> bool:
    """Return True if the server ends the connection after ``act``."""
    try:
        async with asyncio.timeout(LONG_S), client:
            act()
            await anext(client.messages)
    except aiomqtt.MqttError:
        return True
    return False


async def assert_rejected(nc: Client, rejections: list[str], *publications: str) -> None:
    """Publish to forbidden subjects, and check that the server rejects each."""
    for subject in publications:
        await nc.publish(subject, b"evil")
    async with asyncio.timeout(LONG_S):
        while len(rejections) < len(publications):
            await nc.flush()
    await nc.flush()  # further rejections would have arrived with its response
    assert len(rejections) == len(publications), rejections


FORBIDDEN_TOPICS = (
    "raw/p2",
    "raw/p1/x",
    "p/1/raw/p2",
    *(f"p/{partition}/raw/p1" for partition in range(4)),
    "edge/p1/awaits",
    "edge/p2/awaits",
    "bms/p1/state",
    "hours/p1",
    "$MQTT/msgs/edge/p2/awaits",
    "$MQTT/rmsgs/edge/p2/awaits",
    "$JS/API/STREAM/DELETE/RAW",
    "$KV/packs/p1",
)
FORBIDDEN_FILTERS = (
    "edge/p2/awaits",
    "raw/#",
    "bms/#",
    "fleet/#",
    "#",
    "+/#",
    "$MQTT/sub/#",
    "$MQTT/msgs/#",
    "$JS/#",
    "$KV/#",
)


async def test_edge_publishes_its_own_subject_and_receives_replies(fleet: Fleet) -> None:
    async with fleet.program(Role.ADMIN) as (admin, _), fleet.edge(fleet.token("p1"), identifier="one") as edge:
        all_messages = await admin.subscribe(">")
        await admin.flush()
        for topic in FORBIDDEN_FILTERS:
            assert [code.value >= 0x80 for code in await edge.subscribe(topic, qos=1)] == [True], topic
        assert [code.value for code in await edge.subscribe("edge/p1/awaits", qos=1)] == [1]
        await edge.publish("raw/p1", b"first", qos=1)
        for topic in FORBIDDEN_TOPICS:
            await edge.publish(topic, b"evil", qos=1)  # acknowledged, and dropped
        await edge.publish("raw/p1", b"last", qos=1)
        received = []
        while not received or received[-1][1] != b"last":
            message = await all_messages.next_msg(LONG_S)
            received.append((message.subject, message.data))
        assert [pair for pair in received if b"evil" in pair[1]] == []
        await admin.publish(subjects.block_request("p1"), b"yours")
        async with asyncio.timeout(LONG_S):
            message = await anext(edge.messages)
        assert (message.topic.value, message.payload) == ("edge/p1/awaits", b"yours")
    assert await fleet.stored() == [("p1", b"first"), ("p1", b"last")]


async def test_will_on_a_forbidden_topic_is_dropped(fleet: Fleet) -> None:
    blocks_before = await fleet.stored()
    will = aiomqtt.Will("raw/p2", b"evil", qos=1)
    client = fleet.edge(fleet.token("p1"), will=will)
    if await is_accepted(client):  # the server may also reject the connection
        async with fleet.edge(fleet.token("p1"), will=will) as edge:
            edge._client._sock_close()  # without DISCONNECT, so that the server publishes the will
    async with fleet.edge(fleet.token("p3")) as edge:
        await edge.publish("raw/p3", b"later", qos=1)
    assert await fleet.stored() == [*blocks_before, ("p3", b"later")]


async def test_tenants_are_isolated(fleet: Fleet) -> None:
    async with fleet.program(Role.READER, "other") as (other, _), fleet.program(Role.WORKER) as (worker, _):
        estimates = await other.subscribe("bms.>")
        await other.flush()
        await worker.publish(subjects.published("p1", "state"), b"of acme")
        await worker.flush()
        async with fleet.program(Role.WORKER, "other") as (other_worker, _):
            await other_worker.publish(subjects.published("p1", "state"), b"of other")
        assert (await estimates.next_msg(LONG_S)).data == b"of other"
    async with fleet.edge(fleet.token("p1", "other")) as edge:
        await edge.publish("raw/p1", b"theirs", qos=1)
    assert await fleet.stored("other") == [("p1", b"theirs")]
    assert b"theirs" not in [data for _, data in await fleet.stored()]


async def test_worker_can_do_its_work_and_nothing_else(fleet: Fleet) -> None:
    async with fleet.edge(fleet.token("work")) as edge, fleet.program(Role.WORKER) as (nc, rejections):
        await edge.publish("raw/work", b"block", qos=1)
        js = nc.jetstream()
        states = await js.object_store(subjects.STATES_BUCKET)
        await states.put("p1.1", b"state")
        assert (await states.get("p1.1")).data == b"state"
        await states.delete("p1.1")
        checkpoints = await js.key_value(subjects.CHECKPOINTS_BUCKET)
        revision = await checkpoints.put("any", b"1")
        await checkpoints.update("any", b"2", revision)
        assert (await js.publish(subjects.hours("p1"), b"{}", headers={"Nats-Msg-Id": "p1.1"})).seq
        assert (await js.publish(subjects.table_change("p1"), b"BMSTnull")).seq
        assert (await js.publish(subjects.dead("p1", "1"), b"block")).seq
        await nc.publish(subjects.worker("w1"), b"{}")
        inbox = await nc.subscribe(nc.new_inbox())
        for partition in range(4):
            await nc.publish(
                f"$JS.API.CONSUMER.MSG.NEXT.RAW.{consumer(partition)}", b'{"batch":1,"group":"w"}', inbox.subject
            )
        assert (await inbox.next_msg(LONG_S)).subject.startswith("p.")
        packs = await (await js.key_value(subjects.PACKS_BUCKET)).watchall()
        assert await packs.updates(LONG_S) is None
        await put_new(nc, subjects.PACKS_BUCKET, {"lost": b"{}"})
        await put_new(nc, subjects.CELLS_BUCKET, {"lost": b""})
        assert rejections == []
        streams = ("$JS.API.STREAM.DELETE.RAW", "$JS.API.STREAM.PURGE.RAW", "$JS.API.STREAM.PURGE.KV_packs")
        await assert_rejected(nc, rejections, "raw.p1", "p.1.raw.p1", *streams)


def test_real_worker_needs_no_further_permissions(
    fleet: Fleet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "packs.csv").write_text("pack,cell\nreal,ncr18650\n")
    server = ("--server", fleet.cluster.url, "--creds", credentials.credentials_file(fleet.keys, "acme", Role.ADMIN))
    assert run(capsys, "fleet", "packs", "load", tmp_path / "packs.csv", *server)[::2] == (0, "")
    violations_before = fleet.cluster.log(0).read_text().count("Violation")
    asyncio.run(_run_worker(fleet))
    reader, worker = (credentials.credentials_file(fleet.keys, "acme", role) for role in (Role.READER, Role.WORKER))
    address = ("--server", fleet.cluster.url, "--creds")
    code, out, err = run(capsys, "fleet", "checkpoints", "list", *address, reader)
    assert (code, err) == (0, "")
    day = out.splitlines()[3].split()[0]
    assert run(capsys, "fleet", "checkpoints", "restore", "--day", day, *address, worker)[::2] == (0, "")
    assert fleet.cluster.log(0).read_text().count("Violation") == violations_before


async def _run_worker(fleet: Fleet) -> None:
    """Run a worker that processes a block, publishes a state and a reply, and writes a checkpoint."""
    samples = np.zeros(60, dtype=SAMPLE)
    samples["time_s"], samples["voltage_v"], samples["temperature_c"] = np.arange(60), 3.9, 25.0
    block = encode(Block(store_created_ns=1, number=1, oldest=1, arrival_s=60.0, samples=samples))
    stop = asyncio.Event()
    file = credentials.credentials_file(fleet.keys, "acme", Role.WORKER)
    working = asyncio.create_task(work(Options(fleet.cluster.url, "one", file), stop))
    async with (
        asyncio.timeout(LONG_S),
        fleet.program(Role.READER) as (reader, _),
        fleet.edge(fleet.token("real")) as edge,
    ):
        states = await reader.subscribe(subjects.published("real", "state"))
        await reader.flush()
        await edge.subscribe("edge/real/awaits")
        await edge.publish("raw/real", block, qos=1)
        assert b"soc" in (await states.next_msg(LONG_S)).data
        awaited = subjects.BlockRequest.model_validate_json(str((await anext(edge.messages)).payload, "utf-8"))
        assert (awaited.store, awaited.number) == (1, 1)  # no checkpoint includes block 1 yet
        stop.set()
        await working
        checkpoints = await reader.jetstream().key_value(subjects.CHECKPOINTS_BUCKET)
        pointers = [await checkpoints.get(key) for key in await checkpoints.keys() if key != "any"]  # of another test
        assert any(CheckpointPointer.model_validate_json(pointer.value or b"").kept for pointer in pointers)


async def test_reader_reads_everything_and_cannot_write(fleet: Fleet) -> None:
    letter = DeadLetter("p1", 1, "damaged", "w", b"block")
    async with fleet.program(Role.WORKER) as (worker, _), fleet.program(Role.READER) as (nc, rejections):
        await worker.jetstream().publish(letter.subject, letter.data, headers=letter.headers())
        assert ("p1", "damaged") in (await DeadPackReader(nc).read()).reasons
        js = nc.jetstream()
        assert (await js.stream_info(subjects.RAW_STREAM)).config.name == subjects.RAW_STREAM
        hours = await js.pull_subscribe(subjects.hours(), "collector", stream=subjects.HOURS_STREAM)
        assert (await hours.consumer_info()).name == "collector"
        live = await nc.subscribe(subjects.hours())  # as the fleet page does
        await js.stream_info(subjects.RAW_STREAM)  # sent after the subscription, unlike the ping of a flush
        await worker.publish(subjects.hours("p1"), b"row")
        assert (await live.next_msg(LONG_S)).data == b"row"
        assert rejections == []
        consumers = ("$JS.API.CONSUMER.DELETE.RAW.p1", "$JS.API.CONSUMER.MSG.NEXT.RAW.p1")
        await assert_rejected(
            nc, rejections, "raw.p1", "bms.p1.state", "edge.p1.awaits", "$KV.checkpoints.p1", *consumers
        )


async def test_dashboard_reads_estimates_over_mqtt(fleet: Fleet) -> None:
    token = credentials.credentials_file(fleet.keys, "acme", Role.DASHBOARD).read_text()
    async with fleet.edge(token) as dashboard, fleet.program(Role.WORKER) as (worker, _):
        assert [code.value for code in await dashboard.subscribe("bms/#", qos=1)] == [1]
        assert [code.value >= 0x80 for code in await dashboard.subscribe("raw/#", qos=1)] == [True]
        await dashboard.publish("bms/p1/state", b"evil", qos=1)
        await worker.publish(subjects.published("p1", "state"), b"true")
        async with asyncio.timeout(LONG_S):
            assert (await anext(dashboard.messages)).payload == b"true"


async def test_invalid_tokens_are_rejected(fleet: Fleet, tmp_path: Path) -> None:
    credentials.make_accounts(tmp_path, TENANTS, NOW)
    day, valid_token = timedelta(days=1), fleet.token("p1")
    head, _, signature = valid_token.split(".")
    worker_token = credentials.credentials_file(fleet.keys, "acme", Role.WORKER).read_text().splitlines()[1]
    tokens = {
        "none": "",
        "expired": fleet.token("p1", issued=NOW - 2 * day, expires=NOW - day),
        "signed by another operator": credentials.edge_tokens(tmp_path, "acme", ["p1"], NOW)["p1"],
        "claims of another pack": f"{head}.{fleet.token('p2').split('.')[1]}.{signature}",
        "a worker's": worker_token,
    }
    assert {name: await is_accepted(fleet.edge(token)) for name, token in tokens.items()} == dict.fromkeys(
        tokens, False
    )
    assert await is_accepted(fleet.edge(fleet.token("p1", expires=datetime.now(UTC) + day)))
    with pytest.raises(NatsError, match="Authorization"):
        await connect_with(fleet.cluster.url, valid_token)


async def test_revoked_edge_is_disconnected_and_connects_with_a_new_token(fleet: Fleet) -> None:
    stolen_token, other_token = fleet.token("stolen"), fleet.token("p1")
    changed_tenants = TENANTS | {
        "acme": TenantSettings(revoked={"stolen": NOW + timedelta(seconds=1)}),
        "new": TenantSettings(),
    }
    accounts = credentials.make_accounts(fleet.keys, changed_tenants, NOW)
    assert await is_disconnected(fleet.edge(stolen_token), lambda: fleet.reload(accounts))
    assert not await is_accepted(fleet.edge(stolen_token))
    assert await is_accepted(fleet.edge(fleet.token("stolen", issued=NOW + timedelta(seconds=2))))
    assert await is_accepted(fleet.edge(other_token))
    assert await is_accepted(fleet.edge(fleet.token("p1", "new")))


def test_private_keys_are_readable_by_their_owner_only_and_never_shown(fleet: Fleet) -> None:
    files = [path for path in fleet.keys.rglob("*") if path.is_file()]
    assert len(files) > 20
    assert {stat.S_IMODE(path.stat().st_mode) for path in files} == {0o600}
    assert {stat.S_IMODE(path.stat().st_mode) for path in fleet.keys.rglob("*") if path.is_dir()} == {0o700}
    seeds = [path.read_text() for path in files if path.suffix == ".nk"]
    public_text = (
        fleet.cluster.log(0).read_text() + fleet.cluster.conf(0).read_text() + (fleet.keys / "claims.json").read_text()
    )
    assert [seed for seed in seeds if seed in public_text] == []
    assert fleet.token("p1") not in public_text


def test_keys_are_created_once_and_claims_do_not_change(tmp_path: Path) -> None:
    first = credentials.make_accounts(tmp_path, TENANTS, NOW)
    files = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    assert credentials.make_accounts(tmp_path, TENANTS, NOW + timedelta(days=1)) == first
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == files
    assert credentials.read_accounts(tmp_path) == first


def test_errors_do_not_show_keys(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no keys of a tenant acme: start `fleet serve`"):
        credentials.edge_tokens(tmp_path, "acme", ["p1"], NOW)["p1"]
    with pytest.raises(UserError, match=r"claims\.json: cannot be read"):
        credentials.read_accounts(tmp_path)
    (tmp_path / "claims.json").write_text("{}")
    with pytest.raises(UserError, match="copy it from the node that has the keys"):
        credentials.read_accounts(tmp_path)
    credentials.make_accounts(tmp_path, TENANTS, NOW)
    with pytest.raises(UserError, match="there are acme, other"):
        credentials.edge_tokens(tmp_path, "nobody", ["p1"], NOW)["p1"]
    (tmp_path / "acme" / "edge.nk").write_text("SAADEFECT")
    with pytest.raises(UserError, match=r"edge\.nk: not a key") as raised:
        credentials.edge_tokens(tmp_path, "acme", ["p1"], NOW)["p1"]
    assert "DEFECT" not in str(raised.value)


def test_tokens_of_all_packs_of_a_table_are_written_for_their_owner_only(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    credentials.make_accounts(tmp_path / "keys", TENANTS, NOW)
    packs = [f"p{n}" for n in range(100)]
    (tmp_path / "packs.csv").write_text("pack,cell,capacity_ah,series\n" + "".join(f"{p},lfp,100,16\n" for p in packs))
    for out in ("tokens", "tokens.csv"):
        command = ("fleet", "users", "acme", tmp_path / "packs.csv", "--folder", tmp_path, "--out", tmp_path / out)
        assert run(capsys, *command) == (0, f"{tmp_path / out}: 100 tokens written; keep them secret\n", "")
    lines = (tmp_path / "tokens.csv").read_text().splitlines()
    assert (lines[0], [line.split(",")[0] for line in lines[1:]]) == ("pack,token", packs)
    files = [tmp_path / "tokens.csv", *(tmp_path / "tokens").iterdir()]
    assert len(files) == 101
    assert {stat.S_IMODE(path.stat().st_mode) for path in files} == {0o600}
    claims = (tmp_path / "tokens" / "p7.token").read_text().split(".")[1]
    assert json.loads(base64.urlsafe_b64decode(claims + "=" * (-len(claims) % 4)))["name"] == "p7"
