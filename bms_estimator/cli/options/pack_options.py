"""Settings and cell from the pack file and the command line; parsers of numeric options; options of pages and serial ports."""

import math
import os
import re
import sys
import threading
import webbrowser
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from pydantic import ValidationError

from bms_estimator.model.cell import CellModel, generic_cells, load_cell
from bms_estimator.model.config_file import error_reason, without_secrets
from bms_estimator.model.decimal_text import number as parse_decimal
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import PackModel, load_model
from bms_estimator.process.runtime import stop_on_signal
from bms_estimator.protocols.base.polled_protocol import BMS_GAIN_STD
from bms_estimator.settings.connections import MqttSettings, PageSettings
from bms_estimator.settings.observer import BOARD_GAIN_STD
from bms_estimator.settings.pack import PackSettings, Settings, load_settings
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.serial.port_list import named_ports

Number = TypeVar("Number", int, float)


def decimal(minimum: float = -math.inf, maximum: float = math.inf) -> Callable[[str | float], float]:
    """Return a parser of a decimal number within limits."""
    return _limited(parse_decimal, minimum, maximum)


def whole(minimum: float = -math.inf, maximum: float = math.inf) -> Callable[[str | int], int]:
    """Return a parser of an integer within limits."""
    return _limited(_parse_integer, minimum, maximum)


def _parse_integer(text: str) -> int:
    """Parse an integer.

    Raises:
        ValueError: The text is not an integer.
    """
    if not re.fullmatch("[-+]?[0-9]+", text):
        raise ValueError(f"{text[:40]!r}: not an integer")
    return int(text)


def _limited(parse: Callable[[str], Number], minimum: float, maximum: float) -> Callable[[str | Number], Number]:
    """Return a parser that also checks the limits of the number."""

    def parse_and_check(text: str | Number) -> Number:
        if not isinstance(text, str):  # typer also passes the option's default, which is a number
            return text
        try:
            value = parse(text)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from None
        if not minimum <= value <= maximum:
            bounds = {"at least": minimum, "at most": maximum}
            limits = [f"{name} {bound:.12g}" for name, bound in bounds.items() if math.isfinite(bound)]
            raise typer.BadParameter(f"{text}: must be {' and '.join(limits)}")
        return value

    return parse_and_check


LABORATORY_RESOLUTION_V = 1e-3
"""Voltage resolution of laboratory equipment [V], assumed for a capture without a pack file."""
PLATEAU_CELL, PLATEAU_GAIN_STD = "lfp", 0.01
"""Generic cell with plateaus, and std of the voltage's gain assumed for its captures. ``BMS_GAIN_STD`` is an error
of 16 mV, the step between the plateaus. On three parts of a capture 1.6 % above the OCV curve, 0.01 gave SOC errors of 2.9 to
6.2 %, and 0.005 gave 2.6 to 7.4 %."""


def load_pack(path: Path) -> tuple[Settings, PackModel]:
    """Load a pack's settings and the model of the whole pack.

    The cell file is searched for in the folder of the pack file first, then in the working directory.

    Raises:
        UserError: The file cannot be read, a setting is invalid, or the cell is unknown.
    """
    settings = load_settings(path)
    return settings, _pack_model(settings, _locate_cell(path, settings.pack.cell), settings.pack.capacity_ah)


def single_cell_of(path: Path, settings: Settings) -> CellModel:
    """Return the model of one cell of a pack, before it is scaled to the cells in series and parallel.

    The cell file is searched for as in ``load_pack``.
    """
    return load_cell(_locate_cell(path, settings.pack.cell), settings.pack.capacity_ah)


def pack_or_cell(
    pack: Path | None, cell: str | None, capacity_ah: float | None, series: int | None = None
) -> tuple[Settings, PackModel]:
    """Load the settings of ``pack``. ``cell``, ``capacity_ah`` [Ah] and ``series`` take precedence over the settings.

    Raises:
        UserError: Neither ``pack`` nor ``cell`` is given, or ``load_pack`` fails.
    """
    if pack is None and cell is None:
        raise UserError("give either --cell NAME|CELL.toml or --pack pack.toml")
    settings = load_settings(pack) if pack else Settings(sensor=_unknown_sensor(str(cell)))
    if series is not None:
        settings = with_pack(settings, series=series)
    if cell is None and pack is not None:
        cell = _locate_cell(pack, settings.pack.cell)
    if capacity_ah is None:
        capacity_ah = settings.pack.capacity_ah
    model = _pack_model(settings, str(cell), capacity_ah)
    return with_pack(settings, cell=cell, capacity_ah=capacity_ah), model


def _unknown_sensor(cell: str) -> SensorSettings:
    """Return the sensor of a capture without a pack file.

    With a cell file, its gain error is that of a calibrated board, because the file may have been measured with the same sensor.
    With a generic cell, it is that of any BMS.
    """
    generic_std = PLATEAU_GAIN_STD if cell == PLATEAU_CELL else BMS_GAIN_STD
    gain_std = generic_std if cell in generic_cells() else BOARD_GAIN_STD
    return SensorSettings(voltage_resolution_v=LABORATORY_RESOLUTION_V, voltage_gain_std=gain_std)


def _locate_cell(pack: Path, cell: str) -> str:
    """Return the path of the cell file in the folder of a pack file, if it exists; otherwise return ``cell`` unchanged."""
    cell_file = pack.parent / cell
    return str(cell_file) if cell_file.is_file() else cell


def _pack_model(settings: Settings, cell: str, capacity_ah: float | None) -> PackModel:
    """Return the model of the whole pack, built from ``cell``."""
    model = load_model(cell, capacity_ah).pack(settings.pack.series, settings.pack.parallel)
    if settings.pack.initial_soc is not None:
        reject_soc_for_fuel_cell(model, "pack.initial_soc")
    return model


def reject_soc_for_fuel_cell(model: PackModel, key: str) -> None:
    """Reject an SOC for a fuel cell.

    Args:
        model: Model of the whole pack.
        key: Name of the setting or option that gives the SOC, for the error.

    Raises:
        UserError: The model is a fuel cell.
    """
    model.battery(f"{key}: {model.cell.name} is a fuel cell, which has no state of charge; remove {key}")


def with_pack(settings: Settings, **changes: object) -> Settings:
    """Return settings with changed values of ``[pack]``.

    Raises:
        UserError: A value is invalid.
    """
    try:
        pack = PackSettings.model_validate(settings.pack.model_dump() | changes)
    except ValidationError as error:
        detail = error.errors()[0]
        name = ".".join(map(str, ("pack", *detail["loc"])))
        raise UserError(f"{name} = {detail['input']}: {error_reason(detail)}") from None
    return settings.model_copy(update={"pack": pack})


def with_sensor(settings: Settings, **changes: object) -> Settings:
    """Return settings with changed values of ``[sensor]``; None leaves a value unchanged.

    Raises:
        UserError: The source is not a serial port.
    """
    given = {name: value for name, value in changes.items() if value is not None}
    if given and settings.source is not None:
        raise UserError(
            f"{', '.join(given)}: applies to a serial device, but [source] in the settings is another device; remove one of them"
        )
    sensor = SensorSettings.model_validate(settings.sensor.model_dump(exclude_unset=True) | given)
    return settings.model_copy(update={"sensor": sensor})


def with_broker(settings: Settings, url: str) -> Settings:
    """Return settings whose broker is ``url``; the other settings of ``[mqtt]`` are unchanged.

    Raises:
        UserError: ``url`` is not a valid broker URL.
    """
    others = settings.mqtt.model_dump() if settings.mqtt else {}
    try:
        mqtt = MqttSettings.model_validate(others | {"url": url})
    except ValidationError:
        raise UserError(
            f"--mqtt {without_secrets(url)}: must be mqtt://host:port, or mqtts://host:port for TLS"
        ) from None
    return settings.model_copy(update={"mqtt": mqtt})


def complete_port(incomplete: str) -> list[str]:
    """Return the connected serial ports whose names begin with ``incomplete``."""
    return [name for name in named_ports() if name.startswith(incomplete)]


PortOverride = Annotated[
    str | None,
    typer.Option(help="serial port that replaces sensor.port of the settings", autocompletion=complete_port),
]
"""Option that replaces the serial port of the settings."""


TokenFile = Annotated[Path | None, typer.Option(help="file with the access token of the page", show_default=False)]
Browser = Annotated[
    bool, typer.Option("--browser/--no-browser", help="open the page in a browser if there is a desktop")
]

DESKTOP_VARIABLES = ("DISPLAY", "WAYLAND_DISPLAY")
"""Environment variables of which a desktop session sets at least one."""


def page_settings(settings: PageSettings, **options: Any) -> PageSettings:
    """Return the settings of a page, changed by options of the command line; None leaves a setting unchanged.

    Raises:
        UserError: The address to listen on is invalid, or is open to other machines and there is no token file.
    """
    given = {name: value for name, value in options.items() if value is not None}
    try:
        return PageSettings.model_validate(settings.model_dump() | given)
    except ValidationError as error:
        reason = error_reason(error.errors()[0])
        raise UserError(f"--listen {given.get('listen', settings.listen)}: {reason}") from None


def open_browser(url: str) -> None:
    """Open ``url`` in a browser if the user works on a desktop.

    The browser is opened in a thread, because some browsers block until they are closed.
    """
    if not sys.stdout.isatty() or not any(os.environ.get(name) for name in DESKTOP_VARIABLES):
        return
    threading.Thread(target=webbrowser.open, args=[url], name="browser", daemon=True).start()


async def serve(page: AbstractAsyncContextManager[str], name: str, *, browser: bool) -> None:
    """Serve a page, which yields its address, until a signal.

    Args:
        page: The page.
        name: Description of the page, printed before its address.
        browser: Open the page in a browser.
    """
    stop = stop_on_signal()
    async with page as url:
        typer.echo(f"{name}: {url}")
        if browser:
            open_browser(url)
        await stop.wait()
