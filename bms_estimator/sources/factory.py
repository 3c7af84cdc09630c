"""Factory of sources. A kind is one file here and a row in ``KINDS``; it is imported when it is needed."""

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
"""Modules by ``source.kind``, with a ``producer(settings)`` that creates the line producer."""


def make_line_producer(settings: Settings) -> LineProducer | None:
    """Make the line producer of ``[source]``; None if the source is a serial port.

    Raises:
        UserError: A setting cannot be used.
        ModuleNotFoundError: An optional package is missing.
    """
    if settings.source is None:
        return None
    module = importlib.import_module(f"{__package__}.{KINDS[settings.source.kind]}")
    made: LineProducer = module.producer(settings)
    return made


def open_line_source(settings: Settings, *, tap: ReadTap | None = None) -> LineSource | None:
    """Open the source of ``[source]``; None if it is a serial port.

    Raises:
        UserError, ModuleNotFoundError: As ``make_line_producer``.
    """
    producer = make_line_producer(settings)
    if producer is None:
        return None
    return LineSource(producer, settings.sensor, period_s=settings.sensor.sample_period_s, tap=tap)
