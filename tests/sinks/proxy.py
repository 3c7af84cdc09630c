"""What stands between a client and its broker: a network that fails in silence, or a broker of the older MQTT."""

import asyncio
import contextlib
from typing import Self

REFUSED = b"\x20\x02\x00\x01"
"""CONNACK of a broker that does not know the client's version of MQTT."""


class Proxy:
    """Hands on to the broker on ``port``.

    Args:
        port: The broker's.
        knows_5: Else a client of MQTT 5 is refused, as a broker of 3.1.1 does.

    Attributes:
        port: Where it listens.
        half_open_ended: Set when the broker has ended a connection that was left half-open.
    """

    def __init__(self, port: int, *, knows_5: bool = True) -> None:
        self._broker_port, self._knows_5 = port, knows_5
        self._clients: list[asyncio.StreamWriter] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._half_open = False
        self.half_open_ended = asyncio.Event()

    @property
    def url(self) -> str:
        return f"mqtt://127.0.0.1:{self.port}"

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._accept, "127.0.0.1", 0)
        self.port = int(self._server.sockets[0].getsockname()[1])
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def cut(self) -> None:
        """The clients lose their connections, of which the broker hears nothing."""
        self._half_open = True
        for client in self._clients:
            client.transport.abort()
        self._clients = []

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task
        self._tasks.add(task)
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError, asyncio.CancelledError):
            await self._serve(reader, writer)
        writer.transport.abort()
        self._tasks.discard(task)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        start = await reader.readuntil(b"MQTT") + await reader.readexactly(1)
        if start.endswith(b"\x05") and not self._knows_5:
            writer.write(REFUSED)
            await writer.drain()
            return
        from_broker, to_broker = await asyncio.open_connection("127.0.0.1", self._broker_port)
        to_broker.write(start)
        self._clients.append(writer)
        up = asyncio.create_task(pump(reader, to_broker))
        try:
            await pump(from_broker, writer)
            while await from_broker.read(4096):  # the client is gone, the broker does not know
                pass
            if self._half_open:
                self.half_open_ended.set()
        finally:
            up.cancel()
            to_broker.transport.abort()


async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Hand on until either end is gone."""
    with contextlib.suppress(ConnectionError):
        while data := await reader.read(65_536):
            if writer.transport.is_closing():
                return
            writer.write(data)
            await writer.drain()
