"""C header with the tables of a cell, for firmware that estimates or predicts the cell's voltage."""

import re

import numpy as np

from bms_estimator.conversion.circuit import OcvTable, fill_template, ladder_table, ocv_table, value_lines
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv
from bms_estimator.kernels.cell_model.rc_ladder import (
    BRANCHES,
    GAS_J,
    HYSTERESIS_J,
    STRONG_J,
    TAU_S,
    TREND,
    WEAK_J,
)
from bms_estimator.kernels.kalman_filter.records import Noise
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.version import __version__

FINE_POINTS = 2001
"""Number of SOCs at which the error of a linear interpolation is computed."""
INTERPOLATION_ERROR_V = 2e-4
"""Maximum error of a linear interpolation of the OCV between the nodes of the header, per cell in series [V]."""
EXTREME_TEMPERATURE_DIFFERENCE_K = 40.0
"""Difference from 25 °C up to which ``INTERPOLATION_ERROR_V`` also holds for the temperature coefficient [K]."""


def c_header(cell: CellModel) -> str:
    """Return the text of a C99 header with tables of the OCV and of the RC ladder, and the equations as a comment."""
    curve, ladder, ratings = _thinned(cell), ladder_table(cell), cell.cell
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
        name=_comment(ratings.name),
        description=f": {_comment(ratings.description)}" if ratings.description else "",
        version=__version__,
        series_count=ratings.series_count,
        guard=re.sub(r"\W", "_", ratings.name, flags=re.ASCII).upper(),
        capacity_as=_float(3600.0 * ratings.capacity_ah),
        pairs=BRANCHES,
        ocv_nodes=curve.soc.size,
        ohm_nodes=ladder.soc.size,
        trend=TREND,
        weak_k=_float(WEAK_J / GAS_J),
        strong_k=_float(STRONG_J / GAS_J),
        hysteresis_k=_float(HYSTERESIS_J / GAS_J),
        hysteresis_soc=_float(Noise().hysteresis_soc),
        tables="\n".join(tables),
    )


def _thinned(cell: CellModel) -> OcvTable:
    """Return the OCV at the fewest nodes between which linear interpolation is within ``INTERPOLATION_ERROR_V``.

    The table of the cell file is interpolated by a cubic curve, which firmware need not evaluate.
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
    return f"static const CELL_MEMORY float {declaration} = {{\n{value_lines(_floats(values), 4)}\n}};\n"


def _matrix(declaration: str, rows: Floats) -> str:
    text = ",\n".join(f"    {{\n{value_lines(_floats(row), 8)}\n    }}" for row in rows)
    return f"static const CELL_MEMORY float {declaration} = {{\n{text}\n}};\n"


def _floats(values: Floats) -> list[str]:
    return [_float(x) for x in values.tolist()]


def _float(value: float) -> str:
    """Return a float constant of C with the nine digits that restore each single-precision number."""
    text = f"{value:.9g}"
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


def _comment(text: str) -> str:
    """Return a text without line breaks and ``*/``, because the text of a foreign cell file must not end the C comment."""
    return " ".join(text.replace("*/", "* /").split())
