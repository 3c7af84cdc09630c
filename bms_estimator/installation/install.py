"""Installation, upgrade and removal of the service: its units, drop-ins, udev rule and user."""

import contextlib
import os
import shutil
import subprocess
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from bms_estimator.installation import paths
from bms_estimator.installation.machine import Machine, read_file, run, tree
from bms_estimator.installation.program_copy import is_program_copy
from bms_estimator.model.errors import UserError
from bms_estimator.process.state_folder import lock_holder
from bms_estimator.settings.pack import Settings

FILES = Path(__file__).parent / "files"
"""Folder with the original files."""
SYSUSERS_LINES = (f'u {paths.NAME} - "Battery estimator" {paths.STATE}', f"m {paths.NAME} dialout")
"""Lines for systemd-sysusers that create the user of the service. Members of the group dialout may open serial ports."""
UNIT_PROGRAM = "/opt/bms-estimator/bin/bms-estimator"
"""Program in the original unit, which is replaced by the installed program."""


@dataclass(frozen=True)
class SystemFile:
    """File to be written.

    Attributes:
        kind: Kind of the file, for the output of ``install``.
        path: Absolute path on the machine.
        text: Content.
    """

    kind: str
    path: Path
    text: str


def system_files(machine: Machine, program: Path) -> list[SystemFile]:
    """Return the files that the service needs on a machine.

    Args:
        machine: Machine of the service.
        program: Absolute path of the program on the machine.
    """
    unit = (FILES / "bms-estimator.service").read_text(encoding="utf-8").replace(UNIT_PROGRAM, str(program))
    template = unit.replace(str(paths.PACK_FILE), f"{paths.SETTINGS}/%i.toml")
    rule = (FILES / "99-bms-estimator.rules").read_text(encoding="utf-8")
    files = [
        SystemFile("unit", paths.UNIT, unit),
        SystemFile("unit", paths.TEMPLATE, template),
        SystemFile("udev rule", paths.UDEV_RULE, rule),
    ]
    # where these daemons set the clock, the drop-in allows the service to ask the kernel whether it is synchronized
    if any(machine.path(daemon).exists() for daemon in paths.CLOCK_DAEMONS):
        drop_in = (FILES / "clock.conf").read_text(encoding="utf-8")
        files += [SystemFile("unit", paths.clock_drop_in(unit), drop_in) for unit in (paths.UNIT, paths.TEMPLATE)]
    return files


USER_STATE = ".local/state/bms-estimator"
"""Folder in a home folder with the state of packs that its user runs without the service."""
UDEV_CONTROL = Path("/run/udev/control")
"""Socket of udev, which does not run in containers."""
NOT_STARTED = " under systemd; systemd does not run here, so it is not started now"
"""Addition to the text "it starts with the machine" on a machine without systemd, such as a container."""
OTHER_UNITS = f"{paths.NAME}@*.service"
"""Pattern of the units of other packs."""
Report = Callable[[str, str], None]
"""Function that shows a finished step: its subject, and what was done."""


@dataclass(frozen=True)
class PackFiles:
    """Files of a pack to install.

    Attributes:
        settings: Settings file of the pack.
        named: Files that the settings name.
    """

    settings: Path
    named: Sequence[Path]


def install(machine: Machine, program: Path, pack: PackFiles | None, report: Report) -> bool:
    """Write the files of the service, create its user, and enable the service. State and settings of an earlier installation remain.

    Args:
        machine: Machine of the service.
        program: Absolute path of the program on the machine.
        pack: Files to install; None: keep the files of an earlier installation.
        report: Called after each step.

    Returns:
        True if the service may be started; False if it has no settings, or if the user has disabled it.

    Raises:
        UserError: A file cannot be written, or a program of the system is missing or fails.
    """
    is_upgrade = machine.path(paths.UNIT).exists()
    _link_program(machine, program, report)
    machine.run("systemd-sysusers", "--inline", *SYSUSERS_LINES)
    group = machine.group_id(paths.NAME)
    if group is None:
        raise UserError(f"systemd-sysusers did not create the group {paths.NAME}")
    report("user", f"{paths.NAME}, in group dialout")
    if pack is not None:
        _require_same_pack(machine, pack)
        _write_settings(machine, pack, group, report)
    _set_settings_group(machine, group)
    for file in system_files(machine, program):
        machine.write(file.path, file.text.encode())
        report(file.kind, str(file.path))
    if machine.has_running_systemd:
        reload_system()
    if not machine.path(paths.PACK_FILE).exists() or (is_upgrade and pack is None and not _is_enabled(machine)):
        return False
    machine.run("systemctl", "enable", "--quiet", paths.UNIT.name)
    report("service", f"enabled: it starts with the machine{NOT_STARTED if machine.lacks_systemd else ''}")
    return True


def require_stopped(settings: Settings, home: Path, start_command: str) -> None:
    """Check that no process outside systemd serves a pack, because a second one would fail or publish to the same topics.

    Args:
        settings: Settings of the pack.
        home: Home folder of the user who may have run the pack.
        start_command: Command that starts the pack afterwards.

    Raises:
        UserError: A process serves the pack. The message contains the commands that stop it and start the service.
    """
    for folder in [settings.state.folder] if settings.state.folder else [home / USER_STATE, paths.STATE]:
        process = lock_holder(folder.expanduser(), settings.pack.name)
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # the process has just ended
            if process and f"/{paths.NAME}" not in Path(f"/proc/{process}/cgroup").read_text(encoding="utf-8"):
                raise UserError(
                    f"{settings.pack.name}: process {process} runs this pack by hand, so that the service is installed but "
                    f"not started; stop the process, then start the service:\n  sudo kill {process}\n  sudo {start_command}"
                )


def compile_ahead(program: Path) -> None:
    """Run the command ``compile`` as the user of the service. It shows a bar, and adds missing kernels to the service's cache.

    Otherwise the start of the service would take minutes without an explanation. If the compilation fails, the service repeats it.
    """
    paths.CACHE.mkdir(mode=0o755, exist_ok=True)
    shutil.chown(paths.CACHE, paths.NAME, paths.NAME)
    variables = {
        "NUMBA_CACHE_DIR": str(paths.CACHE),
        "PATH": paths.SEARCH_PATH,
        "TERM": os.environ.get("TERM", "dumb"),
    }
    subprocess.run(  # noqa: S603 - this program
        [program, "compile"], env=variables, cwd="/", user=paths.NAME, group=paths.NAME, extra_groups=(), check=False
    )


def start_service() -> None:
    """Start or restart the service of this machine, and restart the running units of other packs.

    Raises:
        UserError: The service does not start.
    """
    run(["systemctl", "try-restart", OTHER_UNITS])
    try:
        run(["systemctl", "restart", paths.UNIT.name])
    except UserError:
        raise UserError(
            f"the service does not start; its log says why: journalctl -u {paths.NAME} -n 20\n"
            f"after a change of {paths.PACK_FILE}: systemctl restart {paths.NAME}"
        ) from None


def restart_running_units() -> None:
    """Restart the running units, so that they run the upgraded program. Units that do not run are not started."""
    run(["systemctl", "try-restart", paths.UNIT.name, OTHER_UNITS])


def reload_system() -> None:
    """Make systemd and udev of this machine read their files again."""
    run(["systemctl", "daemon-reload"])
    if UDEV_CONTROL.exists():
        run(["udevadm", "control", "--reload"])
        run(["udevadm", "trigger", "--subsystem-match=tty"])


def _link_program(machine: Machine, program: Path, report: Report) -> None:
    """Link the program from the search path of root, unless a program of this name is there."""
    folders = [machine.path(folder) for folder in paths.SEARCH_PATH.split(":")]
    if any((folder / paths.NAME).exists() for folder in folders):
        return
    link = machine.path(paths.PROGRAM_LINK)
    link.parent.mkdir(parents=True, exist_ok=True)
    link.unlink(missing_ok=True)
    link.symlink_to(program)
    report("program", f"{paths.PROGRAM_LINK}, a link to {program}")


def _require_same_pack(machine: Machine, pack: PackFiles) -> None:
    """Refuse to replace the settings of another pack.

    Raises:
        UserError: The installed settings belong to another pack. The message contains the commands that install both.
    """
    installed = machine.read(paths.PACK_FILE)
    installed_name = installed and _pack_name(installed)
    name = _pack_name(pack.settings.read_bytes())
    if installed_name and installed_name != name:
        target = paths.SETTINGS / f"{name}.toml"
        files = " ".join(map(str, pack.named))
        copy = f"\n  sudo install -m 640 -g {paths.NAME} {files} {paths.SETTINGS}" if files else ""
        raise UserError(
            f"{paths.PACK_FILE}: has the settings of the pack {installed_name}, but {pack.settings} those of {name}; to run both:{copy}\n"
            f"  sudo install -m 640 -g {paths.NAME} {pack.settings} {target}\n"
            f"  sudo systemctl enable --now {paths.NAME}@{name}\n"
            f"to replace {installed_name}, remove {paths.PACK_FILE} first"
        )


def _pack_name(settings: bytes) -> str | None:
    """Return the name of the pack in settings; None if they cannot be read."""
    try:
        return str(tomllib.loads(settings.decode()).get("pack", {}).get("name", "pack"))
    except ValueError:
        return None


def _write_settings(machine: Machine, pack: PackFiles, group: int, report: Report) -> None:
    """Copy a pack file and the files that it names. Back up each installed file that differs."""
    files = {paths.SETTINGS / file.name: read_file(file) for file in pack.named}
    files[paths.PACK_FILE] = pack.settings.read_bytes()
    for name, content in files.items():
        installed = machine.read(name)
        if installed is not None and installed != content:
            backup = name.with_name(f"{name.name}.old")
            machine.write(backup, installed, mode=0o640, group=group)
            report("settings", f"{backup}, the previous {name.name}")
        machine.write(name, content, mode=0o640, group=group)
        report("settings", str(name))


def _set_settings_group(machine: Machine, group: int) -> None:
    """Set the group of all settings. After a new installation the group may have another id."""
    folder = machine.path(paths.SETTINGS)
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    for path in tree(folder):
        os.chown(path, -1, group, follow_symlinks=False)


def _is_enabled(machine: Machine) -> bool:
    folders = machine.path(paths.UNIT).parent.glob("*.wants")
    return any((folder / paths.UNIT.name).is_symlink() for folder in folders)


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
    all_units = paths.UNIT, paths.TEMPLATE
    units = [unit for unit in all_units if machine.path(unit).exists()]
    if units:
        if machine.has_running_systemd:
            run(["systemctl", "stop", paths.UNIT.name, OTHER_UNITS])
        machine.run("systemctl", "disable", "--quiet", *(unit.name for unit in units))
        report("service", "stopped and disabled")
    drop_ins = [paths.drop_ins(unit) for unit in all_units]
    user_data = [*drop_ins, paths.SETTINGS, paths.STATE]
    for name in (*all_units, *map(paths.clock_drop_in, all_units), paths.UDEV_RULE, paths.CACHE):
        _remove(machine, name, report)
    for name in user_data if purge else ():
        _remove(machine, name, report)
    for folder in drop_ins:
        _remove_if_empty(machine.path(folder))
    if machine.has_running_systemd:
        reload_system()
    for name in user_data:
        _give_to_root(machine.path(name))
    _remove_user(machine, report)
    if machine.path(paths.PROGRAM_LINK).is_symlink():
        _remove(machine, paths.PROGRAM_LINK, report)
    if is_program_copy(machine.path(paths.PROGRAM_COPY)):
        _remove(machine, paths.PROGRAM_COPY, report)
    return [name for name in user_data if machine.path(name).exists()]


def _remove(machine: Machine, name: Path, report: Report) -> None:
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
    if machine.group_id(paths.NAME) is None:
        return
    # with --root, userdel would run in a chroot and need the libraries of the image
    machine.run("userdel", paths.NAME, root_option="--prefix")
    if machine.group_id(paths.NAME) is not None:
        machine.run("groupdel", paths.NAME, root_option="--prefix")
    report("removed", f"user {paths.NAME}")


def _remove_if_empty(folder: Path) -> None:
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def _give_to_root(folder: Path) -> None:
    """Make root the owner of a remaining folder, because a new user may get the id of the removed user."""
    for path in tree(folder) if folder.exists() else ():
        os.chown(path, 0, 0, follow_symlinks=False)
