"""Equivalent circuit of a cell as tables: open-circuit voltage and RC ladder; and the templates of exported files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template

import numpy as np

from bms_estimator.estimator.filter_settings import SOC_GRID, ladder_of_branches
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.rc_ladder import weak_share
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, TableOcv

TEMPLATES = Path(__file__).with_name("templates")
LINE_VALUES = 6
"""Number of values on a line of a table."""


def fill_template(template: str, **values: object) -> str:
    """Return the text of a template with values in place of its placeholders, such as ``${name}``."""
    return Template((TEMPLATES / template).read_text(encoding="utf-8")).substitute(values)


def value_lines(texts: Sequence[str], indent: int) -> str:
    """Return values as indented lines of at most ``LINE_VALUES``, separated by commas."""
    lines = (", ".join(texts[i : i + LINE_VALUES]) for i in range(0, len(texts), LINE_VALUES))
    return ",\n".join(" " * indent + line for line in lines)


MIN_OHM = 1e-9
"""Minimum of the exported resistances [ohm], because the capacitance of an RC pair without resistance is infinite."""


@dataclass(frozen=True)
class OcvTable:
    """Open-circuit voltage over SOC.

    Attributes:
        soc: Shape (n,), increasing from 0 to 1.
        ocv_v: Shape (n,), OCV at 25 C, the mean of the OCVs after charge and after discharge [V].
        per_kelvin_v: Shape (n,), temperature coefficient of the OCV [V/K].
        hysteresis_v: Shape (n,), half of the difference of the OCV after charge and after discharge, at 25 C [V].
    """

    soc: Floats
    ocv_v: Floats
    per_kelvin_v: Floats
    hysteresis_v: Floats


@dataclass(frozen=True)
class LadderTable:
    """Resistances of the RC ladder over SOC at 25 C; see ``model.cell.Ladder``.

    Attributes:
        soc: Shape (n,), increasing.
        weak_ohm: Shape (RESISTANCES, n), part with the low activation energy [ohm].
        strong_ohm: Shape (RESISTANCES, n), part with the high activation energy [ohm].
    """

    soc: Floats
    weak_ohm: Floats
    strong_ohm: Floats


def ocv_table(cell: CellModel) -> OcvTable:
    """Return the OCV at the nodes of the cell file, or at the nodes of ``ocv_grid`` if the cell file has the function (2.10)."""
    ocv = cell.ocv
    if isinstance(ocv, TableOcv):
        soc, ocv_v = np.array(ocv.soc), np.array(ocv.ocv_v)
        per_kelvin_v, hysteresis_v = (np.array(x or np.zeros(soc.size)) for x in (ocv.per_kelvin_v, ocv.hysteresis_v))
        return OcvTable(soc, ocv_v, per_kelvin_v, hysteresis_v)
    ocv_v, _ = ocv_grid(cell)
    zeros = np.zeros(ocv_v.size)
    return OcvTable(np.linspace(0.0, 1.0, ocv_v.size), ocv_v, zeros, zeros)


def ladder_table(cell: CellModel) -> LadderTable:
    """Return the RC ladder of the cell file, or the RC ladder that the live service computes from R_s and both RC pairs."""
    if cell.ladder is None:
        ohm, weak = ladder_of_branches(cell).T, weak_share(SOC_GRID)
        soc, weak_ohm, strong_ohm = SOC_GRID, weak * ohm, (1.0 - weak) * ohm
    else:
        soc, weak_ohm, strong_ohm = (
            np.array(x) for x in (cell.ladder.soc, cell.ladder.weak_ohm, cell.ladder.strong_ohm)
        )
    return LadderTable(soc, np.maximum(weak_ohm, MIN_OHM), strong_ohm)
