"""Page of all packs that publish at a broker."""

import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

from bms_estimator.mqtt.topic_cache import DeviceMessage, Subscriber
from bms_estimator.page.history_query import HistoryQuery
from bms_estimator.page.pack_topics import PackTopics
from bms_estimator.page.page_server import PageServer
from bms_estimator.settings.connections import MqttSettings, PageSettings


@contextlib.asynccontextmanager
async def dashboard(broker: MqttSettings, settings: PageSettings, folder: Path) -> AsyncIterator[str]:
    """Serve the page within the context.

    Args:
        broker: Settings of the broker.
        settings: Address and access of the page.
        folder: State folder of packs served on this machine, for their histories.

    Yields:
        The page's address.

    Raises:
        UserError: A setting cannot be used, or the address is in use.
    """
    pack_topics, history = PackTopics(), HistoryQuery()
    pack_topics.set_link_state(f"{', '.join(broker.urls)}: not reached yet")

    def on_message(message: DeviceMessage) -> None:
        if message.device not in pack_topics.packs:
            history.add(message.device, folder / f"{message.device}.sqlite")
        pack_topics.put(*message)
        pack_topics.set_hidden_count(subscriber.hidden)

    def on_hidden(device: str) -> None:
        pack_topics.drop(device)
        history.drop(device)
        pack_topics.set_hidden_count(subscriber.hidden)

    def on_link_change() -> None:
        lost = subscriber.lost_since is not None
        pack_topics.set_link_state(subscriber.trouble or "the broker is lost" if lost else None)

    async with PageServer(settings, pack_topics, history, retry=False) as server:
        subscriber = Subscriber(broker, on_message, on_link_change, on_hidden=on_hidden)
        async with subscriber:
            yield server.url
