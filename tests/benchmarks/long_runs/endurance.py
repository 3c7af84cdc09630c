"""Load test: thousands of frames a second over a PTY, a day of serial bytes, attacks, a lost sensor, and wear of the disk.

The attacks are idle connections to the HTTP listeners of service, dashboard and fleet page while their broker or server is
restarted, an edge of a fleet that misuses its token, and those of ``attacks``.

make load ARGS="--rate 5000 --minutes 10 --hours 24 --no-idle --lost 10 --attack-s 20 --wear-minutes 18"
"""

import argparse
import asyncio
import math
import multiprocessing as mp
import os
import signal
import sys
import tempfile
import time
import tty
from collections.abc import Coroutine, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.chen_mora import simulate_cell
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.model.cell import load_cell
from bms_estimator.protocols.firmware.protocol import BoardProtocol
from tests.benchmarks import disk_wear
from tests.benchmarks.load import CELL, CURRENT_STEP_A, HALF_PERIOD_S, ON_A, VOLTAGE_STEP_V
from tests.benchmarks.long_runs import attacks, edge_token, lost_sensor
from tests.benchmarks.table import Row, show
from tests.benchmarks.wire import hello, sample_frames
from tests.fleet.nats_cluster import running
from tests.idle_connections import (
    DESCRIPTORS,
    IDLE_CONNECTIONS,
    Outcome,
    attack_dashboard,
    attack_fleet_page,
    attack_service,
    few_descriptors,
)
from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S

BOARD_RATE_HZ = 1000
"""Rate in the hello message [Hz], the highest of the protocol. The timestamps show the true rate."""
SEND_S = 0.002
"""Interval at which the board sends its bytes, as on USB [s]."""
BURST_S = 0.006
"""Maximum duration of the frames that are sent at once after a delay of the sender [s]."""
CHUNK_S = 10.0
"""Duration of the frames that the sender prepares at a time [s]."""
WARM_S = 20.0
"""Warm-up time before CPU time and memory are measured [s]."""
DIRECTION_S = 8.0 * 3600.0
"""Duration of discharge pulses, and of the charge pulses after them [s]."""
MAX_CPU = 0.20
"""Limit of the CPU time of the service as a fraction of a core."""
MAX_GROWTH_MIB = 2.0
"""Limit of the growth of the resident memory [MiB]."""
READ_BYTES = 4096
"""Number of bytes of a read in the day of serial bytes."""
PACK_TOML = """
[pack]
name = "load"
cell = "{cell}"
[sensor]
port = "{port}"
sample_rate_hz = {rate_hz}
[mqtt]
url = "{url}"
[state]
folder = "{folder}"
"""


def simulate_load(first: int, count: int, rate_hz: int, soc: float) -> tuple[SampleBlock, float]:
    """Return samples ``first`` to ``first + count - 1`` of a pack under a pulsed load, and the SOC after them.

    The RC voltages are zero at the first sample.
    """
    cell = load_cell(CELL)
    block = np.zeros(count, dtype=SAMPLE)
    time_s = np.arange(first, first + count) / rate_hz
    direction = 1.0 - 2.0 * (time_s // DIRECTION_S % 2.0)
    current_a = ON_A * direction * (time_s % (2.0 * HALF_PERIOD_S) < HALF_PERIOD_S)
    voltage_v, socs = simulate_cell((soc, 0.0, 0.0), time_s, current_a, cell.cell.capacity_ah * 3600.0, cell.a)
    noise = np.random.default_rng(first).uniform(-0.5, 0.5, (2, count))
    block["time_s"] = time_s
    block["current_a"] = np.round(current_a / CURRENT_STEP_A + noise[0]) * CURRENT_STEP_A
    block["voltage_v"] = np.round(voltage_v / VOLTAGE_STEP_V + noise[1]) * VOLTAGE_STEP_V
    return block, float(socs[-1])


def chunks(rate_hz: int, seconds: float, chunk_s: float) -> Iterator[bytes]:
    """Yield the bytes that the board sends, in chunks of ``chunk_s``."""
    soc, first, total = 0.9, 0, round(rate_hz * seconds)
    while first < total:
        count = min(round(rate_hz * chunk_s), total - first)
        block, soc = simulate_load(first, count, rate_hz, soc)
        yield sample_frames(block, first).tobytes()
        first += count


def send(master: int, rate_hz: int, seconds: float, results: "mp.Queue[tuple[int, int, int]]") -> None:
    """Send frames at ``rate_hz``, as a board does. This function runs in another process.

    Frames for which the line has no space are lost. At the end the numbers of all frames, of lost frames and of written bytes
    are put into ``results``. After a delay of the process, pending frames are sent in small bursts.
    """
    os.set_blocking(master, False)
    frame_bytes = len(next(chunks(rate_hz, 1.0 / rate_hz, 1.0)))
    begin_s, frames, lost, written = time.monotonic(), 0, 0, 0  # numbers of frames, lost frames and written bytes
    for chunk in chunks(rate_hz, seconds, CHUNK_S):
        position = 0
        while position < len(chunk):
            time.sleep(SEND_S)
            due_frames = min(round((time.monotonic() - begin_s) * rate_hz) - frames, round(BURST_S * rate_hz))
            end = min(position + due_frames * frame_bytes, len(chunk))
            frames += (end - position) // frame_bytes
            while position < end:
                try:
                    accepted = os.write(master, chunk[position:end])
                    position, written = position + accepted, written + accepted
                except BlockingIOError:
                    lost += (end - position + frame_bytes - 1) // frame_bytes
                    position = end
    results.put((frames, lost, written))


@dataclass(frozen=True)
class Run:
    """Results of the load over the PTY."""

    sent: int
    """Number of frames of the board."""
    no_space: int
    """Number of frames for which the line had no space, because the service did not read."""
    line: dict[str, int]
    """Counters of the line, by the health message of the service."""
    samples: dict[str, int]
    """Counters of the samples, by the same message."""
    cpu: float
    """CPU time of the service as a fraction of a core."""
    rss_mib: tuple[float, float]
    """Mean resident memory of the first and of the second half [MiB]."""


async def serve(rate_hz: int, seconds: float, folder: Path, broker: Broker) -> Run:
    """Run the service on a PTY, send frames to it, and return its counters."""
    master, slave = os.openpty()
    tty.setraw(slave)
    pack = folder / "load.toml"
    pack.write_text(
        PACK_TOML.format(cell=CELL, port=os.ttyname(slave), rate_hz=BOARD_RATE_HZ, url=broker.url, folder=folder)
    )
    program = Path(sys.executable).with_name("bms-estimator")
    async with Listener(broker) as live:
        with (folder / "log").open("w") as log:
            service = await asyncio.create_subprocess_exec(program, "run", "--no-view", pack, stdout=log, stderr=log)
        try:
            await live.wait_json("bms/load/health", lambda h: "no frame yet" in (h["sensor_message"] or ""))
            os.write(master, b"\0" + hello(BOARD_RATE_HZ))  # the delimiter ends what may be left of an earlier frame
            spawn = mp.get_context("spawn")
            results: mp.Queue[tuple[int, int, int]] = spawn.Queue()
            sender = spawn.Process(
                target=_send_over, args=(mp.reduction.DupFd(master), rate_hz, seconds, results), daemon=True
            )
            sender.start()
            await live.wait_json("bms/load/state")
            process = psutil.Process(service.pid)
            rss_mib, begin_s, before_s = list[float](), 0.0, 0.0
            started_s = time.monotonic()
            while sender.is_alive() and service.returncode is None:
                await asyncio.sleep(1.0)
                live.messages.clear()  # they would fill the memory
                if time.monotonic() - started_s < min(WARM_S, 0.2 * seconds):
                    begin_s, before_s = time.monotonic(), sum(process.cpu_times()[:2])
                    continue
                rss_mib.append(process.memory_info().rss / 2**20)
            cpu = (sum(process.cpu_times()[:2]) - before_s) / (time.monotonic() - begin_s)
            frames, no_space, written = results.get(timeout=LONG_S)
            health = await live.wait_json("bms/load/health", lambda h: h["line"]["bytes_received"] >= written)
            service.send_signal(signal.SIGINT)
            await service.wait()
        finally:
            if service.returncode is None:  # after an error, no process may remain
                service.kill()
                await service.wait()
            os.close(slave)
            os.close(master)
    half = len(rss_mib) // 2
    means = float(np.mean(rss_mib[:half])), float(np.mean(rss_mib[half:]))
    return Run(frames, no_space, health["line"], health["samples"], cpu, means)


def _send_over(master: "mp.reduction.DupFd", *arguments: object) -> None:
    """Call ``send`` with the descriptor that another process has passed."""
    send(master.detach(), *arguments)  # type: ignore[arg-type]


def process_bytes(rate_hz: int, seconds: float) -> tuple[BoardProtocol, Estimator, float, list[float]]:
    """Process all bytes in reads of ``READ_BYTES``. Return decoder, estimator, elapsed time [s] and hourly RSS [MiB]."""
    decoder, estimator, process = BoardProtocol(), Estimator(load_cell(CELL)), psutil.Process()
    decoder.feed(0.0, hello(rate_hz))
    rss_mib, elapsed_s, bytes_fed = list[float](), 0.0, 0
    bytes_per_s = rate_hz * len(next(chunks(rate_hz, 1.0 / rate_hz, 1.0)))
    for chunk in chunks(rate_hz, seconds, 3600.0):
        begin_s = time.perf_counter()
        for begin in range(0, len(chunk), READ_BYTES):
            data = chunk[begin : begin + READ_BYTES]
            bytes_fed += len(data)
            block = decoder.feed(bytes_fed / bytes_per_s, data)
            if block.size:
                estimator.run(block)
        elapsed_s += time.perf_counter() - begin_s
        rss_mib.append(process.memory_info().rss / 2**20)
    return decoder, estimator, elapsed_s, rss_mib


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """Measure all requested parts."""
    if options.attacks:
        yield from attacks.rows()
    if options.idle:
        yield from idle_rows()
    if options.lost:
        yield from lost_sensor_rows(options.lost)
    if options.minutes:
        with tempfile.TemporaryDirectory() as folder, Broker(Path(folder)) as broker:
            run = asyncio.run(serve(options.rate, 60.0 * options.minutes, Path(folder), broker))
        faults = {
            name: run.line[name]
            for name in ("frames_lost", "crc_errors", "cobs_errors", "length_errors", "clock_jumps")
        }
        received = run.line["frames_received"]
        quantity = f"{options.rate:,} frames/s for {options.minutes:g} min over a PTY"
        is_met = received == run.sent == run.samples["samples"] and not any(faults.values()) and not run.no_space
        fault_counts = ", ".join(f"{n} {name}" for name, n in (faults | {"without space": run.no_space}).items() if n)
        yield Row(quantity, "none lost", f"{received:,} of {run.sent:,} received {fault_counts}", is_met)
        yield Row("  service's processor time", f"below {MAX_CPU:.0%} of a core", f"{run.cpu:.1%}", run.cpu < MAX_CPU)
        first, second = run.rss_mib
        growth = f"{first:.1f} MiB in the first half, {second:.1f} in the second"
        yield Row("  resident memory", "flat", growth, second - first < MAX_GROWTH_MIB)
    if options.hours:
        decoder, estimator, elapsed_s, rss_mib = process_bytes(rate_hz=100, seconds=3600.0 * options.hours)
        received, samples = decoder.counters["frames_received"], int(estimator.state["samples"][0])
        sent_frames = round(100 * 3600 * options.hours)
        quantity = f"{options.hours:g} h of 100 Hz as serial bytes"
        yield Row(
            quantity,
            "none lost",
            f"{samples:,} of {sent_frames:,} in {elapsed_s:.0f} s",
            sent_frames == received == samples,
        )
        warm_hours = math.ceil(len(rss_mib) / 6)  # the pools of the allocator grow during the first sixth
        growth = f"{rss_mib[warm_hours - 1]:.1f} MiB after {warm_hours} h, {rss_mib[-1]:.1f} at the end"
        yield Row("  resident memory", "flat", growth, rss_mib[-1] - rss_mib[warm_hours - 1] < MAX_GROWTH_MIB)
    if options.attack_s:
        yield from edge_token.rows(options.attack_s)
    if options.wear_minutes:
        yield from disk_wear.rows(options.wear_minutes)


def idle_rows() -> Iterator[Row]:
    """Attack the listeners with idle connections."""
    with tempfile.TemporaryDirectory() as name, few_descriptors():
        folder = Path(name)
        with Broker(folder) as broker:
            yield _idle_row("service: page and [prometheus]", attack_service(folder, broker))
            yield _idle_row("dashboard", attack_dashboard(folder, broker))
        with running(folder, partitions=1) as cluster:
            yield _idle_row("fleet page", attack_fleet_page(folder, cluster))


def _idle_row(program: str, attack: Coroutine[None, None, Outcome]) -> Row:
    quantity = f"{IDLE_CONNECTIONS:,} idle connections each, {DESCRIPTORS:,} descriptors: {program}"
    target = "reconnects, answers, no traceback"
    try:
        outcome = asyncio.run(attack)
    except (TimeoutError, AssertionError) as error:
        return Row(quantity, target, f"not recovered: {error}", met=False)
    measured = f"HTTP {outcome.answers}, {outcome.tracebacks} tracebacks, {outcome.log_lines} log lines"
    return Row(quantity, target, measured, met=set(outcome.answers) == {200} and outcome.tracebacks == 0)


def lost_sensor_rows(lost_s: float) -> Iterator[Row]:
    """Measure the reaction to a lost sensor."""
    with tempfile.TemporaryDirectory() as folder, Broker(Path(folder)) as broker:
        yield from lost_sensor.rows(broker, Path(folder), lost_s)


def main() -> None:
    """Measure the requested parts; return 1 if a target was not met."""
    parser = argparse.ArgumentParser(prog="make load", description=__doc__)
    parser.add_argument("--rate", type=int, default=5000, help="frames per second over the PTY")
    parser.add_argument(
        "--minutes", type=float, default=10.0, help="duration of the load over the PTY [min]; 0: skip it"
    )
    parser.add_argument(
        "--attack-s", type=float, default=20.0, help="duration of each attack on a fleet [s]; 0: skip them"
    )
    parser.add_argument(
        "--hours",
        type=float,
        default=24.0,
        help="hours of serial bytes at 100 Hz, processed as fast as possible; 0: skip them",
    )
    parser.add_argument(
        "--idle", action=argparse.BooleanOptionalAction, default=True, help="attack with idle connections"
    )
    parser.add_argument("--lost", type=float, default=10.0, help="delay of the alarm for a lost sensor [s]; 0: skip it")
    parser.add_argument(
        "--attacks",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="attack with resets of the board, a flapping warning and an Arrow batch",
    )
    parser.add_argument(
        "--wear-minutes", type=float, default=18.0, help="duration of the wear of the disk [min]; 0: skip it"
    )
    sys.exit(not show(rows(parser.parse_args())))


if __name__ == "__main__":
    main()
