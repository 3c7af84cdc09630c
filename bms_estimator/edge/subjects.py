"""NATS subjects within the account of one tenant. The MQTT topic of a subject has slashes for the dots.

===========================  ================================================================================
``raw.<pack>``               blocks of an edge (module ``block``), received by the stream ``RAW``
``table.<pack>``             changes of a row of the table of packs, received by the stream ``RAW``
``p.<partition>.raw.<pack>`` these blocks as the stream ``RAW`` stores them; publishing to this subject has no effect.
                             Changes of the table are stored as ``p.<partition>.table.<pack>``, and fits as
                             ``p.<partition>.fit.<pack>``
``fit.<pack>``               result of a fit of the pack's model, received by the stream ``RAW``
``history.<pack>``           rows of a pack's history, or all rows with the last fit, stored in the stream ``HISTORY``
``fits.<pack>``              request for a fit by a worker, stored in the stream ``FITS`` until it is answered
``edge.<pack>.awaits``       ``BlockRequest`` to the edge: the first block that no saved checkpoint includes
``bms.<pack>.<topic>``       estimates, in the format of the command ``run``
``dead.<pack>.<digest>``     a block that a worker could not process, stored in the stream ``DEAD``
``telemetry.<pack>``         batches of an operator's telemetry platform, received by the stream ``TELEMETRY``
``ingest.<pack>``            report of ``fleet ingest`` about dropped samples or a rejected batch
``hours.<pack>``             one-hour summaries by a worker, stored in the stream ``HOURS``
``fleet.worker.<id>``        heartbeat of a worker, once a second, with its partitions and its lag
``fleet.ingest``             subscribed by the running ``fleet ingest``, so that a second one notices it
``fleet.unknown.<pack>``     one report of a worker that it has blocks of an unregistered pack, with the reason
===========================  ================================================================================
"""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

RAW_STREAM, HOURS_STREAM, DEAD_STREAM, TELEMETRY_STREAM = "RAW", "HOURS", "DEAD", "TELEMETRY"
HISTORY_STREAM, FITS_STREAM = "HISTORY", "FITS"
PACKS_BUCKET, CELLS_BUCKET, CHECKPOINTS_BUCKET, STATES_BUCKET = "packs", "cells", "checkpoints", "states"
"""Names of buckets. The first three are key-value buckets: settings by pack, cell files by name, and the last checkpoint
by partition. The fourth is an object bucket with the content of the checkpoints."""
INGEST_PRESENCE = "fleet.ingest"
"""Subject that the running ``fleet ingest`` subscribes to."""
PARTITIONS = 64
"""Default number of partitions. The number cannot be changed after the streams were created."""


def raw(pack: str) -> str:
    """Return the subject on which an edge publishes."""
    return f"raw.{pack}"


def telemetry(pack: str = "*") -> str:
    """Return the subject on which a telemetry platform publishes batches of samples."""
    return f"telemetry.{pack}"


def ingest_report(pack: str) -> str:
    """Return the subject of reports about dropped samples and rejected batches."""
    return f"ingest.{pack}"


def table_change(pack: str = "*") -> str:
    """Return the subject on which a worker sends changes of a pack's row in the table."""
    return f"table.{pack}"


def stored_raw(partition: int, pack: str = "*") -> str:
    """Return the subject of a pack's blocks in the stream ``RAW``."""
    return f"p.{partition}.raw.{pack}"


def stored(partition: int, pack: str = "*") -> str:
    """Return the subject of a pack's blocks, changes of the table and fits in the stream ``RAW``."""
    return f"p.{partition}.*.{pack}"


def is_raw(stored_subject: str) -> bool:
    """Return True if the stream ``RAW`` stores messages of edges under a subject."""
    return stored_subject.split(".")[2] == "raw"


def fit(pack: str = "*") -> str:
    """Return the subject of the results of fits of a pack's model."""
    return f"fit.{pack}"


def history(pack: str = "*") -> str:
    """Return the subject of the rows of a pack's history."""
    return f"history.{pack}"


def fit_request(pack: str = "*") -> str:
    """Return the subject of requests for fits."""
    return f"fits.{pack}"


def mapping(partitions: int) -> tuple[str, str]:
    """Return source and destination of the subject transform that assigns packs to partitions in the stream ``RAW``."""
    return "*.*", f"p.{{{{partition({partitions},2)}}}}.{{{{wildcard(1)}}}}.{{{{wildcard(2)}}}}"


def block_request(pack: str = "*") -> str:
    """Return the subject of a worker's requests to an edge."""
    return f"edge.{pack}.awaits"


def published(pack: str, topic: str) -> str:
    """Return the subject of estimates."""
    return f"bms.{pack}.{topic}"


def hours(pack: str = "*") -> str:
    """Return the subject of a pack's one-hour summaries."""
    return f"hours.{pack}"


def dead(pack: str = "*", digest: str = "*") -> str:
    """Return the subject of a block that a worker could not process."""
    return f"dead.{pack}.{digest}"


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
    """Message to an edge that a saved checkpoint includes all blocks of ``store`` before ``number``, which may be deleted."""

    model_config = ConfigDict(frozen=True)

    store: Annotated[int, Field(ge=0, lt=2**63)]
    number: Annotated[int, Field(ge=1, le=2**63)]
    resend: bool
    """True if a later block arrived first, so that block ``number`` and all later blocks must be sent again."""
