"""Benchmark of a fleet worker: CPU time of a block, in total and by part, and memory and checkpoint size of a pack."""

import sys
import time
from collections.abc import Callable, Iterator

import numpy as np

from bms_estimator.edge.block import Block, decode, encode
from bms_estimator.fleet.worker import hour_summary
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.forecast.capability import write_usable_charge
from bms_estimator.forecast.forecast import Forecast, unknown_values
from bms_estimator.model.cell import load_cell
from bms_estimator.model.sample import SampleBlock
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.parameters import make_parameters_payload
from bms_estimator.telemetry.publish_window import Window
from bms_estimator.telemetry.state import make_state_payload
from bms_estimator.telemetry.weakest_cell import remaining_capacity_ah
from tests.benchmarks.load import CELL, pulses
from tests.benchmarks.table import Row

PACKS, MINUTES, SAMPLES = 100, 90, 60
"""Number of packs, number of blocks (one a minute) of each pack, and number of samples of a block."""
HOUR = 480_000
"""Hour of the blocks [h since 1970]."""
STORE_ID = HOUR * 3600 * 10**9
"""Identifier of the edge's block store: its creation time [ns since 1970]."""
ROUNDS, CALLS = 5, 400
"""Number of measurements of a part, of which the shortest counts, and number of calls in each."""
MAX_US = 400.0
"""Limit of the CPU time of a block with alarms [us]."""
SETTINGS, CELL_MODEL = Settings(), load_cell(CELL)


def rows() -> Iterator[Row]:
    """Measure CPU time in total and by part; each part is the minimum of some rounds."""
    samples = pulses(MINUTES * SAMPLES, rate_hz=1)
    blocks = [encoded_block(samples, minute) for minute in range(MINUTES)]
    partition = Partition(0, lambda _: (SETTINGS, CELL_MODEL))
    block_us = _block_us(partition, blocks)
    yield Row(
        f"a block of {SAMPLES} samples, in total", f"below {MAX_US:.0f} us", f"{block_us:.0f} us", block_us < MAX_US
    )
    rest_us = block_us
    for part_name, us in _part_us(partition, samples, blocks):
        rest_us -= us
        yield Row(f"  {part_name}", "-", f"{us:.1f} us", None)
    yield Row("  the rest: order of blocks, checks, cache misses", "-", f"{rest_us:.1f} us", None)
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
            partition.take(f"pack{pack}", data, sequence)
        minutes_s.append(time.process_time() - begin_s)
    median_s = np.median(minutes_s[1:])
    # The first block after the full hour also completes the summary of the hour.
    hourly_s = max(minutes_s[60] - median_s, 0.0) / 60
    return float(1e6 * (median_s + hourly_s) / PACKS)


def _part_us(partition: Partition, samples: SampleBlock, blocks: list[bytes]) -> Iterator[tuple[str, float]]:
    """Yield the time of each part, on the state before the last block [us]."""
    unpacked, pack_type = partition._records.unpacked, partition.in_force._type_by_pack["pack0"]
    estimator, wall_s = pack_type.estimator, STORE_ID / 1e9 + samples.size
    packed, block, window = partition._records._packs["pack0"], decode(blocks[-1]), Window()
    unpacked.load(packed)
    values = unknown_values()
    before, trace = estimator.record.copy(), estimator.run(block.samples).copy()

    def state() -> bytes:
        window.add(trace, wall_s)
        summary = window.take()
        assert summary is not None
        forecast = Forecast(0.0, values, "none", None)
        return (
            make_state_payload(
                summary, remaining_capacity_ah(estimator), forecast, {}, wall_s, pack_type.meter.update_totals(), 3.0
            )
            .model_dump_json()
            .encode()
        )

    def step() -> None:
        estimator.record[...] = before
        estimator.run(block.samples)

    restore_us = _call_us(lambda: estimator.record.__setitem__(..., before))
    yield "decoding its bytes", _call_us(lambda: decode(blocks[-1]))
    yield "unpacking the state of the pack", _call_us(lambda: unpacked.load(packed))
    yield "the estimator", _call_us(step) - restore_us
    yield (
        "the hour's sums",
        _call_us(lambda: hour_summary.add(unpacked.record["hour"], trace, SAMPLES, STORE_ID, estimator)),
    )
    yield "charge and energy", _call_us(lambda: (pack_type.meter.add(trace), pack_type.meter.update_totals()))
    yield (
        "usable charge and energy",
        _call_us(lambda: write_usable_charge(values, estimator, pack_type.cutoff_v, 0.0)),
    )
    yield "topic state", _call_us(state)
    alarms, cells_v = partition._processor._alarms, block.cells_v
    yield "alarms", _call_us(lambda: alarms.add(pack_type, block.samples, cells_v, trace, wall_s))
    yield "packing the state of the pack", _call_us(unpacked.packed_bytes)
    parameters_us = _call_us(lambda: make_parameters_payload(estimator, wall_s).model_dump_json())
    row_us = _call_us(
        lambda: hour_summary.row(pack_type.settings, HOUR, unpacked.record["hour"], estimator).model_dump_json()
    )
    yield "topic parameters and the row of an hour, a 60th of it", (parameters_us + row_us) / 60


def _call_us(call: Callable[[], object]) -> float:
    """Return the CPU time of a call [us]."""
    min_s = float("inf")
    for _ in range(ROUNDS):
        begin_s = time.process_time()
        for _ in range(CALLS):
            call()
        min_s = min(min_s, time.process_time() - begin_s)
    return 1e6 * min_s / CALLS
