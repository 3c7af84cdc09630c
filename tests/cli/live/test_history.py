"""``history``: CSV export of the service's database."""

import csv
import io

import pytest

from bms_estimator.store.database import Database
from bms_estimator.store.history import HistorySink
from tests.command_line import run
from tests.store.test_history import record_history, snapshot_at


@pytest.fixture
async def pack(tmp_path):
    """Write a pack file, and a history of five minutes with two publications each."""
    (tmp_path / "pack.toml").write_text(f'[state]\nfolder = "{tmp_path}"\n')
    await record_history(tmp_path / "pack.sqlite", [snapshot_at(30.0 * s) for s in range(10)])
    return tmp_path / "pack.toml"


def read_csv(text):
    """Return the rows as dicts."""
    return list(csv.DictReader(io.StringIO(text)))


def test_minutes_are_printed_with_their_units_and_times(pack, capsys):
    code, out, err = run(capsys, "history", pack)
    assert (code, err) == (0, "")
    first, *others = read_csv(out)
    assert (first["time"], first["current_a"], first["publications"]) == ("2023-11-14T22:14:00.000Z", "2", "2")
    assert len(others) == 4


def test_longer_steps_are_written_to_a_file_that_is_not_overwritten(pack, capsys):
    out_file = pack.with_name("out.csv")
    arguments = ["history", pack, "--since", "2023-11-14T22:15", "--until", "2023-11-14T22:17:00", "--out", out_file]
    assert run(capsys, *arguments, "--step", 3600) == (0, "", "")
    [row] = read_csv(out_file.read_text())
    assert (row["time"], row["publications"]) == ("2023-11-14T22:00:00.000Z", "4")
    code, _, err = run(capsys, *arguments)
    assert (code, "exists already" in err) == (2, True)


def test_events_are_printed(pack, capsys):
    _, out, _ = run(capsys, "history", pack, "--events")
    assert [row["name"] for row in read_csv(out)] == ["start", "sensor_online"]


async def test_history_is_read_while_the_service_runs(pack, capsys):
    async with Database(pack.with_name("pack.sqlite")) as database, HistorySink(database, days=1) as history:
        history.publish(snapshot_at(600.0))  # its minute has not ended, and has no row yet
        await history._write()
        code, out, _ = run(capsys, "history", pack)
    assert (code, len(read_csv(out))) == (0, 5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--step", "90"], "must be a multiple of 60 s"), (["--folder", "/nonexistent"], "no history there")],
)
def test_invalid_arguments_are_reported(pack, capsys, arguments, message):
    code, out, err = run(capsys, "history", pack, *arguments)
    assert (code, out) == (2, "")
    assert message in err
