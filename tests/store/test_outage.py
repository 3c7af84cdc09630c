"""Service during a broker outage: its states arrive later, in order and once, even if the service was killed."""

import asyncio
import json
import sqlite3
from contextlib import closing
from pathlib import Path

from tests.mosquitto import Broker, Listener
from tests.patience import until
from tests.serial_line import Line
from tests.service.test_process import pack_file, print_samples, service, stop_service

QUEUED_TOPICS = ("bms/pack/state", "bms/pack/event")
"""Topics whose messages wait during an outage."""


def messages_on_disk(path: Path) -> list[tuple[str, str]]:
    """Return topic and time of each queued message in the database, in order."""
    try:
        with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as connection:
            rows = connection.execute("SELECT topic, payload FROM outbox ORDER BY number").fetchall()
    except sqlite3.Error:
        return []  # the file does not exist yet
    return [(topic, json.loads(payload)["time"]) for topic, payload in rows]


async def test_states_of_an_outage_survive_a_kill_and_arrive_before_newer_ones_in_order_and_once(
    tmp_path: Path, line: Line, broker: Broker
) -> None:
    broker.stop()
    line.plug()
    board = asyncio.create_task(print_samples(line))
    pack = pack_file(tmp_path, line, broker, state=f'[state]\nfolder = "{tmp_path}"\n')
    async with service(pack) as process:
        await until(lambda: len(messages_on_disk(tmp_path / "pack.sqlite")) >= 25)
        process.kill()
    stored = messages_on_disk(tmp_path / "pack.sqlite")
    await asyncio.to_thread(broker.start)
    async with Listener(broker) as live, service(pack) as process:
        await live.wait_json("bms/pack/state", lambda state: state["time"] > stored[-1][1])
        gap = await live.wait_json("bms/pack/event", lambda event: event["name"] == "unseen")
        assert "the estimate has no measurements" in gap["text"]  # the killed run received some after its checkpoint
        await stop_service(process)
        received = [
            (topic, json.loads(payload)["time"]) for topic, payload, _ in live.messages if topic in QUEUED_TOPICS
        ]
    board.cancel()
    assert received[: len(stored)] == stored
    states = [time for topic, time in received if topic == QUEUED_TOPICS[0]]
    assert states == sorted(set(states))
    assert messages_on_disk(tmp_path / "pack.sqlite") == []
