"""Real Prometheus and its promtool."""

import json
import os
import shutil
import subprocess
import time
import urllib.error
import urllib.parse
import urllib.request
from http import HTTPStatus
from pathlib import Path
from typing import Any, Self

from tests.free_port import free_port
from tests.patience import LONG_S

CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "bms_estimator-prometheus" / "usr" / "bin"
"""Folder into which ``make prometheus`` unpacks the programs."""
PATH = f"{os.environ.get('PATH', '')}:{CACHE}"
PROMTOOL, PROMETHEUS = shutil.which("promtool", path=PATH), shutil.which("prometheus", path=PATH)
"""Programs; None: not installed."""


def promtool(*arguments: object, text: str | None = None) -> tuple[int, str]:
    """Run promtool with ``text`` on stdin. Return exit code and output."""
    assert PROMTOOL
    result = subprocess.run(
        [PROMTOOL, *map(str, arguments)], check=False, input=text, capture_output=True, text=True, timeout=LONG_S
    )
    return result.returncode, result.stdout + result.stderr


class Prometheus:
    """Server that scrapes one target each second, and evaluates rules as often.

    Args:
        folder: Folder of its files.
        target: Address of the metrics, host:port.
        rules: Text of the file of alert rules.
    """

    def __init__(self, folder: Path, target: str, rules: str) -> None:
        self._address = f"127.0.0.1:{free_port()}"
        config = {
            "global": {"scrape_interval": "1s", "evaluation_interval": "1s"},
            "rule_files": ["rules.yml"],
            "scrape_configs": [{"job_name": "bms-fleet", "static_configs": [{"targets": [target]}]}],
        }
        (folder / "prometheus.yml").write_text(json.dumps(config))  # JSON is YAML
        (folder / "rules.yml").write_text(rules)
        assert PROMETHEUS
        command = [PROMETHEUS, f"--config.file={folder / 'prometheus.yml'}", f"--storage.tsdb.path={folder / 'data'}"]
        with (folder / "prometheus.log").open("w") as log:
            self._process = subprocess.Popen([*command, f"--web.listen-address={self._address}"], stderr=log)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.wait(LONG_S)

    def query(self, expression: str) -> list[dict[str, Any]]:
        """Return labels (``metric``) and values of an instant query; an empty list until the server is ready."""
        url = f"http://{self._address}/api/v1/query?{urllib.parse.urlencode({'query': expression})}"
        try:
            with urllib.request.urlopen(url, timeout=LONG_S) as answer:
                return json.load(answer)["data"]["result"]
        except urllib.error.HTTPError as error:
            if error.code == HTTPStatus.SERVICE_UNAVAILABLE:
                return []
            raise AssertionError(f"{expression}: {error.read().decode()}") from None
        except (urllib.error.URLError, ConnectionError):
            return []

    def wait(self, expression: str) -> list[dict[str, Any]]:
        """Wait until a query has a result."""
        deadline = time.monotonic() + LONG_S
        while time.monotonic() < deadline:
            assert self._process.poll() is None, "Prometheus has ended"
            if result := self.query(expression):
                return result
            time.sleep(0.05)
        raise AssertionError(f"no result: {expression}")
