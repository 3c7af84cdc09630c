"""Several packs in one process, which share the event loop; each has its own source and broker connection."""

import asyncio
import contextlib
from collections.abc import Iterator, Sequence

from structlog.contextvars import bind_contextvars

from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import PackModel
from bms_estimator.page.page_sink import Pages
from bms_estimator.process.signals import stop_on_signal
from bms_estimator.process.state_folder import state_folder
from bms_estimator.process.systemd import SystemdNotifier
from bms_estimator.service.pack_service import run_pack_service
from bms_estimator.settings.alarm_limits import monitored_alarms
from bms_estimator.settings.pack import Settings


async def run_pack_services(packs: Sequence[tuple[Settings, PackModel]]) -> None:
    """Run the services of several packs until SIGINT, SIGTERM or SIGHUP.

    If one service ends, all end, so that systemd restarts all.

    Args:
        packs: Settings and model of each pack.

    Raises:
        UserError: A setting cannot be used (the text begins with the pack's name), or two packs share a name or a port.
    """
    names = [settings.pack.name for settings, _ in packs]
    _require_unique("pack.name", names)
    sensors = [settings.sensor for settings, _ in packs if settings.source is None]
    _require_unique("sensor.serial", [sensor.serial for sensor in sensors if sensor.serial])
    # several packs may share the port "auto" if each has the serial number of its board
    _require_unique("sensor.port", [sensor.port for sensor in sensors if sensor.port != "auto" or not sensor.serial])
    _require_unique("prometheus.listen", [settings.prometheus.listen for settings, _ in packs if settings.prometheus])
    for settings, cell in packs:  # before any service starts
        with _error_of_pack(settings):
            monitored_alarms(settings, cell)
    stop, notifier, pages = stop_on_signal(), SystemdNotifier(names), Pages()

    async def run_one(settings: Settings, cell: PackModel) -> None:
        bind_contextvars(pack=settings.pack.name)
        try:
            with _error_of_pack(settings):
                folder = state_folder(settings)
                await run_pack_service(settings, cell, stop=stop, folder=folder, notifier=notifier, pages=pages)
        finally:
            stop.set()

    results = await asyncio.gather(*(run_one(*pack) for pack in packs), return_exceptions=True)
    for result in results:
        if isinstance(result, BaseException):
            raise result


@contextlib.contextmanager
def _error_of_pack(settings: Settings) -> Iterator[None]:
    """Begin the text of a UserError with the pack's name."""
    try:
        yield
    except UserError as error:
        raise type(error)(f"{settings.pack.name}: {error}") from error  # its type determines the exit code


def _require_unique(key: str, values: Sequence[str]) -> None:
    """Check that no two packs share a value.

    Raises:
        UserError: Two packs share a value.
    """
    for value in values:
        if values.count(value) > 1:
            raise UserError(f"{key} = {value}: {values.count(value)} of the packs have it; give each its own")
