"""Published JSON schema of a cell; ``python -m tests.conversion.published_schema`` writes it."""

import json
from pathlib import Path

from bms_estimator.conversion.json_and_pybamm import cell_schema

FILE = Path(__file__).parents[2] / "docs" / "reference" / "cell.schema.json"

if __name__ == "__main__":
    FILE.write_text(json.dumps(cell_schema(), indent=2) + "\n", encoding="utf-8")
