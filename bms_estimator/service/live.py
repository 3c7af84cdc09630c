"""The live loop: source -> estimator -> window -> sinks."""

import asyncio
import contextlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import structlog

from bms_estimator.estimator import Estimator
from bms_estimator.model.cell import CellModel
from bms_estimator.model.clock import Clock
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SAMPLE
from bms_estimator.model.settings import Settings
from bms_estimator.service.checkpoint import CheckpointFile, resume
from bms_estimator.service.interrupt import until_first_ends
from bms_estimator.service.notify import Notifier
from bms_estimator.service.requests import Requests, number
from bms_estimator.sinks import Sink
from bms_estimator.snapshot.publisher import Publisher
from bms_estimator.sources import Source

log = structlog.get_logger(__name__)


async def run_live(
    settings: Settings,
    cell: CellModel,
    *,
    source: Source,
    sinks: Sequence[Sink],
    stop: asyncio.Event,
    checkpoint: CheckpointFile | None = None,
    requests: Requests | None = None,
    notifier: Notifier | None = None,
    clock: Clock | None = None,
) -> Estimator:
    """Estimate until the source ends or ``stop`` is set.

    Args:
        settings: The pack's settings.
        cell: The pack as one object (``CellModel.pack``).
        source: Where samples come from; opened and closed here.
        sinks: Where snapshots go; opened and closed here.
        stop: Set to end cleanly.
        checkpoint: Where the state outlives a restart; None: it does not.
        requests: Where this loop offers what it can answer.
        notifier: Who hears that the loop is ready and alive.
        clock: The clocks.

    Returns:
        The estimator as the last sample left it.
    """
    notifier, clock = notifier or Notifier(), clock or Clock()
    estimator = new_estimator(settings, cell)
    restarts, restored = _restore(estimator, checkpoint, cell)
    publisher = Publisher(
        settings,
        cell,
        estimator,
        source=source,
        sinks=sinks,
        clock=clock,
        restarts=restarts,
        checkpoint=restored,
    )
    _offer(requests or Requests(), estimator, publisher)
    async with contextlib.AsyncExitStack() as stack:
        for sink in sinks:
            await stack.enter_async_context(sink)
        await stack.enter_async_context(source)
        notifier.send("READY=1", f"STATUS=estimating {settings.pack.name}")
        tasks = [_estimate(source, estimator, publisher), _keep_alive(publisher, notifier)]
        if checkpoint:
            tasks.append(_save_often(checkpoint, estimator, publisher, settings.state.checkpoint_s, restarts))
        await until_first_ends(*tasks, stop.wait())
        notifier.send("STOPPING=1")
        publisher.publish_last()
    if checkpoint:
        await _save(checkpoint, estimator, publisher, restarts)
    return estimator


def new_estimator(settings: Settings, cell: CellModel) -> Estimator:
    """The estimator of a pack, its kernels loaded: nothing compiles once samples come."""

    def make() -> Estimator:
        return Estimator(
            cell,
            settings.observer,
            identifier=settings.identifier,
            voltage_resolution_v=settings.sensor.voltage_resolution_v,
            voltage_noise_v=settings.sensor.voltage_noise_v,
            initial_soc=settings.pack.initial_soc,
        )

    make().run(np.zeros(1, dtype=SAMPLE))
    return make()


async def _estimate(source: Source, estimator: Estimator, publisher: Publisher) -> None:
    async for block in source:
        publisher.add(estimator.run(block))
        await asyncio.sleep(0)  # a source that always has a block must not starve the sinks


async def _keep_alive(publisher: Publisher, notifier: Notifier) -> None:
    """Publish that nothing comes, and pat the watchdog."""
    longest_s = notifier.watchdog_s / 3.0 or publisher.period_s
    while True:
        notifier.send("WATCHDOG=1")
        await asyncio.sleep(min(max(publisher.wait_s, 0.01), longest_s))
        if publisher.wait_s == 0.0:
            publisher.publish()


def _restore(estimator: Estimator, checkpoint: CheckpointFile | None, cell: CellModel) -> tuple[int, str]:
    """Go on from the checkpoint where there is a good one. Returns how many starts found one, and what was done."""
    if checkpoint is None:
        return 0, "off"
    found = checkpoint.load(cell)
    if found.state is not None:
        resume(estimator, found.state, found.unseen_s)
    log.info("checkpoint", file=str(checkpoint.path), outcome=found.reason)
    return found.restarts, found.reason


async def _save_often(
    checkpoint: CheckpointFile, estimator: Estimator, publisher: Publisher, every_s: float, restarts: int
) -> None:
    while True:
        await asyncio.sleep(every_s)
        await _save(checkpoint, estimator, publisher, restarts)


async def _save(checkpoint: CheckpointFile, estimator: Estimator, publisher: Publisher, restarts: int) -> None:
    """Save what samples have taught; writing waits for the disk in a thread."""
    if not (estimator.state["started"][0] and estimator.state["samples"][0]):
        return
    try:
        state = estimator.record.copy()
        await asyncio.get_running_loop().run_in_executor(checkpoint.thread, checkpoint.save, state, restarts)
        publisher.checkpoint = "saved"
    except OSError as error:
        publisher.checkpoint = f"cannot be saved: {error}"
        log.warning("checkpoint cannot be saved", file=str(checkpoint.path), error=str(error))


def _offer(requests: Requests, estimator: Estimator, publisher: Publisher) -> None:
    """Offer the requests that need the loop."""

    async def state(_: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"estimate": publisher.latest.model_dump() if publisher.latest else None}

    async def parameters(_: Mapping[str, Any]) -> Mapping[str, Any]:
        return publisher.snapshot.parameters.model_dump()

    async def health(_: Mapping[str, Any]) -> Mapping[str, Any]:
        return publisher.snapshot.health.model_dump()

    async def set_soc(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        soc = number(arguments, "soc", 0.0, 1.0)
        if not estimator.state["started"][0]:
            raise UserError("no sample has been taken yet")
        before = float(estimator.state["soc"][0])
        estimator.set_soc(soc)
        log.info("SOC set on request", before=before, soc=soc)
        return {"soc": soc, "before": before}

    for handler in (state, parameters, health, set_soc):
        requests.offer(handler.__name__, handler)
