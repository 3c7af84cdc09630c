"""History of packs from Parquet files."""

import asyncio
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from nats.aio.client import Client
from pyarrow import parquet

from bms_estimator.fleet.ingest import backfill as backfill_module
from bms_estimator.fleet.ingest.backfill import backfill, parquet_files, read_history
from bms_estimator.fleet.ingest.batch_samples import BatchReader
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.errors import UserError
from tests.fleet.ingest.platform import columns_of, options, running_ingest, samples_of
from tests.fleet.ingest.worker_states import of_one_run, states, worker
from tests.fleet.nats_cluster import NatsCluster
from tests.fleet.workers import load_packs
from tests.patience import LONG_S

COUNT = 6000
"""Number of samples of a pack: 17 h."""


def write(path: Path, rows: SampleBlock, **more: Any) -> None:
    """Write samples to a Parquet file, with further columns."""
    path.parent.mkdir(exist_ok=True)
    parquet.write_table(pa.table({**columns_of(rows), **more}), path)


def samples_by_pack(files: list[Path]) -> dict[str, list[float]]:
    """Return the times of each pack's samples."""
    times = dict[str, list[float]]()
    for pack, batch in read_history(files, BatchReader(), files[0].parent):
        times.setdefault(pack, []).extend(batch.samples["time_s"].tolist())
    return times


async def test_interrupted_and_repeated_backfill_gives_the_states_of_one_run(
    nc: Client, cluster: NatsCluster, tmp_path: Path
) -> None:
    registry = await load_packs(nc, ["p1", "p2"])
    rows = {pack: samples_of(pack, COUNT) for pack in ("p1", "p2")}
    for number, part in enumerate(np.array_split(np.arange(COUNT), 3)):
        both = np.concatenate([rows[pack][part] for pack in rows])
        write(tmp_path / "history" / f"{number}.parquet", both[::-1], pack=["p2"] * part.size + ["p1"] * part.size)
    blocks = await nc.subscribe("raw.*")
    async with worker(cluster.url, 2 * COUNT):
        async with running_ingest(tmp_path, cluster.url, "--parquet", tmp_path / "history") as ingest:
            await blocks.next_msg(LONG_S)
            ingest.process.kill()
            await ingest.process.wait()
        for _ in range(2):
            summary = await backfill(options(tmp_path, cluster.url), [tmp_path / "history"], asyncio.Event())
    assert summary.startswith("0 samples sent; 12,000 at or before the last stored time of their pack;")
    assert await states(nc, registry, *rows) == [of_one_run(registry, pack, rows[pack]) for pack in rows]


async def test_backfill_waits_for_confirmations(
    nc: Client, cluster: NatsCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    await load_packs(nc, ["p1"])
    write(tmp_path / "p1.parquet", samples_of("p1", 240))
    write(tmp_path / "ghost.parquet", samples_of("p2", 7))
    values = {"MAX_UNCONFIRMED_OF_PACK": 15, "MAX_PART_SAMPLES": 6, "SAVE_SAMPLES": 6, "REQUEST_S": 0.1, "WAIT_S": 0.05}
    for name, value in values.items():
        monkeypatch.setattr(backfill_module, name, value)
    blocks = await nc.subscribe("raw.p1")
    running = asyncio.create_task(backfill(options(tmp_path, cluster.url), [tmp_path], asyncio.Event()))
    await blocks.next_msg(LONG_S)
    async with worker(cluster.url, 240):
        assert not running.done()  # 40 blocks, of which no worker has confirmed one
        summary = await running
    assert summary.startswith("240 samples sent; 0 at or before")
    assert summary.endswith("7 of packs that are not in the table of packs (ghost)")


@pytest.mark.parametrize("form", ["timestamp", "text", "milliseconds", "seconds"])
def test_time_may_have_any_form(tmp_path: Path, form: str) -> None:
    rows = samples_of("p1", 20_000)[::7]
    times_s = rows["time_s"].tolist()
    columns = {
        "timestamp": {"time": pa.array([round(1e6 * time_s) for time_s in times_s], pa.timestamp("us", "UTC"))},
        "text": {"time": [datetime.fromtimestamp(time_s, UTC).isoformat() for time_s in times_s]},
        "milliseconds": {"time_ms": [round(1e3 * time_s) for time_s in times_s]},
        "seconds": {"time_s": times_s},
    }[form]
    table = pa.table({**columns, "current_a": rows["current_a"], "voltage_v": rows["voltage_v"]})
    order = np.random.default_rng(1).permutation(rows.size)
    parquet.write_table(table.take(order), tmp_path / "van-17.parquet")
    assert samples_by_pack(parquet_files([tmp_path])) == {"van-17": times_s}


def test_packs_advance_together(tmp_path: Path) -> None:
    rows = samples_of("p1", 20_000)  # 55 h
    for pack in ("a", "b"):
        write(tmp_path / f"{pack}.parquet", rows)
    packs = [pack for pack, _ in read_history(parquet_files([tmp_path]), BatchReader(), tmp_path)]
    assert packs[:3] == ["a", "b", "a"]


def test_errors_name_file_and_column(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no \.parquet file in this folder"):
        parquet_files([tmp_path])
    with pytest.raises(UserError, match="does not exist"):
        parquet_files([tmp_path / "missing.parquet"])
    write(tmp_path / "p1.parquet", samples_of("p1", 5), voltage_v=["high"] * 5)
    with pytest.raises(UserError, match="pack p1: row 1: voltage_v = 'high': must be a number"):
        samples_by_pack(parquet_files([tmp_path]))
    parquet.write_table(pa.table({"time_s": [1.0], "current_a": [1.0]}), tmp_path / "p1.parquet")
    with pytest.raises(UserError, match="no column of voltage; found time_s, current_a"):
        samples_by_pack(parquet_files([tmp_path]))
    nested = pa.array([[[3.7]]] * 5)
    write(tmp_path / "p1.parquet", samples_of("p1", 5), cells_v=nested)
    with pytest.raises(UserError, match=r"column cells_v is list<.*must be numbers"):
        samples_by_pack(parquet_files([tmp_path]))
    write(tmp_path / "p1.parquet", samples_of("p1", 5), **{f"cell_{n}_v": [3.7] * 5 for n in range(1, 257)})
    with pytest.raises(UserError, match="256 columns of cell voltages: must be at most 255"):
        samples_by_pack(parquet_files([tmp_path]))
    (tmp_path / "p1.parquet").write_bytes(b"garbage")
    with pytest.raises(UserError, match=r"p1\.parquet"):
        samples_by_pack(parquet_files([tmp_path]))
