"""Service that is started as by systemd: notices to systemd, and cache of compiled kernels."""

import contextlib
import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.command_line import PROGRAM, run
from tests.deploy import kernel_cache
from tests.patience import LONG_S

PACK = '[pack]\ncell = "chen_mora"\n[sensor]\nport = "/dev/bms/absent"\n'


class StartedService:
    """Service that is started as by systemd, with a notify socket and the folders of the unit, but without a home folder.

    Attributes:
        cache: Folder of the compiled kernels.
        state: Folder of the checkpoints.
        process: Process of the service.
    """

    def __init__(self, folder: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(folder / "notify"))
        self._socket.settimeout(LONG_S)
        (folder / "pack.toml").write_text(PACK)
        self.cache, self.state = folder / "cache", folder / "state"
        environment = {
            "PATH": os.environ["PATH"],
            "HOME": "/proc/self/fdinfo",  # not even root can write there
            "NOTIFY_SOCKET": str(folder / "notify"),
            "WATCHDOG_USEC": "1500000",  # 1.5 s
            "NUMBA_CACHE_DIR": str(self.cache),
            "STATE_DIRECTORY": str(self.state),
        }
        self.process = subprocess.Popen(
            [PROGRAM, "run", folder / "pack.toml"],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    def next_notice(self) -> str:
        """Wait for a notice to systemd. Return it."""
        return self._socket.recv(4096).decode()

    def until(self, notice: str) -> None:
        """Wait for a notice, skipping others."""
        deadline = time.monotonic() + LONG_S
        while notice not in self.next_notice().split("\n"):
            assert time.monotonic() < deadline, f"{notice} did not arrive"

    def stop(self) -> tuple[int, str]:
        """Send SIGTERM, as systemd does. Return exit code and log."""
        self.process.send_signal(signal.SIGTERM)
        _, log = self.process.communicate(timeout=LONG_S)
        return self.process.returncode, log

    def close(self) -> None:
        self._socket.close()
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()


@contextlib.contextmanager
def start(folder: Path) -> Iterator[StartedService]:
    (folder / "notify").unlink(missing_ok=True)
    service = StartedService(folder)
    try:
        yield service
    finally:
        service.close()


def compiled_kernels(cache: Path) -> dict[str, int]:
    """Return the modification time of each compiled kernel in the cache [ns]."""
    return {str(path.relative_to(cache)): path.stat().st_mtime_ns for path in cache.rglob("*.nb?")}


def test_systemd_is_notified_of_ready_watchdog_and_stopping(tmp_path):
    kernel_cache.fill(tmp_path / "cache", omitted=None)
    with start(tmp_path) as service:
        assert service.next_notice().startswith("READY=1\n")
        for _ in range(3):
            service.until("WATCHDOG=1")
        code, log = service.stop()
        assert code == 0, log
        service.until("STOPPING=1")
        assert "Traceback" not in log
        assert "/dev/bms/absent" in log


@pytest.mark.thorough
def test_missing_kernel_is_compiled_into_the_cache_once(tmp_path):
    cache = tmp_path / "cache"
    kernel_cache.fill(cache)
    kernels_after_starts = [compiled_kernels(cache)]
    for _ in range(2):
        with start(tmp_path) as service:
            service.until("READY=1")
            assert service.stop()[0] == 0
        kernels_after_starts.append(compiled_kernels(cache))
    before, first, second = kernels_after_starts
    written = {Path(name).name for name, at_ns in first.items() if before.get(name) != at_ns}
    assert written
    assert all(name.startswith(kernel_cache.OMITTED) for name in written)
    assert second == first


def test_wrong_setting_ends_with_code_2_after_which_systemd_does_not_restart(tmp_path, unit_text, capsys):
    (tmp_path / "pack.toml").write_text("[pack]\nseries = 0\n")
    code, _, err = run(capsys, "run", tmp_path / "pack.toml")
    assert (code, "pack.series = 0" in err) == (2, True)
    assert "RestartPreventExitStatus=2\n" in unit_text
