"""Container with a small Debian, booted from this machine's /usr, in which the documented commands install the service."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import uuid
from pathlib import Path

from tests.deploy import kernel_cache

PROJECT = Path(__file__).parents[2]
ROOT_LINKS = {"bin": "usr/bin", "sbin": "usr/sbin", "lib": "usr/lib", "lib64": "usr/lib64"}
OWN_FOLDERS = ("etc/systemd/system/multi-user.target.wants", "etc/udev/rules.d", "opt/bms-estimator/bin", "root/bin")
MOUNT_POINTS = ("usr", "var", "run", "tmp", "proc", "sys", "dev", "home", "opt/python", "opt/packages", "opt/project")
COPIED_FILES = ("passwd", "group", "os-release", "nsswitch.conf")
"""Files of /etc that the container has from this machine."""

PYTHON_COMMAND = f"""#!/bin/sh
export PYTHONPATH=/opt/project:/opt/packages PYTHONDONTWRITEBYTECODE=1 LD_LIBRARY_PATH=/opt/python/lib
exec /opt/python/bin/python{sys.version_info.major}.{sys.version_info.minor} -P -c \\
"""
"""Beginning of a shell script that runs Python code with the packages and the project of this machine."""
PROGRAM = f"""{PYTHON_COMMAND}    'from bms_estimator.cli.main import main; main()' "$@"
"""
"""Program ``bms-estimator`` of the container."""
CLOCK_PROGRAM = f"""{PYTHON_COMMAND}    '
import ctypes
from bms_estimator.process.boot_clock import synchronised
print("clock", ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(512)), synchronised(), flush=True)
'
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
ExecStartPost=/opt/bms-estimator/bin/clock
LoadCredential=mqtt-password:/root/mqtt-password
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
    "apt": "",
    "python3": "",  # the environment exists
    "udevadm": "",  # containers have no udev
    "journalctl": "",  # it would follow the journal without end
}
"""Programs of the documentation page that do nothing here."""


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
        if (Path("/etc") / name).exists():
            shutil.copy(Path("/etc") / name, root / "etc")
    (root / "etc/machine-id").write_text(f"{uuid.uuid4().hex}\n")
    write_program(root / "opt/bms-estimator/bin/bms-estimator", PROGRAM)
    write_program(root / "opt/bms-estimator/bin/clock", CLOCK_PROGRAM)
    write_program(root / "opt/bms-estimator/bin/pip", "#!/bin/sh\n")
    for name, body in REPLACED_PROGRAMS.items():
        write_program(root / "root/bin" / name, f"#!/bin/sh\n{body}\n")
    write_program(root / "root/container-script", Path(__file__).with_name("container_script.sh").read_text())
    for name, port in (("pack", "board"), ("second", "absent")):
        (root / f"root/{name}.toml").write_text(PACK_FILE.format(name=name, port=port))
    # the page asks the user to edit the file of ``config init``; here it is replaced
    edit = "cp /root/pack.toml /root/second.toml /etc/bms-estimator/"
    install = re.sub(r"(?m)^.*config init .*$", rf"\g<0>\n{edit}", commands_of_page("Install"))
    for name, commands in (
        ("install", install),
        ("clock", commands_of_page("Install", block=1)),
        ("uninstall", commands_of_page("Uninstall")),
    ):
        (root / "root" / name).write_text(commands)
    (root / "etc/hosts").write_text("127.0.0.1 localhost\n")
    (root / "root/mqtt-password").write_text(SECRET)
    (root / "root/bms.conf").write_text(BROKER_CONFIG)
    acl = PROJECT / "deploy/mosquitto"
    packs = [(acl / "pack.acl").read_text().replace("PACK", name) for name in ("pack", "second")]
    (root / "root/bms.acl").write_text("".join([(acl / "bms.acl").read_text(), *packs]))
    (root / "root/bms.passwd").touch(mode=0o600)
    system = root / "etc/systemd/system"
    for unit in ("bms-estimator", "bms-estimator@"):
        (system / f"{unit}.service.d").mkdir()
        (system / f"{unit}.service.d/container.conf").write_text(DROP_IN)
    shutil.copy(PROJECT / "deploy/bms-estimator@.service", system)
    shutil.copy(PROJECT / "deploy/bms-estimator@.service.d/pack.conf", system / "bms-estimator@.service.d")
    (system / "container-script.service").write_text(SCRIPT_UNIT)
    state = root / "var/lib/private/bms-estimator"
    for folder in (state.parent, state):
        folder.mkdir(mode=0o700, parents=True)  # mode required by systemd
    # a checkpoint of an earlier version, with the name that the service gives to those of this pack
    shutil.copy(PROJECT / "tests/checkpoint/checkpoint_format_7.npz", state / "pack-5613cbc0.npz")
    private = root / "var/cache/private"
    private.mkdir(mode=0o700, parents=True)  # mode required by systemd
    kernel_cache.fill(private / "bms-estimator", Path("/opt/project/bms_estimator"))
    shutil.copytree(private / "bms-estimator", root / "root/cache")


def write_program(path: Path, text: str) -> None:
    """Write an executable file."""
    path.write_text(text)
    path.chmod(0o755)


def boot(root: Path, systemd_nspawn: str, timeout_s: float) -> str:
    """Boot the container until its script powers it off.

    Returns:
        Report of ``container_script.sh``; the console output if there is none.

    Raises:
        TimeoutError: The container did not end in time. The message has the end of the console output.
    """
    binds = {
        "/usr": "/usr",
        sys.base_prefix: "/opt/python",
        sysconfig.get_path("purelib"): "/opt/packages",
        str(PROJECT): "/opt/project",
    }
    command = [systemd_nspawn, "--quiet", "--register=no", "--keep-unit", "--private-network", f"--directory={root}"]
    command += ["--capability=CAP_SYS_TIME"]  # otherwise the container itself forbids adjtimex
    command += [f"--bind-ro={source}:{target}" for source, target in binds.items()]
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
