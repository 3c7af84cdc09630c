"""Python examples of docs/cell/index.md."""

import re
import sys
from pathlib import Path

import pytest

from bms_estimator.conversion.json_and_pybamm import pybamm_module
from bms_estimator.model.cell import load_cell

PAGE = (Path(__file__).parents[2] / "docs" / "cell" / "index.md").read_text(encoding="utf-8")


@pytest.mark.thorough
def test_the_examples_for_pybamm_and_pybop_print_the_documented_voltage(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pybop", reason="PyBOP is not installed")
    (tmp_path / "mine.py").write_text(pybamm_module(load_cell("nmc", 5.0)))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    exec("\n".join(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)), {})
    documented_v = float(re.search(r"Both programs print (\d\.\d+) V", PAGE)[1])
    assert [float(line) for line in capsys.readouterr().out.split()] == pytest.approx([documented_v] * 2, abs=5e-5)
