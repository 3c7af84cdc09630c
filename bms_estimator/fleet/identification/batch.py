"""Many packs identified anew, by processes of this machine or those of a Dask cluster; each fetches its own samples."""

import asyncio
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from dask.base import compute
from dask.delayed import delayed

from bms_estimator.fleet.identification.block_capture import BlockCapture, fetch
from bms_estimator.fleet.identification.reidentify import ReidentificationResult, reidentify
from bms_estimator.fleet.nats.one_shot_connection import connected
from bms_estimator.fleet.packs.pack_row import PackSpec
from bms_estimator.model.errors import UserError

AT_ONCE = 8
"""Packs for each process between two looks at what has come."""
CLUSTER_S = 10.0
"""So long a cluster's scheduler is waited for."""

Work = Callable[[Sequence["Task"]], Sequence[ReidentificationResult]]


@dataclass(frozen=True)
class Task:
    """One pack.

    Attributes:
        pack: Its name.
        kind: What the fleet is told of it.
        cell_file: The text of the cell file that it names, if it does.
        since_s, until_s: Which samples count [s since 1970].
        server, creds, ca: Where they are, as seen from whoever works on this.
    """

    pack: str
    kind: PackSpec
    cell_file: str | None
    since_s: float
    until_s: float
    server: str
    creds: Path | None
    ca: Path | None


def reidentify_all(tasks: Sequence[Task], *, scheduler: str | None, processes: int) -> Iterator[ReidentificationResult]:
    """What came of each pack, in their order; the first ones come while others are worked on.

    Args:
        tasks: The packs.
        scheduler: Address of a Dask cluster's scheduler, ``tcp://host:port``; None: processes of this machine.
        processes: So many of them.

    Raises:
        UserError: No such cluster, or a process died.
    """
    with _cluster(scheduler) if scheduler else _pool(processes) as work:
        step = AT_ONCE * processes
        for first in range(0, len(tasks), step):
            yield from work(tasks[first : first + step])


def one(task: Task) -> ReidentificationResult:
    """What came of one pack; whatever goes wrong with it is its own."""
    try:
        found = asyncio.run(_fetched(task))
        if not found.blocks:
            return ReidentificationResult(task.pack, reason="the server keeps no sample of it in this span")
        return reidentify(task.pack, np.concatenate(list(found.samples())), task.kind, task.cell_file)
    except UserError as error:
        return ReidentificationResult(task.pack, reason=str(error))
    except Exception as error:  # noqa: BLE001 - said of this pack; hours of work on the others are not lost
        return ReidentificationResult(task.pack, reason=f"a fault of the program: {type(error).__name__}: {error}")


async def _fetched(task: Task) -> BlockCapture:
    async with connected(task.server, task.creds, task.ca) as nc:
        return await fetch(nc, task.pack, since_s=task.since_s, until_s=task.until_s)


@contextmanager
def _pool(processes: int) -> Iterator[Work]:
    """Processes of this machine, for Dask's own scheduler."""
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:

        def on_pool(tasks: Sequence[Task]) -> Sequence[ReidentificationResult]:
            try:
                return _computed(tasks, scheduler="processes", pool=pool, chunksize=1)
            except BrokenProcessPool:
                raise UserError(
                    "a process was ended from outside: too little memory? --processes takes fewer"
                ) from None

        yield on_pool


@contextmanager
def _cluster(scheduler: str) -> Iterator[Work]:
    """A cluster that is there."""
    try:
        from distributed import Client  # noqa: PLC0415 - only who has a cluster needs it
    except ModuleNotFoundError:
        raise UserError(
            f"--scheduler {scheduler}: this needs the package distributed, in the cluster's version: pip install distributed"
        ) from None
    try:
        client = Client(scheduler, timeout=CLUSTER_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UserError(f"--scheduler {scheduler}: no Dask scheduler answers there: {error}") from None
    with client:
        yield lambda tasks: _computed(tasks, scheduler=client.get)


def _computed(tasks: Sequence[Task], **how: Any) -> Sequence[ReidentificationResult]:
    computed: Callable[..., Sequence[ReidentificationResult]] = compute
    return computed(*(delayed(one, pure=False)(task) for task in tasks), **how)
