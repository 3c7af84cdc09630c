"""``bms-estimator board``: display and calibration of a board."""

from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.cli.options.pack_options import complete_port, decimal, whole
from bms_estimator.model.errors import UserError
from bms_estimator.process.state_folder import state_folder
from bms_estimator.protocols.firmware.messages import (
    BAUD,
    MAX_BANDGAP_V,
    MAX_DIVIDER,
    MAX_VOLTS_PER_AMPERE,
    MIN_BANDGAP_V,
    MIN_DIVIDER,
    MIN_VOLTS_PER_AMPERE,
    Channels,
    Hello,
    set_bandgap_command,
    set_current_slope_command,
    set_divider_command,
    set_ratiometric_command,
    set_serial_command,
)
from bms_estimator.settings.pack import Settings, load_settings
from bms_estimator.sources.serial.device_detection import BoardClient
from bms_estimator.sources.serial.port_list import NO_BOARD, KnownBoardFile, NoPortError, resolve_port


def board(
    port: Annotated[
        str,
        typer.Argument(
            help="serial port of the board; auto: port of the only connected board", autocompletion=complete_port
        ),
    ] = "auto",
    aref_v: Annotated[
        float | None,
        typer.Option(
            parser=decimal(),
            help="set the bandgap voltage from the voltage that a multimeter shows between AREF and GND [V]",
            show_default=False,
        ),
    ] = None,
    divider: Annotated[
        float | None,
        typer.Option(
            parser=decimal(MIN_DIVIDER, MAX_DIVIDER),
            help="set the ratio of the voltage divider: pack voltage / voltage at pin A0",
            show_default=False,
        ),
    ] = None,
    volts_per_ampere: Annotated[
        float | None,
        typer.Option(
            parser=decimal(MIN_VOLTS_PER_AMPERE, MAX_VOLTS_PER_AMPERE),
            help="set the slope of the current sensor [V/A]; of a ratiometric sensor, the slope at a supply of 5 V",
            show_default=False,
        ),
    ] = None,
    ratiometric: Annotated[
        bool | None,
        typer.Option(
            "--ratiometric/--absolute",
            help="set whether the slope is proportional to the supply voltage (ratiometric) or constant (absolute)",
            show_default=False,
        ),
    ] = None,
    serial: Annotated[
        int | None,
        typer.Option(
            parser=whole(1, 2**32 - 1),
            help="set the serial number; enter it in decimal; the output shows it in hexadecimal",
            show_default=False,
        ),
    ] = None,
    accept: Annotated[
        Path | None,
        typer.Option(
            help="accept the next board that connects to the service of this pack (settings file), for example a replacement; opens no port",
            show_default=False,
        ),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="with --accept: state folder of the service; default: state.folder of the settings, otherwise the user's state folder"
        ),
    ] = None,
    baud: Annotated[int, typer.Option(parser=whole(1200), help="baud rate of the board")] = BAUD,
) -> None:
    """Show a sensor board's properties, and set its calibration and serial number.

    The board stores these values in its EEPROM.
    The bandgap voltage differs by up to 10 % between boards, and scales the measured pack voltage.
    Therefore calibrate the bandgap once, with --aref-v.
    """
    if accept is not None:
        settings = load_settings(accept)
        _accept_next(settings, folder or state_folder(settings))
        return
    if folder is not None:
        raise UserError(f"--folder {folder}: requires --accept")
    try:
        with BoardClient(resolve_port(port), baud) as client:
            hello = client.hello()
            typer.echo(_properties_text(hello))
            if aref_v is not None:
                changed = client.send(set_bandgap_command(_bandgap_v(client, hello, aref_v)))
                typer.echo(f"bandgap: was {_bandgap_text(hello)}, now {_bandgap_text(changed)}")
            if divider is not None:
                changed = client.send(set_divider_command(divider))
                typer.echo(f"divider: was {_divider_text(hello)}, now {_divider_text(changed)}")
            if volts_per_ampere is not None or ratiometric is not None:
                changed = _set_current_sensor(client, volts_per_ampere, ratiometric)
                typer.echo(f"current: was {_slope_text(hello)}, now {_slope_text(changed)}")
            if serial is not None:
                changed = client.send(set_serial_command(serial))
                typer.echo(f"serial: was {hello.serial:08x}, now {changed.serial:08x}")
    except NoPortError as error:
        raise UserError(str(error)) from None


def _accept_next(settings: Settings, folder: Path) -> None:
    """Forget the board of the pack's service, whose state is in ``folder``, so that it accepts the next board.

    Raises:
        UserError: The settings name the board, none is stored in the folder, or the file cannot be written.
    """
    if settings.sensor.serial:
        raise UserError(
            f"sensor.serial = {settings.sensor.serial}: the settings name the board; change sensor.serial instead of --accept"
        )
    file = KnownBoardFile(folder, settings.pack.name)
    stored_board = file.load()
    if not stored_board:
        raise UserError(
            f"{file.path}: no board is stored in this file; give the state folder of the service with --folder "
            "(the installed systemd unit uses /var/lib/bms-estimator, which root can read)"
        )
    try:
        file.save(NO_BOARD)
    except OSError as error:
        raise UserError(f"{file.path}: cannot be written: {error.strerror}") from error
    removed = f"board {stored_board['serial']} removed" if stored_board["serial"] else "no board was stored"
    typer.echo(f"{file.path}: {removed}; the service accepts the next board that connects")


def _bandgap_v(client: BoardClient, hello: Hello, aref_v: float) -> float:
    """Return the bandgap voltage at which the board's reference is ``aref_v``.

    Raises:
        UserError: The bandgap would be implausible.
    """
    reference_v = client.reference_v()
    bandgap_v = hello.bandgap_uv * 1e-6 * aref_v / reference_v
    if not MIN_BANDGAP_V <= bandgap_v <= MAX_BANDGAP_V:
        raise UserError(
            f"--aref-v {aref_v:g}: the bandgap voltage would be {bandgap_v:.3f} V, but on every board it is between "
            f"{MIN_BANDGAP_V} and {MAX_BANDGAP_V} V; with its present bandgap voltage of {_bandgap_text(hello)} the board measures {reference_v:.3f} V at AREF"
        )
    return bandgap_v


def _set_current_sensor(client: BoardClient, volts_per_ampere: float | None, ratiometric: bool | None) -> Hello:
    """Set the given properties, at least one, of the current sensor. Return the board's properties after the change."""
    if ratiometric is not None:
        changed = client.send(set_ratiometric_command(ratiometric))
    if volts_per_ampere is not None:
        changed = client.send(set_current_slope_command(volts_per_ampere))
    return changed


def _properties_text(hello: Hello) -> str:
    ntc = f"{hello.ntc_r25_ohm} ohm at 25 degC, beta {hello.ntc_beta_k} K" if hello.channels & Channels.NTC else "none"
    return (
        f"firmware   {hello.firmware}\n"
        f"serial     {hello.serial:08x}\n"
        f"rate       {hello.rate_hz} Hz\n"
        f"voltage    divider {_divider_text(hello)}\n"
        f"current    {_slope_text(hello)}, zero at {hello.current_zero_ppm * 1e-6:.6f} of the reference\n"
        f"NTC        {ntc}\n"
        f"bandgap    {_bandgap_text(hello)}\n"
        f"reference  {hello.reference_v:.3f} V, measured against the bandgap at reset"
    )


def _bandgap_text(hello: Hello) -> str:
    return f"{hello.bandgap_uv * 1e-6:.4f} V"


def _divider_text(hello: Hello) -> str:
    return f"{hello.divider_ppm * 1e-6:g}"


def _slope_text(hello: Hello) -> str:
    ratiometric = " at 5 V, ratiometric" if hello.channels & Channels.CURRENT_RATIOMETRIC else ""
    return f"{hello.current_uv_per_a * 1e-6:g} V/A{ratiometric}"
