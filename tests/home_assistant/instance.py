"""A real Home Assistant on loopback with its own folder and Python, and its REST and WebSocket API."""

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
"""Folder of `make home-assistant`."""
MISSING = f"Home Assistant {VERSION} is not there: `make home-assistant` makes it, which takes two minutes"

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
CLIENT = "http://127.0.0.1/"


class HomeAssistant:
    """One that runs, with an owner.

    Args:
        folder: Its configuration.
        dashboard: Of the dashboard ``the-pack``, YAML.
    """

    def __init__(self, folder: Path, dashboard: Path) -> None:
        self.folder, self._port = folder, free_port()
        (folder / "configuration.yaml").write_text(CONFIGURATION.format(port=self._port))
        (folder / "dashboard.yaml").symlink_to(dashboard)
        self._process: subprocess.Popen[bytes] | None = None
        self._token = ""

    def start(self) -> None:
        """Until it answers; the first start makes an owner."""
        command = [str(ENVIRONMENT / "venv/bin/python"), "-m", "homeassistant", "-c", str(self.folder), "--skip-pip"]
        with (self.folder / "console.log").open("ab") as console:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=console, stderr=console)
        deadline = time.monotonic() + LONG_S
        while True:
            assert self._process.poll() is None, self.log
            assert time.monotonic() < deadline, self.log
            try:
                steps = self.ask("/api/onboarding", authorized=False)
                break
            except OSError:
                time.sleep(0.1)
        if not steps[0]["done"]:
            self._onboard()

    def stop(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait(LONG_S)
            self._process = None

    def _onboard(self) -> None:
        owner = {"client_id": CLIENT, "name": "Owner", "username": "owner", "password": "secret", "language": "en"}
        code = self.ask("/api/onboarding/users", owner, authorized=False)["auth_code"]
        form = f"grant_type=authorization_code&code={code}&client_id={CLIENT}".encode()
        self._token = self._call("/auth/token", form)["access_token"]

    def ask(self, path: str, body: Mapping[str, Any] | None = None, *, authorized: bool = True) -> Any:
        """Return the response of its REST API; with a ``body`` by POST."""
        content = None if body is None else json.dumps(body).encode()
        return self._call(path, content, {"Authorization": f"Bearer {self._token}"} if authorized else {})

    def _call(self, path: str, content: bytes | None, headers: Mapping[str, str] | None = None) -> Any:
        request = urllib.request.Request(f"http://127.0.0.1:{self._port}{path}", content, dict(headers or {}))
        if content is not None and content.startswith(b"{"):
            request.add_header("Content-Type", "application/json")
        with urllib.request.urlopen(request, timeout=LONG_S) as response:
            return json.load(response)

    def add_mqtt(self, port: int) -> None:
        """Set up the integration as its owner would, by the forms."""
        flow = self.ask("/api/config/config_entries/flow", {"handler": "mqtt"})
        broker = {"broker": "127.0.0.1", "port": port}
        done = self.ask(f"/api/config/config_entries/flow/{flow['flow_id']}", broker)
        assert done["type"] == "create_entry", done

    def states(self) -> dict[str, Any]:
        """Return the states by entity."""
        return {state["entity_id"]: state for state in self.ask("/api/states")}

    def call(self, service: str, **data: Any) -> None:
        """Call a service, such as ``number.set_value``."""
        self.ask(f"/api/services/{service.replace('.', '/')}", data)

    def until(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The states, once they are wanted."""
        deadline = time.monotonic() + LONG_S
        while not wanted(states := self.states()):
            assert time.monotonic() < deadline, {name: state["state"] for name, state in states.items()}
            time.sleep(0.1)
        return states

    def command(self, kind: str, **arguments: Any) -> Any:
        """The result of a command of its WebSocket API."""
        with connect(f"ws://127.0.0.1:{self._port}/api/websocket", max_size=None) as connection:
            connection.recv()
            connection.send(json.dumps({"type": "auth", "access_token": self._token}))
            assert json.loads(connection.recv())["type"] == "auth_ok"
            connection.send(json.dumps({"id": 1, "type": kind, **arguments}))
            answer = json.loads(connection.recv())
            assert answer["success"], answer
            return answer["result"]

    @property
    def log(self) -> str:
        """All that it has logged."""
        file = self.folder / "home-assistant.log"
        return file.read_text() if file.exists() else (self.folder / "console.log").read_text()

    def rows(self, entities: str) -> list[tuple[str, str | None]]:
        """Return entity and state of its recorder's rows, for entities ``LIKE`` the pattern, in order."""
        query = (
            "SELECT states_meta.entity_id, state FROM states JOIN states_meta USING (metadata_id)"
            " WHERE states_meta.entity_id LIKE ? ORDER BY state_id"
        )
        with contextlib.closing(sqlite3.connect(self.folder / "home-assistant_v2.db")) as database:
            return list(database.execute(query, (entities,)))
