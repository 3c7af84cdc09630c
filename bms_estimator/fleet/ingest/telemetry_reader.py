"""Reader of the stream ``TELEMETRY``, which holds batches until their samples are in stored blocks."""

import asyncio
import contextlib
import json

from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.stream_reader import StoredMessage, StreamError, read_stream
from bms_estimator.fleet.nats.streams import NO_SUCH_STREAM

WARNING_SHARE = 0.5
"""Fraction of the maximum size of the stream above which ``warning`` is set."""
REQUEST_TIMEOUT_S = 5.0
"""Timeout of a request [s]."""
UNAVAILABLE = 503
"""Error class of a server that cannot respond now, for example because its cluster has no leader. The stream is intact."""
RETRY_S = 1.0
"""Retry interval after the first internal error of the server [s]. Each further error doubles it."""
MAX_FAILURES = 6
"""Number of successive internal errors, within half a minute, after which the stream counts as damaged."""


class MissingStreamError(StreamError):
    """The server has no stream ``TELEMETRY``."""


class DamagedStreamError(StreamError):
    """The server has an internal error in the stream ``TELEMETRY``."""


class TelemetryReader:
    """Reader of batches after a position.

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
        self._purged = 0  # last removed message
        self._last = 0  # last message in the stream at the last check
        self._failures, self._next_check_s = 0, 0.0

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

    @property
    def is_damaged(self) -> bool:
        """True after ``MAX_FAILURES`` successive internal errors of the server."""
        return self._failures >= MAX_FAILURES

    async def check(self, processed: int) -> range | None:
        """Remove processed messages. Set the position if the server has lost messages or recreated the stream.

        Args:
            processed: Sequence number up to which messages are removed.

        Returns:
            Sequence numbers of lost messages if the position was set; then all messages in the stream are unprocessed. None if
            the position is unchanged.

        Raises:
            MissingStreamError: The stream does not exist.
            DamagedStreamError: The server has an internal error.
            StreamError: The server rejects a request.
            nats.errors.Error: The server does not respond.
        """
        now_s = asyncio.get_running_loop().time()
        if now_s < self._next_check_s:
            return None
        try:
            lost = await self._check(processed)
        except DamagedStreamError:
            self._next_check_s = now_s + RETRY_S * 2**self._failures
            self._failures += 1
            raise
        self._failures = 0
        return lost

    async def delete(self) -> None:
        """Delete the stream.

        Raises:
            StreamError: The server rejects the request.
            nats.errors.Error: The server does not respond.
        """
        await self._request("DELETE", {})
        self._failures, self._next_check_s = 0, 0.0

    async def _check(self, processed: int) -> range | None:
        unread = range(self.sequence + 1, self._last + 1)
        info = await self._request("INFO", {})
        state, created = info["state"], str(info["created"])
        if created != self.stream:
            first = max(
                1, state["first_seq"]
            )  # 0 in an empty stream; above 1 in a used stream, if this process has lost its folder
            self.stream, self.sequence, self._purged, self._last = created, first - 1, 0, 0
            return unread
        self._last = state["last_seq"]
        if self._last < self.sequence:  # the server has lost the end of the stream, and assigns its numbers again
            self.sequence = self._purged = self._last
            return unread
        if state["first_seq"] > self.sequence + 1:  # the server has lost the beginning of the stream
            unread = range(self.sequence + 1, state["first_seq"])
            self.sequence = unread[-1]
            return unread
        share = state["bytes"] / info["config"]["max_bytes"]
        self.warning = (
            f"{share:.0%} of the stream {subjects.TELEMETRY_STREAM} is filled; a full stream rejects batches"
            if share > WARNING_SHARE
            else ""
        )
        if processed > self._purged:
            await self._request("PURGE", {"seq": processed + 1})
            self._purged = processed
        return None

    async def _request(self, operation: str, request: dict[str, int]) -> dict[str, dict[str, int]]:
        subject = f"$JS.API.STREAM.{operation}.{subjects.TELEMETRY_STREAM}"
        message = await self._nc.request(subject, json.dumps(request).encode(), timeout=REQUEST_TIMEOUT_S)
        response: dict[str, dict[str, int]] = json.loads(message.data)
        if error := response.get("error"):
            is_missing, is_unavailable = error.get("err_code") == NO_SUCH_STREAM, error.get("code") == UNAVAILABLE
            kind = MissingStreamError if is_missing else StreamError if is_unavailable else DamagedStreamError
            raise kind(f"the server rejects {operation} of {subjects.TELEMETRY_STREAM}: {error}")
        return response
