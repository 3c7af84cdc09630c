"""Reader of the stream ``TELEMETRY``, which holds batches until their samples are in stored blocks."""

import contextlib
import json

from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.stream_reader import StoredMessage, StreamError, read_stream
from bms_estimator.fleet.nats.streams import NO_SUCH_STREAM

WARNING_SHARE = 0.5
"""Fraction of the maximum size of the stream above which a warning is due."""
REQUEST_TIMEOUT_S = 5.0
"""Timeout of a request [s]."""


class MissingStreamError(StreamError):
    """The server has no stream ``TELEMETRY``."""


class TelemetryReader:
    """Reader with a position.

    Args:
        nc: Connection to the tenant's NATS account.
        stream: Creation time of the stream to which ``sequence`` refers.
        sequence: Stream sequence number of the last processed message.

    Attributes:
        stream: Creation time of the present stream.
        sequence: Stream sequence number after which ``read`` begins.
        warning: Reason for a warning; empty without one.
    """

    def __init__(self, nc: Client, stream: str, sequence: int) -> None:
        self._nc, self.stream, self.sequence, self.warning = nc, stream, sequence, ""
        self._purged = 0  # all messages up to this one were removed

    async def read(self) -> list[StoredMessage]:
        """Return some messages after the position; none at the end of the stream. The caller sets the position.

        Raises:
            StreamError: The server does not respond.
            nats.errors.Error: The request cannot be sent.
        """
        first = self.sequence + 1
        pages = read_stream(self._nc, subjects.TELEMETRY_STREAM, subjects.telemetry(), first=first)
        async with contextlib.aclosing(pages):
            async for messages in pages:
                return messages
        return []

    async def check(self, processed: int) -> None:
        """Remove processed messages, and set the position back if the server has lost or recreated the stream.

        Args:
            processed: Sequence number up to which messages are removed.

        Raises:
            MissingStreamError: The stream does not exist.
            StreamError: The server rejects a request.
            nats.errors.Error: The server does not respond.
        """
        info = await self._request("INFO", {})
        state, created = info["state"], str(info["created"])
        if created != self.stream:
            self.stream, self.sequence, self._purged = created, 0, 0
            return
        if state["last_seq"] < self.sequence:  # the server has lost the end of the stream: numbers are used again
            self.sequence = self._purged = state["last_seq"]
            return
        share = state["bytes"] / info["config"]["max_bytes"]
        self.warning = (
            f"{share:.0%} of the stream {subjects.TELEMETRY_STREAM} is filled; a full stream rejects batches"
            if share > WARNING_SHARE
            else ""
        )
        if processed > self._purged:
            await self._request("PURGE", {"seq": processed + 1})
            self._purged = processed

    async def _request(self, operation: str, request: dict[str, int]) -> dict[str, dict[str, int]]:
        subject = f"$JS.API.STREAM.{operation}.{subjects.TELEMETRY_STREAM}"
        message = await self._nc.request(subject, json.dumps(request).encode(), timeout=REQUEST_TIMEOUT_S)
        response: dict[str, dict[str, int]] = json.loads(message.data)
        if error := response.get("error"):
            kind = MissingStreamError if error.get("err_code") == NO_SUCH_STREAM else StreamError
            raise kind(f"the server rejects {operation} of {subjects.TELEMETRY_STREAM}: {error}")
        return response
