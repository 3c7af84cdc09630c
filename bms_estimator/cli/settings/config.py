"""``bms-estimator config``: commands that write, check and show a pack's settings."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import tomlkit
import typer

from bms_estimator.cli.live.ports import show_probing
from bms_estimator.cli.options.pack_options import load_pack
from bms_estimator.cli.settings.settings_template import GivenSettings, settings_file
from bms_estimator.estimator.settings_plausibility import implausible_settings
from bms_estimator.estimator.settings_records import estimator_settings
from bms_estimator.estimator.stability_conditions import Condition, failed_conditions
from bms_estimator.kernels.cell_model.chen_mora import delta
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.mqtt.broker_config import check as check_brokers
from bms_estimator.page.access_control import make_access_control
from bms_estimator.process.systemd import is_for_the_service
from bms_estimator.service.alarm_hooks import hook_warnings
from bms_estimator.settings.alarm_limits import implausible_limits, monitored_alarms
from bms_estimator.settings.edge import EdgeSettings
from bms_estimator.settings.exports import InfluxSettings
from bms_estimator.settings.mqtt import MqttSettings
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.page import PageSettings
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sinks.exports.influx import target
from bms_estimator.sources.factory import make_line_producer
from bms_estimator.sources.serial.device_detection import DetectedDevice
from bms_estimator.sources.serial.device_detection import probe as probe_port
from bms_estimator.sources.serial.port_list import board_ports

app = typer.Typer(no_args_is_help=True, add_completion=False, help="Write, check or show a pack's settings.")

ONLY_IN_SERVICE = "not checked, because a systemd credential exists only while the service runs"
"""Warning about a credential file, which is checked only if this process can read it."""

BrokerSettings = TypeVar("BrokerSettings", MqttSettings, EdgeSettings)

PackFile = Annotated[Path, typer.Argument(help="settings file of the pack")]


@app.command()
def init(
    file: PackFile = Path("pack.toml"),
    probe: Annotated[
        bool, typer.Option("--probe", help="find the device on the serial ports, and write its settings to the file")
    ] = False,
    port: Annotated[
        str | None, typer.Option(help="search only this serial port; default: all ports", show_default=False)
    ] = None,
) -> None:
    """Write a settings file that lists every setting with its meaning, unit and default."""
    if port is not None and not probe:
        raise UserError(f"--port {port}: requires --probe")
    if file.exists():
        raise UserError(f"{file}: exists already and is not changed; give another name")
    given = _probe_settings([port] if port else board_ports()) if probe else {}
    try:
        with file.open("x", encoding="utf-8") as new:
            new.write(settings_file(Settings, given))
    except FileExistsError:
        raise UserError(f"{file}: exists already and is not changed; give another name") from None
    except OSError as error:
        raise UserError(f"{file}: cannot be written: {error.strerror}") from None
    typer.echo(f"{file}: written; edit it, then: bms-estimator config check {file}")


def _probe_settings(ports: Sequence[str]) -> GivenSettings:
    """Return the settings for the detected device, and print its name.

    Raises:
        UserError: No device, or more than one.
    """
    if not ports:
        raise UserError("--probe: no serial port of a board or BMS was found; name the port with --port")
    results = dict[str, DetectedDevice | str]()
    for port in ports:
        with show_probing(port):
            results[port] = probe_port(port)
    summary = "; ".join(f"{port}: {result}" for port, result in results.items())
    devices = {port: result for port, result in results.items() if isinstance(result, DetectedDevice)}
    if not devices:
        raise UserError(f"--probe: no known device was found: {summary}")
    if len(devices) > 1:
        raise UserError(f"--probe: {len(devices)} devices were found; choose one with --port: {summary}")
    ((port, device),) = devices.items()
    typer.echo(f"{port}: {device}")
    sensor: dict[str, object] = {"port": port, "protocol": device.protocol}
    if device.baud != SensorSettings.model_validate(sensor).baud:
        sensor["baud"] = device.baud
    return {"sensor": sensor} | ({"pack": {"series": device.cells}} if device.cells else {})


@app.command()
def check(file: PackFile = Path("pack.toml")) -> None:
    """Check a settings file and the cell file that it names; report errors and likely mistakes."""
    settings, cell = load_pack(file)
    warnings = [
        *implausible_settings(settings, cell),
        *implausible_limits(settings, cell),
        *hook_warnings(settings),
        *_failed_conditions(cell),
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
    make_line_producer(settings)  # raises an error if [source] is invalid or its optional package is missing
    for warning in warnings:
        typer.echo(f"warning: {file}: {warning}", err=True)
    typer.echo(f"{file}: valid; {_summary(settings, cell)}")


@app.command()
def show(
    file: Annotated[
        Path | None, typer.Argument(help="settings file of the pack; without a file, the default settings are shown")
    ] = None,
) -> None:
    """Print all settings in effect as TOML, with derived values as comments."""
    settings, cell = load_pack(file) if file else (Settings(), load_cell(Settings().pack.cell))
    shown = settings.model_dump(mode="json", by_alias=True, exclude_none=True)
    shown["observer"].setdefault("rearm_gain", "never")  # TOML has no null
    typer.echo(tomlkit.dumps(shown))
    typer.echo("# Derived values:")
    for name, value in derived(settings, cell).items():
        typer.echo(f"# {name} = {value:.6g}")


def derived(settings: Settings, cell: PackModel) -> dict[str, float]:
    """Return values that follow from the settings and the cell: of pack, observer and alarms, by dotted name."""
    records = estimator_settings(
        cell,
        settings.observer,
        settings.identifier,
        voltage_resolution_v=settings.sensor.voltage_resolution_v,
        voltage_noise_v=settings.sensor.voltage_noise_v,
        initial_soc=settings.pack.initial_soc,
        sampling=settings.sampling,
        limits=settings.charge_limits,
    )
    observer = records[0]["observer"]
    values = {
        "pack.nominal_voltage_v": cell.cell.nominal_voltage_v,
        "pack.series_count": cell.cell.series_count,
        "observer.dead_zone_v": observer["dead_zone_v"],
        "observer.epsilon_v": observer["epsilon_v"],
        "observer.lock_error_v": observer["lock_error_v"],
        "publish_period_s": 1.0 / settings.publish.rate_hz,
    }
    if isinstance(cell, CellModel):
        # values to which the observer adapts a7..a9 of C_ts and a10..a12 of C_tl
        a = {i: cell.bounds(i).limit for i in range(7, 13)}
        values["pack.capacity_ah"] = cell.cell.capacity_ah
        # SOC below which C_ts is negative, (2.11) of the thesis
        values["observer.delta_1"] = delta(exponent=a[8], offset=a[9], amplitude=a[7])
        # SOC below which C_tl is negative, (2.12) of the thesis
        values["observer.delta_2"] = delta(exponent=a[11], offset=a[12], amplitude=a[10])
    for alarm in monitored_alarms(settings, cell):
        values[f"alarms.{alarm.name}.limit"], values[f"alarms.{alarm.name}.clear"] = alarm.limit, alarm.clear
    return values


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
    unreadable = {key: name for key, name in files.items() if name is not None and is_for_the_service(name)}
    return set(unreadable), [f"{section}.{key} = {name}: {ONLY_IN_SERVICE}" for key, name in unreadable.items()]


def _failed_conditions(cell: PackModel) -> list[str]:
    """Return a warning for each condition of Lemma 4.1.1 of the thesis that the cell's bounds fail.

    A fuel cell has no such bounds, and gives no warning.
    """
    if not isinstance(cell, CellModel):
        return []
    return [f"{cell.cell.name}: {_violation(condition)}" for condition in failed_conditions(cell)]


def _violation(condition: Condition) -> str:
    return (
        f"condition {condition.name} of Lemma 4.1.1 fails: {condition.left:g} is not below {condition.right:g}; "
        "a capacitance of the observer may become negative although the SOC is above its limit"
    )


def _summary(settings: Settings, cell: PackModel) -> str:
    ratings = cell.cell
    broker = ", ".join(settings.mqtt.urls) if settings.mqtt else "no broker"
    if settings.edge:
        url = settings.edge.url
        broker += f"; samples to {url if isinstance(url, str) else ', '.join(url)}"
    capacity = f"{cell.cell.capacity_ah:g} Ah" if isinstance(cell, CellModel) else "fuel cell"
    board = f"{settings.sensor.protocol} board on {settings.sensor.port}"
    return (
        f"{settings.pack.name}: {ratings.name}, {ratings.series_count} in series, {ratings.nominal_voltage_v:g} V, {capacity}; "
        f"{settings.source.short_description if settings.source else board}; {broker}"
    )
