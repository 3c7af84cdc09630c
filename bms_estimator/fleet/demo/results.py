"""Measured results of the demo, as a table."""

from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.demo.observer import Observer
from bms_estimator.fleet.nats.checkpoint_pointer import Pointer, pointer_key
from bms_estimator.fleet.nats.stream_reader import read_stream


async def stored_blocks(nc: Client) -> int:
    """Return the number of blocks in the stream ``RAW``."""
    return (await nc.jetstream().stream_info(subjects.RAW_STREAM)).state.messages


async def result_lines(nc: Client, observer: Observer, takeover_s: float, lags_before_kill: int) -> list[str]:
    """Return the lines of the table.

    Args:
        nc: Connection to the server.
        observer: Received heartbeats and estimates.
        takeover_s: Time from the kill to the takeover of the last partition [s].
        lags_before_kill: Number of ``observer.lags_s`` before the kill.
    """
    counters, compared = observer.counters, max(1, len(observer.errors))
    pointers = await _pointers(nc)
    before_s, after_s = (
        max(lags, default=0.0) for lags in (observer.lags_s[:lags_before_kill], observer.lags_s[lags_before_kill:])
    )
    rows = (
        ("blocks stored by the server", f"{await stored_blocks(nc):,}"),
        ("blocks estimated, each counted once", f"{counters['blocks']:,}"),
        ("blocks that edges sent again", f"{counters['resends']:,}"),
        ("undecodable blocks (dead letters)", f"{counters['damaged']:,}"),
        ("lost blocks", f"{counters['lost_blocks']:,}"),
        ("takeover after the kill", f"{takeover_s:.1f} s"),
        ("largest lag before the kill", f"{before_s:.1f} s"),
        ("largest lag after the kill", f"{after_s:.1f} s"),
        ("SOC estimates within 2 std of the truth", f"{100.0 * observer.within / compared:.0f} %"),
        ("checkpoints: the last two of each partition", f"{sum(len(each.kept) for each in pointers):,}"),
        ("checkpoints: daily, stored for 30 days", f"{sum(len(each.daily) for each in pointers):,}"),
    )
    return [f"   {name:45}{value:>10}" for name, value in rows]


async def _pointers(nc: Client) -> list[Pointer]:
    """Return the pointers to the checkpoints of all partitions that have one."""
    prefix = f"$KV.{subjects.CHECKPOINTS_BUCKET}."
    newest = dict[str, bytes]()
    async for batch in read_stream(nc, f"KV_{subjects.CHECKPOINTS_BUCKET}", f"{prefix}*"):
        newest |= {message.subject.removeprefix(prefix): message.data for message in batch}
    keys = map(pointer_key, range(subjects.PARTITIONS))
    return [Pointer.model_validate_json(newest[key]) for key in keys if newest.get(key)]
