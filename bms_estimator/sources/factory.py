"""Factory of sources.

Each source kind is one module, listed in ``KINDS``. The module is imported only if the settings use it.
"""

import importlib
from collections.abc import Mapping

from bms_estimator.settings.pack import Settings
from bms_estimator.sources.paired_source import DeviceSource, PairedSource
from bms_estimator.sources.serial.port_list import KnownBoardFile
from bms_estimator.sources.serial.serial_source import SerialSource
from bms_estimator.sources.source import LineProducer, LineSource, ReadTap

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
