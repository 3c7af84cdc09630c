"""Signals end a process cleanly."""

import asyncio
import os
import signal
from collections.abc import Iterator

import pytest

from bms_estimator.process.runtime import stop_on_signal
from tests.patience import LONG_S


@pytest.fixture(params=[signal.SIG_DFL, signal.SIG_IGN], ids=["default", "ignored"])
def initial_sighup_handler(request: pytest.FixtureRequest) -> Iterator[signal.Handlers]:
    """Return the handler of SIGHUP that the process inherited: ignored under nohup, default otherwise."""
    before = signal.signal(signal.SIGHUP, request.param)
    yield request.param
    signal.signal(signal.SIGHUP, before)


async def test_sighup_stops_the_process_unless_sighup_was_ignored_at_its_start(
    initial_sighup_handler: signal.Handlers,
) -> None:
    stop = stop_on_signal()
    os.kill(os.getpid(), signal.SIGHUP)
    if initial_sighup_handler is signal.SIG_IGN:
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    else:
        await asyncio.wait_for(stop.wait(), LONG_S)
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().remove_signal_handler(number)
