"""Start the add-on: the setup page until there are settings, then the service. Home Assistant's ingress shows their pages."""

import asyncio
import contextlib
import json
import os
import secrets
import signal
import sys
import urllib.request
from pathlib import Path

import aiohttp
import tomlkit
from aiohttp import web

SETTINGS = Path("/config")
"""Folder of the add-on's settings, which the user can edit."""
DATA = Path("/data")
"""Folder of the add-on's own files."""
SUPERVISOR = "http://supervisor"
INGRESS_PEER = "172.30.32.2"
"""Address of Home Assistant's ingress, which has authenticated the user."""
INGRESS_PORT = 8099
"""Port of ``config.yaml``."""
PAGE_ADDRESS = "127.0.0.1:8765"
"""Address of setup page and live page in the container."""
TIMEOUT_S = 10.0
"""Timeout of a request to the Supervisor [s]."""
POLL_S = 1.0
"""Interval between two checks whether the setup has written the settings [s]."""
STARTING = '<!doctype html><meta http-equiv="refresh" content="2"><p>Starting...</p>'
"""Page while the program does not listen yet."""
NOT_FORWARDED = {"connection", "content-length", "host", "keep-alive", "transfer-encoding"}
"""Hop-by-hop headers, which are not forwarded, in lower case."""


def broker_of_home_assistant(supervisor: str, token: str) -> dict[str, object]:
    """Return host, port, username, password and use of TLS of the broker that Home Assistant offers to add-ons."""
    request = urllib.request.Request(f"{supervisor}/services/mqtt", headers={"Authorization": f"Bearer {token}"})
    with urllib.request.urlopen(request, timeout=TIMEOUT_S) as response:
        return dict(json.load(response)["data"])


def complete_settings(pack: Path, data: Path, supervisor: str, token: str) -> Path:
    """Return a copy of the user's settings file, with Home Assistant's broker and the page where they are not set.

    Args:
        pack: The user's settings file.
        data: Folder for the copy and for the broker's password.
        supervisor: URL of the Supervisor.
        token: Token for the Supervisor.
    """
    settings = tomlkit.parse(pack.read_text(encoding="utf-8"))
    settings["page"] = {"listen": PAGE_ADDRESS, "token_file": str(page_token(data))}
    if "mqtt" not in settings:
        broker = broker_of_home_assistant(supervisor, token)
        settings["mqtt"] = {
            "url": f"{'mqtts' if broker.get('ssl') else 'mqtt'}://{broker['host']}:{broker['port']}",
            "username": broker["username"],
            "password_file": str(private_file(data / "mqtt-password", str(broker["password"]))),
        }
    completed = data / pack.name
    completed.write_text(tomlkit.dumps(settings), encoding="utf-8")
    return completed


def page_token(data: Path) -> Path:
    """Return the file with the token of the page, which only the ingress knows."""
    file = data / "page-token"
    return file if file.exists() else private_file(file, secrets.token_hex(16))


def private_file(file: Path, text: str) -> Path:
    """Write a file that only this user can read; return it."""
    file.touch(mode=0o600)
    file.write_text(text, encoding="utf-8")
    return file


@contextlib.asynccontextmanager
async def ingress(page: str, token: str, peer: str, port: int):  # noqa: ANN201 - an iterator of nothing
    """Serve the page at the address ``page`` to Home Assistant's ingress."""
    async with aiohttp.ClientSession(
        auto_decompress=False, timeout=aiohttp.ClientTimeout(total=None, connect=TIMEOUT_S)
    ) as session:

        async def forward(request: web.Request) -> web.StreamResponse:
            if request.remote != peer:
                raise web.HTTPForbidden
            headers = {name: value for name, value in request.headers.items() if name.lower() not in NOT_FORWARDED}
            headers["Authorization"] = f"Bearer {token}"
            url, body = f"http://{page}{request.path_qs}", await request.read()
            try:
                sent = session.request(request.method, url, headers=headers, data=body, allow_redirects=False)
                async with sent as answer:
                    return await forward_answer(request, answer)
            except aiohttp.ClientConnectorError:
                return web.Response(status=503, text=STARTING, content_type="text/html")

        app = web.Application()
        app.router.add_route("*", "/{path:.*}", forward)
        runner = web.AppRunner(app, access_log=None)
        await runner.setup()
        await web.TCPSite(runner, port=port).start()
        try:
            yield
        finally:
            await runner.cleanup()


async def forward_answer(request: web.Request, answer: aiohttp.ClientResponse) -> web.StreamResponse:
    """Forward the page's response as it arrives. A redirect stays below the path of the ingress."""
    response = web.StreamResponse(status=answer.status)
    for name, value in answer.headers.items():
        if name.lower() not in NOT_FORWARDED:
            response.headers[name] = value
    response.headers["X-Frame-Options"] = "SAMEORIGIN"
    policy = answer.headers.get("Content-Security-Policy", "")
    response.headers["Content-Security-Policy"] = policy.replace("frame-ancestors 'none'", "frame-ancestors 'self'")
    if answer.headers.get("Location", "").startswith("/"):
        response.headers["Location"] = request.headers.get("X-Ingress-Path", "") + answer.headers["Location"]
    with contextlib.suppress(ConnectionResetError):  # the browser has left the page
        await response.prepare(request)
        async for part in answer.content.iter_any():
            await response.write(part)
        await response.write_eof()
    return response


async def run_program(*arguments: str, until: Path | None = None) -> int:
    """Run bms-estimator; end it by SIGTERM of the Supervisor, or when the file ``until`` exists. Return its exit code."""
    child = await asyncio.create_subprocess_exec("bms-estimator", *arguments)
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, child.terminate)
    try:
        while until and child.returncode is None and not until.exists():  # noqa: ASYNC240 - a local file
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(child.wait(), POLL_S)
        if until is None:
            await child.wait()
    finally:
        if child.returncode is None:
            child.terminate()
        code = await child.wait()
    return code


async def main() -> int:
    """Run the setup page until there are settings, then the service."""
    options = json.loads((DATA / "options.json").read_text(encoding="utf-8"))
    pack, token_file = SETTINGS / options["pack_file"], page_token(DATA)
    async with ingress(PAGE_ADDRESS, token_file.read_text(encoding="utf-8"), INGRESS_PEER, INGRESS_PORT):
        if not pack.exists():
            setup = ("setup", str(pack), "--listen", PAGE_ADDRESS, "--token-file", str(token_file), "--no-browser")
            code = await run_program(*setup, until=pack)
            if not pack.exists():
                return code
        try:
            completed = complete_settings(pack, DATA, SUPERVISOR, os.environ["SUPERVISOR_TOKEN"])
        except OSError as error:
            sys.exit(
                f"Home Assistant offers no MQTT broker ({error}): install the add-on Mosquitto broker, or set [mqtt]"
            )
        return await run_program("run", "--no-view", str(completed))


if __name__ == "__main__":
    sys.exit(asyncio.run(main()))
