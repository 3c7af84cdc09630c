"""Instance lock: one service for each pack, whatever happens to its folder and whichever users there are."""

import os
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from bms_estimator.model.errors import UserError
from bms_estimator.process.instance_lock import _name, instance_lock

NOBODY = 65534
HOLD_NAME_SCRIPT = """
import os, socket, sys
os.setuid(int(sys.argv[2]))
held = socket.socket(socket.AF_UNIX)
held.bind("\\0" + sys.argv[1])
held.listen(1)
print(flush=True)
sys.stdin.read()
"""
"""Program that binds the socket name of its first argument, as the user of its second, until its input ends."""


def test_second_service_of_a_pack_is_rejected(tmp_path: Path) -> None:
    served = "^pack: this pack is served already, by "
    for _ in range(2):
        with instance_lock(tmp_path, "pack"):
            with pytest.raises(UserError, match=f"{served}process {os.getpid()}$"), instance_lock(tmp_path, "pack"):
                pass
            for _ in range(5):  # the system reports the owner of the name only to the first connections
                with pytest.raises(UserError, match=served), instance_lock(tmp_path, "pack"):
                    pass
    with (
        instance_lock(tmp_path, "pack"),
        instance_lock(tmp_path, "other"),
        instance_lock(tmp_path / "elsewhere", "pack"),
    ):
        pass


def test_starting_service_holds_the_lock_and_an_ended_one_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket(socket.AF_UNIX) as starting:
        starting.bind(_name(tmp_path, "pack"))
        with pytest.raises(UserError, match=r"served already, by another process$"), instance_lock(tmp_path, "pack"):
            pass
        monkeypatch.setattr(time, "sleep", lambda _: starting.close())
        with capture_logs() as lines, instance_lock(tmp_path, "pack"):
            pass
        assert not lines


def test_recreated_folder_admits_no_second_service(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    folder.mkdir()
    (tmp_path / "link").symlink_to(folder)
    with instance_lock(folder, "pack"):
        shutil.rmtree(folder)
        with pytest.raises(UserError, match="served already"), instance_lock(folder, "pack"):
            pass
        folder.mkdir()
        with pytest.raises(UserError, match="served already"), instance_lock(tmp_path / "link", "pack"):
            pass
        assert not list(folder.iterdir())


def test_symlink_in_place_of_a_lock_file_is_ignored(tmp_path: Path) -> None:
    victim, link = tmp_path / "victim", tmp_path / "pack.lock"
    victim.write_text("precious")
    link.symlink_to(victim)
    with instance_lock(tmp_path, "pack"):
        assert victim.read_text() == "precious"
    assert link.is_symlink()
    assert victim.read_text() == "precious"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can start a process of another user")
def test_lock_held_by_another_user_is_ignored(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLD_NAME_SCRIPT, _name(tmp_path, "pack")[1:], str(NOBODY)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe) as stranger:
        assert stranger.stdout
        assert stranger.stdout.readline()
        with capture_logs() as lines, instance_lock(tmp_path, "pack"):
            pass
        assert [line["user"] for line in lines] == [NOBODY]
        os.chown(tmp_path, NOBODY, NOBODY)  # a process of the folder's owner counts as a service
        with pytest.raises(UserError, match=f"by process {stranger.pid}"), instance_lock(tmp_path, "pack"):
            pass
        with pytest.raises(UserError, match="served already"), instance_lock(tmp_path, "pack"):
            pass  # the owner is no longer reported, and the lock then prefers no service to two services
        assert stranger.stdin
        stranger.stdin.close()
