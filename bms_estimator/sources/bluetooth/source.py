"""A BMS over Bluetooth: its samples, and a check of the Python version. Does no I/O."""

import sys

from bms_estimator.model.errors import UserError
from bms_estimator.settings.ble_source import BleSource
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.line_source import LineProducer

NEEDED_PYTHON = 0x030C0000
"""3.12, as aiobmsble needs it."""


def producer(settings: Settings) -> LineProducer:
    """Make the line producer of ``[source]``.

    Raises:
        UserError: This Python is too old, or aiobmsble does not support this BMS.
        ModuleNotFoundError: It is not installed.
    """
    assert isinstance(settings.source, BleSource)  # noqa: S101 - as KINDS has it
    if sys.hexversion < NEEDED_PYTHON:
        raise UserError(f'source.kind = "ble" needs Python 3.12 or newer; this is {sys.version.split()[0]}')
    from bms_estimator.sources.bluetooth.client import BleProducer  # noqa: PLC0415 - needs that Python, and an extra

    return BleProducer(settings.source)
