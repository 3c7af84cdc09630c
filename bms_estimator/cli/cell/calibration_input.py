"""Input of a calibration: captures, OCV curves, and the cell that supplies what they do not determine."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bms_estimator.calibration.ocv.source import ExternalCurve
from bms_estimator.cli.options.capture_input import load_captures
from bms_estimator.cli.options.capture_options import unique_names
from bms_estimator.cli.options.pack_options import single_cell_of, with_pack
from bms_estimator.model.arrays import CurrentSign
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.settings.pack import load_settings
from bms_estimator.sources.captures.curves import read_curve
from bms_estimator.sources.captures.tables.layout import ColumnMap


@dataclass(frozen=True)
class GivenCell:
    """Cell given by the user, and the arrangement of such cells in the measured pack.

    Attributes:
        cell: One cell.
        series: Number of cells in series.
        parallel: Number of cells in parallel.
    """

    cell: CellModel
    series: int
    parallel: int

    @property
    def pack(self) -> CellModel:
        """All cells as one object."""
        return self.cell.pack(self.series, self.parallel)

    @property
    def size(self) -> str:
        """Capacity of a cell and the numbers of cells, as text."""
        return f"{self.cell.cell.capacity_ah:g} Ah, {self.series}s{self.parallel}p"

    def scaled(self, capture: Columns) -> Columns:
        """Return the capture of a pack scaled to the mean cell."""
        rows = capture.rows.copy()
        rows["voltage_v"] /= self.series
        rows["current_a"] /= self.parallel
        return replace(capture, rows=rows)


def split_inputs(inputs: list[Path]) -> tuple[Path | None, list[Path]]:
    """Return the settings file of the pack, if the first argument is one, and the captures."""
    if inputs[0].suffix == ".toml":
        return inputs[0], inputs[1:]
    return None, inputs


def given_cell(pack: Path | None, cell: str | None, capacity_ah: float | None, series: int | None) -> GivenCell:
    """Return the cell of the options, or else of the settings of a pack.

    Raises:
        UserError: Neither a pack nor a cell is given, or a file cannot be read.
    """
    if pack is None:
        if cell is None:
            raise UserError("give --cell NAME and --capacity AH, or the settings file of a pack before the captures")
        return GivenCell(load_cell(cell, capacity_ah), series or 1, 1)
    settings = load_settings(pack)
    if capacity_ah is not None:
        settings = with_pack(settings, capacity_ah=capacity_ah)
    model = single_cell_of(pack, settings) if cell is None else load_cell(cell, settings.pack.capacity_ah)
    return GivenCell(model, series or settings.pack.series, settings.pack.parallel)


def load_captures_and_curves(
    paths: Sequence[Path], *, current_sign: CurrentSign | None, column_map: ColumnMap | None
) -> tuple[list[Columns], list[ExternalCurve]]:
    """Load captures and OCV curves. Each is named by its file, or by the path if several files have this name.

    Raises:
        UserError: A file cannot be read.
    """
    captures, curves = [], []
    for name, path in zip(unique_names([path.name for path in paths], paths), paths, strict=True):
        curve = read_curve(path)
        if curve is None:
            (loaded,) = load_captures([path], current_sign=current_sign, column_map=column_map)
            captures.append(replace(loaded, name=name))
        else:
            curves.append(ExternalCurve(name, *curve))
    return captures, curves
