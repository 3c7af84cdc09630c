"""Silent packs of a tenant, by the arrival of hourly summaries on the real server."""

from bms_estimator.edge import subjects
from bms_estimator.fleet.packs.pack_bucket import purge_keys, write_bucket
from bms_estimator.fleet.server.tenant_watch import SILENT_S, ArrivalWatch
from tests.fleet.hour_rows import make_hour


async def test_packs_without_a_summary_are_counted_also_those_that_never_sent(nc):
    await write_bucket(nc, subjects.PACKS_BUCKET, {"live": b"{}", "gone": b"{}", "never": b"{}"})
    watch, js = ArrivalWatch(nc), nc.jetstream()
    assert await watch.problems(0.0) == (0, 0)
    for pack in ("live", "gone", "unlisted"):
        await js.publish(subjects.hours(pack), b"{}")
    assert await watch.problems(SILENT_S / 2.0) == (0, 0)
    assert await watch.problems(SILENT_S + 1.0) == (1, 0)
    alarm = make_hour("live", 1).model_dump_json(exclude_none=True).encode().replace(b"}", b',"alarms":"cell_short"}')
    await js.publish(subjects.hours("live"), alarm)
    await write_bucket(nc, subjects.PACKS_BUCKET, {"new": b"{}"})
    assert await watch.problems(1.6 * SILENT_S) == (2, 1)
    await purge_keys(nc, subjects.PACKS_BUCKET, ["never"])
    assert await watch.problems(1.6 * SILENT_S) == (1, 1)
    await js.publish(subjects.hours("live"), b"{}")
    assert (await watch.problems(1.6 * SILENT_S)).alarms == 0
