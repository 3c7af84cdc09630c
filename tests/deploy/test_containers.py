"""Files of the Docker image and of the Home Assistant add-on."""

import asyncio
import importlib.util
import json
import os
import re
import threading
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import aiohttp
import pytest

from bms_estimator.settings.pack import load_settings
from tests.command_line import PROGRAM
from tests.free_port import free_port
from tests.patience import LONG_S

BROKER = {"host": "core-mosquitto", "port": 1883, "ssl": False, "username": "addons", "password": "open-sesame"}
"""Broker as the Supervisor describes it to add-ons."""
PROJECT = Path(__file__).parents[2]
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
def addon(deploy, tmp_path, supervisor, monkeypatch):
    """Return the add-on's script, with folders, Supervisor and ports of this test."""
    spec = importlib.util.spec_from_file_location("addon_run", deploy / "home-assistant/addon/run.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    places = {"SETTINGS": tmp_path / "config", "DATA": tmp_path / "data", "SUPERVISOR": supervisor}
    for name, value in (places | {"PAGE_ADDRESS": f"127.0.0.1:{free_port()}", "INGRESS_PORT": free_port()}).items():
        monkeypatch.setattr(script, name, value)
    for folder in ("config", "data"):
        (tmp_path / folder).mkdir()
    (tmp_path / "data/options.json").write_text('{"pack_file": "pack.toml"}')
    monkeypatch.setenv("SUPERVISOR_TOKEN", "token")
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    monkeypatch.setenv("PATH", f"{PROGRAM.parent}:{os.environ['PATH']}")
    return script


def test_addon_uses_the_broker_of_home_assistant(addon, tmp_path):
    pack = tmp_path / "pack.toml"
    pack.write_text(PACK)
    settings = load_settings(addon.complete_settings(pack, addon.DATA, addon.SUPERVISOR, "token"))
    assert settings.pack.cell == "chen_mora"
    assert settings.mqtt
    assert (settings.mqtt.urls, settings.mqtt.username) == (("mqtt://core-mosquitto:1883",), "addons")
    assert settings.mqtt.password_file
    assert settings.mqtt.password_file.read_text() == "open-sesame"
    assert settings.mqtt.password_file.stat().st_mode & 0o777 == 0o600


def test_addon_keeps_the_broker_of_the_settings(addon, tmp_path):
    pack = tmp_path / "pack.toml"
    pack.write_text(f'{PACK}[mqtt]\nurl = "mqtt://elsewhere"\n')
    settings = load_settings(addon.complete_settings(pack, addon.DATA, "http://127.0.0.1:1", "token"))
    assert settings.mqtt.urls == ("mqtt://elsewhere",)


async def test_ingress_shows_the_setup_and_then_the_pack(addon, monkeypatch):
    monkeypatch.setattr(addon, "INGRESS_PEER", "127.0.0.1")
    ended = asyncio.create_task(addon.main())
    prefix = "/api/hassio_ingress/abc"
    async with aiohttp.ClientSession(
        f"http://127.0.0.1:{addon.INGRESS_PORT}", headers={"X-Ingress-Path": prefix}
    ) as browser:

        async def text_of(path: str) -> str:
            with suppress(aiohttp.ClientConnectorError):
                async with browser.get(path) as response:
                    if response.status == 200:
                        assert "frame-ancestors 'self'" in response.headers["Content-Security-Policy"]
                        return await response.text()
            return ""

        async def page_has(part: str) -> str:
            async with asyncio.timeout(LONG_S):
                while part not in (text := await text_of("/")):  # noqa: ASYNC110 - another process
                    await asyncio.sleep(0.05)
            return text

        setup = await page_has("Set up a pack")
        key = re.search(r'name="(\w+)" value="(\w+)"', setup)
        async with browser.post("/search", data={key[1]: key[2]}, allow_redirects=False) as response:
            assert (response.status, response.headers["Location"]) == (303, f"{prefix}/")
        assert "name at least one place" in await text_of("/")
        (addon.SETTINGS / "pack.toml").write_text(f'{PACK}[sensor]\nport = "/dev/none"\n')
        await page_has("page.js")
        async with browser.get("/events") as events:
            assert await events.content.readline() == b"retry: 1000\n"
    assert not ended.done()
    ended.cancel()
    with suppress(asyncio.CancelledError):
        await ended


async def test_ingress_rejects_other_clients(addon):
    url = f"http://127.0.0.1:{addon.INGRESS_PORT}/"
    async with (
        addon.ingress(addon.PAGE_ADDRESS, "token", "172.30.32.2", addon.INGRESS_PORT),
        aiohttp.ClientSession() as other,
        other.get(url) as response,
    ):
        assert response.status == 403


@pytest.mark.parametrize("static", ["page/static", "setup/page"])
def test_the_pages_work_below_any_path(static):
    folder = PROJECT / "bms_estimator" / static
    texts = [file.read_text() for file in folder.rglob("*") if file.suffix in {".html", ".js", ".py"}]
    assert not [
        link for text in texts for link in re.findall(r'(?:href|src|action)="/|(?:fetch|EventSource)\([`"]/', text)
    ]


@pytest.mark.parametrize("file", ["docker/Dockerfile", "home-assistant/addon/Dockerfile"])
def test_images_install_only_known_extras(deploy, file):
    extras = re.search(r"\[([a-z,]+)\]\"", (deploy / file).read_text())[1].split(",")
    project = tomllib.loads((Path(deploy).parent / "pyproject.toml").read_text())["project"]
    assert set(extras) <= set(project["optional-dependencies"])
