"""The settings of one pack: what ``pack.toml`` holds. Values are SI, the unit stands in the key."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, ConfigDict, Field, ModelWrapValidatorHandler, ValidationError, model_validator

from bms_estimator.model.config_file import Strict, read_toml
from bms_estimator.settings.alarms import AlarmSettings
from bms_estimator.settings.broker_url import of_brokers
from bms_estimator.settings.device_resolution import RESOLUTIONS, Sampling
from bms_estimator.settings.edge import EdgeSettings
from bms_estimator.settings.exports import InfluxSettings, PrometheusSettings
from bms_estimator.settings.home_assistant import HomeAssistantSettings
from bms_estimator.settings.page import PageSettings
from bms_estimator.settings.source_settings import SOURCE, SourceSettings

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Command = Literal["set_soc", "current_zero", "acknowledge_alarm", "publish_rate"]
"""A request that changes something."""
LEAST_RATE_HZ, MOST_RATE_HZ = 0.1, 10.0
"""Of publications."""
LogLevel = Literal["info", "warning", "error"]
DEVICE_NAME = r"^[A-Za-z0-9_-]{1,64}$"
DeviceName = Annotated[str, Field(pattern=DEVICE_NAME)]


class PackSettings(Strict):
    """Which cells, how many, and where to begin."""

    name: DeviceName = Field(default="pack", description="device in topic names: letters, digits, _ and -")
    cell: Annotated[str, Field(min_length=1)] = Field(
        default="ncr18650",
        description="lfp, nmc, nca, lco, lmo, lto: generic, give capacity_ah; else a shipped cell's name or a cell file's path",
    )
    capacity_ah: Positive | None = Field(
        default=None, description="what one cell-file object holds; that of the cell file when left out"
    )
    series: Annotated[int, Field(ge=1, le=10_000)] = Field(default=1, description="cell-file objects in series")
    parallel: Annotated[int, Field(ge=1, le=10_000)] = Field(default=1, description="cell-file objects in parallel")
    initial_soc: Fraction | None = Field(default=None, description="SOC 0..1 at start; from the OCV when left out")


NO_DEVICE = {"port": ("auto",), "protocol": ("binary", "text"), "serial": (None,), "address": (None,)}
"""What ``[sensor]`` may say of a device on a serial line beside ``[source]``: no more than a file with all defaults does."""


def _filled(sensor: dict[str, object]) -> dict[str, object]:
    """The table ``[sensor]`` with what it leaves out, as ``RESOLUTIONS`` has it of the device."""
    protocol = sensor.get("protocol")
    if not isinstance(protocol, str) or protocol not in RESOLUTIONS:
        return sensor
    declared = vars(RESOLUTIONS[protocol])
    return {name: value for name, value in declared.items() if value is not None} | sensor


class SensorSettings(Strict):
    """The board, what it resolves, and its sign of current."""

    port: str = Field(
        default="auto", description="device path, best under /dev/serial/by-id; auto: the only board found"
    )
    serial: Annotated[str, Field(pattern=r"^[0-9a-f]{8}$")] | None = Field(
        default=None,
        description='the only board that is taken, as `bms-estimator board` shows its number, such as "0000002a"; '
        "the first that came, which is remembered, when left out",
    )
    protocol: Literal["binary", "text", "jbd", "daly", "jk", "vedirect", "junctek", "pylontech"] = Field(
        default="binary", description="frames of the firmware, text lines, or a BMS or meter by its name"
    )
    address: Annotated[int, Field(ge=0, le=255)] | None = Field(
        default=None,
        description="of several packs on one RS485 line, the one that is taken; the first that answers when left out",
    )
    baud: Annotated[int, Field(ge=1200, le=10_000_000)] = Field(
        default=500_000, description="a device's own when left out"
    )
    sample_rate_hz: Annotated[int, Field(ge=1, le=1000)] = Field(default=100, description="asked of a binary board")
    current_sign: Literal["discharge_positive", "charge_positive"] = Field(
        default="discharge_positive",
        description="what the board, or a table, calls positive; inside, discharge is; a device's own when left out",
    )
    voltage_resolution_v: Positive = Field(
        default=25.0 / 1024, description="one step of the voltage converter; a device's own when left out"
    )
    voltage_noise_v: NotNegative | None = Field(
        default=None, description="standard deviation of one voltage sample; half a step when left out"
    )
    current_resolution_a: NotNegative | None = Field(
        default=None, description="one step of the current; a device's own when left out, of a board as good as none"
    )
    current_dead_band_a: NotNegative | None = Field(
        default=None, description="smaller currents are shown as 0; a device's own when left out, else none are"
    )
    period_s: Positive | None = Field(
        default=None, description="between two samples, where they come at their own pace; a device's when left out"
    )

    @model_validator(mode="wrap")
    @classmethod
    def _as_the_device_does(cls, table: object, validate: ModelWrapValidatorHandler[Self]) -> Self:
        """What is left out is as the protocol has it, and does not count as set."""
        if not isinstance(table, dict):
            return validate(table)
        made = validate(_filled(table))
        made.model_fields_set.intersection_update(table)
        return made

    @model_validator(mode="after")
    def _only_boards_have_serials(self) -> Self:
        if self.serial and self.protocol != "binary":
            raise ValueError(
                f"serial: only a binary board tells its number, and protocol is {self.protocol}; leave it out"
            )
        return self

    @property
    def sample_period_s(self) -> float:
        """Between two samples [s]."""
        return self.period_s or 1.0 / self.sample_rate_hz


class ObserverSettings(Strict):
    """The adaptive observer, Algorithm 1."""

    law: Literal["improved", "scheme-1", "scheme-2", "scheme-3", "learning"] = Field(
        default="improved",
        description="improved: (3.18) with output (4.1); scheme-1..3: (3.16)..(3.18) with (3.14); "
        "learning: sensitivity times e, docs/observer.md, the default where identifier.enabled = false",
    )
    nussbaum: Literal["mittag-leffler", "k2-cos", "k-cos-sqrt", "ln-cos-sqrt-ln"] = "mittag-leffler"
    alpha: Annotated[float, Field(gt=2, le=3)] = Field(default=2.5, description="a of (3.10), in (2, 3]")
    lambda_: Positive = Field(default=1.0, alias="lambda", description="lambda of (3.10)")
    k0: NotNegative = Field(default=0.0, description="k(t0) of (3.13)")
    dead_zone_v: NotNegative | None = Field(
        default=None,
        description="errors below do not raise k; from the sensor's resolution when left out; 0: (3.13) as printed",
    )
    epsilon_v: Positive | None = Field(
        default=None, description="eps2 of Algorithm 1: below it the error has converged"
    )
    gain_limit: Positive = Field(default=1e3, description="clamp of |N|")
    rearm_gain: float | None = Field(
        default=0.5,
        description='below this N, in lock, k starts again; "never": the printed law',
    )
    lock_error_v: Positive | None = Field(
        default=None, description="an error beyond it for lock_time_s is a loss of lock"
    )
    lock_time_s: Positive = 10.0
    margin_guard: Annotated[float, Field(ge=1e-6, le=1)] = Field(
        default=0.005,
        description="adaptation stops this far above max(delta1, delta2); at these a capacitance is 0",
    )
    scheme_2_lambda: Positive = Field(default=100.0, description="lambda_i of (3.17)")
    scheme_2_epsilon: Positive = Field(default=0.35, description="parameters up to this value are penalised, (3.17)")

    @model_validator(mode="before")
    @classmethod
    def _no_rearm(cls, table: object) -> object:
        """``rearm_gain = "never"`` in a file, since TOML has no null."""
        if isinstance(table, dict) and table.get("rearm_gain") == "never":
            return table | {"rearm_gain": None}
        return table


class IdentifierSettings(Strict):
    """The identifier: SOC with its error, the cell's own parameters."""

    enabled: bool = Field(
        default=True, description="false: SOC by coulomb counting, parameters as the observer's law has them"
    )
    map_memory_h: Annotated[float, Field(ge=1)] = Field(
        default=336.0, description="time constant with which learned elements are forgotten"
    )
    current_offset_std_a: NotNegative | None = Field(
        default=None,
        description="how wrong the current sensor's zero may be; from the capacity when left out; 0: it is taken as right",
    )
    capacity_std: Annotated[float, Field(ge=0, le=0.3)] | None = Field(
        default=None,
        description="how wrong the declared capacity may be, relative; the cell file's when left out; "
        "0: it is taken as right",
    )
    soc_std: Annotated[float, Field(ge=0.005, le=0.5)] | None = Field(
        default=None, description="how wrong the SOC at start may be; a fifth when left out"
    )
    hysteresis_v: NotNegative | None = Field(
        default=None,
        description="OCV after charge less that after discharge, of one cell; that of the cell file when left out",
    )


class PublishSettings(Strict):
    """How often what is estimated goes out."""

    rate_hz: Annotated[float, Field(ge=LEAST_RATE_HZ, le=MOST_RATE_HZ)] = Field(
        default=1.0, description="snapshots per second"
    )


class MqttSettings(Strict):
    """The broker, and what others may have done over it."""

    model_config = ConfigDict(hide_input_in_errors=True)

    url: Annotated[str | tuple[str, ...], AfterValidator(of_brokers)] = Field(
        default="mqtt://localhost:1883",
        description="mqtt://host:port or mqtts://host:port for TLS; or a list of them, tried in turn",
    )
    username: str | None = None
    password_file: Path | None = Field(
        default=None,
        description="file that holds the password, read at start; a name alone: systemd's credential of this name",
    )
    ca_file: Path | None = Field(default=None, description="certificate authority for mqtts, else the system's")
    cert_file: Path | None = Field(
        default=None, description="our own certificate for mqtts, PEM, where the broker asks for one; as password_file"
    )
    key_file: Path | None = Field(
        default=None, description="its key, PEM, not encrypted; in cert_file when left out; as password_file"
    )
    base_topic: Annotated[str, Field(pattern=r"^[^+#\s/]([^+#\s]*[^+#\s/])?$")] = Field(
        default="bms", description="first part of all topics: no +, # or spaces, no / at either end"
    )
    commands: tuple[Command, ...] = Field(
        default=(), description="requests that change something and may be made by whoever may publish; none by default"
    )

    @property
    def urls(self) -> tuple[str, ...]:
        """The addresses of all brokers."""
        return (self.url,) if isinstance(self.url, str) else self.url

    @model_validator(mode="before")
    @classmethod
    def _no_publish_rate(cls, table: object) -> object:
        """The rate stood here once."""
        if isinstance(table, dict) and "publish_rate_hz" in table:
            raise ValueError("publish_rate_hz is now called rate_hz and stands in the section [publish]")
        return table


class StateSettings(Strict):
    """What outlives a restart."""

    folder: Path | None = Field(
        default=None,
        description="where checkpoints go; systemd's StateDirectory when left out, else the user's XDG state folder",
    )
    checkpoint_s: Annotated[float, Field(ge=1)] = 60.0
    longest_days: Positive | None = Field(
        default=None,
        description="a checkpoint that is known to be older is not taken up, as where packs are exchanged; "
        "without: any age, only the SOC is less sure",
    )


class StoreSettings(Strict):
    """What is kept in the state folder: messages for a broker that is away, and the pack's history."""

    outbox_messages: Annotated[int, Field(ge=1, le=10_000_000)] = Field(
        default=90_000,
        description="states and events that wait for a broker, a day of states at one a second; then the oldest goes",
    )
    history_days: Annotated[int, Field(ge=0, le=36_600)] = Field(
        default=366, description="how long minutes and events are kept; 0: none are"
    )


class LogSettings(Strict):
    """What goes to the log."""

    level: LogLevel = Field(default="info", description="and what is worse")


class Settings(Strict):
    """One pack's settings file."""

    pack: PackSettings = PackSettings()
    sensor: SensorSettings = SensorSettings()
    source: SourceSettings | None = Field(
        default=None, description="leave out where the board of [sensor] is the source"
    )
    observer: ObserverSettings = ObserverSettings()
    identifier: IdentifierSettings = IdentifierSettings()
    publish: PublishSettings = PublishSettings()
    mqtt: MqttSettings | None = Field(default=None, description="leave out to publish nowhere")
    edge: EdgeSettings | None = Field(default=None, description="leave out to send no samples to a fleet")
    home_assistant: HomeAssistantSettings = HomeAssistantSettings()
    influx: InfluxSettings | None = Field(default=None, description="leave out to write to none")
    prometheus: PrometheusSettings | None = Field(default=None, description="leave out to listen nowhere")
    page: PageSettings | None = Field(default=None, description="leave out to serve none")
    state: StateSettings = StateSettings()
    store: StoreSettings = StoreSettings()
    log: LogSettings = LogSettings()
    alarms: AlarmSettings = AlarmSettings()

    @model_validator(mode="before")
    @classmethod
    def _law_that_learns(cls, tables: object) -> object:
        """Without the identifier the printed law has its bounds alone: there the one that learns is the default (docs/comparison.md)."""
        if not isinstance(tables, dict):
            return tables
        identifier, observer = tables.get("identifier"), tables.get("observer", {})
        if not isinstance(identifier, dict) or not isinstance(observer, dict) or identifier.get("enabled") is not False:
            return tables
        return tables | {"observer": {"law": "learning"} | observer}

    @model_validator(mode="before")
    @classmethod
    def _sensor_of_the_source(cls, tables: object) -> object:
        """What a source that is no serial line makes of ``[sensor]``: it hands on lines of text.

        Raises:
            ValueError: The table is of a serial device.
        """
        if not isinstance(tables, dict) or tables.get("source") is None:
            return tables
        sensor = tables.get("sensor", {})
        told = sensor.model_dump(exclude_unset=True) if isinstance(sensor, SensorSettings) else sensor
        try:
            source = SOURCE.validate_python(tables["source"])
        except ValidationError:  # said where the section itself is read
            return tables
        if not isinstance(told, dict):
            return tables
        if serial := [name for name, none in NO_DEVICE.items() if told.get(name, none[0]) not in none]:
            names = ", ".join(f"sensor.{name}" for name in serial)
            raise ValueError(f"{names}: tells of a serial device, and [source] is none: take that away, or [source]")
        return tables | {"sensor": {"period_s": source.period_s, **source.sensor, **told, "protocol": "text"}}

    @property
    def sampling(self) -> Sampling:
        """What the source tells of the current, and how often."""
        s = self.sensor
        return Sampling(s.sample_period_s, s.current_resolution_a or 0.0, s.current_dead_band_a or 0.0)


def load_settings(path: Path) -> Settings:
    """Read a pack's settings.

    Raises:
        UserError: As ``read_toml``.
    """
    return read_toml(path, Settings)
