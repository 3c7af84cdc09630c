"""Exports of cyclers, libraries and public data sets become the same samples, with a note of what was guessed."""

from pathlib import Path

import numpy as np
import pytest

from bms_estimator import load_capture
from bms_estimator.model.columns import Columns
from tests.sources.captures.cycler_exports import EXPORTS, Export, compressed, measure, text

WITH_NAME = {"argvalues": EXPORTS, "ids": [export.write.__name__ for export in EXPORTS]}


def assert_is_the_measurement(capture: Columns, *, has_temperature: bool) -> None:
    expected = measure()
    np.testing.assert_allclose(capture["time_s"], expected.time_s, atol=1e-6)
    np.testing.assert_allclose(capture["current_a"], expected.current_a, atol=1e-9)
    np.testing.assert_allclose(capture["voltage_v"], expected.voltage_v, atol=1e-9)
    temperature_c = expected.temperature_c if has_temperature else np.full(expected.time_s.size, np.nan)
    np.testing.assert_allclose(capture["temperature_c"], temperature_c, atol=1e-9)


@pytest.mark.parametrize("export", **WITH_NAME)
def test_export_is_read_without_options(export: Export, tmp_path: Path) -> None:
    capture = load_capture(export.save(tmp_path))
    assert_is_the_measurement(capture, has_temperature=export.has_temperature)
    assert capture.note.startswith(f"read as {export.dialect} (")
    assert capture.warning == ""


@pytest.mark.parametrize("suffix", [".gz", ".zip"])
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le"])
def test_compressed_text_in_any_encoding_is_read(suffix: str, encoding: str, tmp_path: Path) -> None:
    export = next(export for export in EXPORTS if export.write.__name__ == "german")
    plain = Export(export.write, export.dialect, encoding=encoding).save(tmp_path)
    assert_is_the_measurement(load_capture(compressed(plain, suffix)), has_temperature=True)


@pytest.mark.parametrize(
    "header",
    [
        "~Time[h]\tt-Step[h]\tU[V]\tI[A]",  # BaSyTec
        "Run Time (h)\tStep Time (h)\tPotential (V)\tCurrent (A)",  # Novonix
        "elapsed_time_h\tsoc\tpack_voltage_v\tpack_current_a",  # log of a BMS
    ],
)
def test_usual_names_of_other_programs_are_read(header: str, tmp_path: Path) -> None:
    m = measure()
    path = tmp_path / "cell.txt"
    path.write_text(f"{header}\n" + text(zip(m.time_s / 3600.0, m.step, m.voltage_v, m.charge_a, strict=True), "\t"))
    assert_is_the_measurement(load_capture(path), has_temperature=False)
