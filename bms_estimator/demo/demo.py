"""Demo: broker, simulated board and the real service.

The estimator starts with a wrong SOC and converges to the true one. The broker is a nats-server on loopback without
passwords, whose data are deleted when it ends.
"""

import asyncio
import contextlib
import json
import socket
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Self

from bms_estimator.demo.true_soc import PackWithSocHistory
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.page.page_sink import Pages
from bms_estimator.process.child_process import find_server, terminate_with_parent
from bms_estimator.process.listener import is_free
from bms_estimator.process.runtime import stop_on_signal
from bms_estimator.service.pack_service import run_pack_service
from bms_estimator.settings.connections import DEFAULT_LISTEN, MqttSettings, PageSettings, parse_listen
from bms_estimator.settings.observer import IdentifierSettings, ObserverSettings
from bms_estimator.settings.pack import PackSettings, PublishSettings, Settings
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.simulation.simulated_pack import SimulatedPack, random_steps
from bms_estimator.simulation.virtual_board import VirtualBoard
from bms_estimator.sinks.sink import Sink
from bms_estimator.sinks.terminal.sink import TerminalSink
from bms_estimator.sinks.terminal.view_state import BAND_STDS

if TYPE_CHECKING:
    from bms_estimator.model.payloads.estimate import Estimate


MQTT_PORT = 1883
"""Default port of MQTT clients."""
LOOPBACK = "127.0.0.1"
POLL_S = 0.02
"""Interval at which the server's start is checked [s]."""
START_TIMEOUT_S = 60.0
"""Timeout of the server's start [s]. It is long because the machine may be busy."""


class DemoBroker:
    """Broker on loopback; a context manager.

    Args:
        port: TCP port; None: 1883 if it is free, otherwise any free port.

    Raises:
        UserError: The requested port is in use, or nats-server is missing.
    """

    def __init__(self, port: int | None = None) -> None:
        self.port = choose_port(port, MQTT_PORT, "--port")
        self._server = find_server()
        self._stack = contextlib.AsyncExitStack()

    @property
    def url(self) -> str:
        """Address for ``mqtt.url``."""
        return f"mqtt://{LOOPBACK}:{self.port}"

    @property
    def subscribe_command(self) -> str:
        """Command that shows all topics in a second terminal."""
        port = "" if self.port == MQTT_PORT else f" -p {self.port}"
        return f"mosquitto_sub{port} -t 'bms/#' -v"

    async def __aenter__(self) -> Self:
        """Start the server.

        Raises:
            UserError: The server does not start.
        """
        async with contextlib.AsyncExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bms-estimator-demo-")))
            await self._start(folder, stack)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *_: object) -> None:
        """End the server, which first sends pending messages to its clients."""
        await self._stack.aclose()

    async def _start(self, folder: Path, stack: contextlib.AsyncExitStack) -> None:
        config, log = folder / "nats.conf", folder / "log"
        config.write_text(_server_config(folder / "streams", self.port))
        process = await asyncio.create_subprocess_exec(
            *(self._server, "-c", config, "-l", log, "--ports_file_dir", folder),
            preexec_fn=terminate_with_parent(),
            start_new_session=True,  # Ctrl-C in the terminal must end the service before its broker
        )
        stack.push_async_callback(_terminate, process)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(START_TIMEOUT_S):
                while not _is_listening(folder) and process.returncode is None:  # noqa: ASYNC110 - the server reports its start only by a file
                    await asyncio.sleep(POLL_S)
        if not _is_listening(folder):
            reason = log.read_text(errors="replace").strip() if log.exists() else ""
            raise UserError(f"the demo's broker {self._server} does not start: {reason or 'it wrote no log'}")


def _is_listening(folder: Path) -> bool:
    """Return True once the server has written its ports file, which it does when it listens on all ports."""
    return any(folder.glob("*.ports"))


async def _terminate(process: asyncio.subprocess.Process) -> None:
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    await process.wait()


def _server_config(folder: Path, mqtt_port: int) -> str:
    """Return the server's settings. Its port for NATS clients is unused. The port number -1 selects any free port."""
    return f"""
server_name: demo
listen: "{LOOPBACK}:-1"
jetstream {{ store_dir: {json.dumps(str(folder))} }}
mqtt {{ listen: "{LOOPBACK}:{mqtt_port}" }}
"""


def choose_port(port: int | None, default_port: int, option: str) -> int:
    """Return the port to listen on: the requested port; without one, the default port or any free port.

    Args:
        port: Requested port; None: no request.
        default_port: Port that is preferred without a request.
        option: Option that requests the port, for the error.

    Raises:
        UserError: The requested port is in use, or the user may not open it.
    """
    if port is not None:
        if not is_free(port):
            raise UserError(f"port {port}: in use or not permitted; without {option} a free port is chosen")
        return port
    return default_port if is_free(default_port) else _any_free_port()


def _any_free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


CELL = "chen_mora"
"""Cell file of the simulated pack and of the estimator."""
LOAD_A = 0.5
"""Mean of the random load [A]. Its steps reach 2 C, so that the SOC falls by more than a percent in a minute."""
TRUE_SOC = 0.9
"""True SOC at the start."""
INITIAL_SOC = 0.7
"""Wrong initial SOC of the estimator, which assumes a std of 0.2."""
SLOWDOWN = 500.0
"""Divisor of the weights in the adaptive law (3.18) of the thesis. With the printed weights, the law moves a1..a12 to their limits
within half a second, too fast to be watched. A common divisor slows it down and leaves the limits unchanged."""
REST_S = 60.0
"""Rest of the cell at the start [s]. R_s by (4.2) requires the RC voltages, which are known after a rest. Of a1..a12, a10 moves
slowest, and is then still 8 % from its limit."""
RESOLUTION_V = 5e-3
"""Resolution of the board's voltage [V]. It is a fifth of the converter's step, because the board averages noisy
conversions."""
PUBLISH_RATE_HZ = 4.0
"""Publish rate [Hz]."""
LAMBDA = 1e4
"""Factor lambda of the observer's gain N(k), (3.10) of the thesis. With the default of 1 the growth of the gain's state
k becomes visible only after hours."""


async def run_demo(
    *,
    rate_hz: int,
    speed: float,
    port: int | None,
    page_port: int | None,
    seconds: float | None,
    thesis: bool,
    log: Iterable[str],
    opened: Callable[[str], object],
) -> str:
    """Run the demo until a signal, or for ``seconds``.

    Args:
        rate_hz: Sample rate on the board's clock [Hz].
        speed: Speed of the board's clock relative to real time.
        port: Port of the broker; None: 1883, or any free one.
        page_port: Port of the live page; None: 8765, or any free one.
        seconds: Duration [s]; None: until a signal.
        thesis: True to run the thesis's method without the identifier. It only counts the charge and cannot correct the SOC, so
            that it starts with the true SOC.
        log: Log lines that the terminal view shows.
        opened: Called with the address of the live page once it is served.

    Returns:
        A summary in one line.
    """
    stop = stop_on_signal()
    cell = load_cell(CELL)
    load = chain([(REST_S, 0.0)] if thesis else [], random_steps(LOAD_A))
    pack = PackWithSocHistory(SimulatedPack(cell, load, soc=TRUE_SOC))
    initial_soc = TRUE_SOC if thesis else INITIAL_SOC
    result = DemoResult(initial_soc - TRUE_SOC, pack.soc)
    page_port = choose_port(page_port, parse_listen(DEFAULT_LISTEN).port, "--page-port")
    async with DemoBroker(port) as broker, _running_board(pack, rate_hz, speed) as board:
        page = f"{LOOPBACK}:{page_port}"
        hint = f"live page: http://{page}/; in a second terminal: {broker.subscribe_command}"
        if not sys.stdout.isatty():
            sys.stdout.write(f"{hint}\n")
        if seconds is not None:
            asyncio.get_running_loop().call_later(seconds, stop.set)
        settings = _settings(board, broker.url, page, rate_hz, initial_soc)
        if thesis:
            settings = settings.model_copy(update={"identifier": IdentifierSettings(enabled=False)})
            cell = _with_slow_adaptation(cell)
        view = TerminalSink(log=log, hint=hint, true_soc=pack.soc)
        pages = Pages(opened)
        # the settings contain no state folder, so that each run starts with the initial state
        await run_pack_service(settings, cell, sinks=[view, result], tap=pack, stop=stop, pages=pages)
    return result.summary()


@asynccontextmanager
async def _running_board(pack: PackWithSocHistory, rate_hz: int, speed: float) -> AsyncIterator[str]:
    """Run a simulated board, and yield the path of its pseudo-terminal."""
    with VirtualBoard(pack, rate_hz=rate_hz, speed=speed) as board:
        task = asyncio.create_task(board.run_for_host())
        try:
            yield board.path
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


def _with_slow_adaptation(cell: CellModel) -> CellModel:
    """Return the cell with the weights of its bounds divided by ``SLOWDOWN``."""
    slow = {
        name: bounds.model_copy(
            update={key: getattr(bounds, key) / SLOWDOWN for key in ("weight_upper", "weight_lower")}
        )
        for name, bounds in cell.adaptation.items()
    }
    return cell.model_copy(update={"adaptation": slow})


def _settings(path: str, url: str, page: str, rate_hz: int, initial_soc: float) -> Settings:
    return Settings(
        pack=PackSettings(name="demo", cell=CELL, initial_soc=initial_soc),
        sensor=SensorSettings(port=path, sample_rate_hz=rate_hz, voltage_resolution_v=RESOLUTION_V),
        observer=ObserverSettings.model_validate({"lambda": LAMBDA}),
        publish=PublishSettings(rate_hz=PUBLISH_RATE_HZ),
        mqtt=MqttSettings(url=url),
        page=PageSettings(listen=page),
    )


class DemoResult(Sink):
    """Sink that stores the last estimate and the true SOC at that time.

    Args:
        initial_error: Estimated minus true SOC at the start.
        true_soc: Returns the true SOC at the last sample, 0..1.
    """

    def __init__(self, initial_error: float, true_soc: Callable[[], float]) -> None:
        self._initial_error, self._true_soc = initial_error, true_soc
        self._last: Estimate | None = None
        self._last_true_soc = 0.0
        self._started_s = time.monotonic()

    async def __aexit__(self, *_: object) -> None:
        """Do nothing, because the sink holds no resources."""

    def publish(self, snapshot: Snapshot) -> None:
        """Store the estimate of a snapshot."""
        if snapshot.estimate is not None:
            self._last, self._last_true_soc = snapshot.estimate, self._true_soc()

    def summary(self) -> str:
        """Return a summary of the run in one line."""
        estimate, elapsed_s = self._last, time.monotonic() - self._started_s
        if estimate is None or estimate.soc is None:
            return f"{elapsed_s:.1f} s, no sample arrived"
        soc_error, compared = estimate.soc - self._last_true_soc, f", by coulomb counting {estimate.soc:.2%}"
        if estimate.soc_std is not None:
            band = BAND_STDS * estimate.soc_std
            inside = "inside" if abs(soc_error) <= band else "outside"
            compared = f" {inside} the estimate {estimate.soc:.2%} ± {band:.2%} (2 std)"
        return (
            f"{elapsed_s:.1f} s: {estimate.frames_received:,} frames, {estimate.frames_lost} lost, {estimate.crc_errors} CRC errors; "
            f"SOC error {self._initial_error:+.2%} at the start, {soc_error:+.2%} at the end: true SOC {self._last_true_soc:.2%}"
            f"{compared}; observer {'in lock' if estimate.lock else 'out of lock'}"
        )
