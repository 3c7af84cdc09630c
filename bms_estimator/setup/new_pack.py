"""New pack: its settings file, and the command that runs its estimator."""

import itertools
import math
import shlex
from dataclasses import dataclass, replace
from pathlib import Path

from bms_estimator.estimator.settings_plausibility import implausible_measurement
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.config_file import parse_toml
from bms_estimator.model.errors import UserError
from bms_estimator.process.listener import is_free
from bms_estimator.service.pack_check import check_settings, summarize
from bms_estimator.settings.connections import DEFAULT_LISTEN, parse_listen
from bms_estimator.settings.pack import Settings, create_pack_file
from bms_estimator.settings.settings_template import settings_file
from bms_estimator.setup.answers import Answers


@dataclass(frozen=True)
class NewPack:
    """Pack with a new settings file."""

    settings: Settings
    cell: CellModel
    """Model of the whole pack."""
    warnings: list[str]
    """Likely mistakes in the settings."""
    password_files: list[Path]
    """Files with the passwords for brokers."""

    @property
    def summary(self) -> str:
        """Pack, source and broker in one line."""
        return summarize(self.settings, self.cell)


def create_pack(file: Path, answers: Answers, setup_port: int = 0) -> NewPack:
    """Check the settings of a pack. Write its settings file, and password files for its brokers to the same folder.

    Invalid settings are not written. The page gets the first free port from the default port, because each pack has a page.

    Args:
        file: Settings file to create.
        answers: Answers about the pack.
        setup_port: Port of the setup page, which is free when the service starts; 0: no setup page.

    Raises:
        UserError: A setting is invalid, or the file exists or cannot be written.
        ModuleNotFoundError: The optional package of the source is missing.
    """
    default = parse_listen(DEFAULT_LISTEN)
    port = next(port for port in itertools.count(default.port) if port == setup_port or is_free(port))
    answers = replace(answers, page_listen=f"{default.host}:{port}")
    settings = parse_toml(settings_file(Settings, answers.temporary_tables), Settings, str(file))
    pack = settings.pack
    cell = load_cell(pack.cell, pack.capacity_ah).pack(pack.series, pack.parallel)
    warnings = check_settings(settings, cell)
    measured = answers.measured
    values = (measured.voltage_v, measured.current_a) if measured else (math.nan, math.nan)
    warnings += implausible_measurement(cell, *values, answers.device_capacity_ah or math.nan)
    create_pack_file(file, answers.tables)
    logins = {answers.password_file(key): each for key, each in answers.logins.items() if each.password is not None}
    password_files = {file.with_name(name): login for name, login in logins.items()}
    for path, login in password_files.items():
        try:
            login.write_password(path)
        except OSError as error:
            raise UserError(f"{path}: the password cannot be written: {error.strerror}; write it there") from None
    return NewPack(settings, cell, warnings, list(password_files))


def run_command(file: Path) -> str:
    """Return the command that runs the estimator of a pack in the foreground."""
    return shlex.join(["bms-estimator", "run", str(file)])
