"""Secrets of a service: password and key appear neither in its output nor in its files."""

import asyncio
import ssl
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.command_line import PROGRAM
from tests.mosquitto import Broker, Listener
from tests.mqtt.certificates import Authority
from tests.patience import LONG_S
from tests.serial_line import Line

PASSWORD = "open-sesame-4711"
PACK = """
[pack]
cell = "chen_mora"
[sensor]
port = "{folder}/board"
protocol = "text"
[publish]
rate_hz = 10
[mqtt]
url = "mqtts://localhost:{port}"
username = "pack"
password_file = "mqtt-password"
ca_file = "{folder}/ca.crt"
cert_file = "{folder}/pack.crt"
key_file = "pack.key"
[state]
folder = "{folder}/state"
"""


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    """Start a broker that requires a client certificate."""
    authority = Authority(tmp_path)
    for name in ("server", "pack"):
        authority.sign(name)
    files = f"cafile {tmp_path}/ca.crt\ncertfile {tmp_path}/server.crt\nkeyfile {tmp_path}/server.key\n"
    with Broker(tmp_path, f"{files}require_certificate true\nallow_anonymous true") as broker:
        yield broker


async def test_password_and_key_are_never_shown(tmp_path: Path, line: Line, broker: Broker, monkeypatch) -> None:
    credentials = tmp_path / "credentials"
    credentials.mkdir()
    (credentials / "mqtt-password").write_text(PASSWORD)
    key = (tmp_path / "pack.key").rename(credentials / "pack.key").read_text()
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(credentials))
    secrets = [PASSWORD.encode(), key.splitlines()[1].encode()]  # line 0 of the key is a headline
    pack, capture = tmp_path / "pack.toml", tmp_path / "capture"
    pack.write_text(PACK.format(folder=tmp_path, port=broker.port))
    line.plug()
    context = ssl.create_default_context(cafile=tmp_path / "ca.crt")
    context.load_cert_chain(tmp_path / "pack.crt", credentials / "pack.key")
    command = [PROGRAM, "run", "--record", capture, "--no-view", pack]
    async with Listener(broker, tls_context=context) as live:
        service = await asyncio.create_subprocess_exec(*command, stderr=asyncio.subprocess.PIPE)
        try:
            board = asyncio.create_task(feed(line))
            await live.wait_json("bms/pack/state")
            await live.wait_json("bms/pack/health", lambda health: health["sensor_online"])
            proc = Path(f"/proc/{service.pid}")
            outputs = [(proc / "cmdline").read_bytes(), (proc / "environ").read_bytes()]
            board.cancel()
            service.terminate()
            assert service.stderr
            log = await asyncio.wait_for(service.stderr.read(), LONG_S)
            assert await service.wait() == 0
        finally:
            if service.returncode is None:
                service.kill()
    outputs += [log, *(payload for _, payload, _ in live.messages)]
    written = files_of(tmp_path)
    assert len(written) >= 2  # capture and checkpoint
    outputs += [path.read_bytes() for path in written]
    assert b"broker connected" in log
    assert [secret for secret in secrets if any(secret in output for output in outputs)] == []
    assert {oct(path.stat().st_mode & 0o777) for path in written if path.parent.name == "state"} == {"0o600"}


def files_of(folder: Path) -> list[Path]:
    """Return the capture and the files of the state folder, which the service has written."""
    return [*folder.glob("capture*"), *(folder / "state").iterdir()]


async def feed(line: Line) -> None:
    """Send lines of a text board at 50 Hz."""
    while True:
        line.write(b"3.80,0.10,25.0\r\n")
        await asyncio.sleep(0.02)
