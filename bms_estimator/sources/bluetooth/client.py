"""A BMS over Bluetooth, by aiobmsble and bleak: found, connected and polled."""

import asyncio
import logging
import pkgutil
from collections.abc import AsyncGenerator, Mapping

import aiobmsble.bms
from aiobmsble.basebms import BaseBMS
from aiobmsble.utils import bms_cls, bms_identify
from bleak import AdvertisementData, BleakScanner, BLEDevice
from bleak.exc import BleakError

from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.reading import CONNECTED, sample_json_line
from bms_estimator.settings.ble_source import BleSource
from bms_estimator.sources.bluetooth.bms_sample import reading_of
from bms_estimator.sources.line_source import LineProducer, SourceUnavailableError

SCAN_S = 15.0
"""A BMS advertises every few seconds at least; one that a phone is connected to does not [s]."""


class BleProducer(LineProducer):
    """Polls a BMS. It stays connected: most take seconds to connect.

    Args:
        settings: Settings of the BMS.

    Raises:
        UserError: aiobmsble does not support this BMS.
    """

    def __init__(self, settings: BleSource) -> None:
        known = sorted(module.name.removesuffix("_bms") for module in pkgutil.iter_modules(aiobmsble.bms.__path__))
        if settings.bms is not None and settings.bms.removesuffix("_bms") not in known:
            raise UserError(f"source.bms = {settings.bms!r}: aiobmsble knows {', '.join(known)}")
        for library in (
            "aiobmsble",
            "bleak",
            "bleak_retry_connector",
        ):  # their log lines are replaced by one of this module
            logging.getLogger(library).setLevel(logging.CRITICAL)
        self._settings = settings
        self._not_measured = 0
        self._fault: str | None = None

    @property
    def name(self) -> str:
        """Name of the BMS."""
        return self._settings.described

    @property
    def counters(self) -> Mapping[str, int]:
        """Since start: samples without voltage or current."""
        return {"not_measured": self._not_measured}

    @property
    def fault(self) -> str | None:
        """Fault of a BMS that responds without values."""
        return self._fault

    async def iter_lines(self) -> AsyncGenerator[bytes, None]:
        """One line for each poll."""
        try:
            device, kind = await self._find()
            async with kind(device) as bms:
                sample = await bms.async_update()
                yield CONNECTED
                loop = asyncio.get_running_loop()
                next_s = loop.time()
                while True:
                    if line := self._line(sample):
                        yield line
                    next_s = max(next_s + self._settings.poll_s, loop.time())
                    await asyncio.sleep(next_s - loop.time())
                    sample = await bms.async_update()
        except PermissionError:
            raise SourceUnavailableError("it wants a password; take that away in its app") from None
        except TimeoutError:
            raise SourceUnavailableError("no answer") from None
        except FileNotFoundError:  # the socket of D-Bus
            raise SourceUnavailableError("no Bluetooth: are D-Bus and bluetoothd running?") from None
        except (
            BleakError,
            EOFError,
            OSError,
            ValueError,
            LookupError,
            AssertionError,
        ) as error:  # unexpected bytes
            raise SourceUnavailableError(str(error) or type(error).__name__) from None

    def _line(self, sample: Mapping[str, object]) -> bytes | None:
        reading = reading_of(sample)
        if reading is None:
            self._not_measured += 1
            self._fault = "it answers, but tells no voltage or no current"
            return None
        self._fault = None
        return sample_json_line(
            reading.voltage_v, reading.current_a, temperature_c=reading.temperature_c, cells_v=reading.cells_v
        )

    async def _find(self) -> tuple[BLEDevice, type[BaseBMS]]:
        """Find the BMS and the driver of its kind.

        Raises:
            SourceUnavailableError: It does not advertise, or its kind is unknown.
        """
        heard: list[AdvertisementData] = []

        def is_it(device: BLEDevice, advertisement: AdvertisementData) -> bool:
            heard[:] = [advertisement]
            if self._settings.address is not None:
                return bool(device.address.lower() == self._settings.address.lower())
            return self._settings.name in (device.name, advertisement.local_name)

        device = await BleakScanner.find_device_by_filter(is_it, timeout=SCAN_S)
        if device is None:
            raise SourceUnavailableError("it does not advertise: is it near and on, and no phone connected to it?")
        told = self._settings.bms
        kind = await (bms_cls(f"{told.removesuffix('_bms')}_bms") if told else bms_identify(heard[0], device.address))
        if kind is None:
            raise SourceUnavailableError(
                f"{device.name or device.address}: no kind that aiobmsble knows; set source.bms"
            )
        return device, kind
