"""Grafana dashboards: their layout, and the queries of a pack's dashboard on a real InfluxDB with a state and an alarm."""

import itertools
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.sinks.exports.influx import ALARM, STATE, lines
from tests.influxdb import InfluxDB
from tests.sinks.snapshots import CELL_SNAPSHOT, SOC_LOW_ALARM

FOLDER = Path(__file__).parents[2] / "deploy" / "grafana"
DASHBOARD = json.loads((FOLDER / "bms.json").read_text(encoding="utf-8"))
TARGETS = [(panel["title"], target) for panel in DASHBOARD["panels"] for target in panel["targets"]]
MODEL_OF_MEASUREMENT = {STATE: Estimate, ALARM: Alarm}
GRID_COLUMNS = 24
"""Width of a dashboard of Grafana [columns]."""
TAGS = {"device", "name", "severity"}
"""Tags of the measurements; all other columns are fields."""


def fields(query: str) -> set[str]:
    """Return the names between SELECT and FROM, without those after AS."""
    selection = re.search(r"SELECT (.*) FROM", query)
    assert selection
    return set(re.findall(r'(?<!AS )"(\w+)"', selection[1]))


@pytest.fixture(scope="module")
def influxdb(tmp_path_factory: pytest.TempPathFactory) -> Iterator[InfluxDB]:
    """Start a server that contains an alarm, and a state in which each number has a value."""
    server = InfluxDB(tmp_path_factory.mktemp("influxdb")).start()
    assert CELL_SNAPSHOT.estimate
    numbers = {
        name: 1.0
        for name, field in Estimate.model_fields.items()
        if "float" in str(field.annotation) and "list" not in str(field.annotation)
    }
    server.write(
        lines(
            None,
            CELL_SNAPSHOT._replace(estimate=CELL_SNAPSHOT.estimate.model_copy(update=numbers), alarms=(SOC_LOW_ALARM,)),
        )
    )
    yield server
    server.stop()


@pytest.mark.parametrize(("title", "target"), TARGETS, ids=[f"{title}-{t['refId']}" for title, t in TARGETS])
def test_every_queried_field_is_published(title: str, target: dict[str, Any]) -> None:
    measurement = re.search(r'FROM "(\w+)"', target["query"])
    assert measurement
    assert fields(target["query"]) - TAGS <= set(MODEL_OF_MEASUREMENT[measurement[1]].model_fields)


def test_every_query_returns_a_value_from_a_real_influxdb(influxdb: InfluxDB) -> None:
    [device] = [variable for variable in DASHBOARD["templating"]["list"] if variable["name"] == "device"]
    assert influxdb.ask(device["query"]) == [{"key": "device", "value": "pack"}]
    for title, target in TARGETS:
        # Grafana replaces these variables; a hundred years contain the snapshot of 2023
        query = target["query"].replace("$device", "pack").replace("$timeFilter", "time > now() - 36500d")
        rows = influxdb.ask(query.replace("$__interval", "3650d"))
        values = [value for row in rows for name, value in row.items() if name not in {"time", *TAGS}]
        assert any(value is not None for value in values), f"{title}: {query}"


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.json")), ids=lambda file: file.stem)
def test_panels_do_not_overlap_and_use_the_selected_source(file: Path) -> None:
    panels = json.loads(file.read_text(encoding="utf-8"))["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    for first, second in itertools.combinations([panel["gridPos"] for panel in panels], 2):
        is_separate = [
            a[position] + a[size] <= b[position]
            for a, b in ((first, second), (second, first))
            for position, size in (("x", "w"), ("y", "h"))
        ]
        assert any(is_separate)
        assert first["x"] + first["w"] <= GRID_COLUMNS
    assert {target["datasource"]["uid"] for panel in panels for target in panel["targets"]} == {"${source}"}


def test_every_query_selects_pack_and_time() -> None:
    for _, target in TARGETS:
        assert "\"device\" = '$device' AND $timeFilter" in target["query"]
