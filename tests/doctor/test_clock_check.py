"""Check of the wall clock."""

from pathlib import Path

import pytest

from bms_estimator.doctor import examine
from bms_estimator.doctor.examine import check_clock
from bms_estimator.doctor.finding import Level
from bms_estimator.installation import paths
from tests.doctor.packs import subject, unit_with

UNITS = [("bms-estimator.service", "UNIT"), ("bms-estimator@house.service", "TEMPLATE")]
"""Name of a running unit, and of the constant with the path of its file."""


@pytest.mark.parametrize(("name", "file"), UNITS)
def test_a_service_that_cannot_see_the_clock_of_chrony_needs_the_drop_in_of_its_unit(
    name: str, file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(examine, "is_clock_synchronized", lambda: True)
    monkeypatch.setattr(examine, "TIMESYNCD", tmp_path / "absent")
    monkeypatch.setattr(paths, file, tmp_path / getattr(paths, file).name)
    pack = subject(tmp_path, unit=unit_with(Id=name))
    _, missing = check_clock(pack)
    assert (missing.level, "clock.conf" in missing.remedy) == (Level.WARNING, True)
    drop_in = paths.clock_drop_in(getattr(paths, file))
    drop_in.parent.mkdir()
    drop_in.touch()
    (synchronized,) = check_clock(pack)
    assert synchronized.level is Level.OK


def test_a_clock_that_is_not_synchronized_is_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(examine, "is_clock_synchronized", lambda: False)
    (warning,) = check_clock(None)
    assert (warning.level, "timedatectl" in warning.remedy) == (Level.WARNING, True)
