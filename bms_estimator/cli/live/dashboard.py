"""``bms-estimator dashboard``: live page of all packs of a broker."""

import asyncio
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.cli.options.pack_options import Browser, TokenFile, page_settings, serve, with_broker
from bms_estimator.page.broker_page import dashboard as broker_page
from bms_estimator.process.runtime import configure_logs, flush_logs
from bms_estimator.process.state_folder import state_folder
from bms_estimator.settings.connections import DEFAULT_LISTEN, MqttSettings, PageSettings
from bms_estimator.settings.pack import Settings, load_settings


def dashboard(
    pack: Annotated[
        Path | None,
        typer.Argument(
            help="settings file of a pack, pack.toml, whose sections \\[mqtt] and \\[page] are used", show_default=False
        ),
    ] = None,
    mqtt: Annotated[
        str | None,
        typer.Option(help="MQTT broker, mqtt://host:port; default: broker in PACK, otherwise mqtt://localhost:1883"),
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(help=f"host:port of the page; default: page.listen in PACK, otherwise {DEFAULT_LISTEN}"),
    ] = None,
    token_file: TokenFile = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="state folder of the services on this machine, from which the page reads the history of their packs"
        ),
    ] = None,
    browser: Browser = True,
) -> None:
    """Serve a live web page of all packs that publish to an MQTT broker, until SIGINT, SIGTERM or SIGHUP."""
    settings = load_settings(pack) if pack else Settings()
    broker = (with_broker(settings, mqtt) if mqtt else settings).mqtt or MqttSettings()
    page = page_settings(settings.page or PageSettings(), listen=listen, token_file=token_file)
    configure_logs()
    with flush_logs():
        live_page = broker_page(broker, page, folder or state_folder(settings))
        asyncio.run(serve(live_page, "live page", browser=browser))
