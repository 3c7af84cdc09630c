"""``config``: generated files are valid, errors name the setting, and the output of ``show`` can be read."""

import re
import tomllib

import pytest

from bms_estimator.model.cell import load_cell
from bms_estimator.model.pack_model import write_cell
from bms_estimator.settings.pack import Settings, load_settings
from bms_estimator.sources.factory import KINDS
from tests.command_line import error, run


@pytest.fixture
def pack(tmp_path):
    return tmp_path / "pack.toml"


def test_init_writes_defaults_that_check_accepts(pack, capsys):
    code, out, err = run(capsys, "config", "init", pack)
    assert (code, err) == (0, "")
    assert f"{pack}: written" in out
    code, out, err = run(capsys, "config", "check", pack)
    assert (code, err) == (0, "")
    assert out.startswith(f"{pack}: valid; pack: ncr18650, 1 in series")
    assert f"bms-estimator doctor {pack}" in out
    assert load_settings(pack) == Settings()


REQUIRED_SETTINGS = {
    "ble": "name = 'battery'\n",
    "can": "dbc = 'pack.dbc'\nvoltage = { signal = 'V' }\ncurrent = { signal = 'I' }\n",
    "mqtt": "profile = 'opendtu'\n",
    "modbus": "host = 'gx'\nvoltage = { address = 259 }\ncurrent = { address = 261 }\n",
}
"""Required settings of ``[source]``, by kind."""


def test_file_of_init_contains_all_settings_and_is_valid_with_all_of_them_uncommented(pack, capsys):
    run(capsys, "config", "init", pack)
    lines = pack.read_text().splitlines()
    for name, field in Settings.model_fields.items():
        assert f"[{name}]" in lines or f"#[{name}]" in lines, field
    # a required setting has no default: its line ends in "= " and is not valid TOML
    uncommented = [line.removeprefix("#") for line in lines if not line.startswith("# ") and not line.endswith("= ")]
    sections = re.split(r"^(?=\[)", "\n".join(uncommented), flags=re.MULTILINE)
    sources = [section for section in sections if section.startswith("[source]")]
    assert len(sources) == len(KINDS)
    for source in sources:  # only one [source] is allowed at a time
        kind = tomllib.loads(source)["source"]["kind"]
        complete_source = source + REQUIRED_SETTINGS.get(kind, "")
        pack.write_text("\n".join([*(section for section in sections if section not in sources), complete_source]))
        written = tomllib.loads(pack.read_text())
        assert written["sensor"]["baud"] == Settings().sensor.baud
        assert set(written) == set(Settings.model_fields)
        loaded = load_settings(pack)
        assert loaded.source
        assert loaded.source.kind in KINDS
        assert loaded.sensor.protocol == "text"  # the decoder of all sources except the serial line
        checked_fields = set(written["sensor"]) - {"protocol"}
        assert loaded.sensor.model_dump(include=checked_fields) == Settings().sensor.model_dump(include=checked_fields)


def test_init_does_not_overwrite_a_file(pack, capsys):
    pack.write_text("mine\n")
    code, out, err = run(capsys, "config", "init", pack)
    assert (code, out) == (2, "")
    assert f"{pack}: exists already" in err
    assert pack.read_text() == "mine\n"


@pytest.mark.parametrize(
    ("text", "message_parts"),
    [
        ("[pack]\nseries = 0\n", ["pack.series = 0", "greater than or equal to 1"]),
        ("[pack]\nsereis = 2\n", ["pack.sereis", "unknown key"]),
        ("[wrong]\na = 1\n", ["wrong", "unknown key"]),
        ("[prometeus]\n", ["prometeus: unknown key; is prometheus meant?"]),
        ("[page]\nport = 1\n", ["page.port: unknown key; there are listen, token_file, hosts"]),
        ('[source]\nkind = "mqt"\n', ["source.kind = 'mqt': must be one of 'mqtt', 'linux'"]),
        ('[source]\nkind = "mqt"\n', ["; is mqtt meant?"]),
        ('[source]\nkind = "mqtt"\nprofile = "esphome_jk"\n', ["must be one of batmon-ha", "; is esphome-jk meant?"]),
        ('[source]\nkind = "modbus"\nprofile = "victron"\n', ["'victron' must be one of", "; is victron-gx meant?"]),
        ('[sensor]\nprotocol = "JDB"\n', ["must be one of binary", "; is jbd meant?"]),
        ('[pack]\ncell = "chenmora"\n', ["chenmora: no such cell file", "; is chen_mora meant?"]),
        ('[log]\nlevel = "warnin"\n', ["; is warning meant?"]),
        ('[source]\nkind = "mqtt"\nprofil = "x"\n', ["source.profil: unknown key; is profile meant?"]),
        ("[observer]\nlamda = 1\n", ["observer.lamda: unknown key; is lambda meant?"]),
        ("[alarms]\nsoc_low = 20\n", ["alarms.soc_low = 20: must be a table"]),
        (
            '[influx]\nurl = "localhost:8086"\n',
            ["influx.url = 'localhost:8086': is not of the form", "http://host:port"],
        ),
        ('[sensor]\nprotocol = "x"\n', ["sensor.protocol = 'x'", "must be one of binary, "]),
        ('[sensor]\nbaud = "fast"\n', ["sensor.baud = 'fast'", "number, without quotes"]),
        ("[observer]\nlambda = -1\n", ["observer.lambda = -1", "greater than 0"]),
        ('[mqtt]\nurl = "http://x"\n', ["mqtt.url = 'http://x'", "mqtt://"]),
        ('[page]\nlisten = "0.0.0.0:8765"\n', ["page: listen", "open to other machines: name a token_file"]),
        ('[page]\nlisten = "8765"\n', ["page.listen = '8765'", "host:port"]),
        ('[pack]\ncell = ""\n', ["pack.cell = ''", "must not be empty", "name of a shipped cell"]),
        ('[sensor]\nport = ""\n', ["sensor.port = ''", "must not be empty", "path of the serial port"]),
        ("[pack]\nparallel = 20000\n", ["pack.parallel = 20000", "less than or equal to 10000"]),
        ("[sensor]\nbaud = 20_000_000\n", ["sensor.baud = 20000000", "less than or equal to 10000000"]),
        ("[state]\ncheckpoint_s = 0.1\n", ["state.checkpoint_s = 0.1", "greater than or equal to 1"]),
        ("[identifier]\nmap_memory_h = 0.5\n", ["identifier.map_memory_h = 0.5", "greater than or equal to 1"]),
        ('[mqtt]\nbase_topic = "/bms"\n', ["mqtt.base_topic = '/bms'", "nor begin or end with /"]),
        ('[mqtt]\nbase_topic = "home/bms/"\n', ["mqtt.base_topic = 'home/bms/'", "nor begin or end with /"]),
        ("[source]\nchip = 5\n", ["source.kind", "missing"]),
        (
            '[sensor]\nport = "/dev/ttyUSB0"\nprotocol = "jbd"\n[source]\nkind = "linux"\n',
            ["sensor.port, sensor.protocol: ", "[source] describes another source"],
        ),
        (
            '[source]\nkind = "linux"\nshunt_ohm = 0\n',
            ["source.shunt_ohm = 0: ", "greater than 0", "resistance of the shunt"],
        ),
        ('[pack]\ncell = "nonsense"\n', ["nonsense", "ncr18650", "lfp"]),
        ('[pack]\ncell = "lfp"\n', ["lfp is a generic cell", "capacity_ah of [pack]"]),
        ('[pack]\ncell = "lfp"\ncapacity_ah = 0\n', ["pack.capacity_ah = 0", "greater than 0", "capacity of the cell"]),
    ],
)
def test_error_names_the_setting_and_the_allowed_values(text, message_parts, pack, capsys):
    pack.write_text(text)
    for command in ("check", "show"):
        code, out, err = run(capsys, "config", command, pack)
        assert (code, out) == (2, "")
        assert [part for part in message_parts if part not in err] == [], err
        if "nonsense" not in text and "generic" not in err:  # errors about cells do not name the file
            assert err.startswith(f"error: {pack}: ")


def test_all_errors_of_a_file_are_reported_together(pack, capsys):
    pack.write_text("[pack]\nseries = 0\nparallel = -1\n[sensor]\nbaud = 1\n")
    err = error(run(capsys, "config", "check", pack))
    assert [line.split(": ")[2] for line in err.splitlines()] == [
        "pack.series = 0",
        "pack.parallel = -1",
        "sensor.baud = 1",
    ]


def test_show_prints_the_settings_in_effect_as_toml(pack, capsys):
    pack.write_text('[pack]\ncell = "chen_mora"\nseries = 6\n[sensor]\nport = "/dev/ttyACM3"\n')
    code, out, err = run(capsys, "config", "show", pack)
    assert (code, err) == (0, "")
    settings = tomllib.loads(out)
    assert settings["pack"]["series"] == 6
    assert settings["sensor"] == {**tomllib.loads(default_settings(capsys))["sensor"], "port": "/dev/ttyACM3"}
    assert Settings.model_validate(settings) == load_settings(pack)
    assert "# pack.series_count = 6\n" in out


@pytest.mark.parametrize("rearm_gain", ['"never"', "-2.0"])
def test_output_of_show_is_a_valid_file_with_the_same_settings(rearm_gain, pack, tmp_path, capsys):
    pack.write_text(f'[observer]\nrearm_gain = {rearm_gain}\n[mqtt]\nbase_topic = "home/b"\n[state]\nfolder = "kept"\n')
    code, out, _ = run(capsys, "config", "show", pack)
    assert code == 0
    assert f"rearm_gain = {rearm_gain}\n" in out
    copy = tmp_path / "copy.toml"
    copy.write_text(out)
    assert load_settings(copy) == load_settings(pack) != Settings()


def test_file_of_init_contains_units_and_limits_of_settings(pack, capsys):
    run(capsys, "config", "init", pack)
    text = pack.read_text()
    assert "[h, at least 1]\n#map_memory_h = 336.0\n" in text
    assert "at most 10000000]\n#baud = 500000\n" in text


def default_settings(capsys):
    """Return the default settings, as ``show`` prints them without a file."""
    code, out, _ = run(capsys, "config", "show")
    assert code == 0
    return out


@pytest.fixture
def cell_file(tmp_path):
    """Return a function that writes the shipped NCR18650 with changed values of ``[cell]``."""

    def write(**changes):
        cell = load_cell("ncr18650")
        path = tmp_path / "cell.toml"
        write_cell(path, cell.model_copy(update={"cell": cell.cell.model_copy(update=changes)}))
        return path

    return write


@pytest.mark.parametrize(
    ("cell", "settings", "message"),
    [
        ({"capacity_ah": 1e5}, "", "cell.capacity_ah = 100000: no cell holds more than 2000 Ah"),
        ({}, "capacity_ah = 2900", "pack.capacity_ah = 2900: no cell holds more than 2000 Ah; is it in mAh?"),
        ({"series_count": 4}, "series = 4", "pack.series = 4: the cell file is of 4 cells in series already"),
        ({"nominal_voltage_v": 14.4, "voltage_max_v": 17.0}, "", "14.4 V nominal of 1 in series: 14.4 V a cell"),
        ({}, "series = 14", "14 in series of 3 Ah: a single row of small cells; is pack.parallel right?"),
        (
            {},
            "series = 7\nparallel = 4",
            "sensor.voltage_resolution_v = 0.02441: the board's range ends at 25.0 V, but this pack has 29.1",
        ),
        ({}, "series = 2\nfull_voltage_v = 8.1", "pack.full_voltage_v = 8.1: the OCV of"),
        (
            {},
            "series = 2\ncutoff_voltage_v = 6.8",
            "pack.cutoff_voltage_v = 6.8: the OCV of",
        ),
        ({}, "series = 2\nfull_voltage_v = 84", "pack.full_voltage_v = 84: the OCV of"),
        ({}, "series = 2\ncutoff_voltage_v = 2.5", "pack.cutoff_voltage_v = 2.5: the OCV of"),
        (
            {},
            "tail_current_a = 150",
            "pack.tail_current_a = 150: above 3 A, the limit of the alarm charge_over_current",
        ),
        ({}, "[alarms]\ncell_imbalance = {limit_v = 50}", "alarms.cell_imbalance.limit_v = 50: outside 0.001 to 1 V"),
        ({}, "series = 2\ncutoff_v = 7.6", "pack.cutoff_v = 7.6: the OCV of"),
        ({}, "series = 2\ncutoff_v = 3.3", "pack.cutoff_v = 3.3: the OCV of"),
        (
            {},
            "max_discharge_a = 60",
            "pack.max_discharge_a = 60: above 15 A, the limit of valid samples (current_max_a",
        ),
        (
            {},
            "max_charge_a = 9\n[alarms.charge_over_current]\nlimit_a = 3",
            "pack.max_charge_a = 9: above 3 A, the limit of the alarm charge_over_current, which",
        ),
        (
            {},
            (
                'series = 2\n[source]\nkind = "modbus"\nport = "localhost:502"\n'
                "voltage = {address = 0}\ncurrent = {address = 1}\ncells = {address = 2, count = 4}"
            ),
            "source.cells: 4 cells, but the pack has 2 in series: the others must read 0 V; is pack.series right?",
        ),
    ],
)
def test_check_warns_about_implausible_settings(cell, settings, message, cell_file, pack, capsys):
    pack.write_text(f'[pack]\ncell = "{cell_file(**cell)}"\n{settings}\n')
    code, out, err = run(capsys, "config", "check", pack)
    assert code == 0
    assert f"{pack}: valid; " in out
    assert f"warning: {pack}: {message}" in err


@pytest.mark.parametrize(
    "settings",
    [
        'cell = "ncr18650"\nseries = 6\n[sensor]\nvoltage_resolution_v = 0.03',
        'cell = "ncr18650"\nseries = 14\nparallel = 4\n[sensor]\nvoltage_resolution_v = 0.06',
        'cell = "ncr18650"\nseries = 14\nparallel = 4\n[sensor]\nprotocol = "text"',
        'cell = "leaf"\nseries = 4\nparallel = 2',
        'cell = "lfp"\ncapacity_ah = 100\nseries = 4',
        'cell = "lfp"\ncapacity_ah = 100\nseries = 4\nfull_voltage_v = 13.8\ntail_current_a = 4\ncutoff_voltage_v = 11.2',
        'cell = "lfp"\ncapacity_ah = 100\nseries = 4\nmax_discharge_a = 200\nmax_charge_a = 100',
    ],
)
def test_check_accepts_plausible_packs(settings, pack, capsys):
    pack.write_text(f"[pack]\n{settings}\n")
    code, _, err = run(capsys, "config", "check", pack)
    assert (code, err) == (0, "")


@pytest.mark.parametrize("name", ["mqtt-password", "/run/credentials/bms-estimator.service/mqtt-password"])
def test_check_warns_about_credentials_of_the_service(name, pack, capsys, monkeypatch):
    monkeypatch.delenv("CREDENTIALS_DIRECTORY", raising=False)
    pack.write_text(f'[mqtt]\npassword_file = "{name}"\n')
    code, out, err = run(capsys, "config", "check", pack)
    assert code == 0
    assert f"{pack}: valid; " in out
    assert f"warning: {pack}: mqtt.password_file = {name}: not checked" in err


def test_check_finds_a_credential_by_its_name(pack, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    (tmp_path / "mqtt-password").write_text("secret\n")
    (tmp_path / "mqtt-password").chmod(0o600)
    pack.write_text('[mqtt]\npassword_file = "mqtt-password"\n')
    assert run(capsys, "config", "check", pack)[::2] == (0, "")


def test_check_fails_on_a_missing_password_file(pack, tmp_path, capsys):
    pack.write_text(f'[mqtt]\npassword_file = "{tmp_path / "none"}"\n')
    code, _, err = run(capsys, "config", "check", pack)
    assert code == 75
    assert "mqtt.password_file" in err
    assert "cannot be read" in err


def test_generic_cell_has_the_capacity_of_the_pack(pack, capsys):
    pack.write_text('[pack]\ncell = "lfp"\ncapacity_ah = 100\nseries = 4\nparallel = 2\n')
    code, out, _ = run(capsys, "config", "check", pack)
    assert code == 0
    assert "lfp, 4 in series, 13 V, 200 Ah" in out


def test_check_fails_on_a_missing_token_file_and_warns_about_a_token_in_the_credentials(tmp_path, capsys):
    pack = tmp_path / "pack.toml"
    pack.write_text(f'[influx]\nbucket = "bms"\ntoken_file = "{tmp_path / "none"}"\n')
    code, _, err = run(capsys, "config", "check", pack)
    assert (code, err) == (
        75,
        f"error: influx.token_file = {tmp_path / 'none'}: cannot be read: No such file or directory\n",
    )
    pack.write_text('[influx]\nbucket = "bms"\ntoken_file = "influx-token"\n')
    code, out, err = run(capsys, "config", "check", pack)
    assert (code, "valid" in out) == (0, True)
    assert "influx.token_file = influx-token: not checked" in err


@pytest.mark.parametrize(
    "url", ["mqtt://user:secret@host", "mqtt://user:secret", "mqtt://user:p@secret@", "x://user:secret"]
)
@pytest.mark.parametrize("section", ["mqtt", "edge", "influx"])
def test_a_rejected_url_is_shown_without_its_password(pack, capsys, section, url):
    if section == "influx":
        url = url.replace("mqtt", "http")
    pack.write_text(f'[{section}]\nurl = "{url}"\n')
    code, out, err = run(capsys, "config", "check", pack)
    assert (code, out) == (2, "")
    assert f"{section}.url = " in err
    assert "secret" not in err


@pytest.mark.parametrize(
    ("law", "is_checked"), [("improved", True), ("scheme-3", True), ("scheme-1", False), ("learning", False)]
)
def test_check_names_failing_conditions_of_lemma_4_1_1_only_for_a_law_with_bounds(law, is_checked, pack, capsys):
    """The bounds of chen_mora, those of Table 5 of the thesis, violate a condition (erratum 6)."""
    pack.write_text(f'[pack]\ncell = "chen_mora"\n[observer]\nlaw = "{law}"\n')
    code, _, err = run(capsys, "config", "check", pack)
    assert code == 0
    assert ("of Lemma 4.1.1 fails" in err) == is_checked


@pytest.mark.parametrize(
    ("nussbaum", "k0", "law", "is_zero"),
    [
        ("mittag-leffler", 0.0, "improved", False),
        ("k2-cos", 0.0, "improved", True),
        ("k2-cos", 0.5, "improved", False),
        ("k-cos-sqrt", 0.0, "scheme-1", True),
        ("ln-cos-sqrt-ln", 1.0, "improved", True),
        ("ln-cos-sqrt-ln", 1.5, "improved", False),
        ("k2-cos", 0.0, "learning", False),
    ],
)
def test_check_warns_of_an_initial_gain_for_which_the_nussbaum_function_is_0(nussbaum, k0, law, is_zero, pack, capsys):
    pack.write_text(f'[pack]\ncell = "leaf"\n[observer]\nlaw = "{law}"\nnussbaum = "{nussbaum}"\nk0 = {k0}\n')
    code, _, err = run(capsys, "config", "check", pack)
    assert code == 0
    assert (f"warning: {pack}: observer.k0 = {k0:g}: N(k) of '{nussbaum}' is 0" in err) == is_zero
