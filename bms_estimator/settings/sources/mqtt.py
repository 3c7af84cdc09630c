"""Battery values that another program publishes: ``[source]`` with ``kind = "mqtt"``."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, model_validator

from bms_estimator.model.config_file import Positive, Strict
from bms_estimator.protocols.registry import DEVICES
from bms_estimator.settings.connections import BrokerSettings, BrokerUrls
from bms_estimator.settings.sources.mqtt_profiles import PROFILES, ProfileName
from bms_estimator.settings.sources.source import BaseSource, Name, as_tuple

Unit = Literal["V", "mV", "A", "mA", "C", "F", "K", "s", "ms", "iso", "%", "Ah", "mAh"]
ALLOWED_UNITS: Mapping[str, tuple[Unit, ...]] = {
    "voltage": ("V", "mV"),
    "current": ("A", "mA"),
    "temperature": ("C", "F", "K"),
    "cells": ("V", "mV"),
    "time": ("s", "ms", "iso"),
    "soc": ("%",),
    "capacity": ("Ah", "mAh"),
}
"""Units in which a quantity may be received, by quantity; the first unit is the default."""
CONVERSIONS: Mapping[Unit, tuple[float, float]] = {
    "mV": (1e-3, 0.0),
    "mA": (1e-3, 0.0),
    "mAh": (1e-3, 0.0),
    "ms": (1e-3, 0.0),
    "F": (5.0 / 9.0, -160.0 / 9.0),
    "K": (1.0, -273.15),
}
"""Factor and offset that convert a value to V, A, C, s, % or Ah, by unit. Values in other units are not converted."""
STALE_PERIODS, MIN_STALE_S = 3.0, 30.0
"""Default age at which a voltage or current is stale: in sample periods, and its minimum [s]."""
ABSENT_PERIODS = 2.0
"""Default age, in sample periods, at which a temperature or cell voltage is stale if every message contained it before, but
later messages do not. One message without it is tolerated."""
DEFAULT_RESOLUTION_V = 0.01
"""Voltage resolution of a publisher without a profile [V]."""


class ValueLocation(Strict):
    """Location of a quantity in messages, and its conversion to SI units. A string alone is the path."""

    topic: Name | tuple[Name, ...] | None = Field(
        default=None,
        description="topic, or a list of alternative topics; default: source.topic; {cell} stands for the cell number",
    )
    path: str = Field(
        default="",
        description="path in the JSON payload: keys and list indices, separated by dots; empty: the payload is a plain number; "
        "{cell} stands for the cell number; the path of cells may also lead to a list",
    )
    unit: Unit | None = Field(default=None, description="unit of the received value")
    scale: float = Field(default=1.0, description="factor by which the received value is multiplied")
    offset: float = Field(default=0.0, description="offset added after scale, in the unit of the received value")

    @model_validator(mode="before")
    @classmethod
    def _accept_path_alone(cls, table: object) -> object:
        return {"path": table} if isinstance(table, str) else table

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics as configured."""
        return (self.topic,) if isinstance(self.topic, str) else self.topic or ()

    def to_si(self, number: float) -> float:
        """Convert a number to V, A, C or s."""
        factor, offset = (1.0, 0.0) if self.unit is None else CONVERSIONS.get(self.unit, (1.0, 0.0))
        return factor * (self.scale * number + self.offset) + offset


def _merge_location(default: Any, configured: dict[str, Any]) -> Any:
    """Return a location with the settings of the profile that are not configured.

    A configured topic or path replaces all locations of the profile.
    """
    defaults = [default] if isinstance(default, dict) else default
    merged = [{**each, **configured} for each in defaults]
    return merged[0] if len(merged) == 1 or {"topic", "path"} & configured.keys() else merged


class SourceBroker(BrokerSettings):
    """Connection to the broker of ``[source]``."""

    section: ClassVar[str] = "source"


class MqttSource(BaseSource):
    """Battery values that another program publishes over MQTT; see docs/pack/mqtt-source.md."""

    kind: Literal["mqtt"] = Field(description="kind of this source")
    profile: ProfileName | None = Field(
        default=None, description="known publisher, whose topics are the defaults of this section"
    )
    prefix: Name | None = Field(
        default=None, description="name of the publisher in its topics, which replaces {prefix} in topics and paths"
    )
    instance: str = Field(
        default="",
        description="name or number of the battery in the publisher's topics, which replaces {instance} in topics and paths",
    )
    topic: Name | None = Field(default=None, description="topic of all quantities for which no other topic is set")
    voltage: ValueLocation | None = Field(
        default=None,
        description='location of the pack voltage: path in the JSON payload, or {topic = "...", path = "..."}',
    )
    current: ValueLocation | None = Field(
        default=None,
        description="location of the current, written like voltage; sensor.current_sign is the direction of positive current",
    )
    temperature: Annotated[tuple[ValueLocation, ...], BeforeValidator(as_tuple)] = Field(
        default=(),
        description="location of the temperature, written like voltage; a list for several probes, or {probe} in place of the probe's number",
    )
    cells: ValueLocation | None = Field(
        default=None,
        description="location of the cell voltages, written like voltage; {cell} stands for the cell number, or the path leads to a list",
    )
    time: ValueLocation | None = Field(
        default=None,
        description="location of the time of measurement on the publisher's clock, written like voltage; default: arrival times are used",
    )
    soc: ValueLocation | None = Field(
        default=None,
        description="location of the SOC that the publisher reports [%], written like voltage; it is shown beside the estimate",
    )
    capacity: ValueLocation | None = Field(
        default=None,
        description="location of the capacity from which the publisher computes its SOC, written like voltage",
    )
    settle_s: Annotated[float, Field(ge=0, le=60)] = Field(
        default=0.5,
        description="maximum time between a new voltage and a new current of one sample. After this time the last value of the missing one is used and marked as held; the estimator interpolates the current at the time of the voltage",
    )
    max_age_s: Positive | None = Field(
        default=None,
        description="maximum age of a voltage or current in a sample; default: three times interval_s, and at least 30 s; one interval_s longer than max_silent_s if that is set. Also maximum age of a temperature or cell voltage that every message contained before, but that is now null or absent; default: twice interval_s",
    )
    max_silent_s: Positive | None = Field(
        default=None,
        description="maximum time between two messages of a publisher that sends only changes. Until then the last values are used again, and a retained voltage or current is accepted while availability_topic reports the publisher online; default: the publisher sends a value in each interval_s",
    )
    slow_max_age_s: Positive = Field(
        default=300.0,
        description="maximum age of a temperature or cell voltage in a sample, unless availability_topic reports the publisher online",
    )
    interval_s: Positive = Field(
        default=10.0, description="expected sample period; values are stale after three periods"
    )
    availability_topic: str | None = Field(
        default=None,
        description="topic on which the publisher reports offline, directly or by its last will; the service gives this as the reason for missing samples. While it is online, temperatures and cell voltages do not expire, and retained ones are accepted",
    )
    ask: Mapping[str, str] = Field(
        default={}, description="requests to a publisher that only answers requests, as a table of payloads by topic"
    )
    ask_s: Positive = Field(default=10.0, description="interval at which the requests of ask are published")
    url: BrokerUrls | None = Field(
        default=None, description="URL of the broker, or a list of URLs to try in turn; default: broker of [mqtt]"
    )
    username: str | None = Field(default=None, description="user name at the broker in url")
    password_file: Path | None = Field(
        default=None,
        description="file with the password for the broker in url; a name without a folder is a systemd credential",
    )
    ca_file: Path | None = Field(
        default=None, description="certificate authority of the broker in url; default: the system's certificates"
    )

    quantities: ClassVar[tuple[str, ...]] = tuple(ALLOWED_UNITS)

    @property
    def broker(self) -> BrokerSettings | None:
        """Connection to the broker in ``url``; None: the source uses the broker of ``[mqtt]``."""
        if self.url is None:
            return None
        return SourceBroker(
            url=self.url, username=self.username, password_file=self.password_file, ca_file=self.ca_file
        )

    @model_validator(mode="before")
    @classmethod
    def _merge_profile(cls, table: object) -> object:
        """Merge settings into the profile. A quantity keeps those settings of the profile that are not configured."""
        profile = PROFILES.get(table.get("profile", "")) if isinstance(table, dict) else None
        if profile is None or not isinstance(table, dict):
            return table
        merged: dict[str, Any] = {**profile.table, **table}
        for name in cls.quantities:
            configured = table.get(name)
            configured = {"path": configured} if isinstance(configured, str) else configured
            if name in profile.table and isinstance(configured, dict):
                merged[name] = _merge_location(profile.table[name], configured)
        missing = [
            f"{name}: missing ({description})"
            for name, description in profile.required_settings.items()
            if not merged.get(name)
        ]
        if missing:
            raise ValueError(f"profile {table['profile']}: {'; '.join(missing)}")
        return merged

    @model_validator(mode="after")
    def _check_locations_and_broker(self) -> "MqttSource":
        for name in ("voltage", "current"):
            if getattr(self, name) is None:
                raise ValueError(f"{name}: missing; give its path, or choose a profile: {', '.join(PROFILES)}")
        for name, location in self.locations():
            if not location.topics and not self.topic:
                raise ValueError(f"{name}.topic: missing, and source.topic is not set")
            if location.unit and location.unit not in ALLOWED_UNITS[name]:
                raise ValueError(f"{name}.unit = {location.unit}: must be one of {', '.join(ALLOWED_UNITS[name])}")
            if location.scale == 0.0:
                raise ValueError(f"{name}.scale = 0: must not be 0")
        if self.url is None and (self.username or self.password_file or self.ca_file):
            raise ValueError(
                "username, password_file and ca_file apply to the broker in source.url, which is missing; remove them, because the broker of [mqtt] has its own"
            )
        return self

    def locations(self) -> Iterator[tuple[str, ValueLocation]]:
        """Yield the name of each configured quantity with each of its locations."""
        for name in self.quantities:
            value = getattr(self, name)
            locations = value if isinstance(value, tuple) else () if value is None else (value,)
            yield from ((name, location) for location in locations)

    def substitute(self, text: str) -> str:
        """Substitute prefix and instance in a topic or a path. ``{probe}`` becomes ``{cell}``, the only placeholder of a number."""
        text = text.replace("{probe}", "{cell}")
        return text.replace("{prefix}", self.prefix or "").replace("{instance}", self.instance)

    def topics(self, location: ValueLocation) -> list[str]:
        """Return the topics of a quantity, which may contain ``{cell}``."""
        return [self.substitute(topic) for topic in location.topics or (self.topic or "",)]

    @property
    def period_s(self) -> float:
        """Expected time between two samples [s]."""
        return self.interval_s

    @property
    def stale_s(self) -> float:
        """Maximum age of a voltage or current in a sample [s]."""
        default_s = max(STALE_PERIODS * self.interval_s, MIN_STALE_S, (self.max_silent_s or 0.0) + self.interval_s)
        return self.max_age_s or default_s

    @property
    def absent_s(self) -> float:
        """Maximum age of a temperature or cell voltage that every message contained before, but later messages do not [s]."""
        return self.max_age_s or ABSENT_PERIODS * self.interval_s

    @property
    def short_description(self) -> str:
        """Description in a few words."""
        publisher = self.profile or (self.topics(self.voltage)[0] if self.voltage else "")
        return f"{publisher} {self.prefix or ''}".strip() + " by MQTT"

    @property
    def sensor_defaults(self) -> Mapping[str, object]:
        """Return the ``[sensor]`` defaults: current sign and resolution of the profile."""
        if self.profile is None:
            return {"voltage_resolution_v": DEFAULT_RESOLUTION_V}
        profile = PROFILES[self.profile]
        device = DEVICES.get(profile.protocol)
        return {
            "current_dead_band_a": device.sensor_defaults.current_dead_band_a if device else None,
            "current_sign": profile.current_sign,
            "voltage_resolution_v": profile.voltage_resolution_v,
            "current_resolution_a": profile.current_resolution_a,
        }
