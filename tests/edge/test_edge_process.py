"""Process of command ``edge``: kill, clean shutdown, and imports without kernels."""

import asyncio
import contextlib
import itertools
import json
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from bms_estimator.edge.block_sender import BlockSender
from bms_estimator.model.cell import load_cell
from bms_estimator.service.pack_service import run_pack_service
from bms_estimator.settings.connections import EdgeSettings
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.health import sample_counters
from tests.command_line import PROGRAM, error, run, running_program
from tests.fleet.nats_cluster import NatsCluster, running
from tests.fleet.receiver import Receiver
from tests.patience import LONG_S, until
from tests.serial_line import Line


@pytest.fixture(scope="module")
def engine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NatsCluster]:
    with running(tmp_path_factory.mktemp("engine"), partitions=4) as engine:
        yield engine


class Board:
    """Board that prints a line every 10 ms, with a higher voltage each time."""

    def __init__(self, line: Line) -> None:
        self._line, self._numbers = line, itertools.count(1)

    async def print_lines(self) -> None:
        with contextlib.suppress(OSError):
            self._line.received()  # makes the line non-blocking, so that write raises while no process reads it
        while True:
            with contextlib.suppress(BlockingIOError):
                self._line.write(b"%.4f,0.10,25.0\r\n" % (3.0 + 1e-4 * next(self._numbers)))
            await asyncio.sleep(0.01)


def write_pack_file(folder: Path, line: Line, mqtt_port: int) -> Path:
    """Write the settings of an edge that reads the serial line, and return their path."""
    path = folder / "pack.toml"
    path.write_text(f"""
[pack]
name = "pack"
[sensor]
port = "{line.path}"
protocol = "text"
[edge]
url = "mqtt://127.0.0.1:{mqtt_port}"
block_s = 1.0
""")
    return path


async def test_edge_sends_no_block_twice_after_a_kill_and_ends_cleanly_on_sigterm(
    tmp_path: Path, line: Line, engine: NatsCluster
) -> None:
    line.plug()
    pack, log_file = write_pack_file(tmp_path, line, engine.mqtt_port), tmp_path / "log"
    board = asyncio.create_task(Board(line).print_lines())
    async with Receiver(engine.url, "pack") as receiver:
        with log_file.open("wb") as log:
            async with running_program(PROGRAM, "edge", pack, stdout=asyncio.subprocess.DEVNULL, stderr=log) as process:
                await receiver.wait_for_samples(1)
                process.kill()
            first_log_size = log_file.stat().st_size
            async with running_program(
                sys.executable, "-X", "importtime", PROGRAM, "edge", pack, stdout=asyncio.subprocess.DEVNULL, stderr=log
            ) as process:
                # blocks of the first process may still arrive while the second process imports its modules
                await until(lambda: b"store of blocks" in log_file.read_bytes()[first_log_size:])
                await receiver.wait_for_samples(sum(block.samples.size for block in receiver.blocks) + 1)
                process.send_signal(signal.SIGTERM)
                assert await asyncio.wait_for(process.wait(), LONG_S) == 0
        board.cancel()
        lines = log_file.read_text().splitlines()
        store = next(json.loads(each) for each in reversed(lines) if "store of blocks" in each)
        voltages = receiver.samples["voltage_v"].tolist()
    assert voltages == sorted(set(voltages))
    assert (receiver.samples["time_s"][1:] >= receiver.samples["time_s"][:-1]).all()
    assert [block.number for block in receiver.blocks] == list(range(1, len(receiver.blocks) + 1))
    assert {block.store_created_ns for block in receiver.blocks} == {store["made_s"] * 10**9}
    imported = {each.rpartition("|")[2].strip() for each in lines if each.startswith("import time:")}
    assert "bms_estimator.edge.block_sender" in imported
    assert not [name for name in imported if name.split(".")[0] in ("numba", "scipy") or ".kernels" in name]


async def test_run_with_an_edge_sends_all_samples_that_it_estimates_from_or_drops(
    tmp_path: Path, line: Line, engine: NatsCluster
) -> None:
    line.plug()
    board, stop = asyncio.create_task(Board(line).print_lines()), asyncio.Event()
    edge = {"url": f"mqtt://127.0.0.1:{engine.mqtt_port}", "block_s": 1.0}
    settings = Settings.model_validate(
        {"pack": {"name": "both"}, "sensor": {"port": str(line.path), "protocol": "text"}, "edge": edge}
    )
    async with Receiver(engine.url, "both") as receiver:
        service = asyncio.create_task(run_pack_service(settings, load_cell("chen_mora"), stop=stop, folder=tmp_path))
        await receiver.wait_for_samples(1)
        stop.set()
        estimator = await asyncio.wait_for(service, LONG_S)
        counters = sample_counters(estimator.state[0])
        samples = counters["samples"] + sum(n for name, n in counters.items() if name.startswith("dropped_"))
        # on a busy machine the service may end before it has sent all blocks
        async with BlockSender(EdgeSettings.model_validate(edge), "both", tmp_path):
            await receiver.wait_for_samples(samples)
        assert receiver.samples.size == samples
    board.cancel()


def test_edge_without_a_server_url_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "pack.toml"
    path.write_text("[pack]\n")
    err = error(run(capsys, "edge", path))
    assert 'edge: missing: where samples are sent, as in [edge] with url = "mqtt://host:port"' in err


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ('url = "http://a"', "edge.url = 'http://a': must be mqtt://host:port"),
        ("block_s = 0", "edge.block_s = 0: must be greater than or equal to 1"),
        ('key_file = "a"', "edge.key_file = a: of no use without edge.cert_file"),
    ],
)
def test_error_reports_the_invalid_edge_setting(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], table: str, message: str
) -> None:
    path = tmp_path / "pack.toml"
    path.write_text(f'[sensor]\nport = "/dev/none"\n[edge]\n{table}\n')
    assert message in error(run(capsys, "edge", path))


def test_config_check_reads_the_password_file_of_the_server(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, password_file = tmp_path / "pack.toml", tmp_path / "password"
    path.write_text(f'[edge]\nusername = "a"\npassword_file = "{password_file}"\n')
    code, _, err = run(capsys, "config", "check", path)
    assert code == 75
    assert err == f"error: edge.password_file = {password_file}: cannot be read: No such file or directory\n"
    password_file.write_text("secret")
    password_file.chmod(0o644)
    code, _, err = run(capsys, "config", "check", path)
    assert code == 0
    assert f"edge.password_file = {password_file}: every user of this machine may read it" in err
