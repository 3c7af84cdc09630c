"""Stored checkpoints for tests: a clock, checkpoints of given bytes, and the stored objects."""

from collections.abc import Iterator
from dataclasses import dataclass

from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import PartitionCheckpoint
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CheckpointStore
from bms_estimator.fleet.worker.checkpoint.claims import Claim

DAY_S = 86_400.0
STATES_STREAM = f"OBJ_{subjects.STATES_BUCKET}"


class Clock:
    """Wall clock of the checkpoints, which stands still at noon, so that a test does not span two days."""

    now_s = 1.79e9 // DAY_S * DAY_S + DAY_S / 2

    def time(self) -> float:
        return self.now_s


@dataclass(frozen=True)
class RawCheckpoint(PartitionCheckpoint):
    """Checkpoint that is stored as the given parts, whatever the format."""

    parts: tuple[bytes, ...] = ()

    def chunks(self, _: int | None = None) -> Iterator[bytes]:
        return iter(self.parts)


def raw(sequence: int, *parts: bytes) -> RawCheckpoint:
    """Return a checkpoint of the given bytes."""
    return RawCheckpoint(0, sequence, parts=parts)


async def load(store: CheckpointStore, claim: Claim) -> list[bytes]:
    """Return the intact checkpoints, the newest first."""
    return [data async for _, data in store.load(claim)]


async def chunk_subject(nc: Client, name: str) -> str:
    """Return the subject of an object's chunks."""
    info = await (await nc.jetstream().object_store(subjects.STATES_BUCKET)).get_info(name)
    return f"$O.{subjects.STATES_BUCKET}.C.{info.nuid}"


async def damage(nc: Client, name: str) -> None:
    """Replace the chunks of an object."""
    subject = await chunk_subject(nc, name)
    await nc.jetstream().purge_stream(STATES_STREAM, subject=subject)
    await nc.jetstream().publish(subject, b"damaged")


async def stored_objects(nc: Client) -> set[str]:
    """Return the names of all objects with stored chunks or metadata."""
    objects = await (await nc.jetstream().object_store(subjects.STATES_BUCKET)).list(ignore_deletes=True)
    found = (await nc.jetstream().stream_info(STATES_STREAM, subjects_filter=">")).state.subjects or {}
    return {str(each.name) for each in objects} | {name.rpartition(".")[2] for name in found if ".C." in name}
