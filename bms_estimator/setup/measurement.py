"""Measurement of the present voltage and current of a pack by its device."""

import asyncio
import contextlib
import math
from dataclasses import dataclass

import numpy as np

from bms_estimator.model.errors import UserError
from bms_estimator.settings.pack import Settings
from bms_estimator.setup.found_device import values_text
from bms_estimator.sources.factory import open_source
from bms_estimator.sources.source import ReceivedSamples

FIRST_SAMPLE_TIMEOUT_S = 15.0
"""Timeout of the first sample [s]. A board needs up to 3 s after its port was opened, a Bluetooth BMS up to 15 s."""
FIRST_SAMPLE_PERIODS = 2.0
"""Number of sample periods that are added to the timeout of the first sample."""
AVERAGE_S = 2.0
"""Duration of the average, from the first sample on [s]."""


@dataclass(frozen=True)
class Measurement:
    """Means over ``AVERAGE_S``."""

    voltage_v: float
    current_a: float
    """Current [A], positive on discharge."""
    soc: float | None = None
    """Last SOC that the device reported, 0..1; None: not reported."""
    capacity_ah: float | None = None
    """Capacity from which the device computes its SOC [Ah]; None: not reported."""

    def __str__(self) -> str:
        """Return the values as text."""
        soc = "" if self.soc is None else f"; the device reports an SOC of {self.soc:.0%}"
        capacity = "" if self.capacity_ah is None else f" and a capacity of {self.capacity_ah:g} Ah"
        return values_text(self.voltage_v, self.current_a) + soc + capacity


def first_sample_timeout_s(settings: Settings, response_s: float | None = None) -> float:
    """Return the timeout of the first sample [s].

    Args:
        settings: Settings of the source.
        response_s: Time within which the device answers [s]; None: ``FIRST_SAMPLE_TIMEOUT_S``.
    """
    return (response_s or FIRST_SAMPLE_TIMEOUT_S) + FIRST_SAMPLE_PERIODS * settings.sensor.sample_period_s


async def measure(settings: Settings, response_s: float | None = None) -> Measurement:
    """Return the present voltage and current.

    Args:
        settings: Settings of the source.
        response_s: Time within which the device answers [s]; None: ``FIRST_SAMPLE_TIMEOUT_S``.

    Raises:
        UserError: No sample arrives, or none is valid.
        ModuleNotFoundError: The optional package of the source is missing.
    """
    timeout_s = first_sample_timeout_s(settings, response_s)
    blocks = list[ReceivedSamples]()
    async with open_source(settings) as source:
        received = aiter(source)
        try:
            async with asyncio.timeout(timeout_s):
                blocks.append(await anext(received))
        except TimeoutError:
            raise UserError(f"no sample within {timeout_s:g} s: {source.silence_reason}") from None
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(AVERAGE_S):
                async for block in received:
                    blocks.append(block)
    samples = np.concatenate([block.samples for block in blocks])
    reported = [float(soc) for block in blocks for soc in block.device_soc if math.isfinite(soc)]
    capacity_ah = blocks[-1].device_capacity_ah
    valid = samples[np.isfinite(samples["voltage_v"]) & np.isfinite(samples["current_a"])]
    if not valid.size:
        raise UserError("the device sends no valid voltage and current: is the pack connected to it?")
    return Measurement(
        float(valid["voltage_v"].mean()),
        float(valid["current_a"].mean()),
        reported[-1] if reported else None,
        capacity_ah if math.isfinite(capacity_ah) else None,
    )
