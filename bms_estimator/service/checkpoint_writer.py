"""Writer of a pack's state: after the first sample, when SOC or alarms change, at intervals, and at the end."""

import asyncio
import contextlib
import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import structlog

from bms_estimator.checkpoint.run_file import RunCounters
from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.model.cell_slots import CellSlots
from bms_estimator.pack.pack import Pack
from bms_estimator.pack.state import CHECKPOINT, HISTORY, LOAD, REFUSED
from bms_estimator.pack_model.fit import PackFit
from bms_estimator.service.alarm_hooks import AlarmHooks
from bms_estimator.service.alarm_monitor import AlarmMonitor
from bms_estimator.service.service_status import ServiceStatus
from bms_estimator.telemetry.alarms.definitions import INPUTS, PENDING, PROBES, SILENCE
from bms_estimator.telemetry.alarms.evaluator import AlarmEvaluator
from bms_estimator.telemetry.publish_window import ChargeEnergy, LifetimeTotals

SOC_CHANGE = 0.002
"""Change of the SOC that triggers a save. If the service is killed, no larger change is lost."""
CHECK_INTERVAL_S = 1.0
"""Interval of the check for a change of the SOC or an acknowledgement [s]. A raised alarm is saved at once."""
DISK_HUNG_S = 10.0
"""Time after which a disk that has not completed a write counts as hung [s]."""
ALARM_SAVE_INTERVAL_S = 30.0
"""Minimum interval between saves if alarms have only ended, so that a flapping alarm does not wear the disk [s]. A kill
within this time raises the alarm again at the next start."""
RETRY_S = 10.0
"""Interval between retries of a failed save of the alarms [s]."""
LOAD_SAVE_INTERVAL_S = 300.0
"""Interval between two saves of the observed load [s]. A crash loses at most the load of this time."""
FINAL_SAVE_TIMEOUT_S = 20.0
"""Timeout of the save at shutdown [s]. A busy SD card may take several seconds. systemd waits 90 s before it kills a service."""

T = TypeVar("T")

log = structlog.get_logger(__name__)


class CheckpointWriter:
    """Writer that saves the state of a pack in a separate thread, so that a slow disk delays nothing else.

    Args:
        pack: The pack; read only.
        files: Files of the state. The history is saved when the ``revision`` of the slow fit changes, and the observed load
            every ``LOAD_SAVE_INTERVAL_S``.
        alarms: Monitor of the alarms.
        totals: Lifetime totals.
        hooks: Alarm hooks; read only.
        slots: Cell slots of the source; read only.
        status: Receives the outcome of each save.
        interval_s: Maximum interval between two saves [s].
    """

    def __init__(
        self,
        pack: Pack,
        files: StateFiles,
        *,
        alarms: AlarmMonitor,
        totals: LifetimeTotals,
        hooks: AlarmHooks,
        slots: CellSlots,
        status: ServiceStatus,
        interval_s: float,
    ) -> None:
        self._pack, self._files = pack, files
        self._monitor, self._totals, self._hooks, self._slots = alarms, totals, hooks, slots
        self._status, self._interval_s = status, interval_s
        self._samples_of_saved_load = 0
        self._saved_revision = pack.slow_fit.revision if pack.slow_fit else 0
        self._discarded = 0  # number of histories whose files were quarantined
        self._saved_counters: RunCounters | None = None
        """Counters and alarms of the last save; None before the first save of this run."""
        status.saved_charge_energy = totals.charge_energy
        self._saved_fit = self._fit  # fit of the saved state
        self._saved_progress: tuple[int, float] | None = None
        """Samples and SOC (``_progress``) of the last saved state; None: this run has not saved a state."""

    async def run(self) -> None:
        """Save at each interval, and earlier after the first sample, a change of the SOC, or a raised alarm."""
        loop = asyncio.get_running_loop()
        state_tried_s, failed, load_tried_s = -math.inf, False, loop.time()
        # until the final save marks the run as clean, the next start counts it as crashed
        run_file_failures, run_file_tried_s = 0 if await self._save_counters() else 1, loop.time()
        if run_file_failures:
            self._raise_state_lost()
        while True:
            await self._wait_for_alarm(min(CHECK_INTERVAL_S, self._interval_s))
            run_file_delay_s = RETRY_S if run_file_failures else self._counters_delay_s
            if not run_file_failures and await self._is_run_file_missing():
                self._saved_counters, run_file_delay_s = None, 0.0
            if loop.time() >= run_file_tried_s + run_file_delay_s:
                run_file_failures, run_file_tried_s = (
                    0 if await self._save_counters() else run_file_failures + 1,
                    loop.time(),
                )
                if run_file_failures > 1 and self._lacks_alarm:  # the cause of a single failure may pass
                    self._raise_state_lost()
            if loop.time() >= state_tried_s + self._interval_s or (self._needs_save and not failed):
                history_saved = await self._save_history()
                failed = not (await self._save() and history_saved)
                state_tried_s = loop.time()
            if loop.time() >= load_tried_s + LOAD_SAVE_INTERVAL_S:
                await self._save_load()
                load_tried_s = loop.time()

    def _raise_state_lost(self) -> None:
        name = self._files.run_file.path.name
        self._monitor.raise_state_lost(f"{name} cannot be written, so that a restart loses alarms")

    async def _wait_for_alarm(self, pause_s: float) -> None:
        """Wait for ``pause_s``, or until an alarm changes: its cause may be about to cut the power of this computer."""
        changed = self._monitor.changed
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(pause_s):
                await changed.wait()
        changed.clear()

    async def save_final(self, *, clean: bool) -> None:
        """Save at the end of a run; give up after ``FINAL_SAVE_TIMEOUT_S``.

        Args:
            clean: True if the run ended as requested, False after an exception.
        """
        try:
            async with asyncio.timeout(FINAL_SAVE_TIMEOUT_S):
                await self._save(whole=True)
                await self._save_counters(clean=clean)
                await self._save_history(is_last=True)
                await self._save_load()
        except TimeoutError:
            log.warning("the disk hangs: the last checkpoint is not written", file=str(self._files.checkpoint.path))

    @property
    def _fit(self) -> PackFit | None:
        return self._pack.slow_fit.fit if self._pack.slow_fit else None

    @property
    def _alarms(self) -> AlarmEvaluator:
        return self._monitor.alarms

    @property
    def _needs_save(self) -> bool:
        """True if the state has changed enough to be saved before the interval ends."""
        if self._saved_progress is None:
            return True
        if self._pack.slow_fit and self._pack.slow_fit.revision != self._saved_revision:
            return True
        return bool(abs(self._pack.estimator.state["soc"][0] - self._saved_progress[1]) >= SOC_CHANGE)

    @property
    def _progress(self) -> tuple[int, float]:
        """Number of samples and SOC. A fuel cell has the SOC NaN, which is replaced by 0 because NaN is not equal to itself."""
        state = self._pack.estimator.state[0]
        return int(state["samples"]), float(np.nan_to_num(state["soc"]))

    @property
    def _counters_delay_s(self) -> float:
        """Minimum interval between two saves of counters and alarms [s]; 0 if the next one is urgent."""
        if self._saved_counters is None or self._slots.cell_indices != self._saved_counters.cell_slots:
            return 0.0
        if self._alarms.saved_state == self._saved_counters.alarms:
            return self._interval_s
        return 0.0 if self._lacks_alarm else min(ALARM_SAVE_INTERVAL_S, self._interval_s)

    @property
    def _lacks_alarm(self) -> bool:
        """True if the last save lacks a raised alarm."""
        return lacks_alarm(self._saved_counters.alarms if self._saved_counters else "", self._alarms.saved_state)

    async def _is_run_file_missing(self) -> bool:
        """Return True if the file with counters and alarms was deleted."""
        path = self._files.run_file.path
        return not await self._call_disk(lambda: os.path.exists(path), path)  # noqa: PTH110 - False if it cannot be read

    async def _save_counters(self, *, clean: bool = False) -> bool:
        """Save counters and alarms if they have changed. Return False if they cannot be written."""
        hooks = self._hooks.finished_hashes if clean else None  # after a crash all hooks repeat their jobs
        alarms, slots, file = self._alarms.saved_state, self._slots.cell_indices, self._files.run_file
        counters = RunCounters(self._status.restarts, self._totals.total, clean, alarms, hooks, slots)
        if counters == self._saved_counters:
            return True
        if not await self._write(lambda: file.save(counters), file.path):
            self._status.saved_charge_energy = None  # the unsaved totals are published
            return False
        self._saved_counters = counters
        self._status.saved_charge_energy = ChargeEnergy.from_totals(counters.total)
        return True

    async def _save(self, *, whole: bool = False) -> bool:
        """Save the state if it has changed. Return False if it cannot be written.

        An unchanged state is not saved again: a new save time would hide the gap since the last sample.

        Args:
            whole: True: write the whole file, not only changes.
        """
        progress = self._progress
        if not progress[0] or (progress == self._saved_progress and self._fit is self._saved_fit):
            return True
        state, fit = self._pack.state(CHECKPOINT), self._fit
        if not await self._write(lambda: self._files.save(state, whole=whole)):
            return False
        self._status.checkpoint, self._saved_progress, self._saved_fit = "saved", progress, fit
        return True

    async def _save_history(self, *, is_last: bool = False) -> bool:
        """Save the history if its revision has changed, or at the end. Return False if it cannot be written."""
        model, file = self._pack.slow_fit, self._files.history
        if model is None:
            return True
        if is_last:
            model.take_rows()
        revision = model.revision
        if revision == self._saved_revision and not (is_last and model.unsaved_rows):
            return True
        state, discarded = self._pack.state(HISTORY), model.discarded

        def save() -> None:
            if discarded != self._discarded and file.path.exists():
                log.warning("history", file=str(file.path), outcome=f"{REFUSED}its fit fails; {file.quarantine()}")
            self._files.save(state)

        if await self._write(save, file.path):
            self._saved_revision, self._discarded = revision, discarded
            return True
        return False

    async def _save_load(self) -> None:
        """Save the observed load, if there are new samples."""
        samples = self._progress[0]
        if self._pack.forecaster is None or samples == self._samples_of_saved_load:
            return
        state = self._pack.state(LOAD)
        if await self._write(lambda: self._files.save(state), self._files.load.path):
            self._samples_of_saved_load = samples

    async def _write(self, write: Callable[[], None], path: Path | None = None) -> bool:
        """Call ``write``, which writes ``path`` or the checkpoint, in the disk's thread. Return False if it fails."""
        file = path or self._files.checkpoint.path
        try:
            await self._call_disk(write, file)
            self._status.disk_free_mib = self._files.checkpoint.disk_free_mib
        except OSError as error:
            self._status.checkpoint = f"cannot be saved: {error}"
            log.warning("checkpoint cannot be saved", file=str(file), error=str(error))
            return False
        return True

    async def _call_disk(self, call: Callable[[], T], file: Path) -> T:
        """Call a function that accesses ``file`` in the disk's thread. Report a disk that hangs."""
        future = asyncio.get_running_loop().run_in_executor(self._files.thread, call)
        # asyncio.wait_for of Python 3.11 may swallow a cancellation
        await asyncio.wait({future}, timeout=DISK_HUNG_S)
        if not future.done():
            before, self._status.checkpoint = self._status.checkpoint, "not saved: the disk hangs"
            log.warning("checkpoint cannot be saved", file=str(file), error="the disk hangs")
            await asyncio.wait({future})
            self._status.checkpoint = before
        return await future


def lacks_alarm(saved: str, latest: str) -> bool:
    """Return True if a restart from ``saved`` would lack an alarm, a delay, a measured quantity, a probe or an acknowledgement.

    It is also True if an acknowledged alarm has ended: after a restart its acknowledgement would cover a new cause.

    Args:
        saved: Saved state of the alarms, as from ``AlarmEvaluator.saved_state``.
        latest: Present state of the alarms.
    """
    before, after = json.loads(saved or "{}"), json.loads(latest or "{}")
    if any(before.pop(key, None) != after.pop(key, None) for key in (INPUTS, SILENCE)):
        return True
    if set(after.pop(PENDING, [])) - set(before.pop(PENDING, [])):
        return True
    if after.pop(PROBES, 0) > before.pop(PROBES, 0):
        return True
    if any(each["acknowledged"] and name not in after for name, each in before.items()):
        return True
    return any(
        name not in before
        or before[name]["acknowledged"] != each["acknowledged"]
        or (before[name]["gone"] and not each["gone"])
        for name, each in after.items()
    )
