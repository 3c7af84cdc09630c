"""Notifications to systemd from a process that serves several packs."""

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from bms_estimator.process.systemd import SystemdNotifier, extend_start


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[socket.socket]:
    """Return a socket that receives the notifications, in place of systemd's."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.setblocking(False)
        yield systemd


def receive_states(systemd: socket.socket) -> list[str]:
    """Return the notifications that have arrived."""
    states = []
    while True:
        try:
            states.append(systemd.recv(4096).decode())
        except BlockingIOError:
            return states


def test_process_is_ready_with_its_last_pack_and_alive_after_a_report_of_each_pack(
    tmp_path: Path, systemd: socket.socket
) -> None:
    notifier = SystemdNotifier(["a", "b"], {"NOTIFY_SOCKET": str(tmp_path / "notify")})
    notifier.ready("a")
    assert receive_states(systemd) == []
    notifier.ready("b")
    assert receive_states(systemd) == ["READY=1\nSTATUS=estimating a, b"]
    for pack in "aaab":
        notifier.alive(pack)
    notifier.alive("b")
    assert receive_states(systemd) == ["WATCHDOG=1"]
    notifier.alive("a")
    assert receive_states(systemd) == ["WATCHDOG=1"]


def test_watchdog_of_another_process_is_ignored() -> None:
    environment = {"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": str(os.getpid())}
    assert SystemdNotifier(["a"], environment).watchdog_s == 3.0
    assert SystemdNotifier(["a"], environment | {"WATCHDOG_PID": "1"}).watchdog_s == 0.0


def test_a_long_start_extends_its_timeout(
    tmp_path: Path, systemd: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    extend_start("compiling kernels: 3 of 9")
    assert receive_states(systemd) == ["EXTEND_TIMEOUT_USEC=120000000\nSTATUS=compiling kernels: 3 of 9"]
