"""A small Debian that boots in a container from this machine's own /usr, with the service in it."""

import os
import shutil
import subprocess
import sys
import sysconfig
import uuid
from pathlib import Path

from tests.deploy import kernel_cache

PROJECT = Path(__file__).parents[2]
LINKS = {"bin": "usr/bin", "sbin": "usr/sbin", "lib": "usr/lib", "lib64": "usr/lib64"}
FOLDERS = ("etc/bms-estimator", "etc/systemd/system/multi-user.target.wants", "opt/bms-estimator/bin")
EMPTY = ("usr", "var", "run", "tmp", "proc", "sys", "dev", "root", "home", "opt/python", "opt/packages", "opt/project")
ACCOUNTS = ("passwd", "group", "os-release", "nsswitch.conf")

PROGRAM = f"""#!/bin/sh
export PYTHONPATH=/opt/project:/opt/packages PYTHONDONTWRITEBYTECODE=1 LD_LIBRARY_PATH=/opt/python/lib
exec /opt/python/bin/python{sys.version_info.major}.{sys.version_info.minor} -P -c \\
    'from bms_estimator.cli import main; main()' "$@"
"""

PACK = """
[pack]
name = "boot"
cell = "chen_mora"

[sensor]
port = "/dev/bms/absent"
"""

CLOCK = """
[Service]
ExecStartPost=/opt/bms-estimator/bin/clock
"""
"""What the service's own confinement lets it see of the clock."""

READ_CLOCK = f"""#!/bin/sh
export LD_LIBRARY_PATH=/opt/python/lib
exec /opt/python/bin/python{sys.version_info.major}.{sys.version_info.minor} -c \\
    'import ctypes; print("adjtimex", ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(512)), flush=True)'
"""

JUDGE = """
[Unit]
Wants=bms-estimator.service
After=bms-estimator.service
SuccessAction=poweroff-force
FailureAction=poweroff-force

[Service]
Type=oneshot
StandardOutput=append:/root/report
StandardError=append:/root/report
ExecStart=sh -c 'for n in $(seq 60); do ls /var/cache/private/bms-estimator/*/* >/dev/null 2>&1 && break; sleep 0.1; done'
ExecStart=systemctl show bms-estimator -p ActiveState,SubState,NRestarts,Result,WatchdogUSec,StatusText,MainPID,User
ExecStart=-sh -c 'grep -E "^(Uid|NoNewPrivs|Seccomp|CapEff):" /proc/$(systemctl show bms-estimator -P MainPID)/status'
ExecStart=-sh -c 'xargs -0 -n1 echo </proc/$(systemctl show bms-estimator -P MainPID)/environ | grep BMS_BOOT_ID'
ExecStart=find /var/cache/private/bms-estimator -name "*.nbi" -printf "cached %%f\\n"
ExecStart=-systemctl restart bms-estimator
ExecStart=-systemctl start bms-estimator@second
ExecStart=systemctl show bms-estimator@second -p StatusText
ExecStart=-sh -c 'ls /var/lib/private/bms-estimator; ls -d /var/cache/private/bms-estimator/* | wc -l'
ExecStart=-systemctl stop bms-estimator@second
ExecStart=systemctl show bms-estimator -p ActiveEnterTimestampMonotonic,InactiveExitTimestampMonotonic
ExecStart=systemctl stop bms-estimator
ExecStart=systemctl show bms-estimator -p Result
ExecStart=journalctl --no-pager -o cat -u bms-estimator
"""


def make_root(root: Path) -> None:
    """Lay out the container's own files; all programs come from this machine, read only."""
    root.mkdir(exist_ok=True)
    root.chmod(0o755)  # "/" of everyone in there
    for folder in (*FOLDERS, *EMPTY):
        (root / folder).mkdir(parents=True, exist_ok=True)
    for name, target in LINKS.items():
        (root / name).symlink_to(target)
    for name in ACCOUNTS:
        if (Path("/etc") / name).exists():
            shutil.copy(Path("/etc") / name, root / "etc")
    (root / "etc/machine-id").write_text(f"{uuid.uuid4().hex}\n")
    program = root / "opt/bms-estimator/bin/bms-estimator"
    program.write_text(PROGRAM)
    program.chmod(0o755)
    (root / "opt/bms-estimator/bin/clock").write_text(READ_CLOCK)
    (root / "opt/bms-estimator/bin/clock").chmod(0o755)
    for name in ("pack", "second"):
        (root / f"etc/bms-estimator/{name}.toml").write_text(PACK.replace("boot", name))
    shutil.copytree(PROJECT / "deploy", root / "etc/systemd/system", dirs_exist_ok=True)
    (root / "etc/systemd/system/bms-estimator.service.d").mkdir()
    (root / "etc/systemd/system/bms-estimator.service.d/clock.conf").write_text(CLOCK)
    (root / "etc/systemd/system/judge.service").write_text(JUDGE)
    private = root / "var/cache/private"
    private.mkdir(mode=0o700, parents=True)  # as systemd wants it
    kernel_cache.fill(private / "bms-estimator", Path("/opt/project/bms_estimator"))


def boot(root: Path, systemd_nspawn: str, timeout_s: float) -> str:
    """Boot until the judge switches off. Returns its report.

    Raises:
        TimeoutError: It did not end in time; the message holds what the console said.
    """
    binds = {
        "/usr": "/usr",
        sys.base_prefix: "/opt/python",
        sysconfig.get_path("purelib"): "/opt/packages",
        str(PROJECT): "/opt/project",
    }
    command = [systemd_nspawn, "--quiet", "--register=no", "--keep-unit", "--private-network", f"--directory={root}"]
    command += ["--capability=CAP_SYS_TIME"]  # else the container itself forbids adjtimex
    command += [f"--bind-ro={source}:{target}" for source, target in binds.items()]
    command += ["--boot", "systemd.unit=judge.service", "systemd.mask=systemd-networkd.service"]
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
