"""The service of one pack as ``bms-estimator run`` starts it: board, estimator, broker, checkpoint, signals."""

import asyncio
import contextlib
import fcntl
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import structlog

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.plausible import implausible
from bms_estimator.model.cell import CellModel
from bms_estimator.model.errors import UserError
from bms_estimator.model.settings import Settings
from bms_estimator.service.checkpoint import CheckpointFile, pack_identity
from bms_estimator.service.interrupt import stop_on_signal
from bms_estimator.service.live import run_live
from bms_estimator.sinks import Delivery, Sink
from bms_estimator.sinks.mqtt import MqttSink
from bms_estimator.sinks.requests import Requests
from bms_estimator.sources.serial_board import SerialBoard, Tap

log = structlog.get_logger(__name__)


async def serve(
    settings: Settings,
    cell: CellModel,
    *,
    sinks: Sequence[Sink] = (),
    tap: Tap | None = None,
    stop: asyncio.Event | None = None,
) -> Estimator:
    """Run until SIGINT or SIGTERM.

    Args:
        settings: The pack's settings; with ``[mqtt]`` a broker is served.
        cell: The pack as one object (``CellModel.pack``).
        sinks: Further sinks, such as the console.
        tap: Gets all bytes of the board with their arrival times.
        stop: Set by someone else to end as a signal does.

    Returns:
        The estimator as the last sample left it.

    Raises:
        UserError: A setting that cannot be used.
    """
    stop = stop_on_signal(stop)
    for line in implausible(settings, cell):
        log.warning("a setting that cannot be", pack=settings.pack.name, reason=line)
    delivery, all_sinks = Delivery(), list(sinks)
    requests = Requests(delivery, settings.mqtt.commands if settings.mqtt else ())
    board = SerialBoard(settings.sensor, tap=tap)
    if settings.mqtt is not None:
        sample_period_s = settings.sensor.sample_period_s
        mqtt = MqttSink(settings.mqtt, settings.pack.name, requests, delivery, sample_period_s=sample_period_s)
        all_sinks.append(mqtt)
    checkpoint = _checkpoint(settings, cell)
    with alone(checkpoint.path.with_suffix(".lock")) if checkpoint else contextlib.nullcontext():
        return await run_live(
            settings,
            cell,
            source=board,
            sinks=all_sinks,
            stop=stop,
            checkpoint=checkpoint,
            requests=requests,
            delivery=delivery,
            current_zero=board.current_zero,
        )


@contextlib.contextmanager
def alone(path: Path) -> Iterator[None]:
    """Serve a pack alone: two services would overwrite each other's checkpoint and availability.

    Args:
        path: Lock file, made where it is not there; the system frees it however the process ends.

    Raises:
        UserError: Another process holds it.
    """
    with contextlib.ExitStack() as held:
        try:
            file = held.enter_context(path.open("a+"))
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            file.truncate(0)
            file.write(f"{os.getpid()}\n")
            file.flush()
        except BlockingIOError:
            holder = path.read_text(encoding="ascii").strip() or "?"
            raise UserError(f"{path}: this pack is served already, by process {holder}") from None
        except OSError as error:  # nor will the checkpoint be written, which health says
            log.warning("cannot make sure that this pack is served once", file=str(path), reason=error.strerror)
        yield


def _checkpoint(settings: Settings, cell: CellModel) -> CheckpointFile | None:
    """The pack's checkpoint in the folder of the settings, else in systemd's StateDirectory, else none.

    Raises:
        UserError: The folder cannot be made.
    """
    given = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    folder = settings.state.folder or (Path(given) if given else None)
    if folder is None:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"state.folder = {folder}: {error.strerror}") from None
    return CheckpointFile(folder / f"{settings.pack.name}.npz", pack_identity(settings, cell))
