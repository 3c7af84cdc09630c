"""``bms-estimator config``: write, check and show a pack's settings."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import tomlkit
import typer

from bms_estimator.cli.live.ports import asking
from bms_estimator.cli.options.pack_options import load_pack
from bms_estimator.cli.settings.settings_template import Given, settings_file
from bms_estimator.estimator.settings_plausibility import implausible_settings
from bms_estimator.estimator.settings_records import estimator_settings
from bms_estimator.estimator.stability_conditions import Condition, failed_conditions
from bms_estimator.kernels.cell_model.chen_mora import delta
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.mqtt.broker_config import check as check_brokers
from bms_estimator.page.access_control import guard_of
from bms_estimator.process.systemd import is_for_the_service
from bms_estimator.service.alarm_hooks import hook_warnings
from bms_estimator.settings.alarm_limits import out_of_range, watched
from bms_estimator.settings.edge import EdgeSettings
from bms_estimator.settings.exports import InfluxSettings
from bms_estimator.settings.mqtt import MqttSettings
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.page import PageSettings
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sinks.exports.influx import target
from bms_estimator.sources.factory import make_line_producer
from bms_estimator.sources.serial.device_detection import DetectedDevice
from bms_estimator.sources.serial.device_detection import probe as who_is_there
from bms_estimator.sources.serial.port_list import board_ports

app = typer.Typer(no_args_is_help=True, add_completion=False, help="Write, check and show a pack's settings.")

ONLY_IN_SERVICE = "not there now, so not checked: a credential of systemd is there only while the service runs"

Doors = TypeVar("Doors", MqttSettings, EdgeSettings)

PackFile = Annotated[Path, typer.Argument(help="settings of the pack")]


@app.command()
def init(
    file: PackFile = Path("pack.toml"),
    probe: Annotated[
        bool, typer.Option("--probe", help="identify the device on the serial ports, and configure it")
    ] = False,
    port: Annotated[str | None, typer.Option(help="serial port to probe; default: all", show_default=False)] = None,
) -> None:
    """Write a settings file with every setting, its unit, default and meaning."""
    if port is not None and not probe:
        raise UserError(f"--port {port}: is for --probe")
    if file.exists():
        raise UserError(f"{file}: exists already and is left as it is; give another name")
    given = _probed([port] if port else board_ports()) if probe else {}
    try:
        with file.open("x", encoding="utf-8") as new:
            new.write(settings_file(Settings, given))
    except FileExistsError:
        raise UserError(f"{file}: exists already and is left as it is; give another name") from None
    except OSError as error:
        raise UserError(f"{file}: cannot be written: {error.strerror}") from None
    typer.echo(f"{file}: written; edit it, then: bms-estimator config check {file}")


def _probed(ports: Sequence[str]) -> Given:
    """Return the settings for the detected device, and print its name.

    Raises:
        UserError: No device, or more than one.
    """
    if not ports:
        raise UserError("--probe: no serial port is there that may be a board's or a BMS's; name it with --port")
    answers = dict[str, DetectedDevice | str]()
    for port in ports:
        with asking(port):
            answers[port] = who_is_there(port)
    said = "; ".join(f"{port}: {answer}" for port, answer in answers.items())
    found = {port: answer for port, answer in answers.items() if isinstance(answer, DetectedDevice)}
    if not found:
        raise UserError(f"--probe: nobody is known to be there: {said}")
    if len(found) > 1:
        raise UserError(f"--probe: {len(found)} devices are there; choose one with --port: {said}")
    ((port, device),) = found.items()
    typer.echo(f"{port}: {device}")
    sensor: dict[str, object] = {"port": port, "protocol": device.protocol}
    if device.baud != SensorSettings.model_validate(sensor).baud:
        sensor["baud"] = device.baud
    return {"sensor": sensor} | ({"pack": {"series": device.cells}} if device.cells else {})


@app.command()
def check(file: PackFile = Path("pack.toml")) -> None:
    """Check a settings file and its cell file; report errors and likely mistakes."""
    settings, cell = load_pack(file)
    warnings = [
        *implausible_settings(settings, cell),
        *out_of_range(settings, cell),
        *hook_warnings(settings),
        *_lemma(cell),
    ]
    if settings.mqtt is not None:
        mqtt, unseen = _here("mqtt", settings.mqtt)
        warnings += unseen + check_brokers(mqtt)
        settings = settings.model_copy(update={"mqtt": mqtt})
    if settings.edge is not None:
        edge, unseen = _here("edge", settings.edge)
        warnings += unseen + check_brokers(edge)
    if settings.page is not None:
        unread, unseen = _unread("page", settings.page, "token_file")
        warnings += unseen
        if not unread:
            guard_of(settings.page)
    if settings.influx is not None:
        unread, unseen = _unread("influx", settings.influx, "password_file", "token_file")
        warnings += unseen
        target(settings.influx.model_copy(update=dict.fromkeys(unread)))
    make_line_producer(settings)  # reports parts of [source] that are invalid or not installed
    for warning in warnings:
        typer.echo(f"warning: {file}: {warning}", err=True)
    typer.echo(f"{file}: good: {_in_short(settings, cell)}")


@app.command()
def show(file: Annotated[Path | None, typer.Argument(help="settings of the pack; else the defaults")] = None) -> None:
    """Print the settings in effect and derived values as TOML."""
    settings, cell = load_pack(file) if file else (Settings(), load_cell(Settings().pack.cell))
    shown = settings.model_dump(mode="json", by_alias=True, exclude_none=True)
    shown["observer"].setdefault("rearm_gain", "never")  # the one None that is not the default
    typer.echo(tomlkit.dumps(shown))
    typer.echo("# What follows from them:")
    for name, value in derived(settings, cell).items():
        typer.echo(f"# {name} = {value:.6g}")


def derived(settings: Settings, cell: PackModel) -> dict[str, float]:
    """Return values that follow from the settings: of the pack, of the observer, limits of Lemma 4.1.3."""
    record = estimator_settings(
        cell,
        settings.observer,
        settings.identifier,
        voltage_resolution_v=settings.sensor.voltage_resolution_v,
        voltage_noise_v=settings.sensor.voltage_noise_v,
        initial_soc=settings.pack.initial_soc,
        sampling=settings.sampling,
    )[0]["observer"]
    follows = {
        "pack.nominal_voltage_v": cell.cell.nominal_voltage_v,
        "pack.series_count": cell.cell.series_count,
        "observer.dead_zone_v": record["dead_zone_v"],
        "observer.epsilon_v": record["epsilon_v"],
        "observer.lock_error_v": record["lock_error_v"],
        "publish_period_s": 1.0 / settings.publish.rate_hz,
    }
    if isinstance(cell, CellModel):
        a = {i: cell.bounds(i).limit for i in range(7, 13)}
        follows["pack.capacity_ah"] = cell.cell.capacity_ah
        follows["observer.delta_1"] = delta(a[8], a[9], a[7])  # (2.11)
        follows["observer.delta_2"] = delta(a[11], a[12], a[10])  # (2.12)
    for alarm in watched(settings, cell):
        follows[f"alarms.{alarm.name}.limit"], follows[f"alarms.{alarm.name}.clear"] = alarm.limit, alarm.clear
    return follows


def _here(section: str, doors: Doors) -> tuple[Doors, list[str]]:
    """Return the settings without files that only the running service can read, and a warning for each such file."""
    without, warnings = _unread(section, doors, "password_file", "cert_file", "key_file")
    if without & {"cert_file", "key_file"}:  # one is of no use without the other
        without |= {"cert_file", "key_file"}
    return doors.model_copy(update=dict.fromkeys(without)), warnings


def _unread(
    section: str, settings: MqttSettings | EdgeSettings | InfluxSettings | PageSettings, *keys: str
) -> tuple[set[str], list[str]]:
    """Return the keys of files that only the running service can read, and a warning for each."""
    files = {key: getattr(settings, key) for key in keys}
    unread = {key: name for key, name in files.items() if name is not None and is_for_the_service(name)}
    return set(unread), [f"{section}.{key} = {name}: {ONLY_IN_SERVICE}" for key, name in unread.items()]


def _lemma(cell: PackModel) -> list[str]:
    """Return the conditions of Lemma 4.1.1 that the bounds fail; empty for a fuel cell."""
    return [f"{cell.cell.name}: {_unmet(c)}" for c in failed_conditions(cell)] if isinstance(cell, CellModel) else []


def _unmet(condition: Condition) -> str:
    return (
        f"condition {condition.name} of Lemma 4.1.1 fails: {condition.left:g} is not below {condition.right:g}; "
        "a capacitance of the observer may turn negative above its SOC limit"
    )


def _in_short(settings: Settings, cell: PackModel) -> str:
    c = cell.cell
    broker = ", ".join(settings.mqtt.urls) if settings.mqtt else "no broker"
    if settings.edge:
        url = settings.edge.url
        broker += f"; samples to {url if isinstance(url, str) else ', '.join(url)}"
    holds = f"{cell.cell.capacity_ah:g} Ah" if isinstance(cell, CellModel) else "fuel cell"
    board = f"{settings.sensor.protocol} board on {settings.sensor.port}"
    return (
        f"{settings.pack.name}: {c.name}, {c.series_count} in series, {c.nominal_voltage_v:g} V, {holds}; "
        f"{settings.source.described if settings.source else board}; {broker}"
    )
