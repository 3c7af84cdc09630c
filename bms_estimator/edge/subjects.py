"""Names on the server, within the account of one tenant. An MQTT topic is the subject with / for the dots.

===========================  ================================================================================
``raw.<pack>``               an edge's blocks, ``block``; the stream ``RAW`` takes them and stores them as ...
``p.<partition>.raw.<pack>`` ... this; published to it, a message reaches no stream
``edge.<pack>.awaits``       to the edge: which block a worker awaits next, ``BlockRequest``
``bms.<pack>.<topic>``       estimates, as ``run`` publishes them
``hours.<pack>``             what a worker sums up each hour, kept by the stream ``HOURS``
``fleet.worker.<id>``        each second, from each worker: that it lives, what it holds, how far it lags
``fleet.unknown.<pack>``     once, from a worker: it holds blocks of a pack that the table does not know, and why
===========================  ================================================================================
"""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

RAW_STREAM, HOURS_STREAM = "RAW", "HOURS"
PACKS_BUCKET, CELLS_BUCKET, CHECKPOINTS_BUCKET, STATES_BUCKET = "packs", "cells", "checkpoints", "states"
"""Key-value: settings by pack; cell files by name; the last checkpoint by partition. Objects: what checkpoints hold."""
PARTITIONS = 64
"""Default number of partitions; it is set when the streams are made and never changes."""


def raw(pack: str) -> str:
    """Return the subject on which an edge publishes."""
    return f"raw.{pack}"


def kept(partition: int, pack: str = "*") -> str:
    """Return the subject in the stream ``RAW`` of a pack's blocks."""
    return f"p.{partition}.raw.{pack}"


def mapping(partitions: int) -> tuple[str, str]:
    """Source and destination of the transform by which ``RAW`` puts each pack into its partition."""
    return "raw.*", f"p.{{{{partition({partitions},1)}}}}.raw.{{{{wildcard(1)}}}}"


def awaits(pack: str) -> str:
    """Return the subject of a worker's requests to an edge."""
    return f"edge.{pack}.awaits"


def published(pack: str, topic: str) -> str:
    """Return the subject of estimates."""
    return f"bms.{pack}.{topic}"


def hours(pack: str = "*") -> str:
    """Return the subject of a pack's one-hour summaries."""
    return f"hours.{pack}"


def worker(name: str = "*") -> str:
    """Return the subject of a worker's heartbeats."""
    return f"fleet.worker.{name}"


def unknown(pack: str = "*") -> str:
    """Return the subject on which a worker reports an unknown pack."""
    return f"fleet.unknown.{pack}"


def partition_of(pack: str, partitions: int) -> int:
    """Return the partition of a pack: FNV-1a of its name, as in the server's ``partition`` mapping."""
    digest = 0x811C9DC5
    for byte in pack.encode():
        digest = (digest ^ byte) * 0x01000193 & 0xFFFFFFFF
    return digest % partitions


class BlockRequest(BaseModel):
    """Message to an edge: all blocks of ``store`` before ``number`` are safe and may be deleted."""

    model_config = ConfigDict(frozen=True)

    store: Annotated[int, Field(ge=0, lt=2**63)]
    number: Annotated[int, Field(ge=1, le=2**63)]
    resend: bool
    """A later block arrived first: send this one and all after it again."""
