"""From a pack's file and what the command line says on top of it to settings and cell."""

from pathlib import Path

from pydantic import ValidationError

from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.model.settings import MqttSettings, PackSettings, SensorSettings, Settings, load_settings

TABLE_RESOLUTION_V = 1e-3
"""What a capture resolves when no pack file says otherwise: laboratory equipment's millivolt [V]."""


def load_pack(path: Path) -> tuple[Settings, CellModel]:
    """A pack's settings and the pack as one object.

    A cell file is looked for beside the pack file first, then in the working directory.

    Raises:
        UserError: As ``read_toml``; or there is no such cell.
    """
    settings = load_settings(path)
    beside = path.parent / settings.pack.cell
    cell = load_cell(beside if beside.is_file() else settings.pack.cell)
    return settings, cell.pack(settings.pack.series, settings.pack.parallel)


def pack_or_cell(pack: Path | None, cell: str | None) -> tuple[Settings, CellModel]:
    """The settings of ``pack``, and ``cell`` in place of its cell where one is given.

    Raises:
        UserError: Neither is given, or as ``load_pack``.
    """
    if pack is None and cell is None:
        raise UserError("give --cell NAME|CELL.toml or --pack pack.toml")
    if cell is None and pack is not None:
        return load_pack(pack)
    settings = load_settings(pack) if pack else Settings(sensor=SensorSettings(voltage_resolution_v=TABLE_RESOLUTION_V))
    model = load_cell(settings.pack.cell if cell is None else cell).pack(settings.pack.series, settings.pack.parallel)
    return with_pack(settings, cell=cell), model


def with_pack(settings: Settings, **changes: object) -> Settings:
    """Settings with some of ``[pack]`` changed."""
    pack = PackSettings.model_validate(settings.pack.model_dump() | changes)
    return settings.model_copy(update={"pack": pack})


def with_sensor(settings: Settings, **changes: object) -> Settings:
    """Settings with some of ``[sensor]`` changed; None leaves a value as it is."""
    given = {name: value for name, value in changes.items() if value is not None}
    sensor = SensorSettings.model_validate(settings.sensor.model_dump() | given)
    return settings.model_copy(update={"sensor": sensor})


def with_broker(settings: Settings, url: str) -> Settings:
    """Settings with another broker.

    Raises:
        UserError: ``url`` is none.
    """
    others = settings.mqtt.model_dump() if settings.mqtt else {}
    try:
        mqtt = MqttSettings.model_validate(others | {"url": url})
    except ValidationError:
        raise UserError(f"--mqtt {url}: must be {MqttSettings.model_fields['url'].description}") from None
    return settings.model_copy(update={"mqtt": mqtt})
