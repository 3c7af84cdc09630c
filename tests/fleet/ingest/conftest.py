"""Server with all streams."""

from collections.abc import AsyncIterator

import pytest
from nats.aio.client import Client

from bms_estimator.fleet.nats.streams import make_streams, make_telemetry_stream
from tests.fleet.ingest.worker_states import PARTITIONS
from tests.fleet.nats_cluster import NatsCluster, connected


@pytest.fixture(scope="module")
def partitions() -> int:
    return PARTITIONS


@pytest.fixture
async def nc(cluster: NatsCluster) -> AsyncIterator[Client]:
    """Yield a connection to the server, which has all streams."""
    nc = await connected(cluster.url)
    await make_streams(nc, partitions=PARTITIONS)
    await make_telemetry_stream(nc, 1 << 30)
    yield nc
    await nc.close()
