"""Attacks on one pack and on the ingestion of a fleet: a board in a reset loop, a flapping warning, and a hostile Arrow batch.

make load ARGS="--minutes 0 --hours 0 --attack-s 0 --lost 0 --wear-minutes 0 --no-idle"
"""

import asyncio
import resource
import tempfile
from collections.abc import Iterator
from pathlib import Path

from bms_estimator.fleet.ingest.batch_samples import BatchError, BatchReader
from bms_estimator.fleet.ingest.ingest import decode_batch
from bms_estimator.telemetry.alarms.definitions import Change
from tests.benchmarks.table import Row
from tests.firmware.test_reset_loop import MAX_RISES, RESETS, reset_loop
from tests.fleet.ingest.platform import arrow_with_shared_columns
from tests.fleet.ingest.test_batch_samples import MANY_COLUMNS
from tests.patience import LONG_S
from tests.service.test_alarm_hooks import (
    CLEARED,
    RAISED,
    lines_of,
    run_hooks,
    wait_for_health,
    wait_for_lines,
    write_program,
)
from tests.simavr_board import build_firmware

FLAPS = 40
"""Number of times that the warning is raised and cleared while a program runs."""
MAX_RUNS_BEFORE = 1
"""Maximum number of runs that a new critical alarm waits for: the program that runs already."""
SHARED_ROWS = 1 << 19
"""Rows of the hostile batch of 0.6 MB, which has 1 GiB of doubles after conversion."""
MAX_GROWTH_MIB = 32.0
"""Limit of the growth of the peak memory [MiB]."""
CRITICAL = RAISED.model_copy(update={"name": "pack_over_voltage", "severity": "critical"})


def rows() -> Iterator[Row]:
    """Run all attacks."""
    if reason := build_firmware():
        yield Row("a board in a reset loop", "", reason, met=None)
    else:
        yield from reset_rows()
    yield flapping_row()
    yield arrow_row()


def reset_rows() -> Iterator[Row]:
    """Reset the board again and again while an alarm is latched, in both wirings of the relay."""
    for relay, max_rises in MAX_RISES.items():
        with tempfile.TemporaryDirectory() as folder:
            loop = asyncio.run(reset_loop(Path(folder), relay))
        what = f'{RESETS} resets of the board, alarm latched, relay = "{relay}"'
        alarms = {"hook_failed", "sensor_fault", "pack_over_voltage"} & loop.texts.keys()
        measured = f"{loop.rises}; {', '.join(sorted(alarms))}"
        yield Row(
            what, f"at most {max_rises} switchings; 3 alarms", measured, loop.rises <= max_rises and len(alarms) == 3
        )


def flapping_row() -> Row:
    """Raise a critical alarm after a flapping warning of the same hook, whose program runs until then."""
    with tempfile.TemporaryDirectory() as folder:
        runs = asyncio.run(_run_flapping_hook(Path(folder)))
    before = runs.index(CRITICAL.name)
    what = f"runs of a hook before a critical alarm that follows {FLAPS} flaps of a warning"
    return Row(what, f"at most {MAX_RUNS_BEFORE}", f"{before} of {len(runs)}", before <= MAX_RUNS_BEFORE)


async def _run_flapping_hook(folder: Path) -> list[str]:
    """Return the names of the alarms for which the program ran, in their order."""
    out, go = folder / "out", folder / "go"
    program = write_program(folder / "program", f'echo "$BMS_NAME" >> {out}; until [ -e {go} ]; do sleep 0.01; done')
    async with run_hooks({"run": [program], "timeout_s": LONG_S}) as running:
        running.on_alarm_change(Change(0.0, RAISED))
        await wait_for_lines(out, 1)
        for alarm in (*[CLEARED, RAISED] * FLAPS, CLEARED, CRITICAL):
            running.on_alarm_change(Change(0.0, alarm))
        go.touch()
        await wait_for_health(running, lambda health: health.done == 3)  # warning raised, critical, warning cleared
    return lines_of(out)


def arrow_row() -> Row:
    """Decode a batch whose columns share one buffer."""
    batch = arrow_with_shared_columns(MANY_COLUMNS, SHARED_ROWS)
    before_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        BatchReader().read(decode_batch(batch))
        outcome = "accepted"
    except BatchError:
        outcome = "rejected"
    growth_mib = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib) / 1024
    what = f"peak memory of ingestion by an Arrow batch of {len(batch) / 1e6:.1f} MB whose {len(MANY_COLUMNS)} columns share a buffer"
    measured = f"{growth_mib:.1f} MiB, {outcome}"
    return Row(
        what,
        f"rejected, at most {MAX_GROWTH_MIB:g} MiB more",
        measured,
        growth_mib <= MAX_GROWTH_MIB and outcome == "rejected",
    )
