"""``backup`` and ``restore``: a pack moves to another machine with its settings, its password and all that it has learned."""

import asyncio
import tarfile
from pathlib import Path

import pytest

from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.model.cell import load_cell
from bms_estimator.process.state_folder import instance_lock, state_folder
from bms_estimator.service.live_loop import run_estimation_loop
from bms_estimator.settings.pack import Settings, load_settings
from tests.command_line import error, run
from tests.scripted_source import ScriptedSource

SETTINGS = """
[pack]
name = "home"
[mqtt]
password_file = "home.password"
"""


@pytest.fixture
def pack(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the settings file of a pack on the first machine, with a password file beside it."""
    machine = tmp_path / "first"
    machine.mkdir()
    monkeypatch.setenv("XDG_STATE_HOME", str(machine / "state"))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    (machine / "home.toml").write_text(SETTINGS)
    (machine / "home.password").write_text("secret")
    monkeypatch.chdir(machine)
    return machine / "home.toml"


async def learn(settings: Settings) -> None:
    """Run the service of a pack for ten samples of a load."""
    model, source = load_cell("ncr18650"), ScriptedSource()
    source.give(*((float(second), 1.0, 3.8) for second in range(10)))
    source.finish()
    files = StateFiles(state_folder(settings), settings, model)
    await run_estimation_loop(settings, model, source=source, sinks=[], stop=asyncio.Event(), files=files)


def saved_soc(settings: Settings) -> float:
    return StateFiles(state_folder(settings), settings, load_cell("ncr18650")).saved_pack().pack.estimator.soc


def test_a_pack_moves_to_another_machine_with_its_settings_and_all_that_it_has_learned(
    pack, tmp_path, capsys, monkeypatch
):
    asyncio.run(learn(load_settings(pack)))
    alike = state_folder(load_settings(pack)) / "home-12345678.run"  # of another pack
    alike.write_text("{}")
    soc, archive, moved = saved_soc(load_settings(pack)), tmp_path / "home.tar.gz", tmp_path / "second" / "house.toml"
    assert run(capsys, "backup", pack, archive)[0] == 0
    assert archive.stat().st_mode & 0o777 == 0o600  # it contains the password
    moved.parent.mkdir()
    monkeypatch.setenv("XDG_STATE_HOME", str(moved.parent / "state"))
    assert run(capsys, "restore", archive, moved)[0] == 0
    assert moved.read_text() == SETTINGS
    assert moved.with_name("home.password").read_text() == "secret"
    assert {each.name for each in moved.parent.iterdir()} == {"house.toml", "home.password", "state"}
    assert saved_soc(load_settings(moved)) == soc
    names = {each.name for each in (moved.parent / "state/bms-estimator").iterdir()}
    assert names == {each.name for each in (pack.parent / "state/bms-estimator").iterdir()} - {alike.name}
    assert "the pack has a state already" in error(run(capsys, "restore", archive, moved))


def test_a_running_service_and_another_pack_are_refused(pack, tmp_path, capsys):
    archive = tmp_path / "home.tar.gz"
    assert "has no state of the pack home" in run(capsys, "backup", pack, archive)[2]
    settings = load_settings(pack)
    (state_folder(settings) / "home.run").write_text("{}")
    with instance_lock(state_folder(settings), "home"):
        assert "this pack is served already" in run(capsys, "backup", pack, archive)[2]
    assert run(capsys, "backup", pack, archive)[0] == 0
    other = pack.with_name("other.toml")
    other.write_text('[pack]\nname = "other"\n')
    assert "archive of the pack home, but" in run(capsys, "restore", archive, other)[2]


def test_a_file_that_is_no_archive_is_refused(pack, tmp_path, capsys):
    broken, foreign = tmp_path / "broken.tar.gz", tmp_path / "foreign.tar.gz"
    broken.write_bytes(b"no archive")
    with tarfile.open(foreign, "w:gz") as archive:
        archive.add(pack, "home.toml")
    assert run(capsys, "restore", broken, pack)[2].startswith(f"error: {broken}: ")
    assert "is not an archive of bms-estimator backup" in run(capsys, "restore", foreign, pack)[2]


@pytest.mark.parametrize("position", [40, 200, -20])
def test_a_damaged_archive_is_refused(pack, tmp_path, capsys, position):
    archive = tmp_path / "home.tar.gz"
    (state_folder(load_settings(pack)) / "home.run").write_text("{}")
    assert run(capsys, "backup", pack, archive)[0] == 0
    content = bytearray(archive.read_bytes())
    content[position : position + 8 or None] = b"\xff" * 8
    archive.write_bytes(content)
    err = error(run(capsys, "restore", archive, tmp_path / "second.toml"))
    assert err.startswith(f"error: {archive}: ")
