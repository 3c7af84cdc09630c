"""Streams, buckets and consumers of one tenant, made once; a repeated call changes nothing.

``RAW`` keeps what edges have sent, in partitions; each is read through a durable consumer of its own, which the server
pins to one worker at a time (https://github.com/nats-io/nats-architecture-and-design, ADR-42). Key-value and object
buckets are streams of the shape that all clients give them (ADR-8, ADR-20).
"""

import asyncio
import contextlib
import json
from collections.abc import Awaitable, Callable
from typing import Any, ParamSpec, TypeVar

from nats.aio.client import Client
from nats.errors import NoRespondersError
from nats.errors import TimeoutError as NatsTimeoutError

from bms_estimator.edge import subjects
from bms_estimator.model.errors import UserError

P = ParamSpec("P")
T = TypeVar("T")

RAW_BYTES, RAW_AGE_S = 8 << 30, 7 * 86_400.0
"""Maximum size and age of the stream ``RAW``."""
HOURS_PART, HOURS_AGE_S = 1 / 16, 30 * 86_400.0
"""Maximum size of ``HOURS`` as a fraction of that of ``RAW``, and time that summaries wait for their collector [s]."""
MAX_BLOCK_BYTES = 256 << 10
"""Maximum size of a block in ``RAW`` [bytes]: 7,000 samples that do not compress fit."""
PACK_FRACTION = 1 / 3
"""Fraction of ``RAW`` that one pack can fill with blocks of the maximum size: by default seven days of minute blocks. Beyond it, the
pack's oldest block is removed."""
MIN_PACK_BLOCKS = 60
"""Blocks of a pack that even a small ``RAW`` keeps: an hour of minute blocks."""
DUPLICATES_S = 3600.0
"""A repeated summary with its number within this time is dropped."""
GROUP = "w"
"""Priority group of a consumer for workers."""
PIN_S = 2.0
"""Time without a request after which a worker loses a partition [s]."""
PARTITIONS_KEY = "bms.partitions"
"""Key in the metadata of ``RAW``."""
ANSWER_S, ATTEMPTS = 5.0, 12
"""Timeout of a request [s] and number of attempts: a cluster drops requests while it elects a leader."""
NO_SUCH_STREAM = 10059
"""The server's number for it."""
AT_ONCE = 16
"""Number of consumers created at a time."""


class NoAnswerError(UserError):
    """The server does not respond; it may later."""


async def make_streams(
    nc: Client,
    *,
    partitions: int = subjects.PARTITIONS,
    replicas: int = 1,
    raw_bytes: int = RAW_BYTES,
    raw_age_s: float = RAW_AGE_S,
) -> None:
    """Create missing streams, and set limits and replicas as configured.

    Args:
        nc: Connected as the tenant.
        partitions: Number of partitions of ``RAW``, which cannot change.
        replicas: 1, or 3 in a cluster of three.
        raw_bytes: ``RAW`` keeps no more; beyond it the oldest is dropped.
        raw_age_s: Nor anything older.

    Raises:
        UserError: The streams have another number of partitions, or the server has no room for them.
        NoAnswerError: None answers.
    """
    found = await partitions_of(nc)
    if found not in (None, partitions):
        raise UserError(
            f"the stream {subjects.RAW_STREAM} has {found} partitions, and {partitions} are asked for: "
            "their number stays as it was made"
        )
    for stream in (_raw(partitions, raw_bytes, raw_age_s), _hours(raw_bytes), *_buckets()):
        await _repeated(_ensure_stream, nc, stream | {"num_replicas": replicas})
    numbers = range(partitions)
    for first in range(0, partitions, AT_ONCE):
        await asyncio.gather(*(_repeated(_ensure_consumer, nc, n, replicas) for n in numbers[first : first + AT_ONCE]))


async def partitions_of(nc: Client) -> int | None:
    """Return the number of partitions of the stream ``RAW``; None if it does not exist."""
    answer = await _repeated(_ask, nc, f"STREAM.INFO.{subjects.RAW_STREAM}", {})
    if "error" in answer:
        if answer["error"].get("err_code") == NO_SUCH_STREAM:
            return None
        raise _refused(subjects.RAW_STREAM, answer)
    return int(answer["config"].get("metadata", {}).get(PARTITIONS_KEY, subjects.PARTITIONS))


def consumer(partition: int) -> str:
    """Name of the durable consumer of a partition."""
    return f"p{partition}"


def pack_blocks(raw_bytes: int) -> int:
    """Return the number of blocks of one pack that ``RAW`` keeps."""
    return max(round(PACK_FRACTION * raw_bytes / MAX_BLOCK_BYTES), MIN_PACK_BLOCKS)


def _raw(partitions: int, most_bytes: int, age_s: float) -> dict[str, Any]:
    source, destination = subjects.mapping(partitions)
    limits = {
        "max_bytes": most_bytes,
        "max_age": _ns(age_s),
        "max_msg_size": MAX_BLOCK_BYTES,
        "max_msgs_per_subject": pack_blocks(most_bytes),
        "discard": "old",
        "allow_direct": True,
    }
    return _stream(
        subjects.RAW_STREAM,
        source,
        subject_transform={"src": source, "dest": destination},
        metadata={PARTITIONS_KEY: str(partitions)},
        **limits,
    )


def _hours(raw_bytes: int) -> dict[str, Any]:
    limits = {
        "max_bytes": round(HOURS_PART * raw_bytes),
        "max_age": _ns(HOURS_AGE_S),
        "discard": "old",
        "allow_direct": True,
    }
    return _stream(subjects.HOURS_STREAM, subjects.hours(), duplicate_window=_ns(DUPLICATES_S), **limits)


def _buckets() -> list[dict[str, Any]]:
    common = {"discard": "new", "allow_rollup_hdrs": True, "allow_direct": True}
    states = subjects.STATES_BUCKET
    return [
        *(
            _stream(f"KV_{name}", f"$KV.{name}.>", max_msgs_per_subject=1, deny_delete=True, **common)
            for name in (subjects.PACKS_BUCKET, subjects.CELLS_BUCKET, subjects.CHECKPOINTS_BUCKET)
        ),
        _stream(f"OBJ_{states}", f"$O.{states}.C.>", f"$O.{states}.M.>", **common),
    ]


def _stream(name: str, *names: str, **more: Any) -> dict[str, Any]:
    return {"name": name, "subjects": list(names), "storage": "file", "retention": "limits", **more}


async def _ensure_stream(nc: Client, stream: dict[str, Any]) -> None:
    answer = await _ask(nc, f"STREAM.UPDATE.{stream['name']}", stream)
    if answer.get("error", {}).get("err_code") == NO_SUCH_STREAM:
        answer = await _ask(nc, f"STREAM.CREATE.{stream['name']}", stream)
    if "error" in answer:
        raise _refused(stream["name"], answer)


async def _ensure_consumer(nc: Client, partition: int, replicas: int) -> None:
    name = consumer(partition)
    config = {
        "durable_name": name,
        "filter_subject": subjects.kept(partition),
        "ack_policy": "none",
        "priority_groups": [GROUP],
        "priority_policy": "pinned_client",
        "priority_timeout": _ns(PIN_S),
        "num_replicas": replicas,
    }
    request = {"stream_name": subjects.RAW_STREAM, "config": config}
    answer = await _ask(nc, f"CONSUMER.DURABLE.CREATE.{subjects.RAW_STREAM}.{name}", request)
    if "error" in answer:
        raise _refused(f"{subjects.RAW_STREAM}, consumer {name}", answer)


async def _repeated(ask: Callable[P, Awaitable[T]], *args: P.args, **kwargs: P.kwargs) -> T:
    """Ask until there is an answer; every request here may be repeated.

    Raises:
        NoAnswerError: No response.
        UserError: As ``ask``.
    """
    for _ in range(ATTEMPTS):
        with contextlib.suppress(NatsTimeoutError):
            return await ask(*args, **kwargs)
    raise NoAnswerError(f"the server has answered nothing for {ATTEMPTS * ANSWER_S:g} s: are most nodes up?")


async def _ask(nc: Client, what: str, request: dict[str, Any]) -> dict[str, Any]:
    """One request to the server's JetStream, because nats-py supports neither metadata nor priority groups.

    Raises:
        UserError: It has no JetStream, or none for this account.
        NatsTimeoutError: It does not answer.
    """
    try:
        answer = await nc.request(f"$JS.API.{what}", json.dumps(request).encode(), timeout=ANSWER_S)
    except NoRespondersError:
        raise UserError("the server keeps no streams for this account: was it started by `fleet serve`?") from None
    decoded = json.loads(answer.data)
    return decoded if isinstance(decoded, dict) else {}


def _refused(name: str, answer: dict[str, Any]) -> UserError:
    return UserError(f"the server refuses the stream {name}: {answer['error'].get('description', answer['error'])}")


def _ns(seconds: float) -> int:
    return round(1e9 * seconds)
