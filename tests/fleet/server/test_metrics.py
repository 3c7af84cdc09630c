"""Metrics of a real server and worker, read by a real Prometheus with the alert rules, and the queries of the dashboard."""

import asyncio
import contextlib
import json
import re
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import aiomqtt
import nats
import pytest
from structlog.testing import capture_logs

from bms_estimator.fleet.metrics.families import NODE, TENANT, WORKER
from bms_estimator.fleet.server.node_watch import metrics_endpoint
from tests.fleet.serve_process import ServeProcess
from tests.fleet.workers import PERIOD_S, SAMPLES, Process, block, load_packs, send
from tests.free_port import free_port
from tests.patience import LONG_S
from tests.prometheus import PROMETHEUS, PROMTOOL, Prometheus, promtool

pytest.importorskip("prometheus_client", reason="prometheus-client is not installed: pip install prometheus-client")

from prometheus_client.parser import text_string_to_metric_families

ROOT = Path(__file__).parents[3]
RULES = ROOT / "deploy" / "prometheus" / "fleet.rules.yml"
DASHBOARD = json.loads((ROOT / "deploy" / "grafana" / "fleet.json").read_text(encoding="utf-8"))
BLOCKS = 12
"""Number of blocks of pack ``p1``: more than an hour, so that a summary is stored."""
needs_promtool = pytest.mark.skipif(PROMTOOL is None, reason="promtool is not installed (make prometheus)")


class Fleet:
    """Server with metrics and one worker, which has processed the blocks of one pack and a damaged block."""

    def __init__(self, folder: Path) -> None:
        self.metrics = f"127.0.0.1:{free_port()}"
        ports = {name: f"127.0.0.1:{free_port()}" for name in ("listen", "mqtt", "monitor")}
        self.mqtt_port = int(ports["mqtt"].rpartition(":")[2])
        self.url = f"nats://{ports['listen']}"
        settings = "\n".join(f'{name} = "{address}"' for name, address in (ports | {"metrics": self.metrics}).items())
        file = folder / "fleet.toml"
        file.write_text(f"[server]\npartitions = 1\noutage_days = 0.1\n{settings}\n")
        self.server = ServeProcess(file, folder / "state")
        self.server.wait("streams ready")
        self.worker = Process(folder, self.url, "w", "--checkpoint-s", 1)
        self.prometheus: Prometheus | None = None
        self.ready_values: dict[tuple[str, ...], float] = {}

    def scrape(self) -> str:
        with urllib.request.urlopen(f"http://{self.metrics}/metrics", timeout=LONG_S) as response:
            return response.read().decode()

    def values(self) -> dict[tuple[str, ...], float]:
        """Return the values of a scrape by the metric's name and its labels other than ``tenant`` and ``worker``."""
        values = {}
        for family in text_string_to_metric_families(self.scrape()):
            for sample in family.samples:
                labels = {name: text for name, text in sample.labels.items() if name not in {"tenant", "worker"}}
                values[sample.name, *labels.values()] = sample.value
        return values

    def wait(self, condition: Callable[[dict[tuple[str, ...], float]], object]) -> dict[tuple[str, ...], float]:
        """Wait until the values fulfill a condition, and return them."""
        deadline = time.monotonic() + LONG_S
        while not condition(values := self.values()):
            assert time.monotonic() < deadline, values
            time.sleep(0.05)
        return values

    def send(self, *numbers: int, damaged: bytes = b"") -> None:
        """Send blocks of pack ``p1``, whose last sample arrives now, and then a damaged block."""

        async def publish() -> None:
            async with await nats.connect(self.url) as nc:
                await load_packs(nc, ["p1"])
                for number in numbers:
                    await send(nc, "p1", block("p1", number, time.time()))
                if damaged:
                    await send(nc, "p1", damaged)

        asyncio.run(publish())

    def close(self) -> None:
        self.worker.kill()
        self.server.end()
        self.server.close()


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    with contextlib.ExitStack() as stack:
        fleet = Fleet(tmp_path_factory.mktemp("fleet"))
        stack.callback(fleet.close)
        if PROMETHEUS:
            # alerts fire as soon as their condition is true
            rules = re.sub(r"(?m)^( *for:) .*", r"\1 0s", RULES.read_text())
            folder = tmp_path_factory.mktemp("prometheus")
            fleet.prometheus = stack.enter_context(Prometheus(folder, fleet.metrics, rules))
        fleet.send(*range(1, BLOCKS + 1), damaged=b"a damaged block")
        fleet.ready_values = fleet.wait(
            lambda values: (
                values.get(("bms_fleet_worker_blocks_total",)) == BLOCKS + 1
                and values.get(("bms_fleet_stream_messages", "DEAD")) == 1
                and ("bms_fleet_worker_checkpoint_duration_seconds",) in values
                and values["bms_fleet_worker_unsaved_seconds",] == 0.0
                and {each.name for each in (*NODE, *TENANT, *WORKER)} <= {name for name, *_ in values}
            )
        )
        yield fleet


@pytest.fixture
def prometheus(fleet: Fleet) -> Prometheus:
    """Return the server, which evaluates the alert rules and has scraped the fleet."""
    if fleet.prometheus is None:
        pytest.skip("prometheus is not installed (make prometheus)")
    fleet.prometheus.wait("bms_fleet_worker_blocks_total")
    return fleet.prometheus


def test_a_scrape_has_a_value_of_every_metric(fleet: Fleet) -> None:
    values = fleet.ready_values  # the fixture waits until every metric has a value
    assert values["bms_fleet_server_up",] == 1.0
    assert values["bms_fleet_workers",] == 1.0
    assert values["bms_fleet_unowned_partitions",] == 0.0
    assert values["bms_fleet_worker_packs",] == 1.0
    assert values["bms_fleet_worker_samples_total",] >= BLOCKS * SAMPLES
    assert values["bms_fleet_worker_events_total", "damaged"] == 1.0
    assert values["bms_fleet_worker_dead_letters_total",] == 1.0
    assert values["bms_fleet_stream_messages", "RAW"] == BLOCKS + 1
    assert values["bms_fleet_stream_messages", "HOURS"] == BLOCKS * SAMPLES * PERIOD_S // 3600.0
    assert 0.0 < values["bms_fleet_stream_bytes", "RAW"] < values["bms_fleet_stream_max_bytes", "RAW"]
    assert 0.0 < values["bms_fleet_worker_estimation_seconds_total",] < values["bms_fleet_worker_cpu_seconds_total",]
    assert 0.0 < values["bms_fleet_disk_free_bytes",] < values["bms_fleet_disk_bytes",]


@needs_promtool
def test_promtool_accepts_metrics_and_rules(fleet: Fleet) -> None:
    assert promtool("check", "metrics", text=fleet.scrape()) == (0, "")
    assert promtool("check", "config", RULES.with_name("prometheus.yml"))[0] == 0  # includes the rules
    code, output = promtool("test", "rules", ROOT / "tests" / "deploy" / "fleet.rules.test.yml")
    assert code == 0, output


def test_every_alert_rule_has_a_unit_test_and_is_documented() -> None:
    alerts = re.findall(r"alert: (\w+)", RULES.read_text())
    tests = (ROOT / "tests" / "deploy" / "fleet.rules.test.yml").read_text()
    assert len(alerts) >= 5
    assert [alert for alert in alerts if f'alertname="{alert}"' not in tests] == []
    documented = re.findall(r"^\| `(Fleet\w+)`", (ROOT / "docs" / "fleet" / "operation.md").read_text(), re.MULTILINE)
    assert documented == alerts


def test_rules_and_dashboard_use_only_existing_metrics() -> None:
    names = {each.name for each in (*NODE, *TENANT, *WORKER)}
    expressions = [target["expr"] for panel in DASHBOARD["panels"] for target in panel["targets"]]
    used = set(re.findall(r"bms_fleet_\w+", " ".join([*expressions, *re.findall(r"expr: (.*)", RULES.read_text())])))
    assert used <= names


def test_every_query_of_the_dashboard_has_a_result(fleet: Fleet, prometheus: Prometheus) -> None:
    fleet.send(1)  # a repeated block, so that the lag has a recent value
    for panel in DASHBOARD["panels"]:
        for target in panel["targets"]:
            # Grafana replaces these variables
            prometheus.wait(target["expr"].replace("$tenant", ".*").replace("$__rate_interval", "1m"))


@pytest.mark.thorough
def test_alert_fires_when_the_worker_is_killed_and_its_pack_sends(fleet: Fleet, prometheus: Prometheus) -> None:
    alert = 'ALERTS{alertname="FleetPartitionsWithoutWorker", alertstate="firing"}'
    dead_letters = 'ALERTS{alertname="FleetPacksNeedRepair", alertstate="firing", stream="DEAD"}'
    prometheus.wait(dead_letters)
    assert prometheus.query(alert) == []
    fleet.worker.kill()
    fleet.send(BLOCKS + 1)
    assert len(prometheus.wait(alert)) == 1
    assert fleet.values()["bms_fleet_undelivered_messages",] >= 1.0


async def test_sessions_of_mqtt_clients_are_counted(fleet: Fleet) -> None:
    async with aiomqtt.Client("127.0.0.1", fleet.mqtt_port, timeout=LONG_S):
        await asyncio.to_thread(fleet.wait, lambda values: values["bms_fleet_mqtt_sessions",] >= 1.0)


async def test_an_occupied_address_does_not_end_the_server(fleet: Fleet) -> None:
    nothing: Any = None  # no metrics are read
    with capture_logs() as lines:
        async with metrics_endpoint(fleet.metrics, nothing, nothing):
            pass
    assert [line["reason"] for line in lines] == ["Address already in use"]
