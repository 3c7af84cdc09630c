"""Removal of the service."""

import os
import shutil
from pathlib import Path

from bms_estimator.installation import places
from bms_estimator.installation.install import OTHER_PACKS, Report, reload_system
from bms_estimator.installation.machine import Machine, run, tree
from bms_estimator.installation.program_copy import is_program_copy


def uninstall(machine: Machine, *, purge: bool, report: Report) -> list[Path]:
    """Stop the service, and remove its files and its user.

    Args:
        machine: Machine of the service.
        purge: Also remove settings, drop-ins and state.
        report: Called after each step.

    Returns:
        Absolute paths of folders and programs that remain.

    Raises:
        UserError: A program of the system is missing or fails.
    """
    all_units = places.UNIT, places.TEMPLATE
    units = [unit for unit in all_units if machine.path(unit).exists()]
    if units:
        if machine.is_running:
            run(["systemctl", "stop", places.UNIT.name, OTHER_PACKS])
        machine.run("systemctl", "disable", "--quiet", *(unit.name for unit in units))
        report("service", "stopped and disabled")
    drop_ins = [places.drop_ins(unit) for unit in all_units]
    user_data = [*drop_ins, places.SETTINGS, places.STATE]
    for name in (*all_units, *map(places.clock_drop_in, all_units), places.UDEV_RULE, places.CACHE):
        _remove(machine, name, report)
    for name in user_data if purge else ():
        _remove(machine, name, report)
    for folder in drop_ins:
        _remove_if_empty(machine.path(folder))
    if machine.is_running:
        reload_system()
    for name in user_data:
        _give_to_root(machine.path(name))
    _remove_user(machine, report)
    if machine.path(places.PROGRAM_LINK).is_symlink():
        _remove(machine, places.PROGRAM_LINK, report)
    if is_program_copy(machine.path(places.PROGRAM_COPY)):
        _remove(machine, places.PROGRAM_COPY, report)
    return [name for name in user_data if machine.path(name).exists()]


def _remove(machine: Machine, name: Path, report: Report) -> None:
    """Remove a file or a folder, if it exists."""
    path = machine.path(name)
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    elif path.is_symlink() or path.exists():
        path.unlink()
    else:
        return
    report("removed", str(name))


def _remove_user(machine: Machine, report: Report) -> None:
    """Remove the user and its group. Whether ``userdel`` also removes the group depends on the distribution."""
    if machine.group_id(places.NAME) is None:
        return
    machine.run("userdel", places.NAME, root_option="--prefix")
    if machine.group_id(places.NAME) is not None:
        machine.run("groupdel", places.NAME, root_option="--prefix")
    report("removed", f"user {places.NAME}")


def _remove_if_empty(folder: Path) -> None:
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def _give_to_root(folder: Path) -> None:
    """Make root the owner of a remaining folder, because a new user may get the id of the removed user."""
    for path in tree(folder) if folder.exists() else ():
        os.chown(path, 0, 0, follow_symlinks=False)
