"""``bms-estimator fleet fit``: fits of the packs' models to their histories."""

import asyncio
from typing import Annotated

import typer

from bms_estimator.cli.fleet.server_options import DEFAULT_SERVER, Ca, Creds, Server
from bms_estimator.cli.options.pack_options import whole


def fit(
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
    processes: Annotated[int, typer.Option(parser=whole(1), help="number of fits that run in parallel")] = 1,
) -> None:
    """Fit the models of packs to their histories, on request of the workers, until SIGINT, SIGTERM or SIGHUP.

    Each fit takes about a second of one CPU. With too few processes, fits are late.
    """
    from bms_estimator.fleet.fits.fitter import Options, fit_packs  # noqa: PLC0415 - its packages are optional
    from bms_estimator.process.runtime import (  # noqa: PLC0415
        configure_logs,
        flush_logs,
        stop_on_signal,
    )

    async def run() -> None:
        await fit_packs(Options(server, creds, ca, processes), stop_on_signal())

    configure_logs()
    with flush_logs():
        asyncio.run(run())
