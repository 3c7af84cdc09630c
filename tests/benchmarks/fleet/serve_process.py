"""``fleet serve`` with TLS and one tenant, which can be killed and started again."""

import contextlib
import os
import signal
import subprocess
from pathlib import Path

import psutil
from nats.aio.client import Client

from bms_estimator.fleet.nats.connection import connect
from bms_estimator.fleet.server import credentials
from bms_estimator.fleet.server.jwt_claims import Role
from tests.command_line import PROGRAM
from tests.fleet.tenant import NAME
from tests.free_port import free_port
from tests.mqtt.certificates import Authority
from tests.patience import LONG_S


class Server:
    """``fleet serve`` with TLS and one tenant.

    Args:
        folder: Folder of all files.
        packs: Number of packs.
        partitions: Number of partitions.
    """

    def __init__(self, folder: Path, packs: int, partitions: int) -> None:
        self._folder, self.state = folder, folder / "state"
        authority = Authority(folder)
        certificate, key = authority.sign("node")
        self.ca = authority.certificate
        self.port, self.mqtt_port = free_port(), free_port()
        self._settings = folder / "fleet.toml"
        self._settings.write_text(f"""
[server]
listen = "127.0.0.1:{self.port}"
mqtt = "127.0.0.1:{self.mqtt_port}"
monitor = "127.0.0.1:{free_port()}"
partitions = {partitions}
packs = {packs}
outage_days = 0.05
[tls]
cert_file = "{certificate}"
key_file = "{key}"
[tenants.{NAME}]
""")
        self._process: subprocess.Popen[str] | None = None

    @property
    def url(self) -> str:
        """URL for workers."""
        return f"tls://127.0.0.1:{self.port}"

    @property
    def keys(self) -> Path:
        """Folder of the keys."""
        return self.state / "keys"

    @property
    def pid(self) -> int:
        """Process id of nats-server."""
        assert self._process
        return psutil.Process(self._process.pid).children()[0].pid

    def start(self) -> None:
        """Start, and return when the streams are ready."""
        with (self._folder / "serve.log").open("a") as log:
            self._process = subprocess.Popen(
                [PROGRAM, "fleet", "serve", self._settings, "--folder", self.state],
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        assert self._process.stdout
        if not any("streams ready" in line for line in self._process.stdout):
            raise RuntimeError((self._folder / "serve.log").read_text()[-2000:])

    def kill(self) -> None:
        """Kill nats-server by SIGKILL; ``fleet serve`` then ends."""
        if self._process is None:
            return
        with contextlib.suppress(IndexError, psutil.NoSuchProcess):
            os.kill(self.pid, signal.SIGKILL)
        self._process.wait(LONG_S)
        assert self._process.stdout
        self._process.stdout.close()
        self._process = None

    async def connected(self, role: Role) -> Client:
        """Return a connection of a program, which reconnects."""
        return await connect(self.url, "benchmark", creds=self.credentials(role), ca=self.ca)

    def credentials(self, role: Role) -> Path:
        """Return the credentials file of a program."""
        return credentials.credentials_file(self.keys, NAME, role)
