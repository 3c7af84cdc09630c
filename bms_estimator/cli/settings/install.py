"""``bms-estimator install`` and ``uninstall``: the service on this machine."""

import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.installation import paths
from bms_estimator.installation.install import (
    USER_STATE,
    PackFiles,
    compile_ahead,
    install,
    require_stopped,
    restart_running_units,
    start_service,
    uninstall,
)
from bms_estimator.installation.machine import Machine
from bms_estimator.installation.program_copy import (
    copy_program,
    is_hidden_from_services,
    is_program_copy,
    named_files,
    system_python,
)
from bms_estimator.model.errors import UserError
from bms_estimator.mqtt.connection import parse_url
from bms_estimator.settings.connections import MqttSettings
from bms_estimator.settings.pack import load_settings
from bms_estimator.sinks.home_assistant.discovery import discovery_topic
from bms_estimator.version import __version__

USER_FOLDERS = (USER_STATE, ".cache/bms_estimator")
"""Folders in a home folder with state and compiled kernels of a pack that its user runs without the service."""
Root = Annotated[
    Path,
    typer.Option(
        "--root", help="root directory of the system; with another directory than /, no service is started or stopped"
    ),
]


def install_command(
    pack: Annotated[
        Path | None,
        typer.Argument(
            metavar="[PACK.toml]",
            help="settings file of the pack, copied to /etc/bms-estimator; default: the installed settings",
            show_default=False,
        ),
    ] = None,
    root: Root = Path("/"),
    no_start: Annotated[bool, typer.Option("--no-start", help="do not start the service")] = False,
) -> None:
    """Install the service, or upgrade it: user, settings, systemd units and udev rule. Requires root.

    An upgrade keeps settings and state.
    A program in a home folder is copied to /opt/bms-estimator, because services have no access to home folders.
    To upgrade the copy, run the `install` command again from the program in the home folder.
    """
    machine = _machine(root, "install", [str(pack.resolve())] if pack else [])
    files = _check(pack) if pack else None
    program = _program(machine)
    with _errors_of_files():
        may_start = install(machine, program, files, _report)
    run_command = f"{program} run {paths.PACK_FILE}"
    if may_start and machine.root == Path("/") and not no_start:
        require_stopped(
            load_settings(paths.PACK_FILE),
            _user_home(),
            run_command if machine.lacks_systemd else f"systemctl restart {paths.NAME}",
        )
    if machine.has_running_systemd and not no_start:
        if may_start:
            compile_ahead(program)
            start_service()
            _report("service", "started")
        else:
            restart_running_units()
    settings = machine.path(paths.PACK_FILE)
    if not settings.exists():
        typer.echo("\nThe service starts when it has settings:")
        _show_next((f"sudo {paths.NAME} install PACK.toml", "install the settings of a pack"))
        return
    page = load_settings(settings).page
    typer.echo("\nNext:")
    if machine.lacks_systemd:
        _show_next((f"sudo {run_command}", "run the pack by hand, because systemd does not run here"))
        return
    _show_next(
        (f"systemctl status {paths.NAME}", "show the state of charge, or why no samples arrive"),
        (f"journalctl -u {paths.NAME} -f", "show the log"),
        *([(f"http://{page.listen}", "live page")] if page else []),
        (f"sudoedit {paths.PACK_FILE}", "change the settings"),
        (f"sudo systemctl restart {paths.NAME}", "use the changed settings"),
        (f"sudo {paths.NAME} uninstall", "remove the service; settings and state remain"),
    )


def uninstall_command(
    root: Root = Path("/"),
    purge: Annotated[bool, typer.Option("--purge", help="also remove settings and state")] = False,
) -> None:
    """Stop and remove the service, its user, systemd units and udev rule. Settings and state remain. Requires root."""
    machine = _machine(root, "uninstall", ["--purge"] if purge else [])
    # before the removal, which deletes the link to the program, and with --purge the settings
    program = _own_path()
    removal_commands = _home_assistant_removals(machine)
    with _errors_of_files():
        remaining = uninstall(machine, purge=purge, report=_report)
    remaining += [path for path in (_user_home() / name for name in USER_FOLDERS) if machine.path(path).exists()]
    if program.exists():
        remaining.append(program)
    if removal_commands:
        typer.echo(f"\nTo remove the pack from Home Assistant:\n{removal_commands}")
    typer.echo(f"\nRemaining: {', '.join(map(str, remaining)) or 'nothing'}")


def _home_assistant_removals(machine: Machine) -> str:
    """Return the commands that remove the installed packs from Home Assistant, one a line; empty without a broker."""
    commands = list[str]()
    for file in sorted(machine.path(paths.SETTINGS).glob("*.toml")):
        with suppress(UserError):  # a file of other or invalid settings
            settings = load_settings(file)
            if settings.mqtt and settings.home_assistant.enabled:
                commands.append(
                    f"  {publish_command(settings.mqtt)} -t {discovery_topic(settings.home_assistant, settings.pack.name)} -r -n"
                )
    return "\n".join(commands)


def publish_command(mqtt: MqttSettings) -> str:
    """Return a shell command, ``mosquitto_pub`` with the options of the first broker. It asks for the password."""
    broker = parse_url(mqtt.urls[0])
    options = {
        "-h": broker.host,
        "-p": broker.port,
        "-u": mqtt.username,
        "--cafile": mqtt.ca_file,
        "--cert": mqtt.cert_file,
        "--key": mqtt.key_file or mqtt.cert_file,  # without a key file, the certificate file contains the key
    }
    return " ".join(
        (
            "mosquitto_pub",
            *(f"{option} {shlex.quote(str(value))}" for option, value in options.items() if value),
            *(["--tls-use-os-certs"] if broker.tls and not mqtt.ca_file else []),
            *(['-P "$(systemd-ask-password)"'] if mqtt.password_file else []),
        )
    )


@contextmanager
def _errors_of_files() -> Iterator[None]:
    """Convert an error of a file or folder to UserError, for example if the file system is read-only."""
    try:
        yield
    except OSError as error:
        raise UserError(
            f"{error.filename}: cannot be changed: {error.strerror}; remove the cause and repeat the command"
        ) from None


def _machine(root: Path, command: str, arguments: Sequence[str]) -> Machine:
    """Return the machine with a root directory.

    Raises:
        UserError: The user is not root, or the directory contains no system.
    """
    if os.geteuid() != 0:
        options = [] if root == Path("/") else [f"--root={root.resolve()}"]
        raise UserError(f"requires root: sudo {' '.join([str(_own_path()), command, *options, *arguments])}")
    if not root.is_dir():
        raise UserError(f"--root {root}: is not a directory")
    if not (root / "etc").is_dir():
        raise UserError(f"--root {root}: is not the root directory of a system, because it has no directory etc")
    return Machine(root.resolve())


def _check(pack: Path) -> PackFiles:
    """Check a pack file as ``config check`` does. Return it with the files that it names.

    Raises:
        UserError: The settings are invalid, or name a file that the service cannot read.
    """
    from bms_estimator.cli.settings.config import check  # noqa: PLC0415 - it loads numba, which an upgrade does not need

    check(pack)
    return PackFiles(pack, named_files(pack))


def _program(machine: Machine) -> Path:
    """Return the path on the machine of a program that the service can run: this one, or a copy of it.

    Raises:
        UserError: The program is in a home folder, and cannot be copied.
    """
    program = _own_path()
    if not is_hidden_from_services(program):
        if program.is_relative_to(paths.PROGRAM_COPY) and is_program_copy(machine.path(paths.PROGRAM_COPY)):
            typer.echo(
                f"{program} is a copy of version {__version__}, which does not upgrade itself; "
                "to install another version, run `install` of the program in the home folder",
                err=True,
            )
        return program
    python = system_python()
    target = machine.path(paths.PROGRAM_COPY)
    typer.echo(f"copying the program to {target}, because services cannot read {program.parent}", err=True)
    copy_program(target, installed_as=paths.PROGRAM_COPY, python=python)
    _report("program", f"{paths.PROGRAM_COPY}, version {__version__}")
    return paths.PROGRAM_COPY / "bin" / paths.NAME


def _user_home() -> Path:
    """Return the home folder of the user who called sudo."""
    return Path(f"~{os.environ.get('SUDO_USER', 'root')}").expanduser()


def _own_path() -> Path:
    return Path(sys.argv[0]).resolve()


def _report(subject: str, text: str) -> None:
    typer.echo(f"{subject:<10} {text}")


def _show_next(*lines: tuple[str, str]) -> None:
    width = max(len(command) for command, _ in lines)
    for command, text in lines:
        typer.echo(f"  {command:<{width}}  {text}")
