"""The service, its callbacks timed: ``python timed_service.py FILE run pack.toml`` leaves the longest of each kind in FILE."""

import asyncio
import json
import sys
import time
from pathlib import Path
from typing import Any

from bms_estimator.cli.main import main

SHOWN = 5
"""So many kinds, those with the longest."""


def serve(out: Path, arguments: list[str]) -> None:
    """The program, each of its callbacks timed once the loop turns; of each kind the longest is kept."""
    longest: dict[str, tuple[float, float]] = {}
    run, begun = asyncio.Handle._run, 0

    def timed(handle: asyncio.Handle) -> None:
        nonlocal begun
        begun += 1
        callback = handle._callback
        cpu_s, wall_s = time.thread_time(), time.monotonic()
        run(handle)
        cpu_s, wall_s = time.thread_time() - cpu_s, time.monotonic() - wall_s
        name = _name(callback)
        if begun > 1 and (cpu_s, wall_s) > longest.get(name, (0.0, 0.0)):  # the first starts the service
            longest[name] = cpu_s, wall_s

    asyncio.Handle._run = timed  # type: ignore[method-assign]
    try:
        main(arguments)
    finally:
        rows = sorted(((name, *times) for name, times in longest.items()), key=lambda row: -row[1])
        out.write_text(json.dumps(rows[:SHOWN]))


def _name(callback: Any) -> str:
    task = getattr(callback, "__self__", None)
    coroutine = task.get_coro() if isinstance(task, asyncio.Task) else None
    return getattr(coroutine or callback, "__qualname__", repr(callback))


if __name__ == "__main__":
    serve(Path(sys.argv[1]), sys.argv[2:])
