"""``bms-estimator fleet collect`` and ``fleet ask``."""

import asyncio
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.model.errors import UserError

FOLDER = Path("hours")


def collect(
    server: Annotated[str, typer.Option(help="of the fleet, nats://host:port")] = "nats://127.0.0.1:4222",
    credentials: Annotated[Path | None, typer.Option(help="file of the tenant's user", show_default=False)] = None,
    folder: Annotated[Path, typer.Option(help="of the Parquet files")] = FOLDER,
    period: Annotated[float, typer.Option(min=0.0, help="a row waits at most so long for its file [s]")] = 300.0,
) -> None:
    """Write the summaries of hours to Parquet, until SIGINT or SIGTERM."""
    from bms_estimator.fleet.collector import only_collector  # noqa: PLC0415 - its packages are optional
    from bms_estimator.service.logs import configure_logs, drained  # noqa: PLC0415

    configure_logs()
    with drained(), only_collector(folder):
        asyncio.run(_collect(server, credentials, folder, period))


async def _collect(server: str, credentials: Path | None, folder: Path, period_s: float) -> None:
    import nats  # noqa: PLC0415
    from nats.errors import Error  # noqa: PLC0415

    from bms_estimator.fleet.collector import Collector  # noqa: PLC0415
    from bms_estimator.service.interrupt import stop_on_signal  # noqa: PLC0415

    stop = stop_on_signal()
    try:
        nc = await nats.connect(server, user_credentials=credentials, max_reconnect_attempts=-1, name="collector")
    except (Error, OSError) as error:
        raise UserError(f"--server {server}: {error}") from error
    try:
        await Collector(nc, folder, period_s=period_s).run(stop)
    finally:
        await nc.close()
