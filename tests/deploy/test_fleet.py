"""Units of the fleet, checked by systemd, and generated configurations of three nodes."""

import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from bms_estimator.cli.fleet.serve import _nodes
from bms_estimator.fleet.server.nats_config import Accounts, configuration
from bms_estimator.fleet.server.node_spec import NodeLocation, ServerSpec, node_config
from bms_estimator.model.config_file import read_toml
from bms_estimator.settings.fleet import FleetSettings
from tests.deploy.test_unit import MAX_EXPOSURE, exposure, verify

FindProgram = Callable[[str, str], str]
NODES = "a.example,b.example,c.example"


@pytest.fixture(
    params=[
        "bms-estimator-fleet.service",
        "bms-estimator-fit.service",
        "bms-estimator-ingest.service",
        "bms-estimator-worker@1.service",
    ]
)
def unit(request: pytest.FixtureRequest, deploy: Path, tmp_path: Path) -> Path:
    """Return a unit whose program is replaced by one that exists on this machine."""
    text = (deploy / "fleet" / request.param.replace("@1", "@")).read_text()
    path = tmp_path / request.param
    path.write_text(re.sub(r"(?m)^ExecStart=/\S+", f"ExecStart={sys.executable}", text))
    return path


def test_systemd_reports_no_error_in_the_units(find_program: FindProgram, unit: Path) -> None:
    assert verify(find_program("systemd-analyze", "systemd"), unit) == ""


def test_exposure_is_at_most_1_5(find_program: FindProgram, unit: Path) -> None:
    assert exposure(find_program("systemd-analyze", "systemd"), unit) <= MAX_EXPOSURE


def test_memory_of_ingest_is_limited(deploy: Path) -> None:
    assert "\nMemoryMax=2G\n" in (deploy / "fleet" / "bms-estimator-ingest.service").read_text()


def example_configuration(deploy: Path, number: int) -> str:
    """Return the configuration of node ``number`` of three, with placeholders for the claims of the accounts."""
    settings = read_toml(deploy / "fleet" / "fleet.toml", FleetSettings)
    place = NodeLocation(Path("/var/lib/bms-estimator-fleet"), number, _nodes(settings, number, NODES))
    accounts = Accounts(
        "OPERATOR", "SYSTEM", {"SYSTEM": "CLAIMS", **dict.fromkeys(map(str.upper, settings.tenants), "CLAIMS")}
    )
    text = configuration(node_config(place, ServerSpec(settings, accounts)))
    return re.sub(r'"[^"]*/(fleet[a-z-]*\.(crt|key))"', r'"/run/credentials/bms-estimator-fleet.service/\1"', text)


@pytest.mark.parametrize("number", [1, 2, 3])
def test_example_configurations_are_those_that_the_server_generates(deploy: Path, number: int) -> None:
    assert (deploy / f"fleet/three-nodes/n{number}.conf").read_text() == example_configuration(deploy, number)
