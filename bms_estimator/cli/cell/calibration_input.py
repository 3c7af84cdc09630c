"""Files that a calibration reads: captures and OCV curves."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bms_estimator.calibration.ocv.sources import ExternalCurve
from bms_estimator.cli.options.capture_input import load_captures
from bms_estimator.cli.options.capture_options import unique_names
from bms_estimator.model.columns import Columns
from bms_estimator.model.sample import CurrentSign
from bms_estimator.sources.captures.curves import read_curve
from bms_estimator.sources.captures.tables.layout import ColumnMap


def load_captures_and_curves(
    paths: Sequence[Path], *, current_sign: CurrentSign | None, column_map: ColumnMap | None
) -> tuple[list[Columns], list[ExternalCurve]]:
    """Load captures and OCV curves. Files with equal names are named by their paths.

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
