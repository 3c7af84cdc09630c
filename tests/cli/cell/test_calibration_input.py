"""Cell that supplies the values that captures do not determine."""

from bms_estimator.cli.cell.calibration_input import given_cell


def test_the_capacity_of_the_option_replaces_the_capacity_of_the_pack(tmp_path):
    pack = tmp_path / "pack.toml"
    pack.write_text('[pack]\ncell = "nmc"\ncapacity_ah = 5.0\nseries = 4\nparallel = 2\n')
    from_pack, from_option = (given_cell(pack, None, capacity_ah, None) for capacity_ah in (None, 4.0))
    assert from_pack.size == "5 Ah, 4s2p"
    assert from_option.size == "4 Ah, 4s2p"
