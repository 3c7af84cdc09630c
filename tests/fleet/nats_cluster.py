"""Real nats-server for tests with the configuration of ``fleet serve``: one node, or a cluster of three."""

import contextlib
import json
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import nats
from nats.aio.client import Client

from bms_estimator.fleet.server.nats_config import Accounts, Cluster, Node, Tls, configuration
from tests.free_port import free_port
from tests.patience import LONG_S

BINARY = Path(sys.executable).parent / "nats-server"


class NatsCluster:
    """Cluster of nats-servers, whose nodes are numbered from 0.

    Args:
        folder: Folder of the nodes' files. Existing streams in it are restored.
        nodes: Number of nodes, 1 or 3.
        partitions: Number of partitions of the fleet.
        accounts: Accounts of the tenants; None: clients need no credentials.
        tls: Certificates of the server; None: no TLS.
        disk_bytes: Disk space of each node [bytes].
    """

    def __init__(
        self,
        folder: Path,
        nodes: int = 1,
        *,
        partitions: int = 64,
        accounts: Accounts | None = None,
        tls: Tls | None = None,
        disk_bytes: int = 100 << 30,
    ) -> None:
        routes = tuple(f"127.0.0.1:{free_port()}" for _ in range(nodes))
        self._folder = folder
        self.nodes = [
            Node(
                name=f"n{i}",
                store=folder / f"n{i}",
                nats=f"127.0.0.1:{free_port()}",
                mqtt=f"127.0.0.1:{free_port()}",
                monitor=f"127.0.0.1:{free_port()}",
                cluster=Cluster(routes[i], routes) if nodes > 1 else None,
                tls=tls,
                accounts=accounts,
                partitions=partitions,
                disk_bytes=disk_bytes,
                memory_bytes=1 << 30,
            )
            for i in range(nodes)
        ]
        self._processes: list[subprocess.Popen[bytes] | None] = [None] * nodes

    @property
    def url(self) -> str:
        """URL of the first node."""
        return self.urls[0]

    @property
    def urls(self) -> list[str]:
        """URLs of all nodes."""
        return [f"nats://{node.nats}" for node in self.nodes]

    @property
    def mqtt_port(self) -> int:
        """MQTT port of the first node."""
        return self.mqtt_ports[0]

    @property
    def mqtt_ports(self) -> list[int]:
        """MQTT ports of all nodes."""
        return [int(node.mqtt.rpartition(":")[2]) for node in self.nodes]

    def pid(self, i: int) -> int:
        """Return the process id of node ``i``."""
        process = self._processes[i]
        assert process
        return process.pid

    def start(self, i: int, *, wait: bool = True, prefix: Sequence[str] = ()) -> None:
        """Start node ``i`` with its stored streams; return when it is ready, or at once if not ``wait``.

        Args:
            i: Number of the node.
            wait: True: wait until the node is ready.
            prefix: Command that runs the program, with its arguments.
        """
        self.conf(i).write_text(configuration(self.nodes[i]))
        with self.log(i).open("ab") as log:
            self._processes[i] = subprocess.Popen([*prefix, BINARY, "-c", self.conf(i)], stderr=log)
        if wait:
            self.wait_ready(i)

    def kill(self, i: int) -> None:
        """Kill node ``i`` by SIGKILL, if it runs."""
        process, self._processes[i] = self._processes[i], None
        if process is not None:
            process.kill()
            process.wait(LONG_S)

    def accounts_changed(self, accounts: Accounts) -> None:
        """Set other claims, which take effect at the next start or reload."""
        self.nodes = [replace(node, accounts=accounts) for node in self.nodes]

    def conf(self, i: int) -> Path:
        """Return the path of node ``i``'s configuration."""
        return self._folder / f"n{i}.conf"

    def log(self, i: int) -> Path:
        """Return the path of node ``i``'s log."""
        return self._folder / f"n{i}.log"

    def wait_ready(self, i: int) -> None:
        """Wait until the streams of node ``i`` are available and up to date."""
        deadline = time.monotonic() + LONG_S
        while not self._is_ready(i):
            process = self._processes[i]
            assert process, f"node {i} does not run"
            assert process.poll() is None, f"node {i} has ended: {self.log(i).read_text()[-2000:]}"
            assert time.monotonic() < deadline, f"node {i} does not start: {self.log(i).read_text()[-2000:]}"
            time.sleep(0.02)

    def leader(self, stream: str, account: str = "") -> int:
        """Return the number of the node that leads a stream, or -1 without a leader. An empty ``account`` is any account."""
        for i, process in enumerate(self._processes):
            if process is None:
                continue
            with contextlib.suppress(OSError):
                for account_details in self.ask(i, "jsz?accounts=true&streams=true").get("account_details", []):
                    for details in account_details.get("stream_detail", []):
                        if details["name"] == stream and account in ("", account_details["name"]):
                            leader = details.get("cluster", {}).get("leader", "n0" if len(self.nodes) == 1 else "")
                            if leader:
                                return int(leader[1:])  # the nodes are named n0, n1, n2
        return -1

    def ask(self, i: int, request: str) -> Any:
        """Return the response of node ``i``'s monitor to a request such as ``varz``."""
        with urllib.request.urlopen(f"http://{self.nodes[i].monitor}/{request}", timeout=LONG_S) as answer:
            return json.load(answer)

    def _is_ready(self, i: int) -> bool:
        with contextlib.suppress(OSError):
            is_healthy = self.ask(i, "healthz")["status"] == "ok"
            # a cluster accepts no requests for streams before it has elected a leader
            return is_healthy and (len(self.nodes) == 1 or "leader" in self.ask(i, "jsz")["meta_cluster"])
        return False


async def connected(urls: str | list[str]) -> Client:
    """Return a connection that reconnects without limit and notices a silent break within seconds."""

    async def ignore(_error: Exception) -> None:
        """Ignore an error, because the tests kill servers."""

    return await nats.connect(
        urls, max_reconnect_attempts=-1, reconnect_time_wait=0.1, ping_interval=2, error_cb=ignore
    )


@contextlib.contextmanager
def running(folder: Path, nodes: int = 1, **more: Any) -> Iterator[NatsCluster]:
    """Run a cluster whose nodes are ready; they are killed at the end.

    Args:
        folder: Folder of the nodes' files.
        nodes: Number of nodes, 1 or 3.
        more: Further arguments of ``NatsCluster``.
    """
    cluster = NatsCluster(folder, nodes, **more)
    try:
        for i in range(nodes):
            cluster.start(i, wait=False)
        for i in range(nodes):
            cluster.wait_ready(i)
        yield cluster
    finally:
        for i in range(nodes):
            cluster.kill(i)
