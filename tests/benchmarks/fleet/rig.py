"""Fleet of processes on the loopback interface for benchmarks: server, workers and simulated edge devices."""

import contextlib
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import psutil
from nats.aio.client import Client

from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.simulation.simulated_fleet import SimulatedFleet
from tests.command_line import PROGRAM
from tests.fleet.nats_cluster import NatsCluster, connected, running
from tests.patience import LONG_S


class Rig:
    """Processes of one fleet.

    Args:
        folder: Folder of all files, with a log file of each process.
        engine: Server with running nodes.
    """

    def __init__(self, folder: Path, engine: NatsCluster) -> None:
        self.folder, self.engine = folder, engine
        self.server = ",".join(engine.urls)
        self._mqtt = ",".join(f"mqtt://127.0.0.1:{port}" for port in engine.mqtt_ports)
        self.workers: dict[str, subprocess.Popen[bytes]] = {}
        self._started_workers = 0

    def start_worker(self, *, checkpoint_s: float) -> str:
        """Start a worker under a new name, and return the name."""
        self._started_workers += 1
        name = f"w{self._started_workers}"
        arguments = ["--server", self.server, "--name", name, "--checkpoint-s", str(checkpoint_s)]
        self.workers[name] = self.run("worker", *arguments, log=name)
        return name

    def start_fits(self) -> str:
        """Start ``fleet fit``, and return the name of the process, which ends with the workers."""
        self.workers["fit"] = self.run("fit", "--server", self.server, log="fit")
        return "fit"

    def stop_workers(self) -> None:
        """Stop the workers by SIGTERM, so that each writes its checkpoints."""
        for process in self.workers.values():
            process.send_signal(signal.SIGTERM)
        for process in self.workers.values():
            process.wait(LONG_S)
        self.workers.clear()

    def load(self, fleet: SimulatedFleet) -> None:
        """Load the table of packs."""
        table = self.folder / "packs.csv"
        table.write_text(fleet.table())
        process = self.run("packs", "load", str(table), "--server", self.server, log="load")
        if process.wait(10 * LONG_S):
            raise RuntimeError((self.folder / "load.log").read_text())

    def simulate(
        self, packs: int, *, seed: int, begin: str, speed: float, blocks: int | None = None
    ) -> subprocess.Popen[bytes]:
        """Start the simulated edges of a fleet, each for a number of blocks or until stopped."""
        arguments = ["--packs", packs, "--seed", seed, "--begin", begin, "--speed", speed]
        arguments += ["--blocks", blocks] if blocks else []
        return self.run("simulate", "--mqtt", self._mqtt, *map(str, arguments), log="edges")

    def run(self, *arguments: str, log: str) -> subprocess.Popen[bytes]:
        """Start a subcommand of ``bms-estimator fleet``; its output goes to ``log``."""
        with (self.folder / f"{log}.log").open("ab") as file:
            return subprocess.Popen([PROGRAM, "fleet", *arguments], stdout=file, stderr=file)

    def end(self) -> None:
        """Kill all processes."""
        for process in self.workers.values():
            process.kill()
            process.wait(LONG_S)

    async def connected(self) -> Client:
        """Connect to any live node, and reconnect when it disappears."""
        return await connected(self.engine.urls)


@contextlib.contextmanager
def rig(folder: Path, nodes: int, *, partitions: int) -> Iterator[Rig]:
    """Run a server of ``nodes`` nodes without workers, and yield its rig."""
    with running(folder, nodes, partitions=partitions) as engine:
        fleet_rig = Rig(folder, engine)
        try:
            yield fleet_rig
        finally:
            fleet_rig.end()


async def create_streams(rig: Rig, *, partitions: int) -> None:
    """Create the streams, with a replica on each node."""
    nc = await rig.connected()
    await make_streams(nc, partitions=partitions, replicas=len(rig.engine.nodes))
    await nc.close()


def cpu_s(pid: int) -> float:
    """Return the CPU time of a process and of its children [s]."""
    process = psutil.Process(pid)
    times = [each.cpu_times() for each in (process, *process.children(recursive=True))]
    return sum(each.user + each.system for each in times)


def rss_mib(pid: int) -> float:
    """Return the resident memory of a process [MiB]."""
    return float(psutil.Process(pid).memory_info().rss / 2**20)
