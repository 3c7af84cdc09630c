"""Streams, buckets and consumers of one tenant.

The stream ``RAW`` stores the blocks of samples that edges send, divided into partitions by pack. Each partition has a durable
consumer, which the server pins to one worker at a time (https://github.com/nats-io/nats-architecture-and-design, ADR-42).
Key-value and object buckets are streams with the configuration that all clients give them (ADR-8, ADR-20).
"""

import asyncio
import contextlib
import json
from collections.abc import Awaitable, Callable
from typing import Any, ParamSpec, TypeVar

from nats.aio.client import Client
from nats.errors import NoRespondersError, TimeoutError as NatsTimeoutError

from bms_estimator.edge import subjects
from bms_estimator.model.errors import TemporaryError, UserError

P = ParamSpec("P")
T = TypeVar("T")

RAW_BYTES = 8 << 30
"""Default maximum size of the stream ``RAW`` [bytes]."""
RAW_AGE_S = 7 * 86_400.0
"""Default maximum age of a message in the stream ``RAW`` [s]."""
UNLIMITED = -1
"""Value of ``max_bytes`` without a limit except the server's disk space."""
HOURS_FRACTION = 1 / 16
"""Maximum size of the stream ``HOURS`` of hourly summaries, as a fraction of the maximum size of ``RAW``. If minute blocks of seven
days fill ``RAW``, ``HOURS`` holds the summaries of eleven days."""
HOURS_AGE_S = 30 * 86_400.0
"""Maximum age of a message in the stream ``HOURS`` [s]."""
DEAD_FRACTION = 1 / 64
"""Maximum size of the stream ``DEAD`` of dead letters, as a fraction of the maximum size of ``RAW``: 512 of the largest blocks by
default."""
DEAD_AGE_S = 30 * 86_400.0
"""Maximum age of a message in the stream ``DEAD`` [s]."""
MAX_BLOCK_BYTES = 256 << 10
"""Maximum size of a block in ``RAW`` [bytes]: 7,000 incompressible samples."""
MAX_BATCH_BYTES = (1 << 20) - (16 << 10)
"""Maximum size of a batch in ``TELEMETRY`` [bytes]: the server's limit of a message, 1 MiB, less 16 KiB for the reason with which
``DEAD`` stores a rejected batch."""
PACK_FRACTION = 1 / 3
"""Fraction of ``RAW`` that one pack can fill with blocks of the maximum size. Beyond this fraction, the pack's oldest
block is removed. By default the fraction corresponds to seven days of minute blocks."""
MIN_PACK_BLOCKS = 60
"""Minimum number of stored blocks of a pack, even in a small ``RAW``: an hour of minute blocks."""
DUPLICATES_S = 3600.0
"""Time within which the server drops a message of ``HOURS`` or ``HISTORY`` whose id it has already seen [s]."""
HISTORY_PACK_MESSAGES = 500
"""Maximum number of stored messages of a pack in ``HISTORY``. With 12 rows each, they hold a history of 5,000 rows."""
PRIORITY_GROUP = "w"
"""Priority group of the consumers."""
PIN_S = 2.0
"""Time without a request after which a worker loses a partition [s]."""
PARTITIONS_KEY = "bms.partitions"
"""Metadata key of ``RAW`` with the number of partitions."""
RESPONSE_TIMEOUT_S = 5.0
"""Timeout of a request [s]."""
MAX_ATTEMPTS = 12
"""Maximum number of attempts of a request, because a cluster drops requests while it elects a leader."""
NO_SUCH_STREAM = 10059
"""Error code of the server for a missing stream."""
CONSUMER_BATCH = 16
"""Maximum number of consumers that are created concurrently."""


class NoAnswerError(UserError):
    """The server does not respond; a later attempt may succeed."""


async def make_streams(
    nc: Client,
    *,
    partitions: int = subjects.PARTITIONS,
    replicas: int = 1,
    raw_bytes: int = RAW_BYTES,
    raw_age_s: float = RAW_AGE_S,
    states_bytes: int = UNLIMITED,
    history_bytes: int = UNLIMITED,
    max_pack_blocks: int | None = None,
) -> None:
    """Create missing streams and consumers, and set limits and replicas as configured. The function is idempotent.

    Args:
        nc: Connection to the tenant's NATS account.
        partitions: Number of partitions of ``RAW``, which cannot change.
        replicas: Number of replicas: 1, or 3 in a cluster of three.
        raw_bytes: Maximum size of ``RAW`` [bytes]; beyond it the oldest messages are dropped.
        raw_age_s: Maximum age of messages in ``RAW`` [s].
        states_bytes: Maximum size of the bucket ``states``, which contains the checkpoints [bytes]; beyond it the workers remove
            daily ones.
        history_bytes: Maximum size of the histories [bytes]; beyond it the oldest messages are dropped.
        max_pack_blocks: Maximum number of blocks of one pack in ``RAW``; default: ``max_blocks_of_pack``.

    Raises:
        UserError: The streams have another number of partitions, or the server has too little disk space.
        NoAnswerError: The server does not respond.
    """
    existing = await partitions_of(nc)
    if existing not in (None, partitions):
        raise UserError(
            f"the stream {subjects.RAW_STREAM} has {existing} partitions, but {partitions} are configured: "
            "the number of partitions of an existing stream cannot change"
        )
    streams = (
        _raw_stream(partitions, raw_bytes, raw_age_s, max_pack_blocks or max_blocks_of_pack(raw_bytes)),
        _hours_stream(raw_bytes),
        _dead_stream(raw_bytes),
        *_fit_streams(history_bytes),
        *_bucket_streams(states_bytes),
    )
    for stream in streams:
        await _retry(_ensure_stream, nc, stream | {"num_replicas": replicas})
    numbers = range(partitions)
    for first in range(0, partitions, CONSUMER_BATCH):
        await asyncio.gather(
            *(_retry(_ensure_consumer, nc, n, replicas) for n in numbers[first : first + CONSUMER_BATCH])
        )


async def partitions_of(nc: Client) -> int | None:
    """Return the number of partitions of the stream ``RAW``; None if it does not exist."""
    response = await _retry(_request, nc, f"STREAM.INFO.{subjects.RAW_STREAM}", {})
    if "error" in response:
        if response["error"].get("err_code") == NO_SUCH_STREAM:
            return None
        raise _rejection(subjects.RAW_STREAM, response)
    # a stream that an early version created has no such key
    return int(response["config"].get("metadata", {}).get(PARTITIONS_KEY, subjects.PARTITIONS))


async def require_partitions(nc: Client) -> int:
    """Return the number of partitions of the stream ``RAW``.

    Raises:
        UserError: The stream does not exist.
    """
    partitions = await partitions_of(nc)
    if partitions is None:
        raise _no_raw_stream()
    return partitions


async def make_telemetry_stream(nc: Client, max_bytes: int) -> None:
    """Create the stream ``TELEMETRY``, or set its maximum size. It has as many replicas as ``RAW``.

    A full stream rejects new batches, which their senders must then store.

    Raises:
        UserError: There is no stream ``RAW``, or the server has too little disk space.
        NoAnswerError: The server does not respond.
    """
    response = await _retry(_request, nc, f"STREAM.INFO.{subjects.RAW_STREAM}", {})
    if "error" in response:
        raise _no_raw_stream()
    stream = _stream(
        subjects.TELEMETRY_STREAM,
        subjects.telemetry(),
        max_bytes=max_bytes,
        max_msg_size=MAX_BATCH_BYTES,
        discard="new",
        allow_direct=True,
    )
    await _retry(_ensure_stream, nc, stream | {"num_replicas": response["config"]["num_replicas"]})


def _no_raw_stream() -> UserError:
    return UserError(f"the server has no stream {subjects.RAW_STREAM}: create it with `bms-estimator fleet serve`")


def consumer(partition: int) -> str:
    """Return the name of a partition's durable consumer."""
    return f"p{partition}"


def max_blocks_of_pack(raw_bytes: int) -> int:
    """Return the maximum number of blocks of one pack in ``RAW``."""
    return max(round(PACK_FRACTION * raw_bytes / MAX_BLOCK_BYTES), MIN_PACK_BLOCKS)


def _raw_stream(partitions: int, max_bytes: int, age_s: float, max_pack_blocks: int) -> dict[str, Any]:
    source, destination = subjects.mapping(partitions)
    return _stream(
        subjects.RAW_STREAM,
        subjects.raw("*"),
        # changes of the table and fits are stored here, too, so that a worker processes them in order with the blocks
        subjects.table_change(),
        subjects.fit(),
        subject_transform={"src": source, "dest": destination},
        metadata={PARTITIONS_KEY: str(partitions)},
        max_bytes=max_bytes,
        max_age=_ns(age_s),
        max_msg_size=MAX_BLOCK_BYTES,
        max_msgs_per_subject=max_pack_blocks,
        discard="old",
        allow_direct=True,
    )


def _hours_stream(raw_bytes: int) -> dict[str, Any]:
    return _stream(
        subjects.HOURS_STREAM,
        subjects.hours(),
        duplicate_window=_ns(DUPLICATES_S),
        max_bytes=round(HOURS_FRACTION * raw_bytes),
        max_age=_ns(HOURS_AGE_S),
        discard="old",
        allow_direct=True,
    )


def _dead_stream(raw_bytes: int) -> dict[str, Any]:
    return _stream(
        subjects.DEAD_STREAM,
        subjects.dead(),
        max_bytes=round(DEAD_FRACTION * raw_bytes),
        max_age=_ns(DEAD_AGE_S),
        max_msgs_per_subject=1,
        discard="old",
        allow_direct=True,
    )


def _fit_streams(history_bytes: int) -> list[dict[str, Any]]:
    """Return the streams of histories and of requests for fits. A pack has at most one waiting request."""
    history = _stream(
        subjects.HISTORY_STREAM,
        subjects.history(),
        duplicate_window=_ns(DUPLICATES_S),
        max_bytes=history_bytes,
        max_msgs_per_subject=HISTORY_PACK_MESSAGES,
        discard="old",
        allow_direct=True,
        allow_rollup_hdrs=True,
    )
    requests = _stream(
        subjects.FITS_STREAM, subjects.fit_request(), max_msgs_per_subject=1, discard="old", retention="workqueue"
    )
    return [history, requests]


def _bucket_streams(states_bytes: int) -> list[dict[str, Any]]:
    common = {"discard": "new", "allow_rollup_hdrs": True, "allow_direct": True}
    states = subjects.STATES_BUCKET
    return [
        *(
            _stream(f"KV_{name}", f"$KV.{name}.>", max_msgs_per_subject=1, deny_delete=True, **common)
            for name in (subjects.PACKS_BUCKET, subjects.CELLS_BUCKET, subjects.CHECKPOINTS_BUCKET)
        ),
        _stream(f"OBJ_{states}", f"$O.{states}.C.>", f"$O.{states}.M.>", max_bytes=states_bytes, **common),
    ]


def _stream(name: str, *subject_names: str, **options: Any) -> dict[str, Any]:
    return {"name": name, "subjects": list(subject_names), "storage": "file", "retention": "limits"} | options


async def _ensure_stream(nc: Client, stream: dict[str, Any]) -> None:
    response = await _request(nc, f"STREAM.UPDATE.{stream['name']}", stream)
    if response.get("error", {}).get("err_code") == NO_SUCH_STREAM:
        response = await _request(nc, f"STREAM.CREATE.{stream['name']}", stream)
    if "error" in response:
        raise _rejection(stream["name"], response)


async def _ensure_consumer(nc: Client, partition: int, replicas: int) -> None:
    name = consumer(partition)
    config = {
        "durable_name": name,
        "filter_subject": subjects.stored(partition),
        "ack_policy": "none",  # a worker continues after the last message that its checkpoint includes
        "priority_groups": [PRIORITY_GROUP],
        "priority_policy": "pinned_client",
        "priority_timeout": _ns(PIN_S),
        "num_replicas": replicas,
    }
    request = {"stream_name": subjects.RAW_STREAM, "config": config}
    response = await _request(nc, f"CONSUMER.DURABLE.CREATE.{subjects.RAW_STREAM}.{name}", request)
    if "error" in response:
        raise _rejection(f"{subjects.RAW_STREAM}, consumer {name}", response)


async def _retry(send_request: Callable[P, Awaitable[T]], *args: P.args, **kwargs: P.kwargs) -> T:
    """Repeat a request until the server responds. Every request of this module is idempotent.

    Raises:
        NoAnswerError: The server does not respond.
        UserError: The server rejects the request.
    """
    for _ in range(MAX_ATTEMPTS):
        with contextlib.suppress(NatsTimeoutError):
            return await send_request(*args, **kwargs)
    raise NoAnswerError(f"the server has not responded for {MAX_ATTEMPTS * RESPONSE_TIMEOUT_S:g} s: are most nodes up?")


async def _request(nc: Client, operation: str, request: dict[str, Any]) -> dict[str, Any]:
    """Send a request to the JetStream API, because nats-py supports neither metadata nor priority groups.

    Raises:
        UserError: The server has no JetStream, or none for this account.
        NatsTimeoutError: The server does not respond.
    """
    try:
        response = await nc.request(f"$JS.API.{operation}", json.dumps(request).encode(), timeout=RESPONSE_TIMEOUT_S)
    except NoRespondersError:
        raise UserError("the server has no streams for this account: was it started by `fleet serve`?") from None
    decoded = json.loads(response.data)
    return decoded if isinstance(decoded, dict) else {}


def _rejection(name: str, response: dict[str, Any]) -> TemporaryError:
    """Return the error of a rejected request. It is temporary, because the server may lack disk space for a time."""
    return TemporaryError(
        f"the server rejects the stream {name}: {response['error'].get('description', response['error'])}"
    )


def _ns(seconds: float) -> int:
    return round(1e9 * seconds)
