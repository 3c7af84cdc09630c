"""``run_pack_service``: log lines before the first sample, and the state folder."""

import asyncio
import re
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.process.state_folder import state_folder
from bms_estimator.service.pack_service import run_pack_service, run_pack_services
from bms_estimator.settings.pack import PackSettings, Settings
from bms_estimator.settings.sensor import SensorSettings
from tests.patience import LONG_S


async def test_implausible_settings_are_logged():
    settings = Settings(pack=PackSettings(series=14), sensor=SensorSettings(port="/dev/none"))
    stop = asyncio.Event()
    stop.set()  # the service ends at once
    with capture_logs() as lines:
        await run_pack_service(settings, load_cell("ncr18650").pack(14, 1), stop=stop)
    reasons = [line["reason"] for line in lines if line["event"] == "implausible setting"]
    assert len(reasons) == 2
    assert "14 in series of 3 Ah" in reasons[0]
    assert "the board's range ends at 25.0 V" in reasons[1]


@pytest.mark.parametrize(("law", "count"), [("improved", 1), ("scheme-1", 0), ("learning", 0)])
async def test_failing_conditions_of_lemma_4_1_1_are_logged_for_a_law_with_bounds(law: str, count: int) -> None:
    settings = Settings.model_validate({"observer": {"law": law}, "sensor": {"port": "/dev/none"}})
    stop = asyncio.Event()
    stop.set()  # the service ends at once
    with capture_logs() as lines:
        await run_pack_service(settings, load_cell("chen_mora"), stop=stop)
    reasons = [line["reason"] for line in lines if line["event"] == "condition of the observer fails"]
    assert len(reasons) == count
    assert all("1: P9.l9 < P7.l7 of Lemma 4.1.1 fails" in reason for reason in reasons)


@pytest.mark.parametrize(
    ("names", "ports", "mqtt", "text"),
    [
        (("a", "a"), ("/dev/one", "/dev/two"), {}, "pack.name = a: 2 of the packs have it; give each its own"),
        (("a", "b"), ("/dev/one", "/dev/one"), {}, "sensor.port = /dev/one: 2 of the packs have it; give each its own"),
        (
            ("a", "b"),
            ("/dev/one", "/dev/two"),
            {"username": "b", "password_file": "/none"},
            "b: mqtt.password_file = /none: cannot be read",
        ),
    ],
)
async def test_the_error_names_the_pack_that_cannot_be_served(
    names: tuple[str, str], ports: tuple[str, str], mqtt: dict[str, str], text: str, state_home: Path
) -> None:
    cell, packs = load_cell("chen_mora"), []
    for name, port in zip(names, ports, strict=True):
        tables = {"pack": {"name": name}, "sensor": {"port": port}} | ({"mqtt": mqtt} if mqtt and name == "b" else {})
        packs.append((Settings.model_validate(tables), cell))
    with pytest.raises(UserError, match=f"^{re.escape(text)}"):
        await asyncio.wait_for(run_pack_services(packs), LONG_S)


async def test_contradictory_limits_of_a_pack_are_an_error_before_any_service_starts(state_home: Path) -> None:
    tables: list[dict[str, Any]] = [{}, {"alarms": {"over_temperature": {"limit_c": 60.0, "clear_c": 61.0}}}]
    packs = [
        (
            Settings.model_validate({"pack": {"name": name}, "sensor": {"port": f"/dev/{name}"}} | table),
            load_cell("leaf"),
        )
        for name, table in zip("ab", tables, strict=True)
    ]
    with pytest.raises(UserError, match=r"^b: .*clear_c"), capture_logs() as lines:
        await asyncio.wait_for(run_pack_services(packs), LONG_S)
    assert lines == []


async def test_packs_without_a_serial_line_may_have_equal_port_settings(state_home: Path) -> None:
    """Both packs pass the check of the ports. The error about pack b is a later one, which ends the test."""
    source = {"kind": "mqtt", "profile": "opendtu", "url": "mqtt://localhost"}
    sources = {"a": source, "b": source | {"password_file": "/none"}}
    tables = [{"pack": {"name": name}, "source": table} for name, table in sources.items()]
    packs = [(Settings.model_validate(table), load_cell("chen_mora")) for table in tables]
    with pytest.raises(UserError, match=r"^b: source.password_file = /none: cannot be read"):
        await asyncio.wait_for(run_pack_services(packs), LONG_S)


def test_without_a_home_folder_the_service_runs_and_logs_that_state_is_not_saved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setenv("HOME", "~")  # the state folder then cannot be found, as for a user without a home folder
    with capture_logs() as lines:
        state_folder(Settings())
    assert [line["event"] for line in lines] == ["the state will be lost at a restart"]
