"""A server with one tenant, and what connects to it with the tenant's credentials."""

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
from bms_estimator.model.sample import SAMPLE
from bms_estimator.settings.fleet import TenantSettings
from tests.fleet.engine import Engine, running
from tests.patience import LONG_S

NAME = "acme"


class Tenant:
    """The tenant and its server.

    Args:
        engine: One node, ready.
        keys: Folder of all keys.
    """

    def __init__(self, engine: Engine, keys: Path) -> None:
        self.engine, self._keys = engine, keys

    def file(self, role: Role) -> Path:
        """Return the credentials of a program."""
        return credentials.credentials_file(self._keys, NAME, role)

    async def program(self, role: Role) -> Client:
        """Connect a program."""
        return await nats.connect(self.engine.url, user_credentials=self.file(role), connect_timeout=LONG_S)

    def token(self, pack: str) -> str:
        """Return the token of an edge."""
        return credentials.edge_token(self._keys, NAME, pack, datetime.now(UTC) - timedelta(minutes=1))

    def edge(self, pack: str) -> aiomqtt.Client:
        """Return the connection of an edge."""
        return mqtt_client(self.engine.mqtt_port, self.token(pack))

    async def make_streams(self, partitions: int, raw_bytes: int) -> None:
        """Make the streams, or change the size of ``RAW``."""
        nc = await self.program(Role.ADMIN)
        await make_streams(nc, partitions=partitions, raw_bytes=raw_bytes)
        await nc.close()


def mqtt_client(port: int, token: str) -> aiomqtt.Client:
    """Return a connection with a token."""
    return aiomqtt.Client("127.0.0.1", port, username="any", password=token, timeout=LONG_S)


@contextlib.contextmanager
def one_tenant(folder: Path) -> Iterator[Tenant]:
    """Start the server; no stream is made."""
    keys = folder / "keys"
    accounts = credentials.make_accounts(keys, {NAME: TenantSettings()}, datetime.now(UTC))
    with running(folder, accounts=accounts) as engine:
        yield Tenant(engine, keys)


def heavy_block(samples: int, period_s: float, store: int = 1) -> bytes:
    """Return a block of a few kilobytes that holds many samples, number 1 of its store."""
    made = np.zeros(samples, SAMPLE)
    made["time_s"] = period_s * np.arange(samples)
    made["voltage_v"], made["temperature_c"] = 3.7, 25.0
    return encode(Block(store, 1, 1, 1.79e9, made))


def numbered(data: bytes, number: int) -> bytes:
    """Return a block under another number."""
    return data[:16] + number.to_bytes(8, "little") + data[24:]
