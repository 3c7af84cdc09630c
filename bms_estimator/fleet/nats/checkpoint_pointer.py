"""Pointer of a partition, an entry of the bucket ``checkpoints``: a list of its checkpoints, which are in the object store."""

from pydantic import BaseModel, ConfigDict


class CheckpointInfo(BaseModel):
    """Metadata of a stored checkpoint."""

    model_config = ConfigDict(frozen=True)

    sequence: int
    """Stream sequence number of the last included message."""
    object: str
    """Name of the object with all packs, in the object store ``states``."""
    bytes: int
    """Size of this object [bytes]."""
    made_s: float
    """Wall clock at which the last of the objects was written [s since 1970]."""
    format: int = 1
    """Format of the bytes (``checkpoint_format.FORMAT``); versions without this field wrote format 1."""
    increments: tuple[str, ...] = ()
    """Names of further objects, each with the packs that have changed since the previous object."""
    increment_bytes: int = 0
    """Total size of the increments [bytes]."""

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of all objects of the checkpoint, in order."""
        return (self.object, *self.increments)


class CheckpointPointer(BaseModel):
    """List of a partition's checkpoints, and the claim of the worker that owns the partition."""

    model_config = ConfigDict(frozen=True)

    worker: str = ""
    """Name of the owning worker."""
    next: str = ""
    """Name of the object that this worker writes next. Parts of it may already be stored."""
    kept: tuple[CheckpointInfo, ...] = ()
    """Last checkpoint, and an earlier one that shares no object with it."""
    daily: tuple[CheckpointInfo, ...] = ()
    """First checkpoint of each of the last days, newest first, without increments. The newest ones may also be in
    ``kept``."""
    unsaved_claims: int = 0
    """Number of claims since the last checkpoint or the last orderly release."""

    @property
    def checkpoints(self) -> tuple[CheckpointInfo, ...]:
        """All stored checkpoints without repetitions, the last ones first."""
        return tuple(dict.fromkeys((*self.kept, *self.daily)))

    @property
    def objects(self) -> frozenset[str]:
        """Names of the objects of all checkpoints."""
        return frozenset(name for checkpoint in self.checkpoints for name in checkpoint.objects)


def pointer_key(partition: int) -> str:
    """Return the key of a partition's pointer."""
    return f"p{partition}"
