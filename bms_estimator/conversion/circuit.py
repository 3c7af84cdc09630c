"""Equivalent circuit of a cell as tables, the templates of exported files, and a C header.

The tables are the open-circuit voltage and the RC ladder.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template

import numpy as np

from bms_estimator.estimator.filter_settings import SOC_GRID, ladder_of_branches
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv
from bms_estimator.kernels.cell_model.rc_ladder import (
    BRANCHES,
    GAS_CONSTANT,
    HIGH_ACTIVATION_ENERGY,
    HYSTERESIS_ACTIVATION_ENERGY,
    LOW_ACTIVATION_ENERGY,
    TAU_S,
    TREND_PAIR,
    weak_share,
)
from bms_estimator.kernels.kalman_filter.records import Noise
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.version import __version__

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


FINE_POINTS = 2001
"""Number of SOCs at which the error of a linear interpolation is computed."""
INTERPOLATION_ERROR_V = 2e-4
"""Maximum error of a linear interpolation of the OCV between the nodes of the header, per cell in series [V]."""
EXTREME_TEMPERATURE_DIFFERENCE_K = 40.0
"""Difference from 25 °C up to which ``INTERPOLATION_ERROR_V`` also holds for the temperature coefficient [K]."""


def c_header(cell: CellModel) -> str:
    """Return the text of a C99 header with tables of the OCV and of the RC ladder, and the equations as a comment."""
    curve, ladder, ratings = _thinned_ocv(cell), ladder_table(cell), cell.cell
    ocv_shape, ohm_shape = "[CELL_OCV_NODES]", "[CELL_OHM_NODES]"
    tables = [
        _table("CELL_TAU_S[CELL_RC_PAIRS]", np.array(TAU_S)),
        _table(f"CELL_OCV_SOC{ocv_shape}", curve.soc),
        _table(f"CELL_OCV_V{ocv_shape}", curve.ocv_v),
        _table(f"CELL_OCV_V_PER_K{ocv_shape}", curve.per_kelvin_v),
        _table(f"CELL_HYSTERESIS_V{ocv_shape}", curve.hysteresis_v),
        _table(f"CELL_OHM_SOC{ohm_shape}", ladder.soc),
        _matrix(f"CELL_WEAK_OHM[CELL_RC_PAIRS + 1]{ohm_shape}", ladder.weak_ohm),
        _matrix(f"CELL_STRONG_OHM[CELL_RC_PAIRS + 1]{ohm_shape}", ladder.strong_ohm),
    ]
    return fill_template(
        "cell.h.txt",
        name=_comment_text(ratings.name),
        description=f": {_comment_text(ratings.description)}" if ratings.description else "",
        version=__version__,
        series_count=ratings.series_count,
        guard=re.sub(r"\W", "_", ratings.name, flags=re.ASCII).upper(),
        capacity_as=_c_float(3600.0 * ratings.capacity_ah),
        pairs=BRANCHES,
        ocv_nodes=curve.soc.size,
        ohm_nodes=ladder.soc.size,
        trend=TREND_PAIR,
        weak_k=_c_float(LOW_ACTIVATION_ENERGY / GAS_CONSTANT),
        strong_k=_c_float(HIGH_ACTIVATION_ENERGY / GAS_CONSTANT),
        hysteresis_k=_c_float(HYSTERESIS_ACTIVATION_ENERGY / GAS_CONSTANT),
        hysteresis_soc=_c_float(Noise().hysteresis_soc),
        tables="\n".join(tables),
    )


def _thinned_ocv(cell: CellModel) -> OcvTable:
    """Return the OCV at the fewest nodes between which linear interpolation is within ``INTERPOLATION_ERROR_V``.

    The table of the cell file is interpolated by a cubic curve. Between these nodes, firmware can interpolate linearly.
    """
    table, soc, grid = ocv_table(cell), np.linspace(0.0, 1.0, FINE_POINTS), ocv_grid(cell)
    curve = OcvTable(
        soc,
        np.array([ocv(x, *grid) for x in soc]),
        np.interp(soc, table.soc, table.per_kelvin_v),
        np.interp(soc, table.soc, table.hysteresis_v),
    )
    voltages = np.array([curve.ocv_v, EXTREME_TEMPERATURE_DIFFERENCE_K * curve.per_kelvin_v, curve.hysteresis_v])
    nodes = _linear_nodes(soc, voltages, INTERPOLATION_ERROR_V * cell.cell.series_count)
    return OcvTable(soc[nodes], curve.ocv_v[nodes], curve.per_kelvin_v[nodes], curve.hysteresis_v[nodes])


def _linear_nodes(x: Floats, rows: Floats, tolerance: float) -> list[int]:
    """Return the indices of as few nodes as possible, between which all rows are linear within ``tolerance``.

    Args:
        x: Shape (n,), increasing abscissa.
        rows: Shape (curves, n), curves over ``x``.
        tolerance: Maximum deviation of a curve from the line between two nodes.
    """
    nodes, last = [0], x.size - 1
    while nodes[-1] < last:
        first, end = nodes[-1], nodes[-1] + 1
        while end < last and _linear_error(x, rows, first, end + 1) <= tolerance:
            end += 1
        nodes.append(end)
    return nodes


def _linear_error(x: Floats, rows: Floats, first: int, end: int) -> float:
    """Return the largest deviation of the rows from the straight line between two nodes."""
    between = slice(first, end + 1)
    weight = (x[between] - x[first]) / (x[end] - x[first])
    return float(np.abs(rows[:, between] - rows[:, [first]] - weight * (rows[:, [end]] - rows[:, [first]])).max())


def _table(declaration: str, values: Floats) -> str:
    return f"static const CELL_MEMORY float {declaration} = {{\n{value_lines(_c_floats(values), 4)}\n}};\n"


def _matrix(declaration: str, rows: Floats) -> str:
    text = ",\n".join(f"    {{\n{value_lines(_c_floats(row), 8)}\n    }}" for row in rows)
    return f"static const CELL_MEMORY float {declaration} = {{\n{text}\n}};\n"


def _c_floats(values: Floats) -> list[str]:
    return [_c_float(x) for x in values.tolist()]


def _c_float(value: float) -> str:
    """Return a float constant of C with the nine digits that restore each single-precision number."""
    text = f"{value:.9g}"
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


def _comment_text(text: str) -> str:
    """Return a text without line breaks and ``*/``, because the text of a foreign cell file must not end the C comment."""
    return " ".join(text.replace("*/", "* /").split())
