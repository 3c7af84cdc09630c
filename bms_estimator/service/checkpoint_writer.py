"""Writer of checkpoints: with the first sample, as the SOC moves, at intervals, and at the end."""

import asyncio
import math
from collections.abc import Callable

import numpy as np
import structlog

from bms_estimator.checkpoint.checkpoint_file import CheckpointFile, RunCounters
from bms_estimator.estimator import Estimator
from bms_estimator.service.publisher import Publisher
from bms_estimator.telemetry.charge_energy import ChargeEnergy
from bms_estimator.telemetry.lifetime_totals import LifetimeTotals

SAVED_SOC = 0.002
"""Change of the SOC since the checkpoint that triggers a save, so that a kill loses no more."""
LOOK_S = 1.0
"""Interval at which that change is checked [s]."""
HUNG_S = 10.0
"""Time after which a disk that has not accepted the state counts as hung [s]."""
LAST_S = 5.0
"""Timeout of the last save at shutdown [s]; service managers wait for about a minute."""

log = structlog.get_logger(__name__)


class CheckpointWriter:
    """Saves what samples have taught; the disk is waited for in a thread, and nothing else waits for it.

    Args:
        checkpoint: Destination.
        estimator: Read only.
        publisher: Gets the result.
        tally: Totals over restarts.
        restarts: Starts that found a checkpoint.
        every_s: Maximum interval between two saves [s].

    Attributes:
        every_s: May be changed.
    """

    def __init__(
        self,
        checkpoint: CheckpointFile,
        estimator: Estimator,
        publisher: Publisher,
        tally: LifetimeTotals,
        *,
        restarts: int,
        every_s: float,
    ) -> None:
        self.every_s = every_s
        self._checkpoint, self._estimator, self._publisher = checkpoint, estimator, publisher
        self._tally, self._restarts = tally, restarts
        self._alarms = publisher.watch.alarms.kept  # as the disk has them
        publisher.kept = tally.flow
        self._saved: tuple[int, float] | None = None
        """Samples and SOC of the state that was saved last; None: none was by this run."""

    async def run(self) -> None:
        """Save every ``every_s``, and once the SOC has gone by ``SAVED_SOC``, a latching alarm turns or a first sample is there."""
        await self._write(self._mark(clean=False))  # from now on a run that leaves no word has crashed
        loop = asyncio.get_running_loop()
        saved_s, failed = -math.inf, False
        while True:
            await asyncio.sleep(min(LOOK_S, self.every_s))
            moved = self._saved is None or abs(self._estimator.state["soc"][0] - self._saved[1]) >= SAVED_SOC
            moved = moved or self._alarms != self._publisher.watch.alarms.kept
            if loop.time() >= saved_s + self.every_s or (moved and not failed):
                failed = not await self._save()
                saved_s = loop.time()

    async def save_final(self, *, clean: bool) -> None:
        """Save as the run ends, by itself where it is ``clean``; a disk that hangs is left alone after ``LAST_S``."""
        try:
            async with asyncio.timeout(LAST_S):
                await self._save(clean=clean)
        except TimeoutError:
            log.warning("the disk hangs: the last checkpoint is not written", file=str(self._checkpoint.path))

    @property
    def _taught(self) -> tuple[int, float]:
        """Samples and SOC now."""
        state = self._estimator.state[0]
        return int(state["samples"]), float(np.nan_to_num(state["soc"]))  # a fuel cell has none, NaN equals nothing

    async def _save(self, *, clean: bool = False) -> bool:
        """Save unsaved state. Return False if it cannot be written.

        An unchanged state is not saved again: a new save time would hide the gap since the last sample.
        """
        taught, ledger = self._taught, self._ledger(clean=clean)
        if not taught[0] or taught == self._saved:
            if clean or self._alarms != ledger.alarms:
                return await self._write_with(ledger, lambda: self._checkpoint.update_counters(ledger))
            return True
        state = self._estimator.record.copy()
        if not await self._write_with(ledger, lambda: self._checkpoint.save(state, ledger)):
            self._publisher.kept = None
            return False
        self._publisher.checkpoint, self._saved, self._publisher.kept = "saved", taught, ChargeEnergy.of(ledger.total)
        return True

    def _mark(self, *, clean: bool) -> Callable[[], None]:
        ledger = self._ledger(clean=clean)
        return lambda: self._checkpoint.update_counters(ledger)

    def _ledger(self, *, clean: bool) -> RunCounters:
        return RunCounters(self._restarts, self._tally.total, clean, self._publisher.watch.alarms.kept)

    async def _write_with(self, ledger: RunCounters, write: Callable[[], None]) -> bool:
        """Write as ``_write`` does; then the alarms are on disk, too."""
        written = await self._write(write)
        if written:
            self._alarms = ledger.alarms
        return written

    async def _write(self, write: Callable[[], None]) -> bool:
        """Have the disk take something. False: it does not."""
        file = str(self._checkpoint.path)
        future = asyncio.get_running_loop().run_in_executor(self._checkpoint.thread, write)
        try:
            await asyncio.wait({future}, timeout=HUNG_S)  # wait_for of Python 3.11 may swallow that we are to end
            if not future.done():
                self._publisher.checkpoint = "not saved: the disk hangs"
                log.warning("checkpoint cannot be saved", file=file, error="the disk hangs")
            await future
            self._publisher.disk_free_mib = self._checkpoint.disk_free_mib
        except OSError as error:
            self._publisher.checkpoint = f"cannot be saved: {error}"
            log.warning("checkpoint cannot be saved", file=file, error=str(error))
            return False
        return True
