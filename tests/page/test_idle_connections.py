"""A thousand idle connections to each program with an HTTP page, while its broker or NATS server is restarted."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fleet.nats_cluster import NatsCluster, running
from tests.idle_connections import Outcome, attack_dashboard, attack_fleet_page, attack_service, few_descriptors
from tests.mosquitto import Broker

MAX_LOG_LINES = 100
"""Limit of the log lines of a program [lines]. A line for each idle connection would exceed it."""


@pytest.fixture(autouse=True)
def _few_descriptors() -> Iterator[None]:
    with few_descriptors():
        yield


@pytest.fixture
def nats(tmp_path: Path) -> Iterator[NatsCluster]:
    with running(tmp_path, partitions=1) as started:
        yield started


def assert_undisturbed(outcome: Outcome) -> None:
    """Assert that all requests were answered, without tracebacks and with a short log."""
    assert set(outcome.answers) == {200}
    assert outcome.tracebacks == 0
    assert outcome.log_lines < MAX_LOG_LINES


@pytest.mark.thorough
async def test_service_with_idle_connections_saves_checkpoints_and_reconnects_to_its_broker(
    tmp_path: Path, broker: Broker
) -> None:
    assert_undisturbed(await attack_service(tmp_path, broker))


@pytest.mark.thorough
async def test_dashboard_with_idle_connections_reconnects_to_its_broker(tmp_path: Path, broker: Broker) -> None:
    assert_undisturbed(await attack_dashboard(tmp_path, broker))


@pytest.mark.thorough
async def test_fleet_page_with_idle_connections_reconnects_to_its_server(tmp_path: Path, nats: NatsCluster) -> None:
    assert_undisturbed(await attack_fleet_page(tmp_path, nats))
