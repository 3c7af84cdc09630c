"""Streams on the real server: they are created once, and a second call keeps their messages."""

from pathlib import Path

import nats
import pytest

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.streams import make_streams, partitions_of
from bms_estimator.model.errors import UserError
from tests.fleet.nats_cluster import running


async def test_second_call_changes_limits_but_keeps_messages_and_partitions(tmp_path: Path) -> None:
    with running(tmp_path, partitions=8) as cluster:
        nc = await nats.connect(cluster.url)
        js = nc.jetstream()
        assert await partitions_of(nc) is None
        await make_streams(nc, partitions=8)
        await (await js.key_value(subjects.PACKS_BUCKET)).put("a", b"1")
        await (await js.object_store(subjects.STATES_BUCKET)).put("p1.1", b"2")
        await nc.publish(subjects.raw("a"), b"3")
        await make_streams(nc, partitions=8, raw_bytes=1 << 30, raw_age_s=60.0)
        raw = await js.stream_info(subjects.RAW_STREAM)
        assert (raw.state.messages, raw.state.consumer_count, raw.config.max_bytes) == (1, 8, 1 << 30)
        assert (await (await js.key_value(subjects.PACKS_BUCKET)).get("a")).value == b"1"
        assert (await (await js.object_store(subjects.STATES_BUCKET)).get("p1.1")).data == b"2"
        assert await partitions_of(nc) == 8
        with pytest.raises(UserError, match="has 8 partitions, but 64 are configured"):
            await make_streams(nc)
        await nc.close()


async def test_stream_larger_than_the_disk_of_the_server_is_a_user_error(tmp_path: Path) -> None:
    with running(tmp_path) as cluster:
        nc = await nats.connect(cluster.url)
        with pytest.raises(UserError, match="rejects the stream RAW: insufficient storage"):
            await make_streams(nc, raw_bytes=1 << 50)
        await nc.close()
