"""Fixtures of Home Assistant, a broker and a service, shared by all tests of this folder."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.home_assistant.instance import ENVIRONMENT, MISSING, HomeAssistant
from tests.home_assistant.running_pack import RunningPack
from tests.mosquitto import Broker

DASHBOARD = Path(__file__).parents[2] / "deploy/home-assistant/dashboard.yaml"


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    """Start a broker, or skip the tests if Home Assistant is not installed."""
    if not (ENVIRONMENT / "ready").exists():
        pytest.skip(MISSING)
    with Broker(tmp_path_factory.mktemp("broker")) as broker:
        yield broker


@pytest.fixture(scope="module")
def pack(broker: Broker, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningPack]:
    pack = RunningPack(tmp_path_factory.mktemp("pack"), broker)
    yield pack
    pack.close()


@pytest.fixture(scope="module")
def home(pack: RunningPack, broker: Broker, tmp_path_factory: pytest.TempPathFactory) -> Iterator[HomeAssistant]:
    """Start Home Assistant and wait until it has all entities of the pack."""
    home = HomeAssistant(tmp_path_factory.mktemp("home"), DASHBOARD)
    try:
        home.start()
        home.add_mqtt(broker.port)
        home.until(lambda states: "sensor.bms_pack_cell_lowest" in states)
        home.until(lambda states: states["sensor.bms_pack_cell_lowest"]["state"] == "3")  # as printed by the board
        yield home
    finally:
        home.stop()
