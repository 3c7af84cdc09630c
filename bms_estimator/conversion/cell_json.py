"""Cell as JSON with a published schema, docs/reference/cell.schema.json."""

import json
from typing import Any, Literal

from pydantic import Field
from pydantic.json_schema import GenerateJsonSchema

from bms_estimator.kernels.cell_model.rc_ladder import (
    HYSTERESIS_J,
    REFERENCE_C,
    STRONG_J,
    TAU_S,
    WEAK_J,
)
from bms_estimator.kernels.kalman_filter.records import Noise
from bms_estimator.model.cell import CellModel
from bms_estimator.model.config_file import Strict


class ModelConstants(Strict):
    """Constants of the cell model that are the same for all cells."""

    time_constant_s: tuple[float, ...] = Field(
        default=TAU_S, description="time constants of the ladder's RC pairs [s]; the capacitance is this divided by R"
    )
    weak_j_per_mol: float = Field(default=WEAK_J, description="activation energy of weak_ohm [J/mol]")
    strong_j_per_mol: float = Field(default=STRONG_J, description="activation energy of strong_ohm [J/mol]")
    hysteresis_j_per_mol: float = Field(default=HYSTERESIS_J, description="activation energy of hysteresis_v [J/mol]")
    hysteresis_soc: float = Field(
        default=Noise().hysteresis_soc,
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
