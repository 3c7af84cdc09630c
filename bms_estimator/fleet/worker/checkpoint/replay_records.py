"""Records of guarded replays (``replay_guard``), beside the pointers to the checkpoints."""

from nats.aio.client import Client
from nats.js.errors import KeyNotFoundError
from nats.js.kv import KeyValue
from pydantic import BaseModel, ConfigDict, ValidationError

from bms_estimator.edge import subjects


class ReplayRecord(BaseModel):
    """Progress of a guarded replay of a partition."""

    model_config = ConfigDict(frozen=True)

    sequence: int = 0
    """Stream sequence number of the block that the owner of the partition processes; 0: none."""
    deaths: dict[int, int] = {}
    """Number of owners that died while they processed a block, by its stream sequence number."""


class ReplayRecords:
    """Records of one tenant.

    Args:
        nc: Connection to the tenant's NATS account.
        bucket: Key-value bucket of the records.
    """

    def __init__(self, nc: Client, bucket: KeyValue) -> None:
        self._nc, self._bucket = nc, bucket

    async def read(self, partition: int) -> ReplayRecord:
        """Return the record of the last guarded replay of a partition."""
        try:
            return ReplayRecord.model_validate_json((await self._bucket.get(_key(partition))).value or b"")
        except (KeyNotFoundError, ValidationError):
            return ReplayRecord()

    async def write(self, partition: int, record: ReplayRecord) -> None:
        """Store the record of a guarded replay."""
        await self._bucket.put(_key(partition), record.model_dump_json().encode())

    async def send(self, partition: int, record: ReplayRecord) -> None:
        """Send the record of a guarded replay without waiting for its storage."""
        subject = f"$KV.{subjects.CHECKPOINTS_BUCKET}.{_key(partition)}"
        await self._nc.publish(subject, record.model_dump_json().encode())


def _key(partition: int) -> str:
    return f"p{partition}.replay"
