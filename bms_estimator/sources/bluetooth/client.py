"""Bluetooth client of a BMS, with aiobmsble and bleak: scan, connect and poll."""

import asyncio
import logging
import pkgutil
from collections.abc import AsyncGenerator, Mapping
from typing import NamedTuple

import aiobmsble.bms
from aiobmsble.basebms import BaseBMS
from aiobmsble.utils import bms_cls, bms_identify
from bleak import AdvertisementData, BleakScanner, BLEDevice
from bleak.exc import BleakError

from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.reading import CONNECTED, sample_json_line
from bms_estimator.settings.sources.source import BleSource
from bms_estimator.sources.bluetooth.bms_sample import convert_sample
from bms_estimator.sources.source import LineProducer, SourceUnavailableError

SCAN_S = 15.0
"""Timeout of a scan [s]. A BMS advertises every few seconds, but not while a phone is connected to it."""


class AdvertisedBms(NamedTuple):
    """BMS that advertises, and whose kind is known."""

    address: str
    name: str
    kind: str
    """Name of its driver, as in ``source.bms``."""


async def discover() -> list[AdvertisedBms]:
    """Return all BMS of known kinds that advertise within ``SCAN_S``.

    Raises:
        UserError: There is no Bluetooth.
    """
    try:
        found = await BleakScanner.discover(timeout=SCAN_S, return_adv=True)
    except (BleakError, EOFError, OSError) as error:
        raise UserError(f"no Bluetooth: {error or type(error).__name__}") from None
    result = []
    for device, advertisement in found.values():
        driver = await bms_identify(advertisement, device.address)
        if driver is not None:
            kind = driver.__module__.rpartition(".")[2].removesuffix("_bms")
            result.append(AdvertisedBms(device.address, device.name or device.address, kind))
    return result


class BleProducer(LineProducer):
    """Line producer that polls a BMS. It stays connected, because most BMS need seconds to connect.

    Args:
        settings: Settings of the BMS.

    Raises:
        UserError: aiobmsble does not support this BMS.
    """

    def __init__(self, settings: BleSource) -> None:
        supported = sorted(module.name.removesuffix("_bms") for module in pkgutil.iter_modules(aiobmsble.bms.__path__))
        if settings.bms is not None and settings.bms.removesuffix("_bms") not in supported:
            raise UserError(f"source.bms = {settings.bms!r}: aiobmsble supports {', '.join(supported)}")
        for library in ("aiobmsble", "bleak", "bleak_retry_connector"):  # LineSource logs the reason in one line
            logging.getLogger(library).setLevel(logging.CRITICAL)
        self._settings = settings
        self._unmeasured_samples = 0
        self._fault: str | None = None

    @property
    def name(self) -> str:
        """Name of the BMS."""
        return self._settings.short_description

    @property
    def counters(self) -> Mapping[str, int]:
        """Number of samples without voltage or current since start."""
        return {"not_measured": self._unmeasured_samples}

    @property
    def fault(self) -> str | None:
        """Fault of a BMS that responds without values."""
        return self._fault

    async def iter_lines(self) -> AsyncGenerator[bytes, None]:
        """Connect, and yield one line for each poll."""
        try:
            device, driver = await self._find()
            async with driver(device) as bms:
                sample = await bms.async_update()
                yield CONNECTED
                loop = asyncio.get_running_loop()
                next_poll_s = loop.time()
                while True:
                    if line := self._line(sample):
                        yield line
                    next_poll_s = max(next_poll_s + self._settings.poll_s, loop.time())
                    await asyncio.sleep(next_poll_s - loop.time())
                    sample = await bms.async_update()
        except PermissionError:
            raise SourceUnavailableError("the BMS asks for a password; remove the password in its app") from None
        except TimeoutError:
            raise SourceUnavailableError("no response") from None
        except FileNotFoundError:  # the socket of D-Bus does not exist
            raise SourceUnavailableError("no Bluetooth: are D-Bus and bluetoothd running?") from None
        except (BleakError, EOFError, OSError) as error:
            raise SourceUnavailableError(str(error) or type(error).__name__) from None
        except (ValueError, LookupError, AssertionError) as error:  # the library could not parse the received bytes
            raise SourceUnavailableError(str(error) or type(error).__name__) from None

    def _line(self, sample: Mapping[str, object]) -> bytes | None:
        reading = convert_sample(sample)
        if reading is None:
            self._unmeasured_samples += 1
            self._fault = "the BMS responds, but reports no voltage or no current"
            return None
        self._fault = None
        return sample_json_line(
            reading.voltage_v,
            reading.current_a,
            temperatures_c=reading.temperatures_c,
            cells_v=reading.cells_v,
            soc=reading.soc,
            capacity_ah=reading.capacity_ah,
        )

    async def _find(self) -> tuple[BLEDevice, type[BaseBMS]]:
        """Find the BMS and its driver.

        Raises:
            SourceUnavailableError: The BMS does not advertise, or aiobmsble does not recognize it.
        """
        advertisements: list[AdvertisementData] = []  # only the latest; when the BMS is found, its own

        def is_wanted(device: BLEDevice, advertisement: AdvertisementData) -> bool:
            advertisements[:] = [advertisement]
            if self._settings.address is not None:
                return bool(device.address.lower() == self._settings.address.lower())
            return self._settings.name in (device.name, advertisement.local_name)

        device = await BleakScanner.find_device_by_filter(is_wanted, timeout=SCAN_S)
        if device is None:
            raise SourceUnavailableError(
                "the BMS does not advertise: is it in range and on, and is no phone connected to it?"
            )
        configured = self._settings.bms
        driver = await (
            bms_cls(f"{configured.removesuffix('_bms')}_bms")
            if configured
            else bms_identify(advertisements[0], device.address)
        )
        if driver is None:
            raise SourceUnavailableError(
                f"{device.name or device.address}: its kind is not recognized by aiobmsble; set source.bms"
            )
        return device, driver
