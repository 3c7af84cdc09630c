"""Requests to a running service from people and dashboards, over any transport that exchanges bytes.

Any client of the transport may send requests. Therefore only listed names are accepted; the size of payloads and the
rates of requests and log lines are limited; commands need a permission in the pack file. No handler's exception ends the
service.
"""

import json
import math
import reprlib
import time
from collections.abc import Awaitable, Callable, Collection, Mapping
from typing import Any, get_args

import structlog

from bms_estimator.model.errors import UserError
from bms_estimator.mqtt.connection import DeliveryStats
from bms_estimator.settings.connections import Command

COMMANDS = get_args(Command)
"""Names of all commands."""
READS = ("forecast",)
"""Names of the requests that change nothing, and therefore need no permission."""
MAX_PAYLOAD_BYTES = 4096
"""Maximum size of a request's payload [bytes]."""
MAX_READ_BYTES = 1 << 17
"""Maximum size of the payload of a request in ``READS`` [bytes], such as a load profile. MQTT has a lower limit, 16 kB."""
REQUESTS_PER_MIN = 6.0
"""Rate limit of all clients' requests together, granted or not [1/min]. This number of requests may arrive at once."""
READS_PER_MIN = 30.0
"""Rate limit of all clients' requests in ``READS`` together [1/min]. This number of requests may arrive at once."""
LOG_S = 60.0
"""Minimum interval between two log lines for each counter of rejection [s]; all rejections are counted."""
MAX_SHOWN = 40
"""Maximum length of a foreign name in the log [characters]."""

Handler = Callable[[Mapping[str, Any]], Awaitable[Mapping[str, Any]]]
"""Function that returns the response's data for a request's arguments. It raises UserError if the request is rejected."""
log = structlog.get_logger(__name__)


class RequestDispatcher:
    """Dispatcher of requests to their handlers, with permissions and rate limits.

    Args:
        delivery: Statistics in which requests are counted by result.
        commands: Allowed commands.
        monotonic: Monotonic clock [s].
    """

    def __init__(
        self,
        delivery: DeliveryStats,
        commands: Collection[Command] = (),
        *,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._counts, self._allowed, self._monotonic = delivery.requests, commands, monotonic
        self._handlers: dict[str, Handler] = {}
        rates = ((COMMANDS, REQUESTS_PER_MIN), (READS, READS_PER_MIN))
        self._limiters: dict[str, RateLimiter] = {}
        for names, per_minute in rates:
            self._limiters |= dict.fromkeys(names, RateLimiter(per_minute, monotonic))  # shared by all names of a kind
        self._logged_s: dict[str, float] = {}

    def register(self, name: str, handler: Handler) -> None:
        """Register the handler of a request of ``COMMANDS`` or ``READS``."""
        self._handlers[name] = handler

    @property
    def allowed(self) -> tuple[Command, ...]:
        """Allowed commands, in the order of ``COMMANDS``."""
        return tuple(command for command in COMMANDS if command in self._allowed)

    async def handle(self, name: str, payload: bytes) -> bytes | None:
        """Return the response to a request, a JSON object with the members status, data, error and transaction.

        Args:
            name: Name of the request.
            payload: JSON object, or empty.

        Returns:
            The response; None for an unknown name and beyond the rate limit.
        """
        if name not in self._limiters:
            self.count_refusal("unknown", name[:MAX_SHOWN])
            return None
        if not self._limiters[name].take():
            self.count_refusal("too_many", name)
            return None
        transaction = None
        try:
            arguments = _arguments(payload, MAX_READ_BYTES if name in READS else MAX_PAYLOAD_BYTES)
            transaction = _transaction(arguments)
            response = _response("ok", await self._handler(name)(arguments), None, transaction)
        except UserError as error:
            self.count_refusal("refused", name, reason=str(error))
            return _response("error", None, str(error), transaction)
        except Exception as error:  # noqa: BLE001  counted and logged: a request must not end the service
            self.count_refusal("failed", name, exc_info=error)
            return _response("error", None, "internal error, which the log of the service describes", transaction)
        self._counts["granted"] += 1
        return response

    def count_refusal(self, counter: str, name: str, **log_fields: Any) -> None:
        """Count a request that is not granted; log the first of a burst.

        Args:
            counter: Name of the counter.
            name: Name of the request.
            log_fields: Fields for the log.
        """
        self._counts[counter] += 1
        now_s = self._monotonic()
        if now_s - self._logged_s.get(counter, -math.inf) >= LOG_S:
            self._logged_s[counter] = now_s
            log.warning("request not granted", kind=counter, request=name, so_far=self._counts[counter], **log_fields)

    def _handler(self, name: str) -> Handler:
        """Return the handler of a request.

        Raises:
            UserError: The request is not allowed, or has no handler.
        """
        if name not in READS and name not in self._allowed:
            raise UserError(f"{name}: not allowed; mqtt.commands in the pack file lists the allowed commands")
        if name not in self._handlers:
            raise UserError(f"{name}: not supported here")
        return self._handlers[name]


class RateLimiter:
    """Token bucket that admits a number of requests a minute, in a burst or spread.

    Args:
        per_minute: Number of requests.
        monotonic: Monotonic clock [s].
    """

    def __init__(self, per_minute: float, monotonic: Callable[[], float]) -> None:
        self._per_minute, self._monotonic = per_minute, monotonic
        self._tokens, self._updated_s = per_minute, monotonic()

    def take(self) -> bool:
        """Remove a token for one request. Return False if the rate limit is exceeded."""
        now_s = self._monotonic()
        added = (now_s - self._updated_s) * self._per_minute / 60.0
        self._tokens, self._updated_s = min(self._tokens + added, self._per_minute), now_s
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True


def number(arguments: Mapping[str, Any], name: str, low: float, high: float) -> float:
    """Return the number ``name`` of a request's arguments.

    Raises:
        UserError: The argument is missing, not a number, or outside ``low``..``high``.
    """
    value = arguments.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise UserError(f"{name} = {reprlib.repr(value)}: must be a number from {low:g} to {high:g}")
    return float(value)


def _response(status: str, data: Mapping[str, Any] | None, error: str | None, transaction: str | int | None) -> bytes:
    response = {"status": status, "data": data, "error": error, "transaction": transaction}
    return json.dumps(response, allow_nan=False, separators=(",", ":")).encode()


def _arguments(payload: bytes, max_bytes: int) -> Mapping[str, Any]:
    """Parse a request's payload of at most ``max_bytes``: a JSON object of finite numbers, or empty.

    Raises:
        UserError: The payload is something else, or too long.
    """
    if len(payload) > max_bytes:
        raise UserError(f"a request's payload must not be longer than {max_bytes} bytes")
    if not payload:
        return {}
    try:
        arguments = json.loads(payload, parse_float=_finite, parse_constant=_finite)
    except (ValueError, RecursionError):
        raise UserError("a request's payload must be a JSON object or empty") from None
    if not isinstance(arguments, dict):
        raise UserError("a request's payload must be a JSON object or empty")
    return arguments


def _finite(token: str) -> float:
    """Parse a number of a request; Python's JSON accepts NaN, and reads 1e999 as infinity.

    Raises:
        UserError: The number is not finite.
    """
    number = float(token)
    if not math.isfinite(number):
        raise UserError(f"{token[:MAX_SHOWN]}: numbers of a request must be finite")
    return number


def _transaction(arguments: Mapping[str, Any]) -> str | int | None:
    """Return the transaction, which the response repeats so that the client can match it.

    Raises:
        UserError: The transaction is neither a string nor an integer.
    """
    transaction = arguments.get("transaction")
    if transaction is not None and (isinstance(transaction, bool) or not isinstance(transaction, str | int)):
        raise UserError("transaction: must be a string or an integer")
    return transaction
