"""JSON of a cell, its published schema, and its way back."""

import json

import jsonschema
import pytest

from bms_estimator.conversion.json_and_pybamm import CellDocument, cell_json, cell_schema
from bms_estimator.model.cell import generic_cells, load_cell, shipped_cells
from tests.conversion.published_schema import FILE


def test_the_published_schema_is_that_of_the_model():
    assert json.loads(FILE.read_text()) == cell_schema(), "run: make cell-schema"


@pytest.mark.parametrize("name", [*generic_cells(), *shipped_cells()])
def test_the_json_of_a_cell_conforms_to_the_schema_and_restores_the_cell(name):
    cell = load_cell(name, 5.0)
    document = json.loads(cell_json(cell))
    jsonschema.validate(document, cell_schema())
    restored = CellDocument.model_validate_json(cell_json(cell))
    assert {key: getattr(restored, key) for key in type(cell).model_fields} == dict(cell)


def test_the_schema_rejects_an_unknown_field():
    document = json.loads(cell_json(load_cell("leaf"))) | {"colour": "red"}
    with pytest.raises(jsonschema.ValidationError, match="colour"):
        jsonschema.validate(document, cell_schema())
