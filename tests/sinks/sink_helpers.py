"""Helpers for tests of the MQTT sink: a sink with the counters of a service, and numbered states to publish."""

import itertools
import json
from collections.abc import Mapping
from typing import Any, Self

from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.mqtt.connection import DeliveryStats
from bms_estimator.mqtt.queue_sender import WINDOW
from bms_estimator.settings.connections import MqttSettings
from bms_estimator.sinks.mqtt.requests import COMMANDS, RequestDispatcher
from bms_estimator.sinks.mqtt.sink import MqttSink
from bms_estimator.store.outbox import Outbox
from tests.mosquitto import Listener
from tests.sinks.snapshots import CELL_SNAPSHOT

STATE_TOPIC = "bms/pack/state"


class Sink:
    """MQTT sink of a pack with its counters. It allows all requests, and answers each with the request's name.

    Attributes:
        requested: Names of the received requests.
    """

    def __init__(self, url: str | tuple[str, ...], max_queued: int = 4, **options: Any) -> None:
        self.delivery = DeliveryStats()
        self.requests = RequestDispatcher(self.delivery, COMMANDS)
        self.requested: list[str] = []
        for name in COMMANDS:
            self.requests.register(name, self._handler(name))
        # short delays, so that tests do not wait
        options = {"first_delay_s": 0.1, "birth_delay_s": 0.1} | options
        outbox = Outbox(None, max_messages=max_queued)
        self.mqtt = MqttSink(MqttSettings(url=url), "pack", self.requests, self.delivery, outbox, **options)

    def _handler(self, name: str) -> Any:
        async def answer(_: Mapping[str, Any]) -> Mapping[str, Any]:
            self.requested.append(name)
            return {"name": name}

        return answer

    async def __aenter__(self) -> Self:
        await self.mqtt.__aenter__()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.mqtt.__aexit__(None, None, None)


def numbered_state(number: int) -> Snapshot:
    """Return a snapshot that has ``number`` as its ``frames_received``, so that a test recognizes it."""
    assert CELL_SNAPSHOT.estimate
    return CELL_SNAPSHOT._replace(estimate=CELL_SNAPSHOT.estimate.model_copy(update={"frames_received": number}))


def state_numbers(live: Listener) -> list[int]:
    """Return the numbers of the received states, in the order of their arrival."""
    return [json.loads(payload)["frames_received"] for payload in live.all(STATE_TOPIC)]


def assert_all_in_order(received: list[int], count: int) -> None:
    """Check that the states 0 to ``count`` - 1 arrived in order. Those in flight at a disconnect may arrive twice."""
    assert list(dict.fromkeys(received)) == list(range(count))
    for before, after in itertools.pairwise(received):
        assert before - WINDOW < after <= before + 1, f"{before}, then {after}"
