"""Export of a cell as JSON, whose schema is docs/reference/cell.schema.json, and as a Python module for PyBaMM and PyBOP.

The Python module has the parameters of PyBaMM's Thevenin model. A cell with an RC ladder becomes a series resistance and six RC pairs. The voltage of a ladder's RC pair is x R(SOC), where x
is the filtered current, so that the voltage follows a change of R at once. The voltage v of PyBaMM's RC pair relaxes towards
I R. Both voltages are equal if PyBaMM gets the capacitance tau / R, and in place of R the effective resistance
R / (1 + tau I R'(SOC) / (3600 Q R)), because dv/dt = R dx/dt + x R'(SOC) dSOC/dt. A cell without an RC ladder becomes R_s and the two RC pairs (2.5)-(2.9) of the thesis.
"""

import json
from typing import Any, Literal

from pydantic import Field
from pydantic.json_schema import GenerateJsonSchema

from bms_estimator.conversion.circuit import fill_template, ladder_table, ocv_table, value_lines
from bms_estimator.kernels.cell_model.open_loop import MIN_CAPACITANCE
from bms_estimator.kernels.cell_model.rc_ladder import (
    BRANCHES,
    GAS_CONSTANT,
    HIGH_ACTIVATION_ENERGY,
    HYSTERESIS_ACTIVATION_ENERGY,
    LOW_ACTIVATION_ENERGY,
    REFERENCE_C,
    TAU_S,
)
from bms_estimator.kernels.kalman_filter.records import Noise
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.config_file import Strict
from bms_estimator.model.pack_model import DIGITS
from bms_estimator.version import __version__

PAIR_LINES = """\
        "R{k} [Ohm]": lambda temperature_c, current_a, soc: pair_ohm({k}, temperature_c, current_a, soc),
        "C{k} [F]": lambda temperature_c, current_a, soc: pair_farad({k}, temperature_c, current_a, soc),
        "Element-{k} initial overpotential [V]": 0,"""
"""Lines of RC pair k in the module's parameters."""


def pybamm_module(cell: CellModel) -> str:
    """Return the text of a Python module whose ``get_parameter_values`` returns PyBaMM's parameters of the cell."""
    ocv, ratings = ocv_table(cell), cell.cell
    pair_count = 2 if cell.ladder is None else BRANCHES
    return fill_template(
        "thevenin.py.txt",
        name=_docstring_text(ratings.name),
        description=_docstring_text(ratings.description),
        version=__version__,
        pair_count=pair_count,
        capacity_ah=ratings.capacity_ah,
        ocv_soc=_array(ocv.soc),
        ocv_v=_array(ocv.ocv_v),
        per_kelvin_v=_array(ocv.per_kelvin_v),
        elements=_two_pairs(cell) if cell.ladder is None else _ladder(cell),
        voltage_min_v=ratings.voltage_min_v,
        voltage_max_v=ratings.voltage_max_v,
        pair_values="\n".join(PAIR_LINES.format(k=k) for k in range(1, pair_count + 1)),
    )


def _ladder(cell: CellModel) -> str:
    table = ladder_table(cell)
    return fill_template(
        "ladder.py.txt",
        soc=_array(table.soc),
        weak_ohm=_matrix(table.weak_ohm),
        strong_ohm=_matrix(table.strong_ohm),
        tau_s=TAU_S,
        weak_j=LOW_ACTIVATION_ENERGY,
        strong_j=HIGH_ACTIVATION_ENERGY,
        gas_j=GAS_CONSTANT,
    )


def _two_pairs(cell: CellModel) -> str:
    return fill_template("two_pairs.py.txt", a=[None, *cell.a[1:16].tolist()], min_capacitance=MIN_CAPACITANCE)


def _docstring_text(text: str) -> str:
    """Return a text without quotes and backslashes, because a foreign cell file must not end the docstring."""
    return " ".join(text.replace("\\", "/").replace('"', "'").split())


def _array(values: Floats) -> str:
    """Return an array as Python text, in short form if it contains only zeros, as for a column that the cell file lacks."""
    if not values.any():
        return f"np.zeros({values.size})"
    return f"np.array([\n{value_lines(_numbers(values), 4)},\n])"


def _matrix(rows: Floats) -> str:
    return "np.array([\n    " + ",\n    ".join(f"[{', '.join(_numbers(row))}]" for row in rows) + ",\n])"


def _numbers(values: Floats) -> list[str]:
    """Return numbers as Python text, rounded as in a cell file."""
    return [repr(float(f"{x:.{DIGITS}g}")) for x in values.tolist()]


class ModelConstants(Strict):
    """Constants of the cell model that are the same for all cells."""

    time_constant_s: tuple[float, ...] = Field(
        default=TAU_S, description="time constants of the ladder's RC pairs [s]; the capacitance is this divided by R"
    )
    weak_j_per_mol: float = Field(default=LOW_ACTIVATION_ENERGY, description="activation energy of weak_ohm [J/mol]")
    strong_j_per_mol: float = Field(
        default=HIGH_ACTIVATION_ENERGY, description="activation energy of strong_ohm [J/mol]"
    )
    hysteresis_j_per_mol: float = Field(
        default=HYSTERESIS_ACTIVATION_ENERGY, description="activation energy of hysteresis_v [J/mol]"
    )
    hysteresis_soc: float = Field(
        default=Noise().hysteresis_soc,  # a default of the filter that every cell uses
        description="change of SOC after which 1/e of the way to the other OCV branch remains",
    )
    reference_c: float = Field(
        default=REFERENCE_C, description="temperature of the resistances, the OCV and the hysteresis in this file [C]"
    )


class CellDocument(CellModel):
    """Cell file of bms_estimator as JSON: the sections of the file, with the constants of the cell model."""

    version: Literal[1] = Field(
        default=1, description="version of this format; it increases when a field is removed or changes its meaning"
    )
    constants: ModelConstants = ModelConstants()


def cell_json(cell: CellModel) -> str:
    """Return a cell as JSON text that conforms to ``cell_schema``. Absent values are left out."""
    document = CellDocument.model_validate(cell.model_dump(exclude_none=True))
    values = document.model_dump(mode="json", exclude_none=True)
    head = {key: values.pop(key) for key in ("version", "constants")}
    return json.dumps(head | values, indent=2) + "\n"


def cell_schema() -> dict[str, Any]:
    """Return the JSON schema of ``cell_json``."""
    schema = CellDocument.model_json_schema(mode="serialization")
    return {"$schema": GenerateJsonSchema.schema_dialect, **schema}
