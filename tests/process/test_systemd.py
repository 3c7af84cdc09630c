"""Notify messages of a process with several packs."""

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from bms_estimator.process.systemd import SystemdNotifier


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.setblocking(False)
        yield systemd


def heard(systemd: socket.socket) -> list[str]:
    states = []
    while True:
        try:
            states.append(systemd.recv(4096).decode())
        except BlockingIOError:
            return states


def test_several_packs_are_ready_with_the_last_and_alive_only_while_each_is(
    tmp_path: Path, systemd: socket.socket
) -> None:
    notifier = SystemdNotifier(["a", "b"], {"NOTIFY_SOCKET": str(tmp_path / "notify")})
    notifier.ready("a")
    assert heard(systemd) == []
    notifier.ready("b")
    assert heard(systemd) == ["READY=1\nSTATUS=estimating a, b"]
    for pack in "aaab":
        notifier.alive(pack)
    notifier.alive("b")
    assert heard(systemd) == ["WATCHDOG=1"]
    notifier.alive("a")
    assert heard(systemd) == ["WATCHDOG=1"]


def test_a_watchdog_that_waits_for_another_process_is_not_ours() -> None:
    ours = {"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": str(os.getpid())}
    assert SystemdNotifier(["a"], ours).watchdog_s == 3.0
    assert SystemdNotifier(["a"], ours | {"WATCHDOG_PID": "1"}).watchdog_s == 0.0
