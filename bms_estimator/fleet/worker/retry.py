"""Repetition of actions that failed because of the connection or the server."""

from collections.abc import Awaitable, Callable

from nats.errors import Error as NatsError

from bms_estimator.fleet.nats.stream_reader import StreamError

RETRY_S = 0.5
"""Retry interval of server requests [s]."""
RETRYABLE_ERRORS = (NatsError, TimeoutError, StreamError)
"""Errors of the connection or the server after which a request is repeated."""
Attempt = Callable[[Callable[[], Awaitable[None]]], Awaitable[bool]]
"""Function that runs an action, logs an error of the connection or the server, and returns True if the action succeeded."""
