"""Check of the serial port: existence, permissions, udev rule."""

import grp
import os
import pwd
import stat
from collections.abc import Collection, Iterator
from pathlib import Path

from bms_estimator.doctor.finding import ROOT_USER, ExaminedPack, Finding, fault, is_root, ok, warning
from bms_estimator.installation import paths
from bms_estimator.sources.serial.port_list import NoPortError, named_ports, resolve_port

NAME = "port"
SERIAL_GROUP = "dialout"
"""Group of serial ports, of which the user of the systemd unit is a member."""
RULE_FOLDERS = (Path("/etc/udev/rules.d"), Path("/run/udev/rules.d"), Path("/usr/lib/udev/rules.d"))
"""Folders in which udev reads rules."""
NOBODY = 65534
"""User id without permissions. It represents the service's user, whose only permission is the group ``SERIAL_GROUP``."""


def check_port(subject: ExaminedPack) -> Iterator[Finding]:
    """Yield findings on the existence and permissions of the serial port, and on the udev rule."""
    if subject.settings.source is not None:
        return
    try:
        port = resolve_port(subject.settings.sensor.port)
    except NoPortError as error:
        yield fault(NAME, str(error), "connect the device, or set sensor.port to one of: bms-estimator ports")
        return
    yield _permission_finding(subject, port)
    usb_ports = {os.path.realpath(each.device) for each in named_ports().values() if each.vid is not None}
    if os.path.realpath(port) in usb_ports:
        yield _udev_rule_finding(subject)


def may_open(status: os.stat_result, user: int, groups: Collection[int]) -> bool:
    """Return True if a user may read and write a file.

    Args:
        status: Owner, group and mode of the file.
        user: Id of the user.
        groups: Ids of all groups of the user.
    """
    if user == ROOT_USER:
        return True
    if status.st_uid == user:
        needed = stat.S_IRUSR | stat.S_IWUSR
    elif status.st_gid in groups:
        needed = stat.S_IRGRP | stat.S_IWGRP
    else:
        needed = stat.S_IROTH | stat.S_IWOTH
    return status.st_mode & needed == needed


def _permission_finding(subject: ExaminedPack, port: str) -> Finding:
    """Return the finding on the permission of this user to open the port; as root, of the systemd unit's user."""
    status = Path(port).stat()
    owner = f"{_user_name(status.st_uid)}:{_group_name(status.st_gid)} {stat.filemode(status.st_mode)}"
    if is_root() and subject.unit:
        user, groups = NOBODY, _groups_of_service()
        name, remedy = "the service's user", subject.install_command
    else:
        user, groups = os.geteuid(), {os.getegid(), *os.getgroups()}
        name = _user_name(user)
        group = _group_name(status.st_gid) if status.st_gid != ROOT_USER else SERIAL_GROUP
        remedy = f"add the user to the group, then log in again: sudo usermod -aG {group} {name}"
    if may_open(status, user, groups):
        return ok(NAME, f"{port}: {name} may open it ({owner})")
    if status.st_gid == ROOT_USER or not status.st_mode & stat.S_IWGRP:
        remedy = f"let the group open it: {subject.install_command}"
    return fault(NAME, f"{port}: cannot be opened by {name} ({owner})", remedy)


def _groups_of_service() -> set[int]:
    """Return the ids of the groups of the systemd unit's user."""
    try:
        return {grp.getgrnam(SERIAL_GROUP).gr_gid}
    except KeyError:
        return set()


def _udev_rule_finding(subject: ExaminedPack) -> Finding:
    """Return the finding on the udev rule. The rule names boards by their USB port, and excludes them from ModemManager."""
    for folder in RULE_FOLDERS:
        if (folder / paths.UDEV_RULE.name).exists():
            return ok("udev rule", f"{folder / paths.UDEV_RULE.name}")
    text = "not installed: a board may get another name after a reboot, and ModemManager may write to it"
    return warning("udev rule", text, subject.install_command)


def _user_name(user: int) -> str:
    try:
        return pwd.getpwuid(user).pw_name
    except KeyError:
        return str(user)


def _group_name(group: int) -> str:
    try:
        return grp.getgrgid(group).gr_name
    except KeyError:
        return str(group)
