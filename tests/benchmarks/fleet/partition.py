"""Benchmark of a fleet worker: CPU time of a block, in total and by part, and memory and checkpoint size of a pack."""

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.worker import block_processor, hour_summary, partition as partition_module
from bms_estimator.fleet.worker.block_processor import BlockProcessor
from bms_estimator.fleet.worker.pack_alarms import PackAlarms
from bms_estimator.fleet.worker.pack_records import PackRecords
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.cell import load_cell
from bms_estimator.pack.pack import Pack
from bms_estimator.settings.pack import Settings
from tests.benchmarks.load import CELL, pulses
from tests.benchmarks.table import Row

PACKS, MINUTES, SAMPLES = 100, 90, 60
"""Number of packs, number of blocks (one a minute) of each pack, and number of samples of a block."""
HOUR = 480_000
"""Hour of the blocks [h since 1970]."""
STORE_ID = HOUR * 3600 * 10**9
"""Identifier of the edge's block store: its creation time [ns since 1970]."""
PARTS: dict[str, tuple[Any, str]] = {
    "decoding its bytes": (partition_module, "decode"),
    "unpacking the state of the pack": (PackRecords, "load"),
    "estimates of pack and cells": (Pack, "run"),
    "the hour's sums": (hour_summary, "add"),
    "alarms": (PackAlarms, "add"),
    "topic state": (BlockProcessor, "_state_payload"),
    "of it usable charge and energy": (block_processor, "write_usable_charge"),
    "packing the state of the pack": (PackRecords, "store"),
}
"""Function of each measured part of a block: module or class, and name."""
MAX_US = 400.0
"""Limit of the CPU time of a block with alarms [us]."""
SETTINGS, CELL_MODEL = Settings(), load_cell(CELL)


def rows() -> Iterator[Row]:
    """Measure CPU time in total and by part."""
    samples = pulses(MINUTES * SAMPLES, rate_hz=1)
    blocks = [encoded_block(samples, minute) for minute in range(MINUTES)]
    partition = Partition(0, lambda _: (SETTINGS, CELL_MODEL))
    block_us = _block_us(partition, blocks)
    yield Row(
        f"a block of {SAMPLES} samples, in total", f"below {MAX_US:.0f} us", f"{block_us:.0f} us", block_us < MAX_US
    )
    spent_s = Counter[str]()
    with pytest.MonkeyPatch.context() as patch:
        for part, (owner, name) in PARTS.items():
            patch.setattr(owner, name, _timed(getattr(owner, name), spent_s, part))
        total_us = _block_us(Partition(0, lambda _: (SETTINGS, CELL_MODEL)), blocks)
    for part in PARTS:
        us = 1e6 * spent_s[part] / (PACKS * MINUTES)
        yield Row(f"  {part}", "-", f"{us:.1f} us, {us / total_us:.0%}", None)
    packs = partition.snapshot().packs
    bytes_per_pack = sum(map(sys.getsizeof, packs.values())) / PACKS
    begin_s = time.process_time()
    data = b"".join(partition.snapshot().chunks())
    written_s = time.process_time() - begin_s
    begin_s = time.process_time()
    Partition.restore(0, lambda _: None, data)
    read_s = time.process_time() - begin_s
    yield Row("a pack in memory", "-", f"{bytes_per_pack / 1e3:.1f} kB", None)
    yield Row("a pack in the checkpoint", "-", f"{len(data) / PACKS / 1e3:.1f} kB", None)
    yield Row("  to write it", "-", f"{1e6 * written_s / PACKS:.0f} us", None)
    yield Row("  to read it", "-", f"{1e6 * read_s / PACKS:.0f} us", None)


def encoded_block(samples: SampleBlock, minute: int) -> bytes:
    """Return the encoded block of one minute."""
    part = samples[minute * SAMPLES : (minute + 1) * SAMPLES]
    arrival_s = STORE_ID / 1e9 + float(part["time_s"][-1])
    return encode(Block(store_created_ns=STORE_ID, number=minute + 1, oldest=1, arrival_s=arrival_s, samples=part))


def _block_us(partition: Partition, blocks: list[bytes]) -> float:
    """Return the CPU time of one block, with the blocks of all packs in turn [us].

    It is the median of all minutes plus a 60th of the additional time at the full hour.
    """
    minutes_s, sequence = [], 0
    for data in blocks:
        begin_s = time.process_time()
        for pack in range(PACKS):
            sequence += 1
            partition.process(f"pack{pack}", data, sequence)
        minutes_s.append(time.process_time() - begin_s)
    median_s = np.median(minutes_s[1:])
    # The first block after the full hour also completes the summary of the hour.
    hourly_s = max(minutes_s[60] - median_s, 0.0) / 60
    return float(1e6 * (median_s + hourly_s) / PACKS)


def _timed(call: Callable[..., Any], spent_s: Counter[str], part: str) -> Callable[..., Any]:
    """Return ``call`` with its CPU time added to ``spent_s`` [s]."""

    def timed(*arguments: Any, **named: Any) -> Any:
        begin_s = time.thread_time()
        try:
            return call(*arguments, **named)
        finally:
            spent_s[part] += time.thread_time() - begin_s

    return timed
