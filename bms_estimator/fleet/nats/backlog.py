"""Messages of the partitions that the server has not delivered to a worker yet."""

from nats.aio.client import Client
from nats.js.api import ConsumerInfo

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.streams import RESPONSE_TIMEOUT_S, consumer


async def undelivered_messages(nc: Client, partitions: int) -> dict[int, int]:
    """Return the number of undelivered messages of each partition.

    Raises:
        nats.errors.Error: The server does not respond, or has no stream ``RAW``.
    """
    js = nc.jetstream(timeout=RESPONSE_TIMEOUT_S)
    consumers = dict[str, ConsumerInfo]()
    while page := await js.consumers_info(subjects.RAW_STREAM, offset=len(consumers)):
        consumers |= {info.name: info for info in page}
    named = {number: consumers.get(consumer(number)) for number in range(partitions)}
    return {number: info.num_pending or 0 for number, info in named.items() if info}
