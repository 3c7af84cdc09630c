"""Start of the service by a real systemd while the file system of its state cannot be mounted."""

import re

import pytest

from bms_estimator.installation import paths
from bms_estimator.installation.install import FILES, SYSUSERS_LINES
from tests.deploy.boot import boot, make_root, write_program
from tests.patience import LONG_S

SCRIPT = f"""#!/bin/sh
mount="/etc/systemd/system/$(systemd-escape --path --suffix=mount {paths.STATE})"
printf '[Mount]\nWhat=disk\nWhere={paths.STATE}\nType=%s\n' absent >"$mount"
systemd-sysusers --inline '{SYSUSERS_LINES[0]}'
for type in absent tmpfs; do
    sed -i "s/^Type=.*/Type=$type/" "$mount"
    systemctl daemon-reload
    systemctl start {paths.UNIT.name}
    echo "== $type"
    ls {paths.STATE}
    systemctl is-active {paths.UNIT.name}
done
"""
"""Program of the container. It starts the service with a file system that cannot be mounted, and with one that can."""
DROP_IN = f"""
[Service]
Type=oneshot
RemainAfterExit=yes
Restart=no
ExecStart=
ExecStart=/bin/touch {paths.STATE}/started
"""
"""Drop-in that replaces the program of the service."""


def test_service_does_not_start_without_the_file_system_of_its_state(tmp_path, systemd_nspawn):
    root = tmp_path / "root"
    make_root(root)
    unit = root / "etc/systemd/system" / paths.UNIT.name
    unit.write_text((FILES / unit.name).read_text())
    unit.with_name(f"{unit.name}.d").joinpath("test.conf").write_text(DROP_IN)
    write_program(root / "root/container-script", SCRIPT)
    report = boot(root, tmp_path, systemd_nspawn, LONG_S)
    if "== absent" not in report:
        pytest.skip(f"no container boots on this machine: {report[-300:]}")
    parts = dict(re.findall(r"(?ms)^== (\w+)\n(.*?)(?=^== |\Z)", report))
    states = {kind: (part.splitlines()[-1], "started" in part) for kind, part in parts.items()}
    assert states == {"absent": ("inactive", False), "tmpfs": ("active", True)}, report
