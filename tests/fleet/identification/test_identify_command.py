"""``fleet identify`` with the real server: it reads samples from the stream and uploads new cells."""

import asyncio
import csv

import nats
import numpy as np
import pytest

from bms_estimator.cli.options.pack_options import load_pack
from bms_estimator.edge import subjects
from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.packs.pack_bucket import put
from bms_estimator.fleet.packs.pack_row import encode_row
from tests.command_line import run
from tests.fleet.identification.test_reidentify import PACK_SPEC, WRONG_CELL_TOML, pack_samples
from tests.fleet.nats_cluster import running

STORE_ID_NS = 1_700_000_000 * 10**9
"""Creation time of the edge's block store, which identifies it [ns since 1970]."""


async def upload(url):
    """Upload pack rows and a cell file, and publish 8 h of samples of ``house`` and 0.7 h of ``young``."""
    samples = pack_samples(8, rests=False)  # a driving load without rests
    async with await nats.connect(url) as nc:
        await make_streams(nc, partitions=1)
        await put(nc, subjects.CELLS_BUCKET, {"own": WRONG_CELL_TOML.encode()})
        pack_rows = {name: encode_row(PACK_SPEC) for name in ("house", "silent", "young")}
        await put(nc, subjects.PACKS_BUCKET, pack_rows | {"wrong": b"{"})
        for number, part in enumerate(np.array_split(samples, 100), 1):
            arrival_s = STORE_ID_NS * 1e-9 + part["time_s"][-1]
            data = encode(
                Block(store_created_ns=STORE_ID_NS, number=number, oldest=1, arrival_s=arrival_s, samples=part)
            )
            await nc.publish(subjects.raw("house"), data)
            if number < 10:
                await nc.publish(subjects.raw("young"), data)
        await nc.flush()


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    with running(tmp_path_factory.mktemp("cluster"), partitions=1) as cluster:
        asyncio.run(upload(cluster.url))
        yield cluster.url


def test_better_cells_are_written_and_uploaded(url, tmp_path, capsys):
    pack_list, out = tmp_path / "list.csv", tmp_path / "identified"
    pack_list.write_text("rank,pack\n1,young\n2,silent\n3,wrong\n4,house\n")
    command = [
        "fleet",
        "identify",
        "house",
        "--from-file",
        pack_list,
        "--out",
        out,
        "--put",
        "--processes",
        1,
        "--server",
        url,
    ]
    code, message, err = run(capsys, *command)
    assert (code, err) == (0, "")
    assert "1 of 4 packs have a better cell" in message
    with (out / "results.csv").open() as file:
        rows = {row["pack"]: row for row in csv.DictReader(file)}
    assert rows["house"]["better"] == "True"
    assert float(rows["house"]["rms_v"]) < 0.5 * float(rows["house"]["rms_before_v"])
    assert rows["young"]["reason"].endswith("h of samples: at least 6 h are needed")
    assert rows["silent"]["reason"] == "the server keeps no sample of it in this span"
    assert rows["wrong"]["reason"].startswith("its row is wrong")
    assert [path.name for path in out.glob("*.toml")] == ["house.toml"]
    run(capsys, "fleet", "packs", "show", "house", "--out", tmp_path / "shown", "--server", url)
    settings, model = load_pack(tmp_path / "shown" / "pack.toml")
    assert (settings.pack.cell, settings.pack.capacity_ah) == ("of-house.toml", None)
    assert model.cell.capacity_ah == pytest.approx(PACK_SPEC.parallel * float(rows["house"]["capacity_ah"]))
    assert "results.csv: exists already" in run(capsys, *command)[2]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "name at least one pack, or give --from-file LIST"),
        (["house", "nobody"], "nobody: not in the table of packs"),
        (["--from-file", "/nowhere"], "--from-file /nowhere: cannot be read"),
    ],
)
def test_invalid_arguments_are_rejected(url, tmp_path, capsys, arguments, message):
    code, _, err = run(capsys, "fleet", "identify", *arguments, "--out", tmp_path / "out", "--server", url)
    assert (code, message in err) == (2, True)
