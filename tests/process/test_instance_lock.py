"""Instance lock: only one service runs for each pack, even if its folder is deleted or another user holds the lock."""

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
from bms_estimator.process.state_folder import _socket_name, instance_lock

NOBODY = 65534
"""User and group id of ``nobody``, who may not write to the folders of the tests."""
HOLD_LOCK_SCRIPT = """
import os, socket, sys
os.setuid(int(sys.argv[2]))
held = socket.socket(socket.AF_UNIX)
held.bind("\\0" + sys.argv[1])
held.listen(1)
print(flush=True)
sys.stdin.read()
"""
"""Program that holds a lock until its stdin ends. Arguments: name of the lock, user id."""


def test_second_service_of_a_pack_is_rejected_but_not_of_another_name_or_folder(tmp_path: Path) -> None:
    served = "^pack: this pack is served already, by "
    for _ in range(2):  # a released lock can be taken again
        with instance_lock(tmp_path, "pack"):
            with (
                pytest.raises(UserError, match=f"{served}process {os.getpid()}; stop it first$"),
                instance_lock(tmp_path, "pack"),
            ):
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


def test_service_that_does_not_listen_yet_holds_the_lock_until_it_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket(socket.AF_UNIX) as starting:
        starting.bind(_socket_name(tmp_path, "pack"))  # without listen, as in a process that is just starting
        with (
            pytest.raises(UserError, match=r"served already, by another process; stop it first$"),
            instance_lock(tmp_path, "pack"),
        ):
            pass
        # the starting process ends while the lock waits between two attempts
        monkeypatch.setattr(time, "sleep", lambda _: starting.close())
        with capture_logs() as lines, instance_lock(tmp_path, "pack"):
            pass
        assert not lines


def test_second_service_is_rejected_after_its_folder_was_deleted_or_recreated(tmp_path: Path) -> None:
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
def test_lock_held_by_a_user_who_may_not_write_to_the_folder_is_ignored(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLD_LOCK_SCRIPT, _socket_name(tmp_path, "pack").lstrip("\0"), str(NOBODY)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe) as holder:
        assert holder.stdout
        assert holder.stdout.readline()
        with capture_logs() as lines, instance_lock(tmp_path, "pack"):
            pass
        assert [line["user"] for line in lines] == [NOBODY]
        os.chown(tmp_path, NOBODY, NOBODY)  # a process of the folder's owner counts as a service
        with pytest.raises(UserError, match=f"by process {holder.pid}"), instance_lock(tmp_path, "pack"):
            pass
        with pytest.raises(UserError, match="served already"), instance_lock(tmp_path, "pack"):
            pass  # the holder's user is reported only to the first client; a holder of unknown user counts as a service
        assert holder.stdin
        holder.stdin.close()
