"""``bms-estimator top``: all packs of a broker at a glance."""

import asyncio
import sys
from collections import deque
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.cli.live.key_presses import keys
from bms_estimator.cli.options.pack_options import with_broker
from bms_estimator.model.errors import UserError
from bms_estimator.mqtt.subscriber import Subscriber
from bms_estimator.mqtt.topic_cache import DeviceMessage
from bms_estimator.process.log_setup import configure_logs, flush_logs
from bms_estimator.process.signals import stop_on_signal
from bms_estimator.settings.mqtt import MqttSettings
from bms_estimator.settings.pack import Settings, load_settings
from bms_estimator.sinks.terminal.live_view import LiveView
from bms_estimator.sinks.terminal.panels import LOG_LINES
from bms_estimator.sinks.terminal.scene import BrokerOutage

TICK_S = 1.0
"""Redraw interval without messages [s]: the view shows the time since the last one."""
STEPS = {"next": 1, "previous": -1}


def top(
    pack: Annotated[
        Path | None, typer.Argument(help="pack file whose \\[mqtt] says where the broker is", show_default=False)
    ] = None,
    mqtt: Annotated[
        str | None,
        typer.Option(help="broker, mqtt://host:port; default: that of PACK, or localhost", show_default=False),
    ] = None,
) -> None:
    """Show all packs of a broker, one of them in detail.

    On a terminal Tab and the arrow keys select a pack, and q quits. Elsewhere each state is a line, until Ctrl-C.
    """
    settings = load_settings(pack) if pack else Settings()
    if mqtt or not pack:
        settings = with_broker(settings, mqtt or str(MqttSettings.model_fields["url"].default))
    if settings.mqtt is None:
        raise UserError(f"{pack}: has no [mqtt]: name the broker there, or with --mqtt mqtt://host:port")
    log: deque[str] = deque(maxlen=LOG_LINES)
    configure_logs(log if sys.stdout.isatty() else None)
    with flush_logs():
        asyncio.run(_watch(settings.mqtt, log, first=settings.pack.name if pack else ""))


async def _watch(settings: MqttSettings, log: deque[str], first: str) -> None:
    """Show the view until a key, a signal, or the end of the reader."""
    stop = stop_on_signal()

    def hear(heard: DeviceMessage) -> None:
        view.on_message(heard)
        fresh.set()

    def lost() -> BrokerOutage | None:
        since_s = subscriber.lost_since
        return None if since_s is None else BrokerOutage(since_s, subscriber.trouble)

    def press(meaning: str) -> None:
        if meaning == "quit":
            stop.set()
        else:
            view.select(STEPS[meaning])
            fresh.set()

    fresh = asyncio.Event()
    subscriber = Subscriber(settings, hear, fresh.set)
    where = f"{settings.base_topic}/# at {', '.join(settings.urls)}"
    hint = f"{where}; Tab: next pack, q: end" if sys.stdin and sys.stdin.isatty() else where
    view = LiveView(subscriber.devices, log=log, hint=hint, lost=lost, first=first)
    async with view, subscriber:
        with keys(press):
            await _show_until(stop, fresh, view)


async def _show_until(stop: asyncio.Event, fresh: asyncio.Event, view: LiveView) -> None:
    """Draw new messages and status changes until ``stop``."""
    stopped = asyncio.create_task(stop.wait())
    while not stopped.done():
        view.show()
        heard = asyncio.create_task(fresh.wait())
        await asyncio.wait([stopped, heard], timeout=TICK_S, return_when=asyncio.FIRST_COMPLETED)
        heard.cancel()
        fresh.clear()
