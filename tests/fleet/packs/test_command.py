"""``fleet packs`` against the real server."""

import asyncio

import nats
import pytest

from bms_estimator.cli.options.pack_options import load_pack
from bms_estimator.edge.subjects import PACKS_BUCKET
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.packs.pack_bucket import write_bucket
from bms_estimator.model.cell import load_cell
from bms_estimator.model.pack_model import cell_text
from tests.command_line import run
from tests.fleet.nats_cluster import running
from tests.free_port import free_port

TABLE_TEXT = "pack,cell,capacity_ah,series,protocol\nboat,own.toml,,2,\nhouse,lfp,280.0,16,jk\n"


async def with_connection(url, use_connection):
    """Connect to the server and await ``use_connection`` of the connection."""
    async with await nats.connect(url) as nc:
        await use_connection(nc)


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    with running(tmp_path_factory.mktemp("cluster")) as cluster:
        asyncio.run(with_connection(cluster.url, lambda nc: make_streams(nc, partitions=1)))
        yield cluster.url


@pytest.fixture
def table(url, tmp_path):
    """Return the path of a table of two packs, one with a cell file. The server's table of packs is empty."""
    asyncio.run(with_connection(url, lambda nc: write_bucket(nc, PACKS_BUCKET, {}, remove=True)))
    (tmp_path / "own.toml").write_text(cell_text(load_cell("ncr18650")))
    path = tmp_path / "packs.csv"
    path.write_text(TABLE_TEXT)
    return path


def test_printed_table_can_be_loaded_again_without_a_change(url, table, capsys):
    code, out, err = run(capsys, "fleet", "packs", "load", table, "--server", url)
    assert (code, err) == (0, "")
    assert out.startswith(f"{table}: 2 packs of 2 kinds: 2 new")
    code, out, err = run(capsys, "fleet", "packs", "list", "--server", url)
    assert (code, out, err) == (0, "pack,cell,capacity_ah,series,protocol\nboat,own,,2,\nhouse,lfp,280.0,16,jk\n", "")
    printed = table.with_name("printed.csv")
    printed.write_text(out)
    assert (
        run(capsys, "fleet", "packs", "load", printed, "--server", url)[1]
        == f"{printed}: 2 packs of 2 kinds: 2 unchanged\n"
    )


def test_rows_are_removed_with_option_remove_or_by_name(url, table, capsys):
    run(capsys, "fleet", "packs", "load", table, "--server", url)
    smaller_table = table.with_name("smaller_table.csv")
    smaller_table.write_text("pack,cell\nshed,ncr18650\n")
    out = run(capsys, "fleet", "packs", "load", smaller_table, "--server", url)[1]
    assert out == f"{smaller_table}: 1 pack of 1 kind: 1 new, 2 not in the table (--remove removes them)\n"
    assert run(capsys, "fleet", "packs", "load", smaller_table, "--remove", "--server", url)[1].endswith(
        "1 unchanged, 2 removed\n"
    )
    code, _, err = run(capsys, "fleet", "packs", "remove", "shed", "boat", "--server", url)
    assert (code, err) == (2, "error: boat: not in the table of packs; `fleet packs list` prints it\n")
    code, out, err = run(capsys, "fleet", "packs", "remove", "shed", "--server", url)
    assert (code, err) == (0, "")
    assert out == (
        "removed from the table: shed\ntheir blocks, states and hourly summaries remain; --erase erases them\n"
    )
    assert run(capsys, "fleet", "packs", "list", "--server", url)[1] == "pack\n"


def test_show_writes_a_pack_file_that_other_commands_read(url, table, tmp_path, capsys):
    run(capsys, "fleet", "packs", "load", table, "--server", url)
    code, out, err = run(capsys, "fleet", "packs", "show", "house", "--server", url)
    assert (code, err) == (0, "")
    assert 'name = "house"' in out
    assert 'protocol = "jk"' in out
    folder = tmp_path / "boat"
    run(capsys, "fleet", "packs", "show", "boat", "--out", folder, "--server", url)
    settings, model = load_pack(folder / "pack.toml")
    assert (settings.pack.name, model.cell.series_count) == ("boat", 2)


def test_invalid_row_is_reported_and_the_other_rows_are_listed(url, table, capsys):
    rows = {"a": b"{", "b": b'{"cell":"ncr18650"}'}
    asyncio.run(with_connection(url, lambda nc: write_bucket(nc, PACKS_BUCKET, rows)))
    code, out, err = run(capsys, "fleet", "packs", "list", "--server", url)
    assert (code, out) == (0, "pack,cell\nb,ncr18650\n")
    assert err.startswith("warning: a: its row is wrong: Invalid JSON")
    code, _, err = run(capsys, "fleet", "packs", "show", "a", "--server", url)
    assert (code, err.startswith("error: a: its row is wrong: ")) == (2, True)


def test_invalid_table_server_or_credentials_are_reported(url, table, capsys):
    table.write_text("pack,cell\nhouse,lfp\n")
    code, _, err = run(capsys, "fleet", "packs", "load", table, "--server", url)
    assert (code, f"{table}: line 2: lfp is a generic cell: give its capacity" in err) == (2, True)
    table.write_text("pack,cell\nhouse,ncr18650\n")
    port = free_port()
    code, _, err = run(capsys, "fleet", "packs", "load", table, "--server", f"nats://127.0.0.1:{port}")
    assert (code, err) == (
        2,
        f"error: --server nats://127.0.0.1:{port}: connection refused: no server listens on this address\n",
    )
    code, _, err = run(capsys, "fleet", "packs", "list", "--creds", table.with_name("no"), "--server", url)
    assert (code, "cannot be read" in err) == (2, True)
