"""A thousand idle connections to each program with HTTP, while its broker or server is restarted."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fleet.nats_cluster import NatsCluster, running
from tests.idle_connections import Outcome, attack_dashboard, attack_fleet_page, attack_service, few_descriptors
from tests.mosquitto import Broker

MAX_LOG_LINES = 100


@pytest.fixture(autouse=True)
def _few_descriptors() -> Iterator[None]:
    with few_descriptors():
        yield


@pytest.fixture
def engine(tmp_path: Path) -> Iterator[NatsCluster]:
    with running(tmp_path, partitions=1) as started:
        yield started


def assert_unimpressed(outcome: Outcome) -> None:
    assert set(outcome.answers) == {200}
    assert outcome.tracebacks == 0
    assert outcome.log_lines < MAX_LOG_LINES


async def test_the_service_saves_checkpoints_and_finds_its_broker_again(tmp_path: Path, broker: Broker) -> None:
    assert_unimpressed(await attack_service(tmp_path, broker))


@pytest.mark.thorough
async def test_the_dashboard_finds_its_broker_again(tmp_path: Path, broker: Broker) -> None:
    assert_unimpressed(await attack_dashboard(tmp_path, broker))


@pytest.mark.thorough
async def test_the_page_of_a_fleet_finds_its_server_again(tmp_path: Path, engine: NatsCluster) -> None:
    assert_unimpressed(await attack_fleet_page(tmp_path, engine))
