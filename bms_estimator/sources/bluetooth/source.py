"""``kind = "ble"``: a BMS over Bluetooth. It checks the Python version before it imports the client."""

import sys

from bms_estimator.model.errors import UserError
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sources.source import BleSource
from bms_estimator.sources.source import LineProducer

MIN_PYTHON_HEX = 0x030C0000
"""Minimum Python version of aiobmsble, 3.12, in the format of ``sys.hexversion``."""


def producer(settings: Settings) -> LineProducer:
    """Make the line producer of ``[source]``.

    Raises:
        UserError: This Python is too old, or aiobmsble does not support this BMS.
        ModuleNotFoundError: aiobmsble is not installed.
    """
    assert isinstance(settings.source, BleSource)  # noqa: S101 - KINDS maps kind = "ble" to BleSource
    if sys.hexversion < MIN_PYTHON_HEX:
        raise UserError(f'source.kind = "ble" needs Python 3.12 or newer; this is {sys.version.split()[0]}')
    from bms_estimator.sources.bluetooth.client import BleProducer  # noqa: PLC0415 - needs Python 3.12 and an extra

    return BleProducer(settings.source)
