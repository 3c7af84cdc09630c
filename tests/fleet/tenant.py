"""Server with one tenant, and clients with the tenant's credentials."""

import contextlib
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import aiomqtt
import nats
import numpy as np
from nats.aio.client import Client

from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.server import credentials
from bms_estimator.fleet.server.jwt_claims import Role
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.settings.fleet import TenantSettings
from tests.fleet.nats_cluster import NatsCluster, running
from tests.patience import LONG_S

NAME = "acme"
"""Name of the tenant."""
NUMBER_OFFSET, NUMBER_BYTES = 16, 8
"""Offset and size of the number in an encoded block [bytes]."""


class Tenant:
    """Tenant with its server.

    Args:
        cluster: Running server.
        keys: Folder of the tenant's keys.
    """

    def __init__(self, cluster: NatsCluster, keys: Path) -> None:
        self.cluster, self._keys = cluster, keys

    def file(self, role: Role) -> Path:
        """Return the credentials file of a program."""
        return credentials.credentials_file(self._keys, NAME, role)

    async def program(self, role: Role) -> Client:
        """Return a connection with the permissions of a program."""
        return await nats.connect(self.cluster.url, user_credentials=self.file(role), connect_timeout=LONG_S)

    def token(self, pack: str) -> str:
        """Return the token of an edge."""
        return credentials.edge_tokens(self._keys, NAME, [pack], datetime.now(UTC) - timedelta(minutes=1))[pack]

    def edge(self, pack: str) -> aiomqtt.Client:
        """Return the MQTT client of an edge."""
        return mqtt_client(self.cluster.mqtt_port, self.token(pack))

    async def make_streams(self, partitions: int, raw_bytes: int) -> None:
        """Create the streams, or change the size limit of the stream of blocks, ``RAW``, to ``raw_bytes``."""
        nc = await self.program(Role.ADMIN)
        await make_streams(nc, partitions=partitions, raw_bytes=raw_bytes)
        await nc.close()


def mqtt_client(port: int, token: str) -> aiomqtt.Client:
    """Return an MQTT client that authenticates with a token."""
    return aiomqtt.Client("127.0.0.1", port, username="any", password=token, timeout=LONG_S)


@contextlib.contextmanager
def one_tenant(folder: Path) -> Iterator[Tenant]:
    """Run a server with one tenant and without streams."""
    keys = folder / "keys"
    accounts = credentials.make_accounts(keys, {NAME: TenantSettings()}, datetime.now(UTC))
    with running(folder, accounts=accounts) as cluster:
        yield Tenant(cluster, keys)


def heavy_block(samples: int, period_s: float, store: int = 1) -> bytes:
    """Return a block of many equal samples, which are compressed to few bytes. Its number is 1."""
    rows = np.zeros(samples, SAMPLE)
    rows["time_s"] = period_s * np.arange(samples)
    rows["voltage_v"], rows["temperature_c"] = 3.7, 25.0
    return encode(Block(store_created_ns=store, number=1, oldest=1, arrival_s=1.79e9, samples=rows))


def numbered(data: bytes, number: int) -> bytes:
    """Return a block with another number."""
    field = number.to_bytes(NUMBER_BYTES, "little")
    return data[:NUMBER_OFFSET] + field + data[NUMBER_OFFSET + NUMBER_BYTES :]
