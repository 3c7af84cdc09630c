"""Sources that need an optional library: the error about a missing library names the extra to install."""

import sys
from pathlib import Path

import pytest

from bms_estimator.sources.factory import KINDS
from tests.command_line import error, run


@pytest.mark.parametrize(
    ("source", "package", "extra"),
    [
        ('kind = "modbus"\nprofile = "victron-gx"\nhost = "127.0.0.1"', "pymodbus", "modbus"),
        ('kind = "can"\nprofile = "pylontech-can"', "can", "can"),
        ('kind = "can"\nprofile = "pylontech-can"', "cantools", "can"),
    ],
)
def test_missing_package_is_reported_with_its_extra(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    source: str,
    package: str,
    extra: str,
) -> None:
    for module in [*KINDS.values(), "fieldbus.can_signals"]:  # they are imported again
        monkeypatch.delitem(sys.modules, f"bms_estimator.sources.{module}", raising=False)
    monkeypatch.setitem(sys.modules, package, None)  # its import fails
    pack = tmp_path / "pack.toml"
    pack.write_text(f"[source]\n{source}\n")
    err = error(run(capsys, "record", "--pack", pack, tmp_path / "out.bmsraw"))
    assert f"this command needs the package {package}: pip install 'bms_estimator[{extra}]'" in err
