"""``bms-estimator fleet simulate``: simulated edges of many packs."""

import asyncio
import math
import time
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError

from bms_estimator.cli.options.pack_options import decimal, whole
from bms_estimator.fleet.simulation.block_publisher import Report, run_edges
from bms_estimator.fleet.simulation.simulated_edges import SimulatedEdges
from bms_estimator.fleet.simulation.simulated_fleet import BLOCK_S, SimulatedFleet
from bms_estimator.model.config_file import without_secrets, write_text
from bms_estimator.model.errors import UserError
from bms_estimator.process.runtime import stop_on_signal
from bms_estimator.settings.connections import MqttSettings

PAST_BLOCKS = 30 * 24 * 60
"""Number of blocks before the present at which packs faster than real time begin by default: 30 days."""
CONNECTIONS = 4
"""Number of MQTT connections that all edges share."""
MAX_PACKS = 999_999
"""Maximum number of packs, because their names end in a number of six digits."""


def simulate(
    packs: Annotated[int, typer.Option(parser=whole(1, MAX_PACKS), help="number of packs")] = 1000,
    mqtt: Annotated[
        str | None,
        typer.Option(
            help="address of a fleet server without tenants, mqtt://host:port; separate several nodes with commas"
        ),
    ] = None,
    speed: Annotated[float, typer.Option(parser=decimal(1e-3, 1e5), help="speed relative to real time")] = 1.0,
    blocks: Annotated[
        int | None,
        typer.Option(
            parser=whole(1),
            help="number of blocks of one minute that each pack sends; default: until Ctrl-C",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(parser=whole(), help="random seed of the packs")] = 1,
    begin: Annotated[
        datetime | None,
        typer.Option(
            metavar="TIME",
            help="local time of the first sample, 2026-01-31T12:00:00; default: a minute ago, or earlier if --speed is above 1",
            show_default=False,
        ),
    ] = None,
    table: Annotated[Path | None, typer.Option(help="write the table for `fleet packs load` to this file")] = None,
) -> None:
    """Simulate the edges of many packs, each of which sends a block of samples a minute.

    An edge sends a block again if a worker requests it.
    All edges share a few MQTT connections.
    The packs consist of cells that come with this program; their capacities and resistances vary.
    The samples of a block depend only on the seed, the pack and the number of the block.
    With --table and without --mqtt, only the table is written.
    """
    if mqtt is None and table is None:
        raise UserError("give --mqtt mqtt://host:port, or --table OUT.csv to write only the table of the packs")
    fleet = SimulatedFleet(packs, seed=seed, begin_ns=_begin_ns(begin, speed, blocks))
    if table is not None:
        write_text(table, fleet.table())
    if mqtt is not None:
        try:
            settings = MqttSettings.model_validate({"url": tuple(mqtt.split(","))})
        except ValidationError as error:
            raise UserError(
                f"--mqtt {without_secrets(mqtt)}: {error.errors()[0]['msg'].removeprefix('Value error, ')}"
            ) from None
        typer.echo(asyncio.run(_run(fleet, settings, speed, blocks)))


async def _run(fleet: SimulatedFleet, settings: MqttSettings, speed: float, blocks: int | None) -> Report:
    start_s = time.time() - BLOCK_S / speed  # a block earlier, so that the first blocks are sent within the next minute
    edges = SimulatedEdges(fleet, start_s=start_s, speed=speed, last=blocks)
    return await run_edges(fleet, edges, settings, connections=CONNECTIONS, stop=stop_on_signal(), report=typer.echo)


def _begin_ns(begin: datetime | None, speed: float, blocks: int | None) -> int:
    """Return the start in nanoseconds since 1970; a time without a zone is local.

    Packs that are faster than real time start in the past, because workers quarantine the hours of a clock that is ahead.
    """
    if begin is None:
        past_blocks = 1 if speed <= 1.0 else blocks or PAST_BLOCKS
        return time.time_ns() - past_blocks * BLOCK_S * 10**9
    if not math.isfinite(begin.timestamp()) or begin.timestamp() <= 0:
        raise UserError(f"--begin {begin}: must be after 1970")
    return int(begin.timestamp()) * 10**9
