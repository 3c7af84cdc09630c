"""Service as a process: signals, kills, last wills at the broker, full and hanging disks, and signals at the start."""

import asyncio
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from asyncio.subprocess import Process
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest

from bms_estimator.checkpoint.run_file import RunFile
from bms_estimator.process.state_folder import instance_lock
from tests.command_line import PROGRAM, run, running_program
from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S
from tests.serial_line import Line


def pack_file(folder: Path, line: Line, broker: Broker, name: str = "pack", state: str = "") -> Path:
    """Write a pack file. ``state`` is its section ``[state]``, or others. Return its path."""
    path = folder / f"{name}.toml"
    path.write_text(
        f"""
[pack]
name = "{name}"
cell = "chen_mora"
initial_soc = 0.5
[sensor]
port = "{line.path}"
protocol = "text"
baud = 115200
[publish]
rate_hz = 10
[mqtt]
url = "{broker.url}"
{state}
"""
    )
    return path


HUNG_DISK = """
import os, threading
hangs = threading.Event()
os.fsync = lambda _: hangs.wait()
from bms_estimator.cli.main import main
from bms_estimator.service import checkpoint_writer
checkpoint_writer.DISK_HUNG_S = checkpoint_writer.FINAL_SAVE_TIMEOUT_S = 0.1
main()
"""
"""Program whose fsync never returns."""


DEFAULT_HANGUP = """
import signal
signal.signal(signal.SIGHUP, signal.SIG_DFL)
from bms_estimator.cli.main import main
main()
"""
"""Program with the default action of SIGHUP. Under nohup it would inherit from the tests that SIGHUP is ignored."""


ACKNOWLEDGED_DURING_IMPORT = """
import os, signal, sys
from bms_estimator.cli.main import main
class Acknowledge:
    def find_spec(self, name, *_):
        if name == "bms_estimator.cli.live.run":
            os.kill(os.getpid(), signal.SIGUSR1)
sys.meta_path.insert(0, Acknowledge())
main()
"""
"""Program that receives SIGUSR1 while it imports the module of ``run``."""


SIGNAL_DURING_START = """
import os, signal
from bms_estimator.cli.live import run
from bms_estimator.cli.main import main
def load_kernels():
    os.kill(os.getpid(), signal.SIGTERM)
    while True:
        signal.pause()
run.load_kernels = load_kernels
main()
"""
"""Program that gets SIGTERM while it loads its kernels."""


def service(
    *packs: Path, stderr: int | IO[str] = asyncio.subprocess.PIPE, program: Sequence[str] = (str(PROGRAM),)
) -> contextlib.AbstractAsyncContextManager[Process]:
    """Run a service as a process, which is killed at the end. ``program`` replaces ``bms-estimator``."""
    return running_program(*program, "run", *packs, stdout=asyncio.subprocess.DEVNULL, stderr=stderr)


def checkpoints(state_home: Path) -> list[Path]:
    """Return the checkpoints in the default state folder."""
    return [path for path in (state_home / "bms-estimator").glob("*.npz") if ".load" not in path.suffixes]


async def stop_service(process: Process, signal_number: signal.Signals = signal.SIGTERM) -> list[Any]:
    """Stop the service by a signal. Return the decoded lines of its log."""
    process.send_signal(signal_number)
    assert process.stderr
    log = await asyncio.wait_for(process.stderr.read(), LONG_S)
    assert await asyncio.wait_for(process.wait(), LONG_S) == 0, log
    return [json.loads(line) for line in log.decode().splitlines()]  # a pipe gets JSON


async def print_samples(line: Line) -> None:
    """Print lines like a board at 50 Hz. Lines are lost while the line is full, as with a board."""
    with contextlib.suppress(OSError):  # not opened yet
        line.received()  # from now on, writing to a full line fails instead of blocking
    while True:
        with contextlib.suppress(BlockingIOError):
            line.write(b"3.80,0.10,25.0\r\n")
        await asyncio.sleep(0.02)


async def test_a_killed_service_goes_offline_by_its_last_will_and_a_stopped_one_by_its_own_message(
    tmp_path: Path, line: Line, broker: Broker, state_home: Path
) -> None:
    line.plug()
    board = asyncio.create_task(print_samples(line))
    pack = pack_file(tmp_path, line, broker)
    async with Listener(broker) as live:
        async with service(pack) as process:
            state = await live.wait_json("bms/pack/state", lambda s: s["frames_received"] > 10)
            assert state["voltage_v"] == pytest.approx(3.8)
            assert state["temperature_c"] == pytest.approx(25.0)
            process.kill()
            await live.wait("bms/pack/availability", lambda p: p == b"offline")
        before = len(live.messages)
        async with service(pack) as process:
            await live.wait("bms/pack/state", skip=before)
            lines = await stop_service(process, signal.SIGINT)
        await live.wait("bms/pack/availability", lambda p: p == b"offline", skip=before)
    board.cancel()
    (checkpoint,) = checkpoints(state_home)  # no folder is configured
    # only the owner may access the folder and its files
    assert {path.stat().st_mode & 0o077 for path in (checkpoint.parent, *checkpoint.parent.iterdir())} == {0}
    assert str(checkpoint) in {line.get("file") for line in lines}


@pytest.mark.thorough
async def test_a_full_disk_does_not_end_the_service(
    tmp_path: Path, line: Line, broker: Broker, full_disk: Path
) -> None:
    """Neither checkpoints nor the log can be written, and the estimates continue."""
    line.plug()
    board = asyncio.create_task(print_samples(line))
    pack = pack_file(tmp_path, line, broker, state=f'[state]\nfolder = "{full_disk}"\ncheckpoint_s = 1\n')
    async with Listener(broker) as live:
        with (full_disk / "log").open("w") as log:
            async with service(pack, stderr=log) as process:
                checkpoint_status = "cannot be saved: [Errno 28] No space left on device"
                await live.wait_json("bms/pack/health", lambda h: h["checkpoint"] == checkpoint_status)
                before = len(live.messages)
                state = await live.wait_json("bms/pack/state", skip=before)
                frames = state["frames_received"] + 20
                await live.wait_json("bms/pack/state", lambda s: s["frames_received"] > frames, skip=before)
                process.send_signal(signal.SIGTERM)
                assert await asyncio.wait_for(process.wait(), LONG_S) == 0
    board.cancel()


@contextlib.contextmanager
def unread_pipe() -> Iterator[int]:
    """Yield the write end of a pipe that is full and is not read."""
    read, write = os.pipe()
    os.set_blocking(write, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(write, bytes(4096))
    os.set_blocking(write, True)
    try:
        yield write
    finally:
        os.close(read)
        os.close(write)


@pytest.mark.thorough
async def test_a_stopping_service_saves_its_checkpoint_although_its_broker_hangs(
    tmp_path: Path, line: Line, broker: Broker, state_home: Path
) -> None:
    line.plug()
    board = asyncio.create_task(print_samples(line))
    async with Listener(broker) as live, service(pack_file(tmp_path, line, broker)) as process:
        state = await live.wait_json("bms/pack/state", lambda s: s["frames_received"] > 50)
        broker.freeze()
        await stop_service(process)
        messages_before = len(live.messages)
        broker.thaw()
        await live.wait("bms/pack/availability", lambda payload: payload == b"offline", skip=messages_before)
    board.cancel()
    (checkpoint,) = checkpoints(state_home)
    assert b'"clean": true' in checkpoint.with_name("pack.run").read_bytes()
    with np.load(checkpoint) as saved:
        assert saved["state"]["observer"]["samples"][0] >= state["frames_received"]
    assert RunFile(checkpoint.parent, "pack", time.time).load().counters.total.crashes == 0


@pytest.mark.thorough
async def test_a_hanging_disk_and_an_unread_log_delay_neither_estimates_nor_shutdown(
    tmp_path: Path, line: Line, broker: Broker
) -> None:
    """The log is not read, as if it were on the hanging disk, too."""
    line.plug()
    board = asyncio.create_task(print_samples(line))
    program, pack = [sys.executable, "-c", HUNG_DISK], pack_file(tmp_path, line, broker)
    with unread_pipe() as log:
        async with Listener(broker) as live, service(pack, program=program, stderr=log) as process:
            await live.wait_json("bms/pack/health", lambda h: h["checkpoint"] == "not saved: the disk hangs")
            await live.wait_json("bms/pack/state", skip=len(live.messages))
            process.send_signal(signal.SIGTERM)
            await live.wait("bms/pack/availability", lambda p: p == b"offline")
            assert await asyncio.wait_for(process.wait(), LONG_S) == 0
    board.cancel()


@pytest.mark.thorough
async def test_a_hangup_ends_the_service_cleanly(tmp_path: Path, line: Line, broker: Broker) -> None:
    pack, program = pack_file(tmp_path, line, broker, "house"), [sys.executable, "-c", DEFAULT_HANGUP]
    async with Listener(broker) as live, service(pack, program=program) as process:
        await live.wait("bms/house/health")
        process.send_signal(signal.SIGHUP)
        await live.wait("bms/house/availability", lambda payload: payload == b"offline")
        assert await asyncio.wait_for(process.wait(), LONG_S) == 0


async def test_a_service_that_is_still_starting_ends_cleanly_on_a_signal(
    tmp_path: Path, line: Line, broker: Broker
) -> None:
    program = [sys.executable, "-c", SIGNAL_DURING_START]
    async with service(pack_file(tmp_path, line, broker), program=program) as process:
        assert process.stderr
        log = (await asyncio.wait_for(process.stderr.read(), LONG_S)).decode()
        assert await process.wait() == 0
    assert json.loads(log)["event"] == "asked to end before samples were taken"


def test_an_acknowledgement_by_signal_does_not_end_a_service_that_is_still_imported(tmp_path: Path) -> None:
    command = [sys.executable, "-c", ACKNOWLEDGED_DURING_IMPORT, "run", tmp_path / "missing.toml"]
    process = subprocess.run(command, capture_output=True, text=True, timeout=LONG_S, check=False)
    assert (process.returncode, process.stderr.count("missing.toml: cannot be read")) == (2, 1), process.stderr


def test_a_full_disk_at_the_start_gives_an_exit_code_after_which_systemd_restarts_the_service(
    tmp_path: Path, line: Line, broker: Broker, disk_without_files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = disk_without_files / "state"
    code, _, err = run(capsys, "run", pack_file(tmp_path, line, broker, state=f'[state]\nfolder = "{folder}"'))
    assert code == 1  # systemd does not restart the service after exit code 2
    assert err == f"error: state.folder = {folder}: No space left on device\n"


def test_a_state_folder_that_cannot_be_created_yet_gives_exit_code_75(
    tmp_path: Path, line: Line, broker: Broker, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mount").touch()
    folder = tmp_path / "mount" / "state"
    pack = pack_file(tmp_path, line, broker, state=f'[state]\nfolder = "{folder}"')
    other = pack_file(tmp_path, Line(tmp_path / "other board"), broker, "other")
    for packs in ((pack,), (pack, other)):
        code, _, err = run(capsys, "run", *packs)
        assert code == os.EX_TEMPFAIL, "systemd does not restart the service after exit code 2"
        assert f"state.folder = {folder}: Not a directory\n" in err


def test_a_password_file_that_cannot_be_read_yet_gives_exit_code_75(
    tmp_path: Path, line: Line, broker: Broker, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = tmp_path / "not mounted" / "password"
    pack = pack_file(tmp_path, line, broker, state=f'username = "meter"\npassword_file = "{missing}"')
    code, _, err = run(capsys, "run", pack)
    assert code == os.EX_TEMPFAIL
    assert err.endswith(f"error: mqtt.password_file = {missing}: cannot be read: No such file or directory\n")


def test_a_pack_that_another_process_serves_gives_exit_code_75(
    tmp_path: Path, line: Line, broker: Broker, state_home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (state_home / "bms-estimator").mkdir(parents=True)
    with instance_lock(state_home / "bms-estimator", "pack"):
        code, _, err = run(capsys, "run", pack_file(tmp_path, line, broker))
    assert code == os.EX_TEMPFAIL
    assert err.endswith(f"error: pack: this pack is served already, by process {os.getpid()}; stop it first\n")


@pytest.mark.thorough
async def test_an_occupied_address_for_prometheus_ends_no_pack(
    tmp_path: Path, line: Line, broker: Broker, state_home: Path
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as occupant:
        section = f'[prometheus]\nlisten = "127.0.0.1:{occupant.getsockname()[1]}"'
        shed = pack_file(tmp_path, Line(tmp_path / "other board"), broker, "shed")
        packs = [pack_file(tmp_path, line, broker, "house", section), shed]
        async with Listener(broker) as live, service(*packs) as process:
            for name in ("house", "shed"):
                await live.wait(f"bms/{name}/health")
            lines = await stop_service(process)
    assert [each["pack"] for each in lines if each.get("service") == "metrics"] == ["house"]


async def test_two_packs_in_one_process_have_boards_topics_log_lines_and_checkpoints_of_their_own(
    tmp_path: Path, line: Line, broker: Broker, state_home: Path
) -> None:
    other = Line(tmp_path / "other board")
    packs = [pack_file(tmp_path, line, broker, "house"), pack_file(tmp_path, other, broker, "shed")]
    line.plug()
    boards = [asyncio.create_task(print_samples(line))]
    async with Listener(broker) as live, service(*packs) as process:
        house = await live.wait_json("bms/house/health", lambda h: h["sensor_online"])
        shed = await live.wait_json("bms/shed/health", lambda h: "does not exist" in (h["sensor_message"] or ""))
        assert house["samples"]["samples"] > 0 == shed["samples"]["samples"]
        other.plug()
        boards.append(asyncio.create_task(print_samples(other)))
        await live.wait_json("bms/shed/state")
        lines = await stop_service(process)
        for name in ("house", "shed"):
            await live.wait(f"bms/{name}/availability", lambda p: p == b"offline")
    for board in boards:
        board.cancel()
    other.unplug()
    assert {line.get("pack") for line in lines} == {"house", "shed"}
    assert {line["pack"] for line in lines if str(other.path) in line.get("reason", "")} == {"shed"}
    assert {path.name.split("-")[0] for path in checkpoints(state_home)} == {"house", "shed"}
