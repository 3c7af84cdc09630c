"""Measurement of the present voltage and current of a pack by its device."""

import asyncio
import contextlib
from dataclasses import dataclass

import numpy as np

from bms_estimator.model.errors import UserError
from bms_estimator.settings.pack import Settings
from bms_estimator.setup.found_device import values_text
from bms_estimator.sources.factory import open_line_source
from bms_estimator.sources.serial.serial_source import SerialSource
from bms_estimator.sources.source import Source

FIRST_SAMPLE_S = 15.0
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

    def __str__(self) -> str:
        """Return voltage and current as text."""
        return values_text(self.voltage_v, self.current_a)


def open_pack_source(settings: Settings) -> Source:
    """Return the source of a pack. It neither reads nor writes the state folder.

    Raises:
        UserError: A setting is invalid.
        ModuleNotFoundError: The optional package of the source is missing.
    """
    return open_line_source(settings) or SerialSource(settings.sensor)


def first_sample_timeout_s(settings: Settings, response_s: float | None = None) -> float:
    """Return the timeout of the first sample [s].

    Args:
        settings: Settings of the source.
        response_s: Time within which the device answers [s]; None: ``FIRST_SAMPLE_S``.
    """
    return (response_s or FIRST_SAMPLE_S) + FIRST_SAMPLE_PERIODS * settings.sensor.sample_period_s


async def measure(settings: Settings, response_s: float | None = None) -> Measurement:
    """Return the present voltage and current.

    Args:
        settings: Settings of the source.
        response_s: Time within which the device answers [s]; None: ``FIRST_SAMPLE_S``.

    Raises:
        UserError: No sample arrives, or none is valid.
        ModuleNotFoundError: The optional package of the source is missing.
    """
    timeout_s = first_sample_timeout_s(settings, response_s)
    blocks = []
    async with open_pack_source(settings) as source:
        received = aiter(source)
        try:
            async with asyncio.timeout(timeout_s):
                blocks.append((await anext(received)).samples.copy())
        except TimeoutError:
            raise UserError(f"no sample within {timeout_s:g} s: {source.silence_reason}") from None
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(AVERAGE_S):
                async for block in received:
                    blocks.append(block.samples.copy())  # noqa: PERF401 - the timeout would lose a comprehension
    samples = np.concatenate(blocks)
    valid = samples[np.isfinite(samples["voltage_v"]) & np.isfinite(samples["current_a"])]
    if not valid.size:
        raise UserError("the device sends no valid voltage and current: is the pack connected to it?")
    return Measurement(float(valid["voltage_v"].mean()), float(valid["current_a"].mean()))
