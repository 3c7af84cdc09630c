"""Server with its streams, its checkpoints, and a clock of the checkpoints that a test can set."""

from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import nats
import pytest
from nats.aio.client import Client

from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.worker.checkpoint import checkpoint_store
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CheckpointStore, open_checkpoints
from tests.fleet.checkpoints import Clock
from tests.fleet.nats_cluster import NatsCluster, running
from tests.fleet.workers import Heartbeats


@pytest.fixture(scope="module")
def partitions() -> int:
    """Return the number of partitions of the server."""
    return 1


@pytest.fixture
def cluster(tmp_path: Path, partitions: int) -> Iterator[NatsCluster]:
    with running(tmp_path, partitions=partitions) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def module_cluster(tmp_path_factory: pytest.TempPathFactory, partitions: int) -> Iterator[NatsCluster]:
    """Yield a server that all tests of a module share."""
    with running(tmp_path_factory.mktemp("cluster"), partitions=partitions) as cluster:
        yield cluster


@pytest.fixture
async def nc(cluster: NatsCluster, partitions: int) -> AsyncIterator[Client]:
    async with await nats.connect(cluster.url) as nc:
        await make_streams(nc, partitions=partitions)
        yield nc


@pytest.fixture
async def heartbeats(nc: Client) -> AsyncIterator[Heartbeats]:
    async with Heartbeats(nc) as heartbeats:
        yield heartbeats


@pytest.fixture
async def store(nc: Client) -> CheckpointStore:
    return await open_checkpoints(nc, "w")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(checkpoint_store, "time", clock)
    return clock
