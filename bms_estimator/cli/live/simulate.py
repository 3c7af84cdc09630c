"""``bms-estimator simulate``: simulated board or BMS on a pseudo-terminal."""

import asyncio
import math
from pathlib import Path
from typing import Annotated, Literal

import typer

from bms_estimator.cli.options.capture_options import CELL_OR_FUEL_CELL_HELP, CapacityAh, complete_cell
from bms_estimator.cli.options.pack_options import decimal, whole
from bms_estimator.model.cell import Cell, is_fuel_cell, load_cell
from bms_estimator.model.config_file import suggestion, without_secrets
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import load_fuel_cell
from bms_estimator.process.runtime import configure_logs, stop_on_signal, until_first_ends
from bms_estimator.settings.connections import MqttSettings
from bms_estimator.setup.broker_login import BrokerLogin
from bms_estimator.simulation.bms_responses import BMS_RESPONSES
from bms_estimator.simulation.esphome_node import SimulatedNode
from bms_estimator.simulation.simulated_meter import METERS, SimulatedMeter
from bms_estimator.simulation.simulated_pack import (
    LOADS,
    LoadName,
    PackWithRelay,
    SimulatedBms,
    SimulatedPack,
    SimulatedStack,
)
from bms_estimator.simulation.virtual_board import RATE_HZ_AT_RESET, VirtualBoard

DEVICE_PROTOCOLS = (*METERS, *BMS_RESPONSES)
"""Protocols of the simulated devices that are not boards: battery monitors and BMS."""
DEFAULT_LOAD_C = 3.0
"""Default load current of a board as a multiple of the capacity [1/h], at which the SOC changes visibly."""
DEFAULT_LOAD_FRACTION = 0.5
"""Default load current of a fuel cell as a fraction of its limiting current."""
DEVICE_LOAD_C = 1.0
"""Default load current of a battery monitor or BMS as a multiple of the capacity [1/h]. Their packs are large."""


def _complete_protocol(incomplete: str) -> list[str]:
    return [name for name in DEVICE_PROTOCOLS if name.startswith(incomplete)]


def simulate(
    cell: Annotated[
        str,
        typer.Option(
            help=f"{CELL_OR_FUEL_CELL_HELP}; chen_mora: 275 mAh Li-ion cell of Chen and Rincón-Mora",
            autocompletion=complete_cell,
        ),
    ] = "chen_mora",
    capacity_ah: CapacityAh = None,
    series: Annotated[int, typer.Option(parser=whole(1), help="number of cells in series")] = 1,
    load: Annotated[
        LoadName, typer.Option(help="load profile; relay: a constant load that the relay pin of the board connects")
    ] = LoadName.RANDOM,
    current_a: Annotated[
        float | None,
        typer.Option(
            parser=decimal(),
            help="current of the load [A], positive on discharge; default: 3C for a board, 1C for other devices, half of the limiting current of a fuel cell",
            show_default=False,
        ),
    ] = None,
    soc: Annotated[float, typer.Option(parser=decimal(0.0, 1.0), help="initial SOC, 0..1")] = 0.9,
    rate_hz: Annotated[
        int,
        typer.Option(parser=whole(1, 1000), help="sample rate of the board [Hz], until the host requests another rate"),
    ] = RATE_HZ_AT_RESET,
    text: Annotated[
        bool, typer.Option("--text", help="let the board send text lines instead of binary frames")
    ] = False,
    protocol: Annotated[
        str | None,
        typer.Option(
            help=f"simulate a device with this protocol instead of a board: {', '.join(DEVICE_PROTOCOLS)}; jk-pb is a JK-BMS with newer frames",
            autocompletion=_complete_protocol,
            show_default=False,
        ),
    ] = None,
    mqtt: Annotated[
        str | None,
        typer.Option(
            help="instead of a board, simulate an ESPHome node with a JK-BMS that publishes to this MQTT broker, mqtt://host:port or with a login mqtt://user:pw@host",
            show_default=False,
        ),
    ] = None,
    password_file: Annotated[
        Path | None,
        typer.Option(
            help="file with the password, if --mqtt has a user without one: mqtt://user@host", show_default=False
        ),
    ] = None,
    prefix: Annotated[
        str, typer.Option(help="with --mqtt: name of the ESPHome node, and first level of its topics")
    ] = "jk-bms",
    noise_lsb: Annotated[
        float, typer.Option(parser=decimal(0.0), help="standard deviation of the AD converter's noise [LSB]")
    ] = 0.5,
    speed: Annotated[float, typer.Option(parser=decimal(1e-3), help="speed relative to real time")] = 1.0,
    seconds: Annotated[
        float,
        typer.Option(
            parser=decimal(0.0), help="simulated duration in seconds; default: until Ctrl-C", show_default=False
        ),
    ] = math.inf,
    seed: Annotated[int, typer.Option(parser=whole(), help="random seed of load and noise")] = 0,
) -> None:
    """Simulate a sensor board, BMS or battery monitor on a pseudo-terminal, until Ctrl-C.

    The command prints the path of the pseudo-terminal, which `run --port PATH` can open.
    The simulated board uses the firmware's protocol, and measures a simulated pack with a 10-bit AD converter.
    --protocol simulates a BMS or battery monitor instead.
    --mqtt simulates an ESPHome node with a JK-BMS instead, for the setting `source.profile = "esphome-jk"`.
    """
    if is_fuel_cell(cell):
        if capacity_ah is not None or protocol is not None or mqtt is not None or load is LoadName.RELAY:
            raise UserError(
                f"--cell {cell}: a fuel cell is simulated on a board without relay; omit --capacity-ah, --protocol, --mqtt and "
                "--load relay"
            )
        stack = load_fuel_cell(cell).pack(series, parallel=1)
        stack_a = DEFAULT_LOAD_FRACTION * stack.fuel_cell.limiting_current_a if current_a is None else current_a
        signal = SimulatedStack(stack, LOADS[load](stack_a, seed))
        mode: Literal["binary", "text"] = "text" if text else "binary"
        _run(
            VirtualBoard(signal, rate_hz=rate_hz, mode=mode, speed=speed, noise_lsb=noise_lsb, seed=seed), None, seconds
        )
        return
    model = load_cell(cell, capacity_ah).pack(series, parallel=1)
    load_c = DEFAULT_LOAD_C if protocol is None and mqtt is None else DEVICE_LOAD_C
    load_a = load_c * model.cell.capacity_ah if current_a is None else current_a
    device: VirtualBoard | SimulatedMeter | SimulatedNode
    if load is LoadName.RELAY:
        if mqtt is not None or protocol is not None or text:
            raise UserError(
                "--load relay: only a board with binary frames has a relay; omit --mqtt, --protocol and --text"
            )
        relay_pack = PackWithRelay(model, load_a, soc=soc)
        board = VirtualBoard(relay_pack, rate_hz=rate_hz, speed=speed, noise_lsb=noise_lsb, seed=seed)
        relay_pack.is_connected = lambda: board.relay_high  # set here, because the board is created with the pack
        _run(board, relay_pack, seconds)
        return
    pack = SimulatedPack(model, LOADS[load](load_a, seed), soc=soc)
    if mqtt is not None:
        configure_logs()
        try:
            login = BrokerLogin.parse(mqtt)
        except ValueError as error:
            raise UserError(f"--mqtt {without_secrets(mqtt)}: {error}") from None
        broker = login.temporary_settings | ({"password_file": password_file} if password_file else {})
        cells = model.cell.series_count
        device = SimulatedNode(
            pack,
            cells=cells,
            mqtt=MqttSettings.model_validate(broker),
            prefix=prefix,
            speed=speed,
            seed=seed,
            soc=lambda: pack.soc,
            capacity_ah=model.cell.capacity_ah,
        )
    elif protocol is None:
        mode = "text" if text else "binary"
        device = VirtualBoard(pack, rate_hz=rate_hz, mode=mode, speed=speed, noise_lsb=noise_lsb, seed=seed)
    elif protocol in METERS:
        device = METERS[protocol](pack, speed)
    elif protocol in BMS_RESPONSES:
        device = _simulated_bms(protocol, pack, model.cell, speed, seed)
    else:
        raise UserError(
            f"--protocol {protocol}: must be one of {', '.join(DEVICE_PROTOCOLS)}{suggestion(protocol, DEVICE_PROTOCOLS)}"
        )
    _run(device, pack, seconds)


def _simulated_bms(protocol: str, pack: SimulatedPack, cell: Cell, speed: float, seed: int) -> SimulatedBms:
    """Return a simulated BMS with one cell voltage for each cell in series.

    Raises:
        UserError: The protocol supports fewer cells.
    """
    try:
        return SimulatedBms(
            protocol,
            pack,
            cells=cell.series_count,
            speed=speed,
            soc=lambda: pack.soc,
            capacity_ah=cell.capacity_ah,
            seed=seed,
        )
    except ValueError as error:
        raise UserError(f"--series: {error}") from None


def _run(device: VirtualBoard | SimulatedMeter | SimulatedNode, pack: SimulatedPack | None, seconds: float) -> None:
    """Run the device, and print the SOC at the end. A fuel cell has no ``pack``."""
    asyncio.run(_serve(device, seconds))
    soc = "" if pack is None else f", SOC {pack.soc:.2%}"
    typer.echo(f"{device.samples:,} samples in {device.time_s:.1f} s{soc}", err=True)


async def _serve(device: VirtualBoard | SimulatedMeter | SimulatedNode, seconds: float) -> None:
    """Serve until ``seconds`` are over, or SIGINT or SIGTERM."""
    stop = stop_on_signal()
    with device:
        typer.echo(device.path)  # the pseudo-terminal, or topics and brokers of the ESPHome node
        await until_first_ends(stop.wait(), device.run(seconds))
