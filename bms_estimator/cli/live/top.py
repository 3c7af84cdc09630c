"""``bms-estimator top``: a table of all packs of a broker."""

import asyncio
import sys
from collections import deque
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.cli.live.quit_key import quit_key
from bms_estimator.cli.options.pack_options import with_broker
from bms_estimator.model.errors import UserError
from bms_estimator.mqtt.subscriber import Subscriber
from bms_estimator.mqtt.topic_cache import DeviceMessage
from bms_estimator.process.log_setup import configure_logs, flush_logs
from bms_estimator.process.signals import stop_on_signal
from bms_estimator.settings.mqtt import MqttSettings
from bms_estimator.settings.pack import Settings, load_settings
from bms_estimator.sinks.terminal.live_view import LiveView
from bms_estimator.sinks.terminal.screen import LOG_LINES
from bms_estimator.sinks.terminal.view_state import BrokerOutage

REDRAW_S = 1.0
"""Maximum redraw interval [s]. A pack must be drawn as stale although no message arrives."""


def top(
    pack: Annotated[
        Path | None,
        typer.Argument(
            help="settings file of a pack, pack.toml, whose section \\[mqtt] names the broker", show_default=False
        ),
    ] = None,
    mqtt: Annotated[
        str | None,
        typer.Option(
            help="MQTT broker, mqtt://host:port; default: broker in PACK, otherwise mqtt://localhost:1883",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Show all packs that publish to an MQTT broker, as a table.

    In a terminal, q quits. If stdout is not a terminal, each published estimate is printed as a line, until Ctrl-C.
    """
    settings = load_settings(pack) if pack else Settings()
    if mqtt or not pack:
        settings = with_broker(settings, mqtt or str(MqttSettings.model_fields["url"].default))
    if settings.mqtt is None:
        raise UserError(f"{pack}: has no section [mqtt]; name the broker there, or give --mqtt mqtt://host:port")
    log: deque[str] = deque(maxlen=LOG_LINES)
    configure_logs(log if sys.stdout.isatty() else None)
    with flush_logs():
        asyncio.run(_watch(settings.mqtt, log))


async def _watch(settings: MqttSettings, log: deque[str]) -> None:
    """Show the view until q is pressed, a signal arrives, or the reader of standard output is gone."""
    stop, changed = stop_on_signal(), asyncio.Event()

    def on_message(message: DeviceMessage) -> None:
        view.on_message(message)
        changed.set()

    def current_outage() -> BrokerOutage | None:
        lost_since_s = subscriber.lost_since
        return None if lost_since_s is None else BrokerOutage(lost_since_s, subscriber.trouble)

    subscriber = Subscriber(settings, on_message, changed.set)
    address = f"{settings.base_topic}/# at {', '.join(settings.urls)}"
    hint = f"{address}; q: quit" if sys.stdin and sys.stdin.isatty() else address
    view = LiveView(subscriber.devices, log=log, hint=hint, outage=current_outage)
    async with view, subscriber:
        with quit_key(stop.set):
            await _show_until(stop, changed, view)


async def _show_until(stop: asyncio.Event, changed: asyncio.Event, view: LiveView) -> None:
    """Draw new messages and status changes until ``stop``."""
    stopped = asyncio.create_task(stop.wait())
    while not stopped.done():
        view.show()
        change = asyncio.create_task(changed.wait())
        await asyncio.wait([stopped, change], timeout=REDRAW_S, return_when=asyncio.FIRST_COMPLETED)
        change.cancel()
        changed.clear()
