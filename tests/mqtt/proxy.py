"""Proxy between a client and its broker that simulates a silent network, a broker without MQTT 5, or rejections."""

import asyncio
import contextlib
from typing import Self

CONNACK_UNSUPPORTED_VERSION = b"\x20\x02\x00\x01"
"""CONNACK for an unsupported protocol version."""


async def read_packet(reader: asyncio.StreamReader) -> bytes:
    """Read one MQTT packet.

    After its first byte, a packet has its remaining length: 7 bits in each byte, the lowest first, and in the highest
    bit a mark that another byte follows.
    """
    head = await reader.readexactly(2)
    while head[-1] & 0x80:
        head += await reader.readexactly(1)
    length = sum((byte & 0x7F) << 7 * i for i, byte in enumerate(head[1:]))
    return head + await reader.readexactly(length)


def qos1_message(packet: bytes) -> tuple[str, bytes] | None:
    """Return topic and packet identifier of a message at QoS 1; None for any other packet."""
    if packet[0] & 0xF6 != 0x32:  # PUBLISH at QoS 1, with any DUP and RETAIN
        return None
    # the topic begins with its length, after the bytes of the remaining length
    begin = next(i for i, byte in enumerate(packet[1:], 2) if not byte & 0x80)
    end = begin + 2 + int.from_bytes(packet[begin : begin + 2])
    return packet[begin + 2 : end].decode(), packet[end : end + 2]


class Proxy:
    """Proxy that forwards to a broker on this machine.

    Args:
        port: Port of the broker.
        supports_5: False to reject MQTT 5 clients as a broker with MQTT 3.1.1 does.

    Attributes:
        port: Listening port.
        drops_all: True to drop all bytes of both directions silently. A connection that loses bytes stays silent.
        rejects_connections: True to close new connections at once.
        reject_code: Reason code with which the proxy rejects messages at QoS 1 itself; 0: forward them.
        rejected: Topics of the rejected messages.
        half_open_ended: Set when the broker has ended a connection that ``close_clients`` left half-open.
    """

    def __init__(self, port: int, *, supports_5: bool = True) -> None:
        self._broker_port, self._supports_5 = port, supports_5
        self._clients: list[tuple[asyncio.StreamWriter, asyncio.StreamWriter]] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._half_open = self.drops_all = self.rejects_connections = False
        self.reject_code = 0
        self.rejected: list[str] = []
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

    def disconnect_network(self) -> None:
        """Close both ends of all connections, and reject new connections."""
        self.rejects_connections = True
        for client, broker in self._clients:
            client.transport.abort()
            broker.transport.abort()
        self._clients = []

    def close_clients(self) -> None:
        """Close the clients' ends of all connections. The broker's ends stay open."""
        self._half_open = True
        for client, _ in self._clients:
            client.transport.abort()
        self._clients = []

    def send_disconnect(self, reason: int) -> None:
        """Disconnect all clients with a reason code, as an MQTT 5 broker does, and reject new connections."""
        for client, _ in self._clients:
            client.write(bytes([0xE0, 1, reason]))  # DISCONNECT
        self.rejects_connections = True

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task
        self._tasks.add(task)
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError, asyncio.CancelledError):
            await self._serve(reader, writer)
        writer.transport.abort()
        self._tasks.discard(task)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.rejects_connections:
            return
        connect_packet = await read_packet(reader)
        if b"MQTT\x05" in connect_packet and not self._supports_5:
            writer.write(CONNACK_UNSUPPORTED_VERSION)
            await writer.drain()
            return
        while self.drops_all:  # CONNECT is lost, too
            if not await reader.read(65_536):
                return
        from_broker, to_broker = await asyncio.open_connection("127.0.0.1", self._broker_port)
        to_broker.write(connect_packet)
        self._clients.append((writer, to_broker))
        upstream = asyncio.create_task(self._pump_to_broker(reader, to_broker, writer))
        try:
            await self._pump_to_client(from_broker, writer)
            while await from_broker.read(4096):  # the client is gone, and the broker has not noticed
                pass
            if self.drops_all:  # the client must find its connection silent, not closed
                await upstream
            if self._half_open:
                self.half_open_ended.set()
        finally:
            upstream.cancel()
            to_broker.transport.abort()

    async def _pump_to_broker(
        self, reader: asyncio.StreamReader, to_broker: asyncio.StreamWriter, to_client: asyncio.StreamWriter
    ) -> None:
        """Forward the client's bytes until either end is closed."""
        is_silent = False
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
            while not to_broker.transport.is_closing():
                packet = await read_packet(reader)
                is_silent |= self.drops_all
                message = qos1_message(packet) if self.reject_code else None
                if message and not is_silent:
                    self.rejected.append(message[0])
                    to_client.write(bytes([0x40, 3, *message[1], self.reject_code]))  # PUBACK
                elif not is_silent:
                    to_broker.write(packet)
                    await to_broker.drain()

    async def _pump_to_client(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Forward the broker's bytes until either end is closed."""
        is_silent = False
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(65_536):
                is_silent |= self.drops_all
                if writer.transport.is_closing():
                    return
                if not is_silent:
                    writer.write(data)
                    await writer.drain()
