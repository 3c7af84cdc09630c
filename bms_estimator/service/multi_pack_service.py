"""Several packs in one process: a board and a connection to the broker each, one event loop, one service to systemd."""

import asyncio
from collections.abc import Sequence

from structlog.contextvars import bind_contextvars

from bms_estimator.model.errors import UserError
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.page.page_sink import Pages
from bms_estimator.process.signals import stop_on_signal
from bms_estimator.process.state_folder import state_folder
from bms_estimator.process.systemd import SystemdNotifier
from bms_estimator.service.pack_service import run_pack_service
from bms_estimator.settings.pack import Settings


async def serve_several(packs: Sequence[tuple[Settings, PackModel]]) -> None:
    """Serve packs until SIGINT, SIGTERM or SIGHUP. When one service ends, all end, so that systemd restarts all of them.

    Args:
        packs: The settings of each pack, and the pack as one object.

    Raises:
        UserError: A setting that cannot be used, with the pack's name before it; or two packs share a name or a port.
    """
    names = [settings.pack.name for settings, _ in packs]
    _differ("pack.name", names)
    sensors = [settings.sensor for settings, _ in packs if settings.source is None]
    _differ("sensor.serial", [sensor.serial for sensor in sensors if sensor.serial])
    _differ("sensor.port", [sensor.port for sensor in sensors if sensor.port != "auto" or not sensor.serial])
    _differ("prometheus.listen", [settings.prometheus.listen for settings, _ in packs if settings.prometheus])
    stop, notifier, pages = stop_on_signal(), SystemdNotifier(names), Pages()

    async def serve_one(settings: Settings, cell: PackModel) -> None:
        bind_contextvars(pack=settings.pack.name)
        try:
            folder = state_folder(settings)
            await run_pack_service(settings, cell, stop=stop, folder=folder, notifier=notifier, pages=pages)
        except UserError as error:
            raise UserError(f"{settings.pack.name}: {error}") from error
        finally:
            stop.set()

    results = await asyncio.gather(*(serve_one(*pack) for pack in packs), return_exceptions=True)
    for result in results:
        if isinstance(result, BaseException):
            raise result


def _differ(key: str, values: Sequence[str]) -> None:
    """Have each pack a value of its own.

    Raises:
        UserError: Two have the same.
    """
    for value in values:
        if values.count(value) > 1:
            raise UserError(f"{key} = {value}: {values.count(value)} of the packs have it; give each its own")
