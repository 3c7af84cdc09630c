"""A real NATS server on free ports on loopback, alone or three in a cluster, with its MQTT side as broker."""

import contextlib
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import pytest

from tests.free_port import free_port
from tests.patience import LONG_S

NATS = shutil.which("nats-server", path="/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin")
STREAM = "$MQTT_msgs"
"""Stream in which NATS keeps messages of QoS 1 until all have them."""


class Node:
    """One server; ``kill`` is SIGKILL.

    Args:
        folder: For its files.
        name: In the cluster.
        routes: Cluster ports of all; empty: it is alone.
        route: Its own.
    """

    def __init__(self, folder: Path, name: str, routes: tuple[int, ...] = (), route: int = 0) -> None:
        self.name, self.port, self._http = name, free_port(), free_port()
        self._folder = folder / name
        self._folder.mkdir()
        others = ", ".join(f'"nats://127.0.0.1:{port}"' for port in routes)
        cluster = f"cluster {{ name: bms, listen: 127.0.0.1:{route}, routes: [{others}] }}" if routes else ""
        (self._folder / "nats.conf").write_text(f"""
server_name: {name}
listen: 127.0.0.1:{free_port()}
http: 127.0.0.1:{self._http}
jetstream {{ store_dir: "{self._folder}" }}
mqtt {{ listen: 127.0.0.1:{self.port} }}
{cluster}
""")
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def url(self) -> str:
        return f"mqtt://127.0.0.1:{self.port}"

    def start(self) -> Self:
        assert NATS
        self._process = subprocess.Popen(
            [NATS, "-c", str(self._folder / "nats.conf"), "-l", str(self._folder / "log")], stderr=subprocess.DEVNULL
        )
        return self

    @property
    def is_ready(self) -> bool:
        """Return whether streams can be used."""
        with contextlib.suppress(OSError):
            return self.ask("healthz")["status"] == "ok" and "leader" in self.ask("jsz").get("meta_cluster", {"leader"})
        return False

    def ask(self, what: str) -> Any:
        with urllib.request.urlopen(f"http://127.0.0.1:{self._http}/{what}", timeout=LONG_S) as answer:
            return json.load(answer)

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait(LONG_S)
            self._process = None


def leader(nodes: list[Node]) -> str:
    """Name of the node that leads the stream of MQTT messages; empty where none does."""
    account = nodes[0].ask("jsz?accounts=true&streams=true")["account_details"][0]
    streams = {stream["name"]: stream["cluster"] for stream in account["stream_detail"]}
    return str(streams.get(STREAM, {}).get("leader", ""))


@contextlib.contextmanager
def running(nodes: list[Node]) -> Iterator[list[Node]]:
    """The nodes, ready."""
    try:
        for node in nodes:
            node.start()
        deadline = time.monotonic() + LONG_S
        while not all(node.is_ready for node in nodes):
            assert time.monotonic() < deadline, "nats-server did not start"
            time.sleep(0.05)
        yield nodes
    finally:
        for node in nodes:
            node.kill()


def alone(folder: Path) -> list[Node]:
    """One node."""
    return [Node(folder, "n1")]


def three(folder: Path) -> list[Node]:
    """A cluster of three."""
    routes = tuple(free_port() for _ in range(3))
    return [Node(folder, f"n{i + 1}", routes, route) for i, route in enumerate(routes)]


def skip_without_nats() -> None:
    if NATS is None:
        pytest.skip("nats-server is not installed (apt-get install nats-server)")
