"""New pack: its settings file, and the command that runs its estimator."""

import shlex
from dataclasses import dataclass
from pathlib import Path

from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.config_file import parse_toml
from bms_estimator.model.errors import UserError
from bms_estimator.service.pack_check import check_settings, summarize
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.pack_file import create_pack_file
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

    @property
    def summary(self) -> str:
        """Pack, source and broker in one line."""
        return summarize(self.settings, self.cell)


def create_pack(file: Path, answers: Answers) -> NewPack:
    """Check the settings of a pack, and write its settings file, and files with the passwords for brokers beside it.

    Invalid settings are not written.

    Raises:
        UserError: A setting is invalid, or the file exists or cannot be written.
        ModuleNotFoundError: The optional package of the source is missing.
    """
    settings = parse_toml(settings_file(Settings, answers.temporary_tables), Settings, str(file))
    pack = settings.pack
    cell = load_cell(pack.cell, pack.capacity_ah).pack(pack.series, pack.parallel)
    warnings = check_settings(settings, cell)
    create_pack_file(file, answers.tables)
    for section, login in answers.logins.items():
        path = file.with_name(answers.password_file(section))
        try:
            login.write_password(path)
        except OSError as error:
            raise UserError(f"{path}: the password cannot be written: {error.strerror}; write it there") from None
    return NewPack(settings, cell, warnings)


def run_command(file: Path) -> str:
    """Return the command that runs the estimator of a pack in the foreground."""
    return shlex.join(["bms-estimator", "run", str(file)])
