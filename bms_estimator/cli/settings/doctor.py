"""``bms-estimator doctor``: examination of device, broker, service and machine."""

import json
import os
import shlex
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.cli.options.capture_options import AsJson
from bms_estimator.cli.options.pack_options import load_pack
from bms_estimator.cli.options.progress_bar import progress_bar
from bms_estimator.cli.options.table import silenced_log
from bms_estimator.doctor.device_check import MIN_FIRST_SAMPLE_TIMEOUT_S, first_sample_timeout_s, load_decoder
from bms_estimator.doctor.examine import examine
from bms_estimator.doctor.finding import ExaminedPack, Finding, Level, fault
from bms_estimator.doctor.systemd_unit import unit_of
from bms_estimator.installation.machine import root_command
from bms_estimator.model.errors import UserError

DEFAULT_PACKS = (Path("pack.toml"), Path("/etc/bms-estimator/pack.toml"))
"""Settings files of which the first that exists is examined by default."""
COLORS = {Level.OK: "green", Level.WARNING: "yellow", Level.FAULT: "red"}
"""Color of each level on a terminal."""
LEVEL_WIDTH = max(map(len, Level)) + 2
"""Width of the column of the level [characters]."""
NAME_WIDTH = len("kernel cache") + 2
"""Width of the column of the check's name [characters]."""

MIN_TEXT_WIDTH = 40
"""Minimum width of the wrapped text [characters]."""


def doctor(
    pack: Annotated[
        Path | None,
        typer.Argument(
            help="settings file of the pack; default: pack.toml here, otherwise /etc/bms-estimator/pack.toml",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Examine settings, device, broker, service and machine, and name a remedy for each fault.

    The command changes nothing, and does not open a device that another process uses. Opening a free port may reset a board.
    The exit code is 1 if there is a fault, otherwise 0.
    """
    path = pack or next(filter(os.path.isfile, DEFAULT_PACKS), DEFAULT_PACKS[0])
    findings = list[Finding]()
    with silenced_log():
        for finding in _examine(path):
            findings.append(finding)
            if not as_json:
                _print(finding)
    has_fault = any(finding.level is Level.FAULT for finding in findings)
    if as_json:
        result = {"ok": not has_fault, "findings": [asdict(finding) for finding in findings]}
        sys.stdout.write(json.dumps(result) + "\n")
    raise typer.Exit(int(has_fault))


def _examine(path: Path) -> Iterator[Finding]:
    """Yield the findings on a pack and the machine. If the settings are invalid, yield only findings on the machine."""
    subject = load_examined_settings(path)
    if isinstance(subject, Finding):
        yield subject
        yield from examine(None)
    else:
        with progress_bar("loading the decoder"):
            load_decoder(subject)
        if not subject.is_running and (wait_s := first_sample_timeout_s(subject.settings)) > MIN_FIRST_SAMPLE_TIMEOUT_S:
            typer.echo(f"waiting up to {wait_s:g} s for a sample of the device", err=True)
        yield from examine(subject)


def load_examined_settings(path: Path) -> ExaminedPack | Finding:
    """Return the pack and its service, or a finding if the settings cannot be used."""
    try:
        settings, model = load_pack(path)
    except UserError as error:
        return fault("settings", str(error), _remedy(path))
    try:
        unit = unit_of(path)
    except (OSError, subprocess.TimeoutExpired):  # systemd does not answer: examine the pack without its unit
        unit = None
    return ExaminedPack(path, settings, model, unit)


def _remedy(path: Path) -> str:
    """Return the command that creates, checks or reads a settings file that could not be loaded."""
    if not os.path.exists(path):  # noqa: PTH110 - Path.exists raises if the folder cannot be read
        return f"bms-estimator new {path}"
    return (
        f"bms-estimator config check {path}" if os.access(path, os.R_OK) else shlex.join(root_command("doctor", path))
    )


def _print(finding: Finding) -> None:
    """Print a finding. On a terminal its text is wrapped, but not its remedy, so that a command can be copied."""
    indent = " " * (LEVEL_WIDTH + NAME_WIDTH)
    text = finding.text
    if sys.stdout.isatty():
        width = max(shutil.get_terminal_size().columns - len(indent), MIN_TEXT_WIDTH)
        text = f"\n{indent}".join(textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False))
    level = typer.style(f"{finding.level:{LEVEL_WIDTH}}", fg=COLORS[finding.level])
    typer.echo(f"{level}{finding.check:{NAME_WIDTH}}{text}")
    if finding.remedy:
        typer.secho(f"{indent}remedy: {finding.remedy}", bold=True)
