"""Real Mosquitto on a free port on loopback, and a subscriber that stores all messages."""

import asyncio
import getpass
import json
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import aiomqtt
import pytest

from tests.free_port import free_port
from tests.patience import LONG_S

PASSWORD = "p@ss:word"
"""Password with the separators of a URL."""
MOSQUITTO = shutil.which("mosquitto", path="/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin")


class Broker:
    """Mosquitto server. A restart uses the same port and loses the retained messages.

    Args:
        folder: Folder of its configuration.
        extra: Further lines of its configuration.
    """

    def __init__(self, folder: Path, extra: str = "allow_anonymous true") -> None:
        self.port = free_port()
        self._config = folder / "mosquitto.conf"
        # Mosquitto started by root would change to the user mosquitto, who cannot read the folder of a test.
        self._config.write_text(
            f"listener {self.port} 127.0.0.1\nuser {getpass.getuser()}\npersistence false\n{extra}\n"
        )
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def url(self) -> str:
        return f"mqtt://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> Self:
        """Start the server, or skip the test without Mosquitto."""
        if MOSQUITTO is None:
            pytest.skip("mosquitto is not installed (apt-get install mosquitto)")
        self._process = subprocess.Popen(
            [MOSQUITTO, "-c", str(self._config)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        deadline = time.monotonic() + LONG_S
        while time.monotonic() < deadline and self._process.poll() is None:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return self
            time.sleep(0.02)
        raise AssertionError("mosquitto did not start")

    def reload(self) -> None:
        """Make the server read its access list again."""
        assert self._process
        self._process.send_signal(signal.SIGHUP)

    def freeze(self) -> None:
        """Suspend the server, so that it answers nothing while the kernel still accepts connections."""
        assert self._process
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        assert self._process
        self._process.send_signal(signal.SIGCONT)

    def stop(self) -> None:
        """Terminate the server. The signal is repeated, because Mosquitto loses one that arrives right after it opened its port."""
        deadline = time.monotonic() + LONG_S
        while self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(1.0)
                self._process = None
            except subprocess.TimeoutExpired:
                assert time.monotonic() < deadline, "mosquitto did not end"


def password_broker(folder: Path) -> Broker:
    """Return a broker that requires the user name ``owner`` and ``PASSWORD``, as that of Home Assistant does."""
    passwords = folder / "passwords"
    subprocess.run(["mosquitto_passwd", "-b", "-c", passwords, "owner", PASSWORD], check=True, capture_output=True)
    passwords.chmod(0o644)
    return Broker(folder, f"allow_anonymous false\npassword_file {passwords}")


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    with Broker(tmp_path) as broker:
        yield broker


class Listener:
    """Subscriber of all topics that stores the messages in order.

    Attributes:
        messages: (topic, payload, retain flag as delivered).
    """

    def __init__(self, broker: Broker, topic: str = "#", **options: Any) -> None:
        self._client = aiomqtt.Client("127.0.0.1", broker.port, timeout=LONG_S, **options)
        self._topic = topic
        self.messages: list[tuple[str, bytes, bool]] = []
        self._received = asyncio.Event()

    async def __aenter__(self) -> Self:
        await self._client.__aenter__()
        await self._client.subscribe(self._topic, qos=1)
        self._task = asyncio.create_task(self._listen())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        await self._client.__aexit__(None, None, None)

    async def _listen(self) -> None:
        async for message in self._client.messages:
            payload = message.payload if isinstance(message.payload, bytes) else b""
            self.messages.append((message.topic.value, payload, bool(message.retain)))
            self._received.set()

    async def publish(self, topic: str, payload: bytes | str = b"", **options: Any) -> None:
        await self._client.publish(topic, payload, **options)

    def all(self, topic: str) -> list[bytes]:
        """Return the payloads received on ``topic``."""
        return [payload for name, payload, _ in self.messages if name == topic]

    async def wait(self, topic: str, accepts: Callable[[bytes], bool] = lambda _: True, skip: int = 0) -> bytes:
        """Wait for a payload on ``topic`` that ``accepts`` accepts, and return it; the first ``skip`` messages are ignored."""
        deadline = time.monotonic() + LONG_S
        while time.monotonic() < deadline:
            self._received.clear()
            for name, payload, _ in self.messages[skip:]:
                if name == topic and accepts(payload):
                    return payload
            try:
                async with asyncio.timeout(max(deadline - time.monotonic(), 0.0)):
                    await self._received.wait()
            except TimeoutError:
                break
        seen = {name: payload[:300] for name, payload, _ in self.messages}
        raise AssertionError(f"{topic} received no accepted message; last on each topic: {seen}")

    async def wait_json(self, topic: str, accepts: Callable[[Any], bool] = lambda _: True, skip: int = 0) -> Any:
        """Wait like ``wait``, but for a JSON payload, and return it decoded. Fail if the payload has a NaN."""

        def reject_nan(token: str) -> None:
            raise AssertionError(f"{topic} holds {token}")

        payload = await self.wait(topic, lambda p: bool(p) and accepts(json.loads(p, parse_constant=reject_nan)), skip)
        return json.loads(payload)
