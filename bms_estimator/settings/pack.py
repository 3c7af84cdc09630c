"""Settings of one pack, from ``pack.toml``. The name of a setting with a unit ends in the unit.

Also the new settings file of a pack.
"""

import os
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal, Self, TypeVar

from pydantic import BaseModel, Field, TypeAdapter, ValidationError, model_validator

from bms_estimator.model.config_file import Fraction, Positive, Strict, read_toml
from bms_estimator.model.errors import UserError
from bms_estimator.protocols.registry import max_batteries
from bms_estimator.settings.alarms import AlarmSettings
from bms_estimator.settings.connections import (
    EdgeSettings,
    HomeAssistantSettings,
    InfluxSettings,
    MqttSettings,
    PageSettings,
    PrometheusSettings,
)
from bms_estimator.settings.observer import ChargeLimits, IdentifierSettings, ObserverSettings, Sampling
from bms_estimator.settings.sensor import ALLOWED_WITH_SOURCE, SensorSettings
from bms_estimator.settings.settings_template import GivenSettings, settings_file
from bms_estimator.settings.sources.fieldbus import CanSource, ModbusSource
from bms_estimator.settings.sources.mqtt import MqttSource
from bms_estimator.settings.sources.source import BleSource, LinuxSource

SourceSettings = Annotated[MqttSource | LinuxSource | ModbusSource | CanSource | BleSource, Field(discriminator="kind")]

_SOURCE_ADAPTER: TypeAdapter[SourceSettings] = TypeAdapter(SourceSettings)

Section = TypeVar("Section", bound=BaseModel)
MIN_RATE_HZ = 0.1
"""Minimum publish rate [Hz]."""
MAX_RATE_HZ = 10.0
"""Maximum publish rate [Hz]."""
LogLevel = Literal["info", "warning", "error"]
DEVICE_NAME = r"^[A-Za-z0-9_-]{1,64}$"
DeviceName = Annotated[str, Field(pattern=DEVICE_NAME)]


class _PackNames(Strict):
    """Names in ``[pack]``. A fleet's table of packs has its own columns for them."""

    name: DeviceName = Field(
        default="pack", description="name of the pack, also in MQTT topics: letters, digits, _ and -"
    )
    cell: Annotated[str, Field(min_length=1)] = Field(
        default="ncr18650",
        description="generic cell (lfp, nmc, nca, lco, lmo or lto; requires capacity_ah), name of a shipped cell, or path of a cell file",
    )


class PackValues(Strict):
    """Settings of ``[pack]`` that are also columns of a fleet's table of packs."""

    capacity_ah: Positive | None = Field(
        default=None,
        description="capacity of the cell, or of the module that the cell file describes; default: capacity in the cell file",
    )
    series: Annotated[int, Field(ge=1, le=10_000)] = Field(
        default=1, description="number of cells, or of modules that the cell file describes, in series"
    )
    parallel: Annotated[int, Field(ge=1, le=10_000)] = Field(
        default=1, description="number of cells, or of modules that the cell file describes, in parallel"
    )
    initial_soc: Fraction | None = Field(
        default=None, description="initial SOC; default: from the measured voltage, by the OCV curve"
    )
    full_voltage_v: Positive | None = Field(
        default=None,
        description="voltage at the terminals of the pack at which the charger ends a charge, which defines SOC 1; default: OCV of the cell file at SOC 1",
    )
    tail_current_a: Positive | None = Field(
        default=None,
        description="current at full_voltage_v at which the charger ends a charge; default: C/20, and up to C/8 where the charge ends (LFP, LMO and LTO: C/4)",
    )
    cutoff_voltage_v: Positive | None = Field(
        default=None,
        description="voltage at the terminals of the pack at which the protection ends a discharge, which defines SOC 0; default: OCV of the cell file at SOC 0",
    )

    @model_validator(mode="after")
    def _check_full_above_cutoff(self) -> Self:
        full_v, cutoff_v = self.full_voltage_v, self.cutoff_voltage_v
        if full_v is not None and cutoff_v is not None and full_v <= cutoff_v:
            raise ValueError(f"full_voltage_v = {full_v:g}: must be above cutoff_voltage_v = {cutoff_v:g}")
        return self

    @property
    def charge_limits(self) -> ChargeLimits:
        """Limits of charger and protection."""
        return ChargeLimits(self.full_voltage_v, self.tail_current_a, self.cutoff_voltage_v)


class PackSettings(PackValues, _PackNames):
    """Name and initial SOC of the pack; type, capacity and number of its cells."""

    cutoff_v: Positive | None = Field(
        default=None,
        description="voltage at the terminals of the pack at which the load is switched off, which ends the forecast; default: cutoff_voltage_v, otherwise the limit of the alarm pack_under_voltage, otherwise OCV of the cell file at SOC 0",
    )
    max_discharge_a: Positive | None = Field(
        default=None,
        description="largest discharge current of the pack by its rating or its BMS, which bounds the available power; default: 1 C, or the largest current that the pack has supplied for a second",
    )
    device_soc_std: Annotated[float, Field(gt=0, le=0.5)] | None = Field(
        default=None,
        description="standard deviation 0..0.5 of the SOC that the device reports, such as 0.1; a new pack starts with this SOC as a prior; default: the SOC of the device is not used",
    )
    max_charge_a: Positive | None = Field(
        default=None,
        description="largest charge current of the pack by its rating or its BMS, which bounds the available power; default: C/2, or the largest current that the pack has accepted for a second",
    )


def _with_source_defaults(tables: object) -> object:
    """Return tables with the ``[sensor]`` defaults of their ``[source]``. The protocol is text, because sources produce text lines.

    Raises:
        ValueError: ``[sensor]`` describes a serial device.
    """
    if not isinstance(tables, dict) or tables.get("source") is None:
        return tables
    sensor = tables.get("sensor", {})
    configured = sensor.model_dump(exclude_unset=True) if isinstance(sensor, SensorSettings) else sensor
    try:
        source = _SOURCE_ADAPTER.validate_python(tables["source"])
    except ValidationError:  # the validation of the section reports it
        return tables
    if not isinstance(configured, dict):
        return tables
    conflicts = [
        name for name, allowed in ALLOWED_WITH_SOURCE.items() if configured.get(name, allowed[0]) not in allowed
    ]
    if conflicts:
        names = ", ".join(f"sensor.{name}" for name in conflicts)
        raise ValueError(
            f"{names}: only for a serial device, but [source] describes another source; remove one of them"
        )
    return tables | {
        "sensor": {"period_s": source.period_s, **source.sensor_defaults, **configured, "protocol": "text"}
    }


class BmsSettings(Strict):
    """BMS that measures cells and temperatures, while [sensor] or [source] is a battery monitor that measures voltage and current."""

    sensor: SensorSettings = Field(
        default=SensorSettings(),
        description="BMS on a serial port, with the keys of [sensor]",
        examples=['sensor = { port = "/dev/ttyUSB1", protocol = "jk" }'],
    )
    source: SourceSettings | None = Field(
        default=None,
        description='BMS that is not on a serial port, with the keys of [source], such as { kind = "mqtt", profile = "esphome-jk", prefix = "jk-bms" }',
    )

    @model_validator(mode="before")
    @classmethod
    def _add_source_defaults(cls, tables: object) -> object:
        return _with_source_defaults(tables)


class PublishSettings(Strict):
    """Rate of the published estimates."""

    rate_hz: Annotated[float, Field(ge=MIN_RATE_HZ, le=MAX_RATE_HZ)] = Field(
        default=1.0, description="number of published estimates per second"
    )


class StateSettings(Strict):
    """Checkpoints, from which a restarted service resumes."""

    folder: Path | None = Field(
        default=None,
        description="folder of checkpoints and history; default: StateDirectory of the systemd unit, otherwise bms-estimator in the user's XDG state folder",
    )
    checkpoint_s: Annotated[float, Field(ge=1)] = Field(default=60.0, description="interval between two checkpoints")
    longest_days: Positive | None = Field(
        default=None,
        description="maximum age of a checkpoint from which the service resumes [days], for packs that are exchanged; default: no limit",
    )


class StoreSettings(Strict):
    """Other data in the state folder: messages queued during a broker outage, and the pack's history."""

    outbox_messages: Annotated[int, Field(ge=1, le=10_000_000)] = Field(
        default=90_000,
        description="maximum number of queued estimates and events; the default is a day of estimates at 1 Hz. A full queue drops its oldest message, and messages of hooks last",
    )
    history_days: Annotated[int, Field(ge=0, le=36_600)] = Field(
        default=366, description="length of the stored history [days]; 0: no history"
    )


class LogSettings(Strict):
    """Logging."""

    level: LogLevel = Field(default="info", description="minimum level of log messages")


class Settings(Strict):
    """One pack's settings file."""

    pack: PackSettings = PackSettings()
    sensor: SensorSettings = SensorSettings()
    source: SourceSettings | None = Field(
        default=None, description="omit this section if [sensor] describes the source"
    )
    bms: BmsSettings | None = Field(default=None, description="omit this section if one device measures everything")
    observer: ObserverSettings = ObserverSettings()
    identifier: IdentifierSettings = IdentifierSettings()
    publish: PublishSettings = PublishSettings()
    mqtt: MqttSettings | None = Field(default=None, description="omit this section to publish nothing over MQTT")
    edge: EdgeSettings | None = Field(
        default=None, description="omit this section to send no samples to a fleet server"
    )
    home_assistant: HomeAssistantSettings = HomeAssistantSettings()
    influx: InfluxSettings | None = Field(default=None, description="omit this section to disable the export")
    prometheus: PrometheusSettings | None = Field(default=None, description="omit this section to disable the endpoint")
    page: PageSettings | None = Field(default=None, description="omit this section to serve no page")
    state: StateSettings = StateSettings()
    store: StoreSettings = StoreSettings()
    log: LogSettings = LogSettings()
    alarms: AlarmSettings = AlarmSettings()

    @model_validator(mode="before")
    @classmethod
    def _select_law(cls, tables: object) -> object:
        """Select the adaptation law ``learning`` by default if the identifier is off.

        The default law of the thesis moves the parameters between bounds without identifying them
        (docs/theory/thesis.md).
        """
        if not isinstance(tables, dict):
            return tables
        identifier, observer = tables.get("identifier"), tables.get("observer", {})
        if not isinstance(identifier, dict) or not isinstance(observer, dict) or identifier.get("enabled") is not False:
            return tables
        return tables | {"observer": {"law": "learning"} | observer}

    @model_validator(mode="before")
    @classmethod
    def _add_source_defaults(cls, tables: object) -> object:
        return _with_source_defaults(tables)

    @model_validator(mode="before")
    @classmethod
    def _expect_all_batteries(cls, tables: object) -> object:
        """Set ``sensor.batteries`` to ``pack.parallel``, if the protocol can sum the values of this number of batteries."""
        if not isinstance(tables, dict):
            return tables
        pack, sensor = tables.get("pack"), tables.get("sensor")
        if not isinstance(pack, dict) or not isinstance(sensor, dict):
            return tables
        parallel, protocol = pack.get("parallel"), sensor.get("protocol")
        if isinstance(parallel, int) and isinstance(protocol, str) and 1 < parallel <= max_batteries(protocol):
            return tables | {"sensor": {"batteries": parallel} | sensor}
        return tables

    @property
    def bms_settings(self) -> Self | None:
        """Settings whose only device is the one in ``[bms]``; None without this section."""
        if self.bms is None:
            return None
        return self.model_copy(update={"sensor": self.bms.sensor, "source": self.bms.source, "bms": None})

    @property
    def charge_limits(self) -> ChargeLimits:
        """Limits of charger and protection."""
        return self.pack.charge_limits

    @property
    def sampling(self) -> Sampling:
        """Sampling of the source."""
        sensor = self.sensor
        return Sampling(
            period_s=sensor.sample_period_s,
            current_resolution_a=sensor.current_resolution_a or 0.0,
            current_dead_band_a=sensor.current_dead_band_a or 0.0,
            voltage_gain_std=sensor.voltage_gain_std,
            current_gain_std=sensor.current_gain_std,
        )


def load_settings(path: Path) -> Settings:
    """Read a pack's settings. Relative paths of existing files are relative to the folder of the pack file.

    Raises:
        UserError: The file cannot be read or is empty, or a setting is invalid.
    """
    settings = read_toml(path, Settings)
    if not settings.model_fields_set:
        raise UserError(f"{path}: has no settings; was it cut off? `bms-estimator new` writes a new file")
    return _resolve_paths(settings, path.parent)


def _resolve_paths(section: Section, folder: Path) -> Section:
    """Return settings in which each relative path of a file that exists in ``folder`` begins with ``folder``.

    A systemd credential of the same name takes precedence.
    """
    changed: dict[str, BaseModel | Path] = {}
    credentials = Path(os.environ.get("CREDENTIALS_DIRECTORY", os.devnull))
    for key in section.model_fields_set:
        value = getattr(section, key)
        if isinstance(value, BaseModel):
            changed[key] = _resolve_paths(value, folder)
        elif isinstance(value, Path) and (folder / value).is_file() and not os.access(credentials / value, os.R_OK):
            changed[key] = folder / value  # an absolute path remains as it is
    return section.model_copy(update=changed) if changed else section


def create_pack_file(path: Path, given: GivenSettings = MappingProxyType({})) -> None:
    """Write a new settings file that lists every setting; only ``given`` settings differ from the defaults.

    Raises:
        UserError: The file exists already, or cannot be written.
    """
    require_new(path)
    try:
        with path.open("x", encoding="utf-8") as file:
            try:
                file.write(settings_file(Settings, given))
                file.flush()
            except OSError:
                path.unlink()  # a part of the file would prevent the next attempt
                raise
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None


def require_new(path: Path) -> None:
    """Reject the path of a file that exists, or that cannot be created.

    Raises:
        UserError: The file exists, or its folder does not exist or cannot be written.
    """
    if os.path.lexists(path):
        raise UserError(f"{path}: exists already and is not changed; give another name")
    if not path.parent.is_dir():
        raise UserError(f"{path}: cannot be written: there is no folder {path.parent}; create it, or give another name")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise UserError(f"{path}: cannot be written: no permission to write to the folder {path.parent.resolve()}")
