"""Pointer to the checkpoints of a partition: the entry of the bucket ``checkpoints``."""

from pydantic import BaseModel, ConfigDict


class CheckpointInfo(BaseModel):
    """Metadata of a stored checkpoint."""

    model_config = ConfigDict(frozen=True)

    sequence: int
    """Stream sequence number of the last included message."""
    object: str
    """Name in the object store ``states``."""
    bytes: int
    """Size [bytes]."""
    made_s: float
    """Wall clock at which the checkpoint was written [s since 1970]."""
    format: int = 1
    """Format of the bytes (``checkpoint_format.FORMAT``); versions without this field wrote format 1."""


class Pointer(BaseModel):
    """Entry of a partition in the checkpoint bucket."""

    model_config = ConfigDict(frozen=True)

    worker: str = ""
    """Name of the owning worker."""
    next: str = ""
    """Name of the object that this worker writes next. The object may already exist in part."""
    kept: tuple[CheckpointInfo, ...] = ()
    """Last checkpoints, newest first."""
    daily: tuple[CheckpointInfo, ...] = ()
    """First checkpoint of each of the last days, newest first. The newest ones may also be in ``kept``."""

    unsaved_claims: int = 0
    """Number of claims since the last checkpoint or the last orderly release."""

    @property
    def checkpoints(self) -> tuple[CheckpointInfo, ...]:
        """All stored checkpoints without repetitions, the last ones first."""
        return tuple(dict.fromkeys((*self.kept, *self.daily)))


def pointer_key(partition: int) -> str:
    """Return the key of a partition's pointer."""
    return f"p{partition}"
