"""First estimates of a new pack. Nothing is saved or published."""

import asyncio
from collections.abc import Callable

from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import PackModel
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.service.live_loop import run_estimation_loop
from bms_estimator.settings.pack import Settings
from bms_estimator.setup.measurement import first_sample_timeout_s
from bms_estimator.sinks.sink import Sink
from bms_estimator.sources.factory import open_source
from bms_estimator.telemetry.state import UNKNOWN_SOC

MAX_RESTING_C = 0.1
"""Current relative to the capacity [1/h]. Above it, the overvoltage makes the first estimate inexact."""


class EstimateSink(Sink):
    """Sink that passes each estimate to a function.

    Args:
        on_estimate: Called with each estimate.
    """

    def __init__(self, on_estimate: Callable[[Estimate], object]) -> None:
        self._on_estimate = on_estimate

    async def __aexit__(self, *_: object) -> None:
        """Do nothing, because the sink holds no resources."""

    def publish(self, snapshot: Snapshot) -> None:
        """Pass the estimate of a snapshot to the function."""
        if snapshot.estimate is not None:
            self._on_estimate(snapshot.estimate)


async def run_estimator(
    settings: Settings, cell: PackModel, on_estimate: Callable[[Estimate], object], *, seconds: float
) -> None:
    """Run the estimator, and pass each estimate to a function.

    Args:
        settings: Settings of the pack.
        cell: Model of the whole pack.
        on_estimate: Called with each estimate.
        seconds: Duration, counted from the first estimate [s].

    Raises:
        UserError: No sample arrives.
    """
    stop, loop = asyncio.Event(), asyncio.get_running_loop()
    timeout_s = first_sample_timeout_s(settings)
    timer = loop.call_later(timeout_s, stop.set)
    count = 0

    def on_received(received: Estimate) -> None:
        nonlocal timer, count
        if not count:
            timer.cancel()
            timer = loop.call_later(seconds, stop.set)
        count += 1
        on_estimate(received)

    source = open_source(settings)
    await run_estimation_loop(settings, cell, source=source, sinks=[EstimateSink(on_received)], stop=stop)
    timer.cancel()
    if not count:
        raise UserError(f"no sample within {timeout_s:g} s: {source.silence_reason}")


def estimate_text(estimate: Estimate) -> str:
    """Return SOC, voltage and current of an estimate as text."""
    values = f"{estimate.voltage_v:.2f} V, {estimate.current_a:.2f} A"
    if estimate.soc is None:
        return values
    if not estimate.soc_known:
        return f"{values}; {UNKNOWN_SOC}"
    band = "" if estimate.soc_std is None else f" ± {2.0 * estimate.soc_std:.1%} (2 standard deviations)"
    return f"SOC {estimate.soc:.1%}{band}, {values}"


def current_note(current_a: float, capacity_ah: float) -> str:
    """Return a note about the first estimate under a large current; empty if the current is small.

    Args:
        current_a: Present current [A].
        capacity_ah: Capacity of the pack [Ah].
    """
    return (
        "A first estimate under load is inexact, and may lie outside its band; it becomes better at rest."
        if abs(current_a) > MAX_RESTING_C * capacity_ah
        else ""
    )
