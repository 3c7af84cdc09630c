"""Re-identification of many packs in parallel processes. Each process fetches the samples of its own packs."""

import asyncio
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bms_estimator.fleet.identification.block_capture import BlockCapture, fetch
from bms_estimator.fleet.identification.reidentify import ReidentificationResult, reidentify
from bms_estimator.fleet.nats.one_shot_connection import connected
from bms_estimator.fleet.packs.pack_row import PackSpec
from bms_estimator.model.errors import UserError


@dataclass(frozen=True)
class Task:
    """Re-identification of one pack.

    Attributes:
        pack: Name of the pack.
        spec: Row of the pack in the table of packs.
        cell_file: Text of the cell file that ``spec`` names; None for a shipped cell.
        since_s, until_s: Time span of the samples [s since 1970].
        server, creds, ca: Address, credentials file and certificate authority of the NATS server.
    """

    pack: str
    spec: PackSpec
    cell_file: str | None
    since_s: float
    until_s: float
    server: str
    creds: Path | None
    ca: Path | None


def reidentify_all(tasks: Sequence[Task], processes: int) -> Iterator[ReidentificationResult]:
    """Yield the result of each pack, in the order of ``tasks``, while later packs are still computed.

    Args:
        tasks: Packs.
        processes: Number of worker processes.

    Raises:
        UserError: A worker process died.
    """
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            yield from pool.map(reidentify_one, tasks)
        except BrokenProcessPool:
            raise UserError("a worker process was killed, perhaps for lack of memory: reduce --processes") from None


def reidentify_one(task: Task) -> ReidentificationResult:
    """Fetch one pack's samples and identify its cell. An error is returned as the result's ``reason``."""
    try:
        capture = asyncio.run(_fetch(task))
        if not capture.blocks:
            return ReidentificationResult(task.pack, reason="the server keeps no sample of it in this span")
        return reidentify(task.pack, np.concatenate(list(capture.samples())), task.spec, task.cell_file)
    except UserError as error:
        return ReidentificationResult(task.pack, reason=str(error))
    except Exception as error:  # noqa: BLE001 - reported for this pack, so that the others' hours of work are not lost
        return ReidentificationResult(task.pack, reason=f"internal error: {type(error).__name__}: {error}")


async def _fetch(task: Task) -> BlockCapture:
    async with connected(task.server, task.creds, task.ca) as nc:
        return await fetch(nc, task.pack, since_s=task.since_s, until_s=task.until_s)
