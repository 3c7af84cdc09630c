"""``top`` on a real pseudo-terminal with a real broker: it shows the published states."""

import asyncio
import subprocess
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState
from tests.command_line import PROGRAM, run
from tests.mosquitto import Broker, Listener
from tests.pseudo_terminal import BACK, PseudoTerminal
from tests.sinks.snapshots import CELL_SNAPSHOT, NOW


def snapshot_of(device: str, voltage_v: float) -> Snapshot:
    """Return a snapshot of a pack with this name and voltage."""
    assert CELL_SNAPSHOT.estimate
    info = CELL_SNAPSHOT.info.model_copy(update={"device": device})
    return CELL_SNAPSHOT._replace(
        info=info, estimate=CELL_SNAPSHOT.estimate.model_copy(update={"voltage_v": voltage_v})
    )


async def publish(client: Listener, device: str, voltage_v: float) -> None:
    """Publish all messages of a pack with this name and voltage."""
    messages, snapshot = MessageBuilder("bms", device), snapshot_of(device, voltage_v)
    for message in (
        *messages.birth_messages(),
        *messages.live_messages(PublishedState(), snapshot, NOW)[0],
        *messages.guaranteed_messages(None, snapshot),
    ):
        await client.publish(message.topic, message.payload, qos=1, retain=message.retain)


@pytest.fixture
async def client(broker: Broker) -> AsyncIterator[Listener]:
    async with Listener(broker) as client:
        yield client


async def test_two_packs_and_a_lost_broker_are_shown(broker: Broker, client: Listener) -> None:
    def wait_for(*texts: str) -> None:
        terminal.until(lambda: all(each in "\n".join(terminal.screen()) for each in texts))

    with PseudoTerminal("top", "--mqtt", broker.url, columns=100, rows=40) as terminal:
        await asyncio.to_thread(wait_for, "no pack has published anything yet")
        await publish(client, "attic", 51.234)
        await asyncio.to_thread(wait_for, "attic ", "51.234")
        await publish(client, "barn", 13.579)
        await asyncio.to_thread(wait_for, "attic ", "51.234", "barn ", "13.579")
        await client.publish("bms/attic/sensor/availability", b"offline", qos=1)
        await asyncio.to_thread(wait_for, "attic: stale since")
        broker.stop()
        await asyncio.to_thread(wait_for, "no broker since", "51.234")
        terminal.press(b"x\t\x1b[Bq")  # keys other than q do nothing
        await asyncio.to_thread(terminal.until, terminal.ended)
        assert terminal.process.returncode == 0
        assert terminal.is_as_before()
    assert BACK in terminal.output
    assert "Traceback" not in terminal.output


async def test_each_state_is_a_line_without_a_terminal(broker: Broker, client: Listener, tmp_path: Path) -> None:
    pack = tmp_path / "pack.toml"
    pack.write_text(f'[mqtt]\nurl = "{broker.url}"\n')
    process = await asyncio.create_subprocess_exec(PROGRAM, "top", str(pack), stdout=subprocess.PIPE)
    try:
        assert process.stdout
        reading = asyncio.create_task(process.stdout.readline())
        while not reading.done():  # states are not retained, so they are repeated until the program has subscribed
            await publish(client, "attic", 51.234)
            await asyncio.wait([reading], timeout=0.2)
        line = reading.result().decode()
        assert "attic: soc 50.00 % " in line
        assert "51.234 V" in line
    finally:
        process.terminate()
        await process.communicate()
    assert process.returncode == 0


def test_settings_without_a_broker_are_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pack = tmp_path / "pack.toml"
    pack.write_text('[pack]\nname = "attic"\n')
    assert run(capsys, "top", pack) == (
        2,
        "",
        f"error: {pack}: has no section [mqtt]; name the broker there, or give --mqtt mqtt://host:port\n",
    )
    code, _, err = run(capsys, "top", "--mqtt", "http://house")
    assert code == 2
    assert err.startswith("error: --mqtt http://house: must be mqtt://host:port")
