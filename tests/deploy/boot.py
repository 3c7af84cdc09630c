"""Container with a small Debian, booted from this machine's /usr, in which the Debian package and its service run."""

import os
import re
import shutil
import subprocess
import uuid
from importlib.metadata import distribution
from pathlib import Path

PROJECT = Path(__file__).parents[2]
ROOT_LINKS = {"bin": "usr/bin", "sbin": "usr/sbin", "lib": "usr/lib", "lib64": "usr/lib64"}
OWN_FOLDERS = ("etc/systemd/system", "etc/udev/rules.d", "root/bin", "root/house", "root/pip", "var/lib/dpkg")
MOUNT_POINTS = ("usr", "run", "tmp", "proc", "sys", "dev", "home", "opt/packages")
COPIED_FILES = ("etc/passwd", "etc/group", "etc/os-release", "etc/nsswitch.conf", "etc/debian_version")
"""Files that the container has from this machine."""
OVERLAYS = ("/usr", "/var/lib/dpkg")
"""Folders of this machine: its programs and the list of its packages. The container's changes to them end with it."""
CLOCK_PROGRAM = """#!/usr/lib/bms-estimator/bin/python3
import ctypes
from bms_estimator.process.boot_timestamp import is_clock_synchronized
print("clock", ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(512)), is_clock_synchronized(), flush=True)
"""
"""Program that prints the clock's state as seen in the service's sandbox."""

PACK_FILE = """
[pack]
name = "{name}"
cell = "chen_mora"
[sensor]
port = "/dev/bms/{port}"
sample_rate_hz = 10
[mqtt]
username = "{name}"
password_file = "mqtt-password"
"""
SECRET = "open-sesame-4711"
"""Password of both packs at the broker."""

DROP_IN = """
[Service]
ExecStartPost=-/opt/clock
WatchdogSec=5
RestartSec=100ms
# The board is on a pseudo-terminal.
DeviceAllow=char-pts rw
"""
"""Drop-in for both units: a short watchdog, and settings for this container."""

BROKER_CONFIG = """
listener 1883 127.0.0.1
user root
password_file /root/bms.passwd
acl_file /root/bms.acl
"""

SCRIPT_UNIT = """
[Unit]
SuccessAction=poweroff-force
FailureAction=poweroff-force

[Service]
Type=oneshot
StandardOutput=append:/root/report
StandardError=append:/root/report
ExecStart=/root/container-script
"""

REPLACED_PROGRAMS = {
    "sudo": 'exec "$@"',
    # the container has no archive of packages; its script sets the link /root/package to the folder of a build
    "apt": 'case $1 in install) exec dpkg -i /root/package/*.deb ;; remove) exec dpkg -r "$2" ;; purge) exec dpkg -P "$2" ;; esac',
}
"""Programs of the documentation page that the container replaces."""


def commands_of_page(section: str, block: int = 0, page: str = "service") -> str:
    """Return a block of commands (indented lines) from a section of a page of docs/pack. ``block`` is its index."""
    text = (PROJECT / f"docs/pack/{page}.md").read_text()
    inside = re.split(rf"(?m)^##+ {section}\n", text)[1].split("\n##")[0]
    return [part for part in re.findall(r"(?:(?:^    .*)?\n)+", inside, re.MULTILINE) if part.strip()][block]


def make_root(root: Path) -> None:
    """Create the container's own files. All programs are mounted read-only from this machine."""
    root.mkdir(exist_ok=True)
    root.chmod(0o755)  # the container's root folder must be readable by all users
    for folder in (*OWN_FOLDERS, *MOUNT_POINTS):
        (root / folder).mkdir(parents=True, exist_ok=True)
    for name, target in ROOT_LINKS.items():
        (root / name).symlink_to(target)
    for name in COPIED_FILES:
        if (Path("/") / name).exists():
            shutil.copy(Path("/") / name, root / name)
    (root / "etc/machine-id").write_text(f"{uuid.uuid4().hex}\n")
    (root / "etc/hosts").write_text("127.0.0.1 localhost\n")
    for name, body in REPLACED_PROGRAMS.items():
        write_program(root / "root/bin" / name, f"#!/bin/sh\n{body}\n")
    write_program(root / "opt/clock", CLOCK_PROGRAM)
    write_program(root / "root/container-script", Path(__file__).with_name("container_script.sh").read_text())
    (root / "root/house/pack.toml").write_text(PACK_FILE.format(name="pack", port="board"))
    (root / "root/house/mqtt-password").write_text(SECRET)
    (root / "root/house/mqtt-password").chmod(0o600)
    (root / "root/second.toml").write_text(PACK_FILE.format(name="second", port="absent"))
    for name, section, block in (
        ("install", "Install", 0),
        ("remove", "Uninstall", 0),
        ("purge", "Uninstall", 1),
    ):
        (root / "root" / name).write_text(commands_of_page(section, block).lstrip("\n"))
    shutil.copytree(Path(str(distribution("pip").locate_file("pip"))), root / "root/pip/pip")
    (root / "root/bms.conf").write_text(BROKER_CONFIG)
    acl = PROJECT / "deploy/mosquitto"
    packs = [(acl / "pack.acl").read_text().replace("PACK", name) for name in ("pack", "second")]
    (root / "root/bms.acl").write_text("".join([(acl / "bms.acl").read_text(), *packs]))
    (root / "root/bms.passwd").touch(mode=0o600)
    system = root / "etc/systemd/system"
    for unit in ("bms-estimator", "bms-estimator@"):
        (system / f"{unit}.service.d").mkdir()
        (system / f"{unit}.service.d/container.conf").write_text(DROP_IN)
    (system / "container-script.service").write_text(SCRIPT_UNIT)
    state = root / "var/lib/bms-estimator"
    state.mkdir()
    # a checkpoint of an earlier version, with the name that the service gives to those of this pack
    shutil.copy(PROJECT / "tests/checkpoint/checkpoint_format_7.npz", state / "pack-5613cbc0.npz")


def write_program(path: Path, text: str) -> None:
    """Write an executable file."""
    path.write_text(text)
    path.chmod(0o755)


def boot(root: Path, packages: Path, systemd_nspawn: str, timeout_s: float) -> str:
    """Boot the container until its script powers it off.

    Args:
        root: Root folder of ``make_root``.
        packages: Folder with two builds of the program, each with a Debian package and a wheel: ``current``, and ``next``
            of a higher version.
        systemd_nspawn: Path of this program.
        timeout_s: Maximum duration [s].

    Returns:
        Report of ``container_script.sh``; the console output if there is none.

    Raises:
        TimeoutError: The container did not end in time. The message has the end of the console output.
    """
    command = [systemd_nspawn, "--quiet", "--register=no", "--keep-unit", "--private-network", f"--directory={root}"]
    command += ["--capability=CAP_SYS_TIME"]  # otherwise the container itself forbids adjtimex
    command += [f"--bind-ro={packages}:/opt/packages", *(f"--overlay={folder}::{folder}" for folder in OVERLAYS)]
    command += ["--boot", "systemd.unit=container-script.service", "systemd.mask=systemd-networkd.service"]
    environment = {"PATH": os.environ["PATH"], "SYSTEMD_SECCOMP": os.environ.get("SYSTEMD_SECCOMP", "1")}
    try:
        done = subprocess.run(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise TimeoutError(f"{error.stdout!r}"[-2000:]) from None
    report = root / "root/report"
    return report.read_text() if report.exists() else done.stdout + done.stderr
