"""Check of a pack's settings against its cell, and of the files that the settings name."""

from typing import TypeVar

from bms_estimator.estimator.settings_plausibility import implausible_settings
from bms_estimator.estimator.stability_conditions import observer_warnings
from bms_estimator.model.pack_model import PackModel
from bms_estimator.mqtt.connection import check as check_brokers
from bms_estimator.page.access_control import make_access_control
from bms_estimator.process.systemd import is_unreadable_credential
from bms_estimator.service.hook_check import hook_warnings
from bms_estimator.settings.alarm_limits import implausible_limits
from bms_estimator.settings.connections import EdgeSettings, InfluxSettings, MqttSettings, PageSettings
from bms_estimator.settings.pack import Settings
from bms_estimator.sinks.exports.influx import target
from bms_estimator.sources.factory import make_line_producer

ONLY_IN_SERVICE = (
    "not checked: no such file, unless it is a systemd credential, which exists only while the service runs"
)
"""Warning about a credential file that only the running service can read."""

BrokerSettings = TypeVar("BrokerSettings", MqttSettings, EdgeSettings)


def check_settings(settings: Settings, cell: PackModel) -> list[str]:
    """Return a warning for each likely mistake in the settings of a pack.

    Args:
        settings: Settings of the pack.
        cell: Model of the whole pack.

    Raises:
        UserError: A file that the settings name cannot be used.
        ModuleNotFoundError: The optional package of a source is missing.
    """
    warnings = [
        *implausible_settings(settings, cell),
        *implausible_limits(settings, cell),
        *hook_warnings(settings),
        *observer_warnings(settings.observer, cell),
    ]
    if settings.mqtt is not None:
        mqtt, unchecked = _without_credentials("mqtt", settings.mqtt)
        warnings += unchecked + check_brokers(mqtt)
        settings = settings.model_copy(update={"mqtt": mqtt})
    if settings.edge is not None:
        edge, unchecked = _without_credentials("edge", settings.edge)
        warnings += unchecked + check_brokers(edge)
    if settings.page is not None:
        unreadable, unchecked = _unreadable("page", settings.page, "token_file")
        warnings += unchecked
        if not unreadable:
            make_access_control(settings.page)  # raises UserError if the token file is invalid
    if settings.influx is not None:
        unreadable, unchecked = _unreadable("influx", settings.influx, "password_file", "token_file")
        warnings += unchecked
        target(settings.influx.model_copy(update=dict.fromkeys(unreadable)))  # raises UserError for invalid credentials
    for device in (settings, settings.bms_settings):
        if device is not None:
            make_line_producer(device)  # raises an error if [source] is invalid or its optional package is missing
    return warnings


def summarize(settings: Settings, cell: PackModel) -> str:
    """Return pack, source and broker of valid settings in one line."""
    ratings = cell.cell
    broker = ", ".join(settings.mqtt.urls) if settings.mqtt else "no broker"
    if settings.edge:
        url = settings.edge.url
        broker += f"; samples to {url if isinstance(url, str) else ', '.join(url)}"
    devices = " and ".join(map(_device_text, filter(None, (settings, settings.bms_settings))))
    return (
        f"{settings.pack.name}: {ratings.name}, {ratings.series_count} in series, {ratings.nominal_voltage_v:g} V, {cell.capacity_text}; "
        f"{devices}; {broker}"
    )


def _device_text(settings: Settings) -> str:
    """Return the device of ``[sensor]`` or ``[source]`` in a few words."""
    if settings.source is not None:
        return settings.source.short_description
    sensor = settings.sensor
    return f"{sensor.protocol}{' board' if sensor.protocol in ('binary', 'text') else ''} on {sensor.port}"


def _without_credentials(section: str, settings: BrokerSettings) -> tuple[BrokerSettings, list[str]]:
    """Return the settings without files that only the running service can read, and a warning for each such file."""
    removed, warnings = _unreadable(section, settings, "password_file", "cert_file", "key_file")
    if removed & {"cert_file", "key_file"}:  # a certificate and its key can only be checked together
        removed |= {"cert_file", "key_file"}
    return settings.model_copy(update=dict.fromkeys(removed)), warnings


def _unreadable(
    section: str, settings: MqttSettings | EdgeSettings | InfluxSettings | PageSettings, *keys: str
) -> tuple[set[str], list[str]]:
    """Return the keys of files that only the running service can read, and a warning for each."""
    files = {key: getattr(settings, key) for key in keys}
    unreadable = {key: name for key, name in files.items() if name is not None and is_unreadable_credential(name)}
    return set(unreadable), [f"{section}.{key} = {name}: {ONLY_IN_SERVICE}" for key, name in unreadable.items()]
