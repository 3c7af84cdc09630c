"""New pack: its settings file, and the check of the file."""

from dataclasses import dataclass
from pathlib import Path

from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.service.pack_check import check_settings, summarize
from bms_estimator.settings.pack import Settings, load_settings
from bms_estimator.settings.pack_file import create_pack_file
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
    """Write the settings file of a pack, and check it.

    Raises:
        UserError: The file exists, cannot be written, or has an invalid setting.
        ModuleNotFoundError: The optional package of the source is missing.
    """
    create_pack_file(file, answers.tables)
    settings = load_settings(file)
    pack = settings.pack
    cell = load_cell(pack.cell, pack.capacity_ah).pack(pack.series, pack.parallel)
    return NewPack(settings, cell, check_settings(settings, cell))
