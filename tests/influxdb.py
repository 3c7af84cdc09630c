"""Real InfluxDB 1 on free ports on loopback."""

import json
import shutil
import subprocess
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any, Self

import pytest

from tests.free_port import free_port
from tests.patience import LONG_S

INFLUXD = shutil.which("influxd", path="/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin")


class InfluxDB:
    """InfluxDB server with one database. A restart uses the same port and data."""

    def __init__(self, folder: Path) -> None:
        self.url = f"http://127.0.0.1:{free_port()}"
        self._config = folder / "influxdb.conf"
        self._config.write_text(f"""
reporting-disabled = true
bind-address = "127.0.0.1:{free_port()}"
[meta]
dir = "{folder}/meta"
[data]
dir = "{folder}/data"
wal-dir = "{folder}/wal"
[http]
bind-address = "{self.url.removeprefix("http://")}"
log-enabled = false
""")
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> Self:
        """Start the server, or skip the test without InfluxDB."""
        if INFLUXD is None:
            pytest.skip("influxd is not installed (apt-get install influxdb)")
        self._process = subprocess.Popen(
            [INFLUXD, "run", "-config", str(self._config)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        deadline = time.monotonic() + LONG_S
        while time.monotonic() < deadline and self._process.poll() is None:
            try:
                self.ask("CREATE DATABASE bms")
            except (urllib.error.URLError, ConnectionError):
                time.sleep(0.05)
            else:
                return self
        raise AssertionError("influxd did not start")

    def stop(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait(LONG_S)
            self._process = None

    def ask(self, query: str) -> list[dict[str, Any]]:
        """Run an InfluxQL query. Return its rows as dictionaries."""
        data = urllib.parse.urlencode({"q": query, "db": "bms", "epoch": "ms"}).encode()
        with urllib.request.urlopen(f"{self.url}/query", data, timeout=LONG_S) as response:
            [result] = json.load(response)["results"]
        assert "error" not in result, result
        return [
            dict(zip(series["columns"], row, strict=True)) | series.get("tags", {})
            for series in result.get("series", [])
            for row in series["values"]
        ]

    def write(self, lines: list[str]) -> None:
        """Write lines of the line protocol with times in milliseconds."""
        body = "\n".join(lines).encode()
        with urllib.request.urlopen(f"{self.url}/write?db=bms&precision=ms", body, timeout=LONG_S) as response:
            assert response.status == 204
