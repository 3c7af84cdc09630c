"""Files of the Docker image and of the Home Assistant add-on."""

import json
import re
import runpy
import threading
import tomllib
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from bms_estimator.settings.pack import load_settings
from bms_estimator.version import __version__

BROKER = {"host": "core-mosquitto", "port": 1883, "ssl": False, "username": "addons", "password": "open-sesame"}
"""Broker as the Supervisor describes it to add-ons."""
PACK = '[pack]\ncell = "chen_mora"\n'


class Supervisor(BaseHTTPRequestHandler):
    """Home Assistant's Supervisor, which describes its broker to add-ons with the right token."""

    def do_GET(self) -> None:
        is_valid = self.path == "/services/mqtt" and self.headers["Authorization"] == "Bearer token"
        self.send_response(200 if is_valid else 403)
        self.end_headers()
        self.wfile.write(json.dumps({"result": "ok", "data": BROKER}).encode())

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@pytest.fixture
def supervisor() -> Iterator[str]:
    """Return the URL of a running Supervisor."""
    with HTTPServer(("127.0.0.1", 0), Supervisor) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.fixture
def with_broker(deploy, tmp_path, supervisor):
    """Return the add-on's function that adds a broker to a pack file, with the folder ``data`` for its own files."""
    (tmp_path / "data").mkdir()
    script = runpy.run_path(str(deploy / "home-assistant/addon/run.py"))
    return lambda pack: script["with_broker"](pack, tmp_path / "data", supervisor, "token")


def test_addon_uses_the_broker_of_home_assistant(with_broker, tmp_path):
    (tmp_path / "pack.toml").write_text(PACK)
    settings = load_settings(with_broker(tmp_path / "pack.toml"))
    assert settings.pack.cell == "chen_mora"
    assert settings.mqtt
    assert (settings.mqtt.urls, settings.mqtt.username) == (("mqtt://core-mosquitto:1883",), "addons")
    assert settings.mqtt.password_file
    assert settings.mqtt.password_file.read_text() == "open-sesame"
    assert settings.mqtt.password_file.stat().st_mode & 0o777 == 0o600


def test_addon_leaves_settings_with_a_broker_unchanged(with_broker, tmp_path):
    pack = tmp_path / "pack.toml"
    pack.write_text(f"{PACK}[mqtt]\n")
    assert with_broker(pack) == pack


def test_addon_has_the_version_of_the_program(deploy):
    config = (deploy / "home-assistant/addon/config.yaml").read_text()
    assert re.search(r'(?m)^version: "(.*)"$', config)[1] == __version__


@pytest.mark.parametrize("file", ["docker/Dockerfile", "home-assistant/addon/Dockerfile"])
def test_images_install_only_known_extras(deploy, file):
    extras = re.search(r"\[([a-z,]+)\]\"", (deploy / file).read_text())[1].split(",")
    project = tomllib.loads((Path(deploy).parent / "pyproject.toml").read_text())["project"]
    assert set(extras) <= set(project["optional-dependencies"])
