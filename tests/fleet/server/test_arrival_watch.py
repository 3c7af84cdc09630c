"""Silent packs of a tenant, by the arrival of hourly summaries on the real server."""

import nats

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.packs.pack_bucket import purge_keys, write_bucket
from bms_estimator.fleet.server.tenant_watch import SILENT_S, ArrivalWatch
from tests.fleet.hour_rows import make_hour
from tests.fleet.nats_cluster import running


async def test_packs_without_a_summary_are_counted_also_those_that_never_sent(tmp_path):
    with running(tmp_path, partitions=1) as cluster:
        async with await nats.connect(cluster.url) as nc:
            await make_streams(nc, partitions=1)
            await write_bucket(nc, subjects.PACKS_BUCKET, {"live": b"{}", "gone": b"{}", "never": b"{}"})
            watch, js = ArrivalWatch(nc), nc.jetstream()
            assert await watch.problems(0.0) == (0, 0)
            for pack in ("live", "gone", "unlisted"):
                await js.publish(subjects.hours(pack), b"{}")
            assert await watch.problems(SILENT_S / 2.0) == (0, 0)
            assert await watch.problems(SILENT_S + 1.0) == (1, 0)
            alarm = (
                make_hour("live", 1)
                .model_dump_json(exclude_none=True)
                .encode()
                .replace(b"}", b',"alarms":"cell_short"}')
            )
            await js.publish(subjects.hours("live"), alarm)
            await write_bucket(nc, subjects.PACKS_BUCKET, {"new": b"{}"})
            assert await watch.problems(1.6 * SILENT_S) == (2, 1)
            await purge_keys(nc, subjects.PACKS_BUCKET, ["never"])
            assert await watch.problems(1.6 * SILENT_S) == (1, 1)
            await js.publish(subjects.hours("live"), b"{}")
            assert (await watch.problems(1.6 * SILENT_S)).alarms == 0
