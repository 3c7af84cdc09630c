"""Table of packs as CSV: parsing, printing and error texts; registry of the packs in it."""

import pytest

from bms_estimator.fleet.packs.csv_table import check_models, read_table, table_lines
from bms_estimator.fleet.packs.pack_registry import UNKNOWN_PACK, PackRegistry
from bms_estimator.fleet.packs.pack_row import (
    COLUMNS,
    FIT_INTERVAL_S,
    PackSpec,
    decode_row,
    encode_row,
    settings_of,
    shipped_cell_names,
)
from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import cell_text
from bms_estimator.settings.observer import NO_LIMITS, ChargeLimits, IdentifierSettings
from bms_estimator.settings.pack import PackSettings
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.captures.raw_capture import CORRECTIONS

LFP_SPEC = PackSpec(cell="lfp", capacity_ah=100.0, series=16, voltage_resolution_v=0.01)
ROW = "house,lfp,100,16"


@pytest.fixture
def write_table(tmp_path):
    """Return a function that writes a table and returns its path."""
    path = tmp_path / "packs.csv"

    def write(text, encoding="utf-8"):
        path.write_bytes(text.encode(encoding))
        return path

    return write


def error_of(path):
    """Return the text of the error that reading a table raises, without the path."""
    with pytest.raises(UserError) as error_info:
        read_table(path)
    return str(error_info.value).replace(f"{path}: ", "")


@pytest.mark.parametrize("separator", [",", ";"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_table_may_have_either_separator_and_line_end_and_a_byte_order_mark(write_table, separator, encoding, line_end):
    text = "pack,cell,capacity_ah,series\nhouse,lfp,100,16\n\n boat , nmc ,1.5e2,\n"
    parsed = read_table(write_table(text.replace(",", separator).replace("\n", line_end), encoding))
    assert {name: line.spec for name, line in parsed.packs.items()} == {
        "house": PackSpec(cell="lfp", capacity_ah=100.0, series=16),
        "boat": PackSpec(cell="nmc", capacity_ah=150.0),
    }
    assert [line.number for line in parsed.packs.values()] == [2, 4]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("a b,lfp,1,1", "line 2, column pack = 'a b': must be 1 to 64 letters, digits, _ and -"),
        (",lfp,1,1", "line 2, column pack = ''"),
        ("house,,1,1", "line 2, column cell is empty; it must be generic chemistry lfp, nmc"),
        ("house,../x,1,1", "line 2, column cell = '../x': is not of the form that it must have"),
        ("house,x.toml,1,1", "line 2, column cell = 'x.toml': no such file beside the table"),
        (
            "house,lfp,-6.6,1",
            "line 2, column capacity_ah = '-6.6': must be greater than 0 (capacity of the cell",
        ),
        ("house,lfp,1e999,1", "line 2, column capacity_ah = '1e999'"),
        ("house,lfp,nan,1", "line 2, column capacity_ah = 'nan': must be a number"),
        ("house,lfp,1,1.5", "line 2, column series = '1.5'"),
        ("house,lfp,1,0", "line 2, column series = '0': must be greater than or equal to 1"),
        ("house,lfp,1_0,1", "line 2, column capacity_ah = '1_0': must be a number"),
        ('house,lfp,"1,5",1', "line 2, column capacity_ah = '1,5': must be a number, with a point and not a comma"),
        ("house,lfp,1", "line 2, 3 values in 4 columns; give one for each, empty for the default"),
        (f"{ROW}\n{ROW}", "line 3, column pack = 'house': is already on line 2; remove one of them"),
        ('house,"lfp,1,1', "a quote that is opened must be closed"),
        ("", "no row below the line of column names"),
    ],
)
def test_errors_name_line_and_column(write_table, row, message):
    assert message in error_of(write_table(f"pack,cell,capacity_ah,series\n{row}\n"))


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("pack,cell,capacity", "line 1: column 'capacity' is unknown; is capacity_ah meant?"),
        ("pack,cell,zzz", f"line 1: column 'zzz' is unknown; there are {', '.join(COLUMNS)}"),
        ("pack,cell,cell", "line 1: column cell is repeated"),
        ("pack,series", "line 1: column cell is missing"),
        ("", "line 1: column pack is missing"),
    ],
)
def test_invalid_column_names_are_reported_with_a_remedy(write_table, header, message):
    assert message in error_of(write_table(f"{header}\n{ROW}\n"))


def test_file_that_is_missing_or_not_utf_8_is_reported(write_table, tmp_path):
    assert "not UTF-8 (byte 15); save it as CSV in UTF-8" in error_of(write_table("pack,cell\nhouseé,lfp\n", "latin-1"))
    assert "cannot be read: No such file" in error_of(tmp_path / "none.csv")


def test_number_of_errors_is_limited(write_table):
    lines = error_of(write_table("pack,cell\n" + "a b,lfp\n" * 100)).splitlines()
    assert len(lines) == 21  # 20 errors, and the number of the others
    assert lines[-1] == "and 80 more"


def test_cell_may_be_a_file_beside_the_table(write_table, tmp_path):
    (tmp_path / "own.toml").write_text(cell_text(load_cell("ncr18650")))
    path = write_table("pack,cell\nhouse,own.toml\n")
    parsed = read_table(path)
    assert parsed.packs["house"].spec == PackSpec(cell="own")
    assert parsed.cell_files == {"own": tmp_path / "own.toml"}
    check_models(path, parsed, {"own": (tmp_path / "own.toml").read_text()})
    with pytest.raises(UserError, match=r"packs\.csv: line 2: own: no cell file of this name was uploaded"):
        check_models(path, parsed, {})


def test_generic_cell_without_capacity_is_reported_once(write_table):
    path = write_table("pack,cell\na,lfp\nb,lfp\nc,ncr18650\n")
    with pytest.raises(UserError, match="line 2, and 1 more like this: lfp is a generic cell: give its capacity"):
        check_models(path, read_table(path), {})


def test_row_of_the_table_gives_the_settings_of_a_pack():
    row = PackSpec(cell="lfp", capacity_ah=280.0, series=16, protocol="jk", current_dead_band_a=0.2)
    settings = settings_of(row)
    assert (settings.pack.cell, settings.pack.capacity_ah, settings.pack.series) == ("lfp", 280.0, 16)
    assert (settings.sensor.voltage_resolution_v, settings.sampling.period_s) == (0.01, 1.0)
    assert settings.sampling.current_dead_band_a == 0.2


def test_columns_are_the_settings_of_a_pack_file_that_change_an_estimate():
    """A new setting must become a column, unless the edge or the worker handles it."""
    handled_by_the_edge = {"port", "serial", "address", "batteries", "baud", "sample_rate_hz", "current_sign"} | set(
        CORRECTIONS
    )
    fixed_by_the_worker = {"enabled", "pack_model"}
    unused_by_the_worker = {
        *("cutoff_v", "max_discharge_a", "max_charge_a"),  # of forecasts
        "device_soc_std",  # a block does not contain the SOC that the device reports
    }
    settings = {name for section in (PackSettings, SensorSettings, IdentifierSettings) for name in section.model_fields}
    assert settings - handled_by_the_edge - fixed_by_the_worker - unused_by_the_worker == set(COLUMNS) - {"pack"} | {
        "name"
    }


def test_limits_and_uncertainties_of_a_row_are_those_of_a_pack_file(write_table):
    pack = {"full_voltage_v": 54.4, "tail_current_a": 4.0, "cutoff_voltage_v": 44.8}
    identifier = {"current_offset_std_a": 0.1, "capacity_std": 0.2, "soc_std": 0.1, "hysteresis_v": 0.02}
    values = pack | identifier
    header, row = ",".join(values), ",".join(map(str, values.values()))
    path = write_table(f"pack,cell,capacity_ah,series,{header}\nhouse,lfp,280,16,{row}\n")
    settings = settings_of(read_table(path).packs["house"].spec)
    assert settings.charge_limits == ChargeLimits(**pack)
    assert settings.identifier == IdentifierSettings(**identifier, fit_interval_s=FIT_INTERVAL_S)


def test_full_voltage_below_the_cutoff_voltage_is_reported_as_in_a_pack_file(write_table):
    message = "full_voltage_v = 44: must be above cutoff_voltage_v = 54"
    path = write_table("pack,cell,capacity_ah,full_voltage_v,cutoff_voltage_v\nhouse,lfp,280,44,54\n")
    assert error_of(path) == f"line 2, column {message}"
    with pytest.raises(ValueError, match=message):
        PackSettings(full_voltage_v=44.0, cutoff_voltage_v=54.0)
    with pytest.raises(ValueError, match=message):
        decode_row(b'{"cell":"lfp","capacity_ah":280,"full_voltage_v":44,"cutoff_voltage_v":54}')


def test_row_of_a_version_without_limits_is_read_and_written_as_before():
    data = b'{"cell":"lfp","capacity_ah":280.0,"series":16,"protocol":"jk"}'
    assert decode_row(data).charge_limits == NO_LIMITS
    assert encode_row(decode_row(data)) == data


def test_all_shipped_cells_are_valid():
    for name in shipped_cell_names():
        assert PackSpec(cell=name).cell == name


def test_printed_table_is_read_as_it_was(write_table):
    kinds = {"b": LFP_SPEC, "a": PackSpec(cell="ncr18650", protocol="jbd")}
    parsed = read_table(write_table("".join(table_lines(kinds))))
    assert {name: line.spec for name, line in parsed.packs.items()} == kinds


def test_packs_with_equal_rows_share_settings_and_model():
    registry = PackRegistry()
    for i in range(1000):
        registry.set_row(f"p{i}", encode_row(LFP_SPEC.model_copy(update={"series": 14 + i % 5})))
    entries = [registry(f"p{i}") for i in range(1000)]
    assert len({id(entry) for entry in entries}) == 5
    settings, model = entries[0]
    assert model.cell.series_count == settings.pack.series == 14


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "its row is wrong: Invalid JSON"),
        (b"[]", "its row is wrong: "),
        (b'{"cell":"lfp","capacity_ah":"x"}', "its row is wrong: capacity_ah: must be a number, without quotes"),
        (b'{"cell":"lfp","more":1}', "its row is wrong: more: Extra inputs are not permitted"),
        (b'{"cell":"lfp"}', "lfp is a generic cell: give its capacity"),
        (b'{"cell":"lfp","capacity_ah":1e-300}', ""),  # a valid row: any capacity above 0 is allowed
        (b'{"cell":"own"}', "own: no cell file of this name was uploaded"),
        (b'{"cell":"broken"}', "cell broken: not valid TOML"),
        (b'{"cell":"/etc/passwd"}', "its row is wrong: cell: "),
        (b'{"cell":"pem_30w","capacity_ah":1}', "pem_30w is a fuel cell, which has no capacity"),
        (b'{"cell":"lfp","capacity_ah":1,"initial_soc":2}', "its row is wrong: initial_soc: "),
        (b"\xff\xfe", "its row is wrong: "),
        (b'{"cell":"ncr18650","voltage_noise_v":1e300}', "its values allow no estimator: "),
    ],
)
def test_invalid_row_makes_a_pack_unknown_with_a_reason(data, reason):
    registry = PackRegistry()
    registry.set_cell("broken", b"= 1")  # no valid TOML
    registry.set_row("house", data)
    assert registry("house") is None or reason == ""
    assert registry.reason("house").startswith(reason)


def test_pack_becomes_known_with_its_row_and_cell():
    registry = PackRegistry()
    assert registry("house") is None
    assert registry.reason("house") == UNKNOWN_PACK
    assert registry.set_row("house", encode_row(PackSpec(cell="own", series=2)))
    assert not registry.set_row("house", encode_row(PackSpec(cell="own", series=2)))
    assert registry("house") is None
    assert registry.set_cell("own", cell_text(load_cell("ncr18650")).encode())
    assert registry.packs_using({"own", "other"}) == {"house"}
    assert registry.packs_using({"other"}) == registry.packs_using(()) == set()
    assert registry.reason("house") == ""
    assert registry("house")[1].cell.series_count == 2
    assert registry.set_cell("own", None)
    assert not registry.set_cell("own", None)
    assert registry("house") is None
    assert registry.set_row("house", None)
    assert registry.reason("house") == UNKNOWN_PACK
    assert not registry.set_row("house", None)
