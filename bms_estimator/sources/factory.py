"""Factory of sources.

Each source kind is one module, listed in ``KINDS``. The module is imported only if the settings use it.
"""

import importlib
from collections.abc import Mapping

from bms_estimator.settings.pack import Settings
from bms_estimator.sources.line_source import LineProducer, LineSource
from bms_estimator.sources.source import ReadTap

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


def open_line_source(settings: Settings, *, tap: ReadTap | None = None) -> LineSource | None:
    """Make the source that ``[source]`` selects; None without ``[source]``, for a serial port.

    Raises:
        UserError: A setting cannot be used.
        ModuleNotFoundError: An optional package is missing.
    """
    producer = make_line_producer(settings)
    if producer is None:
        return None
    return LineSource(producer, settings.sensor, period_s=settings.sensor.sample_period_s, tap=tap)
