"""Service that exports its values to InfluxDB and Prometheus."""

import asyncio
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from bms_estimator.model.cell import load_cell
from bms_estimator.service.pack_service import run_pack_service
from bms_estimator.settings.pack import Settings
from tests.free_port import free_port
from tests.influxdb import InfluxDB
from tests.patience import LONG_S
from tests.serial_line import Line


async def test_samples_of_a_board_reach_influxdb_and_prometheus(line: Line, tmp_path: Path) -> None:
    pytest.importorskip("prometheus_client", reason="prometheus-client is not installed: pip install prometheus-client")
    influxdb, listen = InfluxDB(tmp_path), f"127.0.0.1:{free_port()}"
    await asyncio.to_thread(influxdb.start)
    settings = Settings.model_validate(
        {
            "sensor": {"port": str(line.path), "protocol": "text"},
            "publish": {"rate_hz": 10},
            "influx": {"url": influxdb.url, "every_s": 3600},
            "prometheus": {"listen": listen},
        }
    )
    line.plug()
    stop = asyncio.Event()
    serving = asyncio.create_task(run_pack_service(settings, load_cell("ncr18650"), stop=stop))
    try:
        async with asyncio.timeout(LONG_S):
            while "bms_voltage_volts{" not in await asyncio.to_thread(scrape, listen):
                line.write(b"3.80,0.10,25.0\r\n")
                await asyncio.sleep(0.05)
        stop.set()
        await serving
        [row, *_] = await asyncio.to_thread(influxdb.ask, "SELECT voltage_v, device FROM bms_state")
        assert (row["voltage_v"], row["device"]) == (3.8, "pack")
    finally:
        serving.cancel()
        await asyncio.to_thread(influxdb.stop)


def scrape(listen: str) -> str:
    """Return the metrics; an empty text until the server listens."""
    try:
        with urllib.request.urlopen(f"http://{listen}/metrics", timeout=LONG_S) as response:
            return response.read().decode()
    except urllib.error.URLError:
        return ""
