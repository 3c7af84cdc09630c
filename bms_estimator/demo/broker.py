"""MQTT broker of the demo: a nats-server on loopback without passwords. Its data are deleted when it ends."""

import asyncio
import contextlib
import errno
import json
import socket
import tempfile
from pathlib import Path
from typing import Self

from bms_estimator.model.errors import UserError
from bms_estimator.process.child_process import ends_with_us
from bms_estimator.process.nats_server_program import find_server

MQTT_PORT = 1883
"""Default port of MQTT clients."""
LOOPBACK = "127.0.0.1"
POLL_S = 0.02
"""Interval at which the server's start is checked [s]."""
START_S = 60.0
"""Timeout of the server's start [s]. It is long because the machine may be busy."""


class DemoBroker:
    """Broker on loopback; a context manager.

    Args:
        port: TCP port; None: 1883 if it is free, otherwise any free port.

    Raises:
        UserError: The requested port is in use, or nats-server is missing.
    """

    def __init__(self, port: int | None = None) -> None:
        self.port = choose_port(port, MQTT_PORT)
        self._server = find_server()
        self._stack = contextlib.AsyncExitStack()

    @property
    def url(self) -> str:
        """Address for ``mqtt.url``."""
        return f"mqtt://{LOOPBACK}:{self.port}"

    @property
    def subscribe_command(self) -> str:
        """Command that shows all topics in a second terminal."""
        port = "" if self.port == MQTT_PORT else f" -p {self.port}"
        return f"mosquitto_sub{port} -t 'bms/#' -v"

    async def __aenter__(self) -> Self:
        """Start the server.

        Raises:
            UserError: The server does not start.
        """
        async with contextlib.AsyncExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bms-estimator-demo-")))
            await self._start(folder, stack)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *_: object) -> None:
        """End the server, which first sends pending messages to its clients."""
        await self._stack.aclose()

    async def _start(self, folder: Path, stack: contextlib.AsyncExitStack) -> None:
        config, log = folder / "nats.conf", folder / "log"
        config.write_text(_configuration(folder / "streams", self.port))
        process = await asyncio.create_subprocess_exec(
            *(self._server, "-c", config, "-l", log, "--ports_file_dir", folder),
            preexec_fn=ends_with_us(),
            start_new_session=True,  # Ctrl-C in the terminal must end the service before its broker
        )
        stack.push_async_callback(_terminate, process)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(START_S):
                while not _listens(folder) and process.returncode is None:  # noqa: ASYNC110 - the server reports its start only by a file
                    await asyncio.sleep(POLL_S)
        if not _listens(folder):
            reason = log.read_text(errors="replace").strip() if log.exists() else ""
            raise UserError(f"the demo's broker {self._server} does not start: {reason or 'it wrote no log'}")


def _listens(folder: Path) -> bool:
    """Return True once the server has written its ports file, which it does when it listens on all ports."""
    return any(folder.glob("*.ports"))


async def _terminate(process: asyncio.subprocess.Process) -> None:
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    await process.wait()


def _configuration(folder: Path, mqtt_port: int) -> str:
    """Return the server's settings. Its port for NATS clients is unused. The port number -1 selects any free port."""
    return f"""
server_name: demo
listen: "{LOOPBACK}:-1"
jetstream {{ store_dir: {json.dumps(str(folder))} }}
mqtt {{ listen: "{LOOPBACK}:{mqtt_port}" }}
"""


def choose_port(port: int | None, default_port: int) -> int:
    """Return the port to listen on: the requested port; without one, the default port or any free port.

    Raises:
        UserError: The requested port is in use.
    """
    if port is not None:
        if not _is_free(port):
            raise UserError(f"port {port}: taken by another program; leave --port out to have a free one chosen")
        return port
    return default_port if _is_free(default_port) else _any_free_port()


def _is_free(port: int) -> bool:
    """Return True if the port is free."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port with old connections in TIME_WAIT is free
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            if error.errno in (errno.EADDRINUSE, errno.EACCES):  # EACCES: a privileged port
                return False
            raise
    return True


def _any_free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])
