"""``top`` on a real pseudo-terminal with a real broker: it shows the publications."""

import asyncio
import subprocess
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from bms_estimator.cli.live.key_presses import actions
from bms_estimator.model.payloads import Snapshot
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState
from tests.command_line import PROGRAM, run
from tests.mosquitto import Broker, Listener
from tests.pseudo_terminal import BACK, PseudoTerminal
from tests.sinks.snapshots import NOW, ONE


def of(device: str, voltage_v: float) -> Snapshot:
    assert ONE.estimate
    info = ONE.info.model_copy(update={"device": device})
    return ONE._replace(info=info, estimate=ONE.estimate.model_copy(update={"voltage_v": voltage_v}))


async def publish(client: Listener, device: str, voltage_v: float) -> None:
    messages, snapshot = MessageBuilder("bms", device), of(device, voltage_v)
    for message in (
        *messages.birth_messages(),
        *messages.live_messages(PublishedState(), snapshot, NOW)[0],
        *messages.must_deliver(None, snapshot),
    ):
        await client.publish(message.topic, message.payload, qos=1, retain=message.retain)


@pytest.fixture
async def client(broker: Broker) -> AsyncIterator[Listener]:
    async with Listener(broker) as client:
        yield client


async def test_two_packs_of_a_broker_that_goes(broker: Broker, client: Listener) -> None:
    def shows(*wanted: str) -> None:
        terminal.until(lambda: all(each in "\n".join(terminal.screen()) for each in wanted))

    with PseudoTerminal("top", "--mqtt", broker.url, columns=100, rows=40) as terminal:
        await asyncio.to_thread(shows, "no pack has published anything yet")
        await publish(client, "attic", 51.234)
        await asyncio.to_thread(shows, " attic ", "51.234 V")
        await publish(client, "barn", 13.579)
        await asyncio.to_thread(shows, "▸ attic", "barn", "13.58 V")
        terminal.press(b"\t")
        await asyncio.to_thread(shows, "▸ barn", "13.579 V")
        terminal.press(b"\x1b[A")
        await asyncio.to_thread(shows, "▸ attic", "51.234 V")
        await client.publish("bms/attic/sensor/availability", b"offline", qos=1)
        await asyncio.to_thread(shows, "stale since")
        broker.stop()
        await asyncio.to_thread(shows, "no broker since", "51.234 V")
        terminal.press(b"q")
        await asyncio.to_thread(terminal.until, terminal.ended)
        assert terminal.process.returncode == 0
        assert terminal.is_as_before()
    assert BACK in terminal.output
    assert "Traceback" not in terminal.output


async def test_without_a_terminal_each_state_is_a_line(broker: Broker, client: Listener, tmp_path: Path) -> None:
    pack = tmp_path / "pack.toml"
    pack.write_text(f'[mqtt]\nurl = "{broker.url}"\n')
    process = await asyncio.create_subprocess_exec(PROGRAM, "top", str(pack), stdout=subprocess.PIPE)
    try:
        assert process.stdout
        reading = asyncio.create_task(process.stdout.readline())
        while not reading.done():  # until it listens: a state is not retained
            await publish(client, "attic", 51.234)
            await asyncio.wait([reading], timeout=0.2)
        line = reading.result().decode()
        assert "attic: soc 50.00 % " in line
        assert "51.234 V" in line
    finally:
        process.terminate()
        await process.communicate()
    assert process.returncode == 0


def test_what_cannot_be_watched_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pack = tmp_path / "pack.toml"
    pack.write_text('[pack]\nname = "attic"\n')
    assert run(capsys, "top", pack) == (
        2,
        "",
        f"error: {pack}: has no [mqtt]: name the broker there, or with --mqtt mqtt://host:port\n",
    )
    code, _, err = run(capsys, "top", "--mqtt", "http://house")
    assert code == 2
    assert err.startswith("error: --mqtt http://house: must be mqtt://host:port")


def test_keys_are_known_in_both_modes_of_a_terminal_and_others_mean_nothing() -> None:
    assert list(actions(b"\t\x1b[B\x1bOB\x1b[Z\x1bOAq")) == ["next"] * 3 + ["previous"] * 2 + ["quit"]
    assert list(actions(b"xyz\x1b[5~\xff\x1b\x1b[")) == []
