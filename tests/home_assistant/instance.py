"""Real Home Assistant on loopback with its own folder and Python, controlled by its REST and WebSocket APIs."""

import contextlib
import json
import os
import sqlite3
import subprocess
import time
import urllib.request
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

from tests.free_port import free_port
from tests.patience import LONG_S

VERSION = os.environ.get("HOME_ASSISTANT", "2025.2.5")
ENVIRONMENT = (
    Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "bms_estimator-home-assistant" / VERSION
)
"""Folder in which `make home-assistant` installs Home Assistant."""
MISSING = f"Home Assistant {VERSION} is not installed: `make home-assistant` installs it in two minutes"

CONFIGURATION = """
homeassistant:
  name: Test
  latitude: 52.5
  longitude: 13.4
  elevation: 30
  time_zone: UTC
  unit_system: metric
  currency: EUR
  country: DE
  language: de
http:
  server_host: 127.0.0.1
  server_port: {port}
recorder:
  commit_interval: 0
history:
energy:
config:
lovelace:
  dashboards:
    the-pack:
      mode: yaml
      title: Pack
      filename: dashboard.yaml
"""
CLIENT_ID = "http://127.0.0.1/"
"""Name of the tests at Home Assistant's login."""
POLL_S = 0.3
"""Interval at which the tests read all states [s]. A shorter one would keep Home Assistant busy with JSON."""


class HomeAssistant:
    """Home Assistant with an owner, as whom the tests use its APIs.

    Args:
        folder: Folder of its configuration.
        dashboard: YAML file of the dashboard ``the-pack``.
    """

    def __init__(self, folder: Path, dashboard: Path) -> None:
        self.folder, self._port = folder, free_port()
        (folder / "configuration.yaml").write_text(CONFIGURATION.format(port=self._port))
        (folder / "dashboard.yaml").symlink_to(dashboard)
        self._process: subprocess.Popen[bytes] | None = None
        self._token = ""

    def start(self) -> None:
        """Start Home Assistant and wait until it responds. Create an owner at the first start."""
        command = [str(ENVIRONMENT / "venv/bin/python"), "-m", "homeassistant", "-c", str(self.folder), "--skip-pip"]
        with (self.folder / "console.log").open("ab") as console:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=console, stderr=console)
        deadline = time.monotonic() + LONG_S
        while True:
            assert self._process.poll() is None, self.log
            assert time.monotonic() < deadline, self.log
            try:
                onboarding_steps = self.request("/api/onboarding", authorized=False)
                break
            except OSError:
                time.sleep(0.1)
        if not onboarding_steps[0]["done"]:
            self._onboard()

    def stop(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait(LONG_S)
            self._process = None

    def _onboard(self) -> None:
        """Create the owner and log in as the owner."""
        owner = {"client_id": CLIENT_ID, "name": "Owner", "username": "owner", "password": "secret", "language": "en"}
        code = self.request("/api/onboarding/users", owner, authorized=False)["auth_code"]
        form = f"grant_type=authorization_code&code={code}&client_id={CLIENT_ID}".encode()
        self._token = self._send("/auth/token", form)["access_token"]

    def request(self, path: str, body: Mapping[str, Any] | None = None, *, authorized: bool = True) -> Any:
        """Return the response of the REST API to a GET, or to a POST of ``body``."""
        content = None if body is None else json.dumps(body).encode()
        return self._send(path, content, {"Authorization": f"Bearer {self._token}"} if authorized else {})

    def _send(self, path: str, content: bytes | None, headers: Mapping[str, str] | None = None) -> Any:
        request = urllib.request.Request(f"http://127.0.0.1:{self._port}{path}", content, dict(headers or {}))
        if content is not None and content.startswith(b"{"):
            request.add_header("Content-Type", "application/json")
        with urllib.request.urlopen(request, timeout=LONG_S) as response:
            return json.load(response)

    def add_mqtt(self, port: int) -> None:
        """Set up the MQTT integration by the forms of its configuration flow."""
        flow = self.request("/api/config/config_entries/flow", {"handler": "mqtt"})
        broker = {"broker": "127.0.0.1", "port": port}
        done = self.request(f"/api/config/config_entries/flow/{flow['flow_id']}", broker)
        assert done["type"] == "create_entry", done

    def states(self) -> dict[str, Any]:
        """Return the states by entity."""
        return {state["entity_id"]: state for state in self.request("/api/states")}

    def call_service(self, service: str, **data: Any) -> None:
        """Call a service, such as ``number.set_value``."""
        self.request(f"/api/services/{service.replace('.', '/')}", data)

    def until(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Wait until a condition holds for the states, and return them."""
        deadline = time.monotonic() + LONG_S
        while not condition(states := self.states()):
            assert time.monotonic() < deadline, {name: state["state"] for name, state in states.items()}
            time.sleep(POLL_S)
        return states

    def websocket_command(self, command_type: str, **arguments: Any) -> Any:
        """Return the result of a command of the WebSocket API."""
        with connect(f"ws://127.0.0.1:{self._port}/api/websocket", max_size=None) as connection:
            connection.recv()  # the request to authenticate
            connection.send(json.dumps({"type": "auth", "access_token": self._token}))
            assert json.loads(connection.recv())["type"] == "auth_ok"
            connection.send(json.dumps({"id": 1, "type": command_type, **arguments}))
            response = json.loads(connection.recv())
            assert response["success"], response
            return response["result"]

    @property
    def log(self) -> str:
        """Return the complete log; before the log file exists, the console output."""
        file = self.folder / "home-assistant.log"
        return file.read_text() if file.exists() else (self.folder / "console.log").read_text()

    def recorder_rows(self, entities: str) -> list[tuple[str, str | None]]:
        """Return entity and state of the recorder's rows in order, for entities ``LIKE`` an SQL pattern."""
        query = (
            "SELECT states_meta.entity_id, state FROM states JOIN states_meta USING (metadata_id)"
            " WHERE states_meta.entity_id LIKE ? ORDER BY state_id"
        )
        with contextlib.closing(sqlite3.connect(self.folder / "home-assistant_v2.db")) as database:
            return list(database.execute(query, (entities,)))
