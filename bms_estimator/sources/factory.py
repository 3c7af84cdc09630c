"""Factory of sources, also of a pack with two devices: a battery monitor for voltage and current, and a BMS for cells and temperatures.

Each source kind is one module, listed in ``KINDS``. The module is imported only if the settings use it.
"""

import asyncio
import contextlib
import importlib
import math
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Self

import numpy as np

from bms_estimator.model.arrays import NO_SOC, SampleStatus
from bms_estimator.model.clock import since_boot
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.serial.port_list import KnownBoardFile
from bms_estimator.sources.serial.serial_source import SerialSource
from bms_estimator.sources.source import LineProducer, LineSource, ReadTap, ReceivedSamples

TEMPERATURES = "temperature_c", "temperature_min_c", "temperature_max_c"
"""Fields of a sample with temperatures."""
DeviceSource = LineSource | SerialSource
"""Source with one device."""
MAX_AGE_PERIODS, MAX_AGE_FLOOR_S = 3.0, 10.0
"""Maximum age of the values of the BMS [sample periods of the BMS], and the lower limit of this maximum [s]."""


class PairedSource:
    """Samples of a battery monitor with the latest cell voltages and temperatures of a BMS.

    If the values of the BMS are too old, the samples have no cell voltages, and the temperature is that of the monitor. An SOC
    from the monitor takes precedence over one from the BMS.

    Args:
        monitor: Battery monitor.
        bms: The BMS.
        period_s: Sample period of the BMS [s].
        monotonic: Monotonic clock [s].
    """

    def __init__(
        self,
        monitor: DeviceSource,
        bms: DeviceSource,
        period_s: float,
        monotonic: Callable[[], float] = since_boot,
    ) -> None:
        self._monitor, self._bms, self._monotonic = monitor, bms, monotonic
        self._max_age_s = max(MAX_AGE_PERIODS * period_s, MAX_AGE_FLOOR_S)
        self._latest: ReceivedSamples | None = None
        self._latest_s = -math.inf
        self._task: asyncio.Task[None] | None = None

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters of the monitor, and counters of the BMS with the suffix ``_of_bms``.

        The suffix hides errors of the BMS from the alarms, which count all ``*_errors`` as lost samples: an error of the BMS
        loses no sample of the monitor.
        """
        return {**self._monitor.counters, **{f"{name}_of_bms": count for name, count in self._bms.counters.items()}}

    @property
    def silence_reason(self) -> str | None:
        """Reason why no samples of the monitor arrive; None while they arrive."""
        return self._monitor.silence_reason

    @property
    def board(self) -> Mapping[str, str]:
        """Properties of the monitor."""
        return self._monitor.board

    @property
    def clock_ppm(self) -> float | None:
        """Rate error of the monitor's clock [1e-6]; None if unknown."""
        return self._monitor.clock_ppm

    @property
    def clock_fault(self) -> str:
        """Description of a fault of the monitor's clock; empty without one."""
        return self._monitor.clock_fault

    @property
    def conflict(self) -> str:
        """Description of a second publisher of the monitor's samples; empty without one."""
        return self._monitor.conflict

    async def __aenter__(self) -> Self:
        async with contextlib.AsyncExitStack() as stack:
            await stack.enter_async_context(self._monitor)
            await stack.enter_async_context(self._bms)
            self._task = asyncio.create_task(self._read_bms(), name="BMS of a battery monitor")
            self._exits = stack.pop_all()
        return self

    async def __aexit__(self, *error: object) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait({self._task})
        await self._exits.aclose()

    async def __aiter__(self) -> AsyncIterator[ReceivedSamples]:
        """Yield the blocks of the monitor with the values of the BMS."""
        async for received in self._monitor:
            if self._task is not None and self._task.done():
                self._task.result()  # raises the exception of the BMS's source
            yield self._with_bms(received)

    async def _read_bms(self) -> None:
        async for received in self._bms:
            self._latest, self._latest_s = received, self._monotonic()

    def _with_bms(self, received: ReceivedSamples) -> ReceivedSamples:
        """Return samples with the cell voltages, temperatures, SOC and capacity of the BMS, unless they are too old."""
        bms, last_rows = self._latest, np.full(received.samples.size, -1)
        if bms is None or self._monotonic() - self._latest_s > self._max_age_s:
            return received
        samples, last = received.samples.copy(), bms.samples[-1]
        if math.isfinite(last["temperature_c"]):
            for name in TEMPERATURES:
                samples[name] = last[name]
            samples["status"] |= last["status"] & np.uint32(SampleStatus.PROBE_FAULT)
        soc, capacity_ah = received.device_soc, received.device_capacity_ah
        if not np.isfinite(soc).any():
            soc = bms.device_soc[last_rows] if bms.device_soc.size else NO_SOC
        return ReceivedSamples(
            samples,
            bms.cells_v[last_rows] if bms.cells_v.size else received.cells_v,
            bms.probes[last_rows] if bms.probes.size else received.probes,
            soc,
            bms.device_capacity_ah if math.isnan(capacity_ah) else capacity_ah,
        )


KINDS: Mapping[str, str] = {
    "mqtt": "mqtt.mqtt_lines",
    "linux": "linux.linux_sensor",
    "modbus": "fieldbus.modbus",
    "can": "fieldbus.can",
    "ble": "bluetooth.source",
}
"""Module of each ``source.kind``. Its function ``producer(settings)`` creates the line producer."""


def make_line_producer(settings: Settings) -> LineProducer | None:
    """Make the line producer that ``[source]`` selects; None without ``[source]``, for a serial port.

    Raises:
        UserError: A setting cannot be used.
        ModuleNotFoundError: An optional package is missing.
    """
    if settings.source is None:
        return None
    module = importlib.import_module(f"{__package__}.{KINDS[settings.source.kind]}")
    line_producer: LineProducer = module.producer(settings)
    return line_producer


def open_device(
    settings: Settings, *, tap: ReadTap | None = None, board_file: KnownBoardFile | None = None
) -> DeviceSource:
    """Make the source of the device that measures voltage and current.

    Args:
        settings: Settings of the pack.
        tap: Receives all bytes with their arrival times.
        board_file: File with the board of the pack; None: each board is accepted.

    Raises:
        UserError: A setting cannot be used.
        ModuleNotFoundError: An optional package is missing.
    """
    producer = make_line_producer(settings)
    if producer is None:
        return SerialSource(settings.sensor, tap=tap, board_file=board_file)
    return LineSource(producer, settings.sensor, period_s=settings.sensor.sample_period_s, tap=tap)


def pair_with_bms(device: DeviceSource, settings: Settings) -> DeviceSource | PairedSource:
    """Return the source of the pack: the device, with the BMS in ``[bms]`` if there is one.

    Raises:
        UserError: A setting cannot be used.
        ModuleNotFoundError: An optional package is missing.
    """
    bms = settings.bms_settings
    return device if bms is None else PairedSource(device, open_device(bms), bms.sensor.sample_period_s)


def open_source(settings: Settings) -> DeviceSource | PairedSource:
    """Make the source of a pack. It neither reads nor writes the state folder.

    Raises:
        UserError: A setting cannot be used.
        ModuleNotFoundError: An optional package is missing.
    """
    return pair_with_bms(open_device(settings), settings)
