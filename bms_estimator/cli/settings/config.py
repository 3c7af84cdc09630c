"""``bms-estimator config``: commands that write, check and show a pack's settings."""

from pathlib import Path
from typing import Annotated

import tomlkit
import typer

from bms_estimator.cli.options.pack_options import load_pack
from bms_estimator.estimator.settings_plausibility import forecast_end_v
from bms_estimator.estimator.settings_records import estimator_settings
from bms_estimator.kernels.cell_model.chen_mora import delta
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.pack_model import PackModel
from bms_estimator.service.pack_check import check_settings, summarize
from bms_estimator.settings.alarm_limits import monitored_alarms
from bms_estimator.settings.pack import Settings, create_pack_file

app = typer.Typer(no_args_is_help=True, add_completion=False, help="Write, check or show a pack's settings.")

PackFile = Annotated[Path, typer.Argument(help="settings file of the pack")]


@app.command()
def init(file: PackFile = Path("pack.toml")) -> None:
    """Write a settings file that lists every setting with its meaning, unit and default.

    `bms-estimator new` also searches for the device, and asks for the values of the pack.
    """
    create_pack_file(file)
    typer.echo(f"{file}: written; edit it, then: bms-estimator config check {file}")


@app.command()
def check(file: PackFile = Path("pack.toml")) -> None:
    """Check a settings file and the cell file that it names; report errors and likely mistakes. It opens no device."""
    settings, cell = load_pack(file)
    for warning in check_settings(settings, cell):
        typer.echo(f"warning: {file}: {warning}", err=True)
    typer.echo(f"{file}: valid; {summarize(settings, cell)}")
    typer.echo(f"to compare them with the device: bms-estimator doctor {file}")


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
    for name, value in derived_values(settings, cell).items():
        typer.echo(f"# {name} = {value:.6g}")


def _derived_of_battery(settings: Settings, cell: CellModel) -> dict[str, float]:
    """Return the values that only a battery has."""
    # values to which the observer adapts a7..a9 of C_ts and a10..a12 of C_tl
    a = {i: cell.bounds(i).limit for i in range(7, 13)}
    return {
        "pack.capacity_ah": cell.cell.capacity_ah,
        "pack.cutoff_v": forecast_end_v(settings, cell),
        # SOC below which C_ts is negative, (2.11) of the thesis
        "observer.delta_1": delta(exponent=a[8], offset=a[9], amplitude=a[7]),
        # SOC below which C_tl is negative, (2.12) of the thesis
        "observer.delta_2": delta(exponent=a[11], offset=a[12], amplitude=a[10]),
    }


def derived_values(settings: Settings, cell: PackModel) -> dict[str, float]:
    """Return values of pack, observer and alarms that follow from the settings and the cell, by dotted name."""
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
    values |= cell.by_kind(lambda battery: _derived_of_battery(settings, battery), lambda _: {})
    for alarm in monitored_alarms(settings, cell):
        values[f"alarms.{alarm.name}.limit"], values[f"alarms.{alarm.name}.clear"] = alarm.limit, alarm.clear
    return values
