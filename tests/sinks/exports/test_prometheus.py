"""Prometheus sink: real scrapes, parsed by the library and checked by promtool if installed."""

import asyncio
import contextlib
import socket
import threading
import urllib.request
from typing import Any

import aiohttp
import pytest
from structlog.testing import capture_logs

from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.health import Health
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.process import listener
from bms_estimator.settings.connections import PrometheusSettings
from tests.free_port import free_port
from tests.patience import LONG_S
from tests.prometheus import PROMTOOL, promtool
from tests.sinks.snapshots import CELL_SNAPSHOT, SNAPSHOT_WITHOUT_SAMPLES, SOC_LOW_ALARM, STACK_SNAPSHOT, snapshot

pytest.importorskip("prometheus_client", reason="prometheus-client is not installed: pip install prometheus-client")

from prometheus_client.parser import text_string_to_metric_families

from bms_estimator.sinks.exports.prometheus import (
    COUNTER_FIELDS,
    LIST_ITEMS,
    PrometheusSink,
    name_and_factor,
)


def snapshot_with_all_values() -> Snapshot:
    """Return a snapshot with cells, energy and an alarm."""
    assert CELL_SNAPSHOT.estimate
    values = {"cells_v": [3.25, None, 3.5], "energy_out_kwh": 1.5, "time_to_cutoff_s": 60.0, "temperature_c": 21.5}
    return CELL_SNAPSHOT._replace(estimate=CELL_SNAPSHOT.estimate.model_copy(update=values), alarms=(SOC_LOW_ALARM,))


async def scrape(*snapshots: Snapshot) -> str:
    """Publish the snapshots. Return the text that Prometheus then scrapes."""
    settings = PrometheusSettings(listen=f"127.0.0.1:{free_port()}")
    async with PrometheusSink(settings) as sink:
        for snapshot in snapshots:
            sink.publish(snapshot)

        def get() -> str:
            with urllib.request.urlopen(f"http://{settings.listen}/metrics") as response:
                return response.read().decode()

        return await asyncio.to_thread(get)


def values(text: str) -> dict[tuple[str, ...], float]:
    """Return the values of a scrape by the metric's name and its labels other than the device."""
    metrics = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels = dict(sample.labels)
            assert labels.pop("device") == "pack"
            metrics[sample.name, *labels.values()] = sample.value
    return metrics


async def test_a_snapshot_without_an_estimate_leaves_the_last_estimate_in_the_scrape() -> None:
    assert values(await scrape(CELL_SNAPSHOT, CELL_SNAPSHOT._replace(estimate=None)))["bms_voltage_volts",] == 3.8


async def test_a_scrape_has_the_values_in_base_units() -> None:
    text = await scrape(snapshot_with_all_values())
    metrics = values(text)
    assert metrics["bms_voltage_volts",] == 3.8
    assert metrics["bms_soc_ratio",] == pytest.approx(0.5)
    assert metrics["bms_energy_out_joules_total",] == 1.5 * 3.6e6  # 1.5 kWh
    assert metrics["bms_temperature_celsius",] == 21.5
    assert metrics["bms_crc_errors_total",] == 3.0
    assert metrics["bms_line_total", "frames_received"] == 2.0
    assert (metrics["bms_cell_volts", "1"], metrics["bms_cell_volts", "3"]) == (3.25, 3.5)
    assert ("bms_cell_volts", "2") not in metrics
    assert metrics["bms_alarm", "soc_low", "warning"] == 1.0
    assert metrics["bms_sensor_online",] == 1.0
    assert "# TYPE bms_energy_out_joules_total counter" in text
    assert "positive on discharge" in text
    if PROMTOOL:
        assert await asyncio.to_thread(promtool, "check", "metrics", text=text) == (0, "")


async def test_unknown_and_stale_values_have_no_metrics() -> None:
    assert values(await scrape()) == {}
    for stale in (SNAPSHOT_WITHOUT_SAMPLES, snapshot(sensor_message="no board")):
        metrics = values(await scrape(stale))
        assert not {"bms_voltage_volts", "bms_soc_ratio"} & {name for name, *_ in metrics}
        assert ("bms_uptime_seconds",) in metrics
    assert values(await scrape(snapshot(sensor_message="no board")))["bms_sensor_online",] == 0.0
    assert ("bms_soc_ratio",) not in values(await scrape(STACK_SNAPSHOT))


async def test_an_occupied_address_is_retried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listener, "OPEN_RETRY_S", 0.02)
    settings = PrometheusSettings(listen=f"127.0.0.1:{free_port()}")
    with capture_logs() as lines:
        async with PrometheusSink(settings) as occupant, PrometheusSink(settings) as sink:
            sink.publish(CELL_SNAPSHOT)
            await occupant.__aexit__()
            async with asyncio.timeout(LONG_S), aiohttp.ClientSession() as session:
                text = ""
                while "bms_soc_ratio" not in text:
                    with contextlib.suppress(aiohttp.ClientError):
                        async with session.get(f"http://{settings.listen}/metrics") as response:
                            text = await response.text()
        async with PrometheusSink(settings), PrometheusSink(settings):
            pass  # ends while it retries
    assert [(line["service"], line["reason"]) for line in lines] == 2 * [("metrics", "Address already in use")]


def test_metric_tables_contain_only_fields_of_the_payloads() -> None:
    fields = set(Estimate.model_fields) | set(Health.model_fields)
    assert {*COUNTER_FIELDS, *LIST_ITEMS} <= fields


def test_units_are_converted_to_base_units() -> None:
    assert name_and_factor("remaining_energy_wh") == ("bms_remaining_energy_joules", 3600.0)
    assert name_and_factor("rss_mib") == ("bms_rss_bytes", 1048576.0)
    assert name_and_factor("innovation_v") == ("bms_innovation_volts", 1.0)
    assert name_and_factor("nussbaum_gain") == ("bms_nussbaum_gain", 1.0)
    assert name_and_factor("adaptation_gain_hz") == ("bms_adaptation_gain_hertz", 1.0)


@pytest.mark.parametrize(
    "listen", ["9108", "127.0.0.1", "127.0.0.1:0", "127.0.0.1:65536", "a b:1", "http://x:1", "x..y:1"]
)
def test_invalid_address_is_rejected(listen: str) -> None:
    with pytest.raises(ValueError, match=r"listen|port|label empty"):
        PrometheusSettings(listen=listen)


def test_ipv4_and_ipv6_addresses_are_accepted() -> None:
    settings: Any = [PrometheusSettings(listen=listen) for listen in ("127.0.0.1:9108", "[::1]:1")]
    assert [each.address for each in settings] == [("127.0.0.1", 9108), ("::1", 1)]


async def test_slow_name_lookup_does_not_block_the_event_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    called, may_return, getaddrinfo = threading.Event(), threading.Event(), socket.getaddrinfo

    def slow_getaddrinfo(*arguments: Any, **options: Any) -> Any:
        called.set()
        assert may_return.wait(LONG_S)
        return getaddrinfo(*arguments, **options)

    monkeypatch.setattr(socket, "getaddrinfo", slow_getaddrinfo)

    async def release() -> None:  # a blocked event loop would never run it
        await asyncio.to_thread(called.wait, LONG_S)
        may_return.set()

    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(release())
        async with PrometheusSink(PrometheusSettings(listen=f"127.0.0.1:{free_port()}")):
            pass
