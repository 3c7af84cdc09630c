"""Streams on the real server: made once, the same when asked for again."""

from pathlib import Path

import nats
import pytest

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.streams import make_streams, partitions_of
from bms_estimator.model.errors import UserError
from tests.fleet.engine import running


async def test_streams_are_made_once_and_keep_their_partitions(tmp_path: Path) -> None:
    with running(tmp_path, partitions=8) as engine:
        nc = await nats.connect(engine.url)
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
        with pytest.raises(UserError, match="has 8 partitions, and 64 are asked for"):
            await make_streams(nc)
        await nc.close()


async def test_no_room_is_said(tmp_path: Path) -> None:
    with running(tmp_path) as engine:
        nc = await nats.connect(engine.url)
        with pytest.raises(UserError, match="refuses the stream RAW: insufficient storage"):
            await make_streams(nc, raw_bytes=1 << 50)
        await nc.close()
