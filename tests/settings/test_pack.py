"""Errors in settings and cell files: one line with file, key, value and allowed values."""

from pathlib import Path

import pytest

from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.settings.pack import Settings, load_settings

CHEN_MORA = Path(__file__).parents[2] / "bms_estimator" / "model" / "cells" / "chen_mora.toml"


def write_edited_cell(tmp_path: Path, old: str, new: str) -> Path:
    """Write the file of the shipped cell ``chen_mora`` with ``old`` replaced by ``new``; return its path."""
    text = CHEN_MORA.read_text()
    assert old in text
    path = tmp_path / "cell.toml"
    path.write_text(text.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "capacity_ah = 0.275",
            "capacity_ah = -6.6",
            r"cell\.toml: cell\.capacity_ah = -6\.6: .*greater than 0.*ampere-hours",
        ),
        ("capacity_ah = 0.275", "", r"cell\.toml: cell\.capacity_ah: missing \(rated capacity"),
        ("capacity_ah = 0.275", "capacity_ah = 0.275\ncapacty = 1", r"cell\.toml: cell\.capacty.*: unknown key"),
        ("capacity_ah = 0.275", 'capacity_ah = "much"', r"cell\.capacity_ah = 'much': .*number"),
        ("capacity_ah = 0.275", "capacity_ah = nan", r"cell\.capacity_ah = nan: .*"),
        ("capacity_ah = 0.275", "capacity_ah = true", r"cell\.capacity_ah = True: must be a number \(rated capacity"),
        ("capacity_ah = 0.275", 'capacity_ah = "3_9"', r"cell\.capacity_ah = '3_9': must be a number, without quotes"),
        ("upper = 1.0, lower = 0.1", "upper = true, lower = 0.1", r"adaptation\.a1\.upper = True: must be a number"),
        ("voltage_min_v = 1.5", "voltage_min_v = 4.6", r"must increase in this order"),
        ("upper = 1.0, lower = 0.1", "upper = 1.0, lower = 2.0", r"adaptation\.a1.*lower = 2\.0 is above upper = 1\.0"),
        ("a12 =", "a16 =", r"adaptation\.a16: no such parameter; a1 to a15 adapt"),
        ('form = "chen-mora"', 'form = "spline"', r"ocv.*'chen-mora', 'table'"),
        ("[cell]", "[cell", r"cell\.toml: not valid TOML: .*line 5"),
    ],
)
def test_the_error_on_an_invalid_cell_file_names_key_value_and_allowed_values(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    with pytest.raises(UserError, match=message):
        load_cell(write_edited_cell(tmp_path, old, new))


def test_all_invalid_keys_are_reported_together(tmp_path: Path) -> None:
    path = write_edited_cell(
        tmp_path, "capacity_ah = 0.275\nnominal_voltage_v = 3.7", "capacity_ah = 0\nnominal_voltage_v = -1"
    )
    with pytest.raises(UserError) as error:
        load_cell(path)
    assert len(str(error.value).splitlines()) >= 2


def test_the_error_on_an_unknown_cell_lists_the_shipped_cells() -> None:
    with pytest.raises(UserError, match=r"no such cell file, nor a shipped cell \(chen_mora, .*thunder_power_6s\)"):
        load_cell("lifepo5")


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (
            "soc = [0.0, 0.3, 0.6, 1.0]\nocv_v = [3.0, 3.6, 3.5, 4.1]",
            r"ocv_v must increase, but 3\.5 follows 3\.6 at point 3",
        ),
        (
            "soc = [0.1, 0.3, 0.6, 0.9]\nocv_v = [3.0, 3.4, 3.6, 4.1]",
            r"soc runs from 0\.1 to 0\.9: give the voltages at 0 and at 1",
        ),
    ],
)
def test_an_ocv_table_must_increase_from_empty_to_full(tmp_path: Path, table: str, message: str) -> None:
    text = CHEN_MORA.read_text()
    before_ocv, ocv_and_rest = text.split("[ocv]", 1)
    _, after_ocv = ocv_and_rest.split("[adaptation]", 1)
    path = tmp_path / "cell.toml"
    path.write_text(f'{before_ocv}[ocv]\nform = "table"\n{table}\n[adaptation]{after_ocv}')
    with pytest.raises(UserError, match=message):
        load_cell(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[pack]\nname = 'a/b'", r"pack\.name = 'a/b'.*letters, digits"),
        ("[pack]\ninitial_soc = 80", r"pack\.initial_soc = 80: .*less than or equal to 1"),
        ("[observer]\nalpha = 2.0", r"observer\.alpha = 2\.0: .*greater than 2.*\(2, 3\]"),
        ("[mqtt]\nurl = 'http://x'", r"mqtt\.url = 'http://x'.*mqtts://host:port"),
        (
            "[mqtt]\ncommands = ['reboot']",
            r"mqtt\.commands\.0 = 'reboot': must be one of set_soc, current_zero, acknowledge_alarm, publish_rate, forget_pack",
        ),
        ("[sensor]\ncurrent_step_a = 0.05", r"sensor\.current_step_a.*: unknown key"),
        ("[sensor]\nsample_rate_hz = 5000", r"sensor\.sample_rate_hz = 5000: .*1000"),
    ],
)
def test_the_error_on_an_invalid_setting_names_key_value_and_allowed_values(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "pack.toml"
    path.write_text(text)
    with pytest.raises(UserError, match=message):
        load_settings(path)


@pytest.mark.parametrize("text", ["", "# [pack]\n"])
def test_a_file_without_settings_is_an_error_because_it_may_be_cut_off(tmp_path: Path, text: str) -> None:
    path = tmp_path / "pack.toml"
    path.write_text(text)
    with pytest.raises(UserError, match="has no settings"):
        load_settings(path)
    path.write_text(f"{text}[pack]\n")
    assert load_settings(path) == Settings()


def test_a_byte_order_mark_before_the_settings_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "pack.toml"
    path.write_text('[pack]\nname = "house"\n', encoding="utf-8-sig")
    assert load_settings(path).pack.name == "house"


def test_the_gain_law_of_the_thesis_is_configurable(tmp_path: Path) -> None:
    path = tmp_path / "pack.toml"
    path.write_text('[observer]\nrearm_gain = "never"\ndead_zone_v = 0.0\nlambda = 2.0\n')
    observer = load_settings(path).observer
    assert observer.rearm_gain is None
    assert observer.lambda_ == 2.0


@pytest.mark.parametrize(
    ("text", "law"),
    [
        ("[pack]", "improved"),
        ("[identifier]\nenabled = false", "learning"),
        ('[identifier]\nenabled = false\n[observer]\nlaw = "improved"', "improved"),
    ],
)
def test_the_default_law_without_the_identifier_is_learning(tmp_path: Path, text: str, law: str) -> None:
    path = tmp_path / "pack.toml"
    path.write_text(text)
    assert load_settings(path).observer.law == law


def test_a_pack_has_the_values_of_its_cell_times_cells_in_series_and_parallel() -> None:
    """Three cells in series and two in parallel have 3 / 2 of a cell's resistance, and 2 / 3 of its capacitance."""
    cell = load_cell("chen_mora")
    pack = cell.pack(series=3, parallel=2)
    resistance, exponent_of_c_ts, capacitance, exponent_of_r_s, voltage = 1, 8, 9, 14, 18  # indices in a1..a21
    assert pack.cell.capacity_ah == pytest.approx(0.55)
    assert pack.cell.nominal_voltage_v == pytest.approx(11.1)
    assert pack.cell.current_max_a == pytest.approx(10.0)
    assert pack.cell.series_count == 3
    assert pack.a[resistance] == pytest.approx(cell.a[resistance] * 1.5)
    assert pack.a[capacitance] == pytest.approx(cell.a[capacitance] / 1.5)
    assert pack.a[exponent_of_r_s] == cell.a[exponent_of_r_s]
    assert pack.a[voltage] == pytest.approx(cell.a[voltage] * 3)
    assert pack.bounds(resistance).limit == pytest.approx(cell.bounds(resistance).limit * 1.5)
    assert pack.bounds(capacitance).limit == pytest.approx(cell.bounds(capacitance).limit / 1.5)
    assert pack.bounds(exponent_of_c_ts).limit == cell.bounds(exponent_of_c_ts).limit


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[pack]\ncapacity_ah = true", "pack.capacity_ah = True: must be a number"),
        ("[pack]\nseries = true", "pack.series = True: must be a number"),
        ('[pack]\nseries = "1_4"', "pack.series = '1_4': must be a number, without quotes"),
        ("[identifier]\nenabled = 1", "identifier.enabled = 1: must be true or false"),
        ('[identifier]\nenabled = "yes"', "identifier.enabled = 'yes': must be true or false"),
        ("[observer]\nrearm_gain = false", "observer.rearm_gain = False: must be a number"),
        ("a = " + 3000 * "[", "not valid TOML: nested too deeply"),
        ("a = " + 5000 * "1", "not valid TOML: Exceeds the limit"),
    ],
)
def test_values_of_another_type_are_rejected_and_not_converted(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "pack.toml"
    path.write_text(text)
    with pytest.raises(UserError) as error:
        load_settings(path)
    assert str(error.value).startswith(f"{path}: {expected}")


def test_an_integer_may_be_written_with_a_decimal_point(tmp_path: Path) -> None:
    path = tmp_path / "pack.toml"
    path.write_text("[pack]\nseries = 4.0\ncapacity_ah = 3\n")
    assert load_settings(path).pack.series == 4


def test_a_file_beside_the_settings_is_found_from_any_folder_unless_a_credential_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pack, credentials, here = tmp_path / "pack.toml", tmp_path / "credentials", tmp_path / "here"
    pack.write_text('[mqtt]\npassword_file = "password"\nca_file = "/absent/ca.pem"\n')
    for folder in (credentials, here):
        folder.mkdir()
    monkeypatch.chdir(here)
    assert load_settings(pack).mqtt.password_file == Path("password")
    for folder in (tmp_path, here):
        (folder / "password").write_text("secret")
    settings = load_settings(pack).mqtt
    assert (settings.password_file, settings.ca_file) == (tmp_path / "password", Path("/absent/ca.pem"))
    (credentials / "password").write_text("secret")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(credentials))
    assert load_settings(pack).mqtt.password_file == Path("password")
