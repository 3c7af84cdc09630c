"""Benchmark of many MQTT sessions with TLS: cost of a session, and time until all are back after the server or the network failed.

``make fleet-sessions`` runs it. The server is ``fleet serve`` with TLS and a tenant, and a worker estimates. Two processes hold the
sessions (``mqtt_session``), each with its own token, connection and pack, and with the timeouts and the backoff of the real edge.
"""

import argparse
import asyncio
import contextlib
import os
import ssl
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bms_estimator.edge import subjects
from bms_estimator.fleet.heartbeat import Heartbeat
from bms_estimator.fleet.nats.connection import close
from bms_estimator.fleet.packs.pack_bucket import write_bucket
from bms_estimator.fleet.packs.pack_row import PackSpec, encode_row
from bms_estimator.fleet.server.jwt_claims import Role
from bms_estimator.service.kernel_warm_up import load_kernels
from tests.benchmarks.fleet.rig import cpu_s, rss_mib
from tests.benchmarks.fleet.serve_process import Server
from tests.benchmarks.fleet.session_process import COUNTS, DELAYS, SessionProcess, Share
from tests.command_line import PROGRAM
from tests.patience import LONG_S

PACK_ROW = encode_row(PackSpec(cell="ncr18650", period_s=1.0))
HANDSHAKES = 200
"""Number of TLS handshakes whose cost is measured."""
POLL_S = 0.05
"""Interval between two checks of the sessions [s]."""
FAILURES = ("timeout", "refused", "no answer")
"""Kinds of failed connection attempts and of lost connections, besides those that the benchmark breaks."""


@dataclass
class Measurement:
    """Server, worker and sessions of a measurement."""

    server: Server
    processes: list[SessionProcess]
    sessions: int
    limit_s: float
    """Maximum time until all sessions are connected [s]."""
    report: Callable[[str, str], None]
    heartbeat: Heartbeat | None = None
    lags_s: list[float] = field(default_factory=list)
    """Largest lag of the worker between two heartbeats [s], of each heartbeat since the last measurement."""
    before: dict[str, int] = field(default_factory=dict)
    """Totals at ``begin_s``."""
    begin_s: float = 0.0
    """Monotonic clock at which the sessions began to connect [s]."""

    def total(self) -> dict[str, int]:
        """Return the totals over all processes."""
        return {name: sum(process.counts[name] for process in self.processes) for name in COUNTS}

    def begin(self, command: str | None = None) -> None:
        """Remember the totals and the time before sessions connect, and send a command that makes them connect."""
        self.before, self.begin_s = self.total(), time.monotonic()
        for process in self.processes if command else ():
            process.command(command)

    async def report_connected(self, name: str, cpu_before_s: float) -> None:
        """Wait until all sessions have connected since ``begin``, and report the time and its cost."""
        elapsed_s, total = await self._until_connected(), self.total()
        reached = (
            f"all {self.sessions:,} in {elapsed_s:.1f} s" if elapsed_s else f"{total['ready']:,} of {self.sessions:,}"
        )
        failures = ", ".join(f"{total[kind] - self.before[kind]:,} {kind}" for kind in FAILURES)
        cpu_time_s = cpu_s(self.server.pid) - cpu_before_s
        self.report(f"{name}: connected", f"{reached}; {failures}; {cpu_time_s:.1f} s CPU of the server")

    async def _until_connected(self) -> float | None:
        """Return the time from ``begin`` until all sessions have connected again [s]; None if it exceeds the limit."""
        connections = self.before["connections"] + self.sessions
        while time.monotonic() < self.begin_s + self.limit_s:
            total = self.total()
            if total["ready"] == self.sessions and total["connections"] >= connections:
                return time.monotonic() - self.begin_s
            await asyncio.sleep(POLL_S)
        return None

    async def measure_steady(self, name: str, seconds: float) -> None:
        """Measure CPU time and latencies for some time without failures."""
        await self._latencies_s()
        pids = [self.server.pid, *(process.pid for process in self.processes)]
        cpu_before_s, begin_s, self.lags_s = [cpu_s(pid) for pid in pids], time.monotonic(), []
        await asyncio.sleep(seconds)
        elapsed_s = time.monotonic() - begin_s
        server, *clients = (cpu_s(pid) - before_s for pid, before_s in zip(pids, cpu_before_s, strict=True))
        if times_s := await self._latencies_s():
            p50, p99, most = np.quantile(times_s, [0.5, 0.99, 1.0])
            self.report(f"{name}: acknowledgment", f"p50 {1e3 * p50:.0f} ms, p99 {1e3 * p99:.0f} ms, max {most:.2f} s")
        if self.lags_s:
            self.report(
                f"{name}: lag of the worker", f"p50 {np.median(self.lags_s):.2f} s, max {max(self.lags_s):.2f} s"
            )
        self.report(f"{name}: cores of server, sessions", f"{server / elapsed_s:.3f}, {sum(clients) / elapsed_s:.3f}")

    async def _latencies_s(self) -> list[float]:
        """Return the acknowledgment times of all processes since the last call [s]."""
        lists = [await asyncio.to_thread(process.latencies_s) for process in self.processes]
        return [time_s for times_s in lists for time_s in times_s]

    async def until_processed(self) -> bool:
        """Send no further blocks, and return True when the worker has processed all of them."""
        self.begin("finish")
        while time.monotonic() < self.begin_s + self.limit_s:
            total = self.total()
            processed = self.heartbeat.counters.get("blocks", 0) if self.heartbeat else 0
            if total["acknowledged"] == total["blocks"] == processed:
                return True
            await asyncio.sleep(POLL_S)
        return False


def main() -> None:
    """Measure, and print one line for each result."""
    arguments = parse_arguments(*sys.argv[1:])
    load_kernels()  # compiled once, not by the worker
    begin_s = time.monotonic()

    def report(name: str, value: str) -> None:
        sys.stdout.write(f"{time.monotonic() - begin_s:6.1f} s  {name:<44}{value}\n")
        sys.stdout.flush()

    asyncio.run(measure(arguments, report))


def parse_arguments(*texts: object) -> argparse.Namespace:
    """Return the options in ``texts``."""
    parser = argparse.ArgumentParser(prog="make fleet-sessions ARGS=...", description=__doc__)
    parser.add_argument("--sessions", type=int, default=10_000)
    parser.add_argument("--processes", type=int, default=2, help="number of processes that hold the sessions")
    parser.add_argument("--partitions", type=int, default=64)
    parser.add_argument("--persistent", action="store_true", help="persistent sessions that subscribe at QoS 1")
    parser.add_argument("--delays", choices=DELAYS, default="edge", help="delays before reconnects")
    parser.add_argument(
        "--attempts",
        type=int,
        default=400,
        help="maximum number of simultaneous connection attempts, because the sessions share the cores with the server",
    )
    parser.add_argument("--connect-s", type=float, default=0.0, help="duration of the first connections [s]")
    parser.add_argument("--steady-s", type=float, default=30.0, help="measured time without failures [s]")
    parser.add_argument("--block-s", type=float, default=60.0, help="interval between two blocks of a session [s]")
    parser.add_argument("--limit-s", type=float, default=60.0, help="maximum time until all are connected [s]")
    return parser.parse_args([str(text) for text in texts])


async def measure(arguments: argparse.Namespace, report: Callable[[str, str], None]) -> bool:
    """Measure first connections, a steady time, a killed server, and lost connections. Return True if no block was lost."""
    with tempfile.TemporaryDirectory() as folder:
        async with _running(Path(folder), arguments, report) as run:
            server = run.server
            await _report_handshakes(server, report)
            memory_mib = rss_mib(server.pid)
            cpu_before_s = cpu_s(server.pid)
            run.begin("start")
            await run.report_connected("first connections", cpu_before_s)
            session_kib = 1024.0 * (rss_mib(server.pid) - memory_mib) / arguments.sessions
            report("memory of the server", f"{rss_mib(server.pid):.0f} MiB, {session_kib:.0f} KiB for each session")
            await run.measure_steady("connected", arguments.steady_s)
            await _report_streams(server, report)

            run.begin()
            server.kill()
            await asyncio.to_thread(server.start)
            report("killed: server ready again after", f"{time.monotonic() - run.begin_s:.1f} s")
            await run.report_connected("killed", 0.0)

            await run.measure_steady("after the kill", arguments.steady_s / 2.0)
            cpu_before_s = cpu_s(server.pid)
            run.begin("drop")
            await run.report_connected("dropped", cpu_before_s)

            complete = await run.until_processed()
            total, counters = run.total(), run.heartbeat.counters if run.heartbeat else {}
            resent = total["sent"] - total["blocks"]
            processed, lost = counters.get("blocks", 0), counters.get("lost_blocks", 0)
            report("blocks made, processed, lost", f"{total['blocks']:,}, {processed:,}, {lost:,}")
            report("blocks resent; requested by workers", f"{resent:,}; {total['requested']:,}")
            load = ", ".join(f"{each:.1f}" for each in os.getloadavg())
            report("load average of 1, 5 and 15 min", load)
            return complete and not lost


@contextlib.asynccontextmanager
async def _running(
    folder: Path, arguments: argparse.Namespace, report: Callable[[str, str], None]
) -> AsyncIterator[Measurement]:
    """Run server, worker and session processes, whose sessions are not connected yet."""
    server = Server(folder, arguments.sessions, arguments.partitions)
    await asyncio.to_thread(server.start)
    packs = [f"p{i}" for i in range(arguments.sessions)]
    with _session_processes(server, packs, arguments) as processes:
        admin = await server.connected(Role.ADMIN)
        await write_bucket(admin, subjects.PACKS_BUCKET, dict.fromkeys(packs, PACK_ROW))
        worker = _start_worker(server, folder)
        try:
            run = Measurement(server, processes, arguments.sessions, arguments.limit_s, report)

            async def record_heartbeat(message: object) -> None:
                run.heartbeat = Heartbeat.model_validate_json(message.data)  # type: ignore[attr-defined]
                if run.heartbeat.lag_s is not None:
                    run.lags_s.append(run.heartbeat.lag_s)

            await admin.subscribe(subjects.worker(), cb=record_heartbeat)
            for process in processes:
                await asyncio.to_thread(process.wait_until_prepared)
            while run.heartbeat is None:  # noqa: ASYNC110 - heartbeats arrive in a callback
                await asyncio.sleep(POLL_S)
            yield run
        finally:
            worker.kill()
            worker.wait(LONG_S)
            await close(admin)
            server.kill()


@contextlib.contextmanager
def _session_processes(
    server: Server, packs: list[str], arguments: argparse.Namespace
) -> Iterator[list[SessionProcess]]:
    count = arguments.processes
    processes = [
        SessionProcess(
            Share(
                packs[i::count],
                server.mqtt_port,
                server.ca,
                server.keys,
                arguments.persistent,
                arguments.block_s,
                arguments.delays,
                arguments.attempts // count,
                arguments.connect_s,
            )
        )
        for i in range(count)
    ]
    try:
        yield processes
    finally:
        for process in processes:
            process.stop()


def _start_worker(server: Server, folder: Path) -> subprocess.Popen[bytes]:
    options = ["--server", server.url, "--creds", server.credentials(Role.WORKER), "--ca", server.ca, "--name", "w"]
    with (folder / "worker.log").open("ab") as log:
        return subprocess.Popen([PROGRAM, "fleet", "worker", *map(str, options)], stdout=log, stderr=log)


async def _report_handshakes(server: Server, report: Callable[[str, str], None]) -> None:
    """Report the CPU time of the server for TLS handshakes of clients that send nothing."""
    context, cpu_before_s = ssl.create_default_context(cafile=server.ca), cpu_s(server.pid)
    for _ in range(HANDSHAKES):
        _, writer = await asyncio.open_connection("127.0.0.1", server.mqtt_port, ssl=context)
        writer.transport.abort()
    cpu_time_ms = 1e3 * (cpu_s(server.pid) - cpu_before_s) / HANDSHAKES
    report("CPU of the server for a TLS handshake", f"{cpu_time_ms:.2f} ms")


async def _report_streams(server: Server, report: Callable[[str, str], None]) -> None:
    """Report what the server stores for the sessions."""
    admin = await server.connected(Role.ADMIN)
    js = admin.jetstream(timeout=LONG_S)
    for name in ("$MQTT_sess", "$MQTT_msgs"):
        state = (await js.stream_info(name)).state
        report(name, f"{state.messages:,} messages, {state.bytes / 1e6:.1f} MB, {state.consumer_count:,} consumers")
    await close(admin)


if __name__ == "__main__":
    main()
