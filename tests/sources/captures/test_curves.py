"""Files of OCV curves: order of the rows, hysteresis, other files, and rejection of invalid values."""

import gzip

import pytest

from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.curves import read_curve


def test_curve_is_read_sorted_by_soc_from_plain_and_compressed_files(tmp_path):
    path = tmp_path / "c.csv"
    path.write_text("# a comment\nocv_v,soc\n4.2,1\n3.0,0\n3.7,0.5\n")
    soc, ocv_v, *optional = read_curve(path)
    assert (soc.tolist(), ocv_v.tolist(), optional) == ([0.0, 0.5, 1.0], [3.0, 3.7, 4.2], [None, None, None])
    compressed = tmp_path / "c.csv.gz"
    compressed.write_bytes(
        gzip.compress(b"soc,ocv_v,std_v,hysteresis_v,per_kelvin_v\n0,3.0,3e-3,0.01,-2e-4\n1,4.2,4e-3,0.02,1e-4\n")
    )
    curve = read_curve(compressed)
    assert (curve.hysteresis_v.tolist(), curve.std_v.tolist()) == ([0.01, 0.02], [3e-3, 4e-3])
    assert curve.per_kelvin_v.tolist() == [-2e-4, 1e-4]


def test_a_std_of_zero_is_rejected(tmp_path):
    path = tmp_path / "c.csv"
    path.write_text("soc,ocv_v,std_v\n0,3.0,0.001\n1,4.2,0\n")
    with pytest.raises(UserError, match="std_v = 0: must be above 0"):
        read_curve(path)


@pytest.mark.parametrize("name", ["time.csv", "absent.csv", "raw.bms", "broken.csv.gz"])
def test_file_that_is_no_curve_gives_none(tmp_path, name):
    (tmp_path / "time.csv").write_text("time_s,current_a,voltage_v\n0,1,3.7\n")
    (tmp_path / "raw.bms").write_bytes(b"\x00\xff")
    (tmp_path / "broken.csv.gz").write_bytes(b"soc,ocv_v")
    assert read_curve(tmp_path / name) is None


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("0,3.0\n100,4.2\n", "soc runs from 0 to 100: must lie within 0..1, not percent"),
        ("0,3.0\nhalf,3.7\n", "line 3: soc = 'half': must be a number"),
        ("0,3.0\n0.5,nan\n", "a value is missing"),
        ("", "no rows"),
    ],
)
def test_invalid_curve_is_rejected_with_a_reason(tmp_path, rows, message):
    path = tmp_path / "c.csv"
    path.write_text("soc,ocv_v\n" + rows)
    with pytest.raises(UserError, match=message):
        read_curve(path)
