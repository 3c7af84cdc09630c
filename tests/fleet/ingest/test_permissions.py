"""Batches over MQTT and NATS on a server with tenants: the credentials of sender and ``fleet ingest`` suffice, and permit no more."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

from bms_estimator.edge.block import decode
from bms_estimator.fleet.server.jwt_claims import Role
from tests.fleet.ingest.platform import arrow_batch, json_batch, running_ingest, samples_of
from tests.fleet.tenant import Tenant, mqtt_client, one_tenant
from tests.fleet.workers import load_packs, until
from tests.patience import LONG_S

PARTITIONS = 2


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tenant]:
    with one_tenant(tmp_path_factory.mktemp("tenant")) as tenant:
        asyncio.run(tenant.make_streams(PARTITIONS, 1 << 30))
        yield tenant


async def test_batches_over_mqtt_and_nats_become_blocks(fleet: Tenant, tmp_path: Path) -> None:
    admin, sender = await fleet.program(Role.ADMIN), await fleet.program(Role.SENDER)
    await load_packs(admin, ["p1", "p2"])
    blocks = await admin.subscribe("raw.*")
    rows = samples_of("p1", 12)
    violations = fleet.cluster.log(0).read_text().count("Violation")
    async with (
        running_ingest(tmp_path, fleet.cluster.url, "--creds", fleet.file(Role.INGEST)) as ingest,
        mqtt_client(fleet.cluster.mqtt_port, fleet.file(Role.MQTT_SENDER).read_text()) as mqtt,
    ):
        await ingest.logged("ingested")
        await mqtt.subscribe("ingest/p1", qos=1)
        await mqtt.publish("telemetry/p1", json_batch(rows[:6]), qos=1)
        await sender.jetstream().publish("telemetry.p2", arrow_batch(rows[:6]))
        await mqtt.publish("telemetry/p1", b"{]", qos=1)
        report = await anext(mqtt.messages)
        await mqtt.publish("telemetry/p1", arrow_batch(rows[6:]), qos=1)
        await sender.jetstream().publish("telemetry.p2", json_batch(rows[6:]))
        received = {
            message.subject: decode(message.data) for message in [await blocks.next_msg(LONG_S) for _ in range(2)]
        }
        assert await ingest.end() == 0
    assert b"neither JSON nor Arrow IPC" in bytes(report.payload)
    assert set(received) == {"raw.p1", "raw.p2"}
    for block in received.values():
        assert block.samples["voltage_v"].tolist() == rows["voltage_v"][:6].tolist()
    assert fleet.cluster.log(0).read_text().count("Violation") == violations
    await admin.close()
    await sender.close()


@pytest.mark.parametrize(
    ("role", "rejected_subjects"),
    [
        (Role.SENDER, ("raw.p1", "dead.p1.1", "edge.p1.awaits", "$KV.packs.p1", "$JS.API.STREAM.PURGE.TELEMETRY")),
        (
            Role.INGEST,
            ("telemetry.p1", "bms.p1.state", "$KV.packs.p1", "$JS.API.STREAM.PURGE.RAW", "$JS.API.STREAM.DELETE.RAW"),
        ),
    ],
)
async def test_credentials_permit_nothing_else(fleet: Tenant, role: Role, rejected_subjects: tuple[str, ...]) -> None:
    nc, rejections = await fleet.program(role), list[str]()

    async def on_error(error: Exception) -> None:
        rejections.append(str(error))

    nc._error_cb = on_error
    for subject in rejected_subjects:
        await nc.publish(subject, b"evil")
    await nc.flush()
    await until(lambda: len(rejections) == len(rejected_subjects), lambda: rejections)
    await nc.close()
