"""Hooks that publish messages, with a real broker: denied topics, outages, a full outbox."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from bms_estimator.mqtt.connection import OnResult
from bms_estimator.service import job_hook
from bms_estimator.service.alarm_hooks import AlarmHooks
from bms_estimator.settings.alarms import AlarmHook
from bms_estimator.telemetry.alarms.definitions import Change
from tests.mosquitto import Broker, Listener
from tests.mqtt.proxy import Proxy
from tests.patience import until
from tests.service.test_alarm_hooks import CLEARED, RAISED, wait_for_health
from tests.sinks.sink_helpers import STATE_TOPIC, Sink, numbered_state

DENIED = "topic readwrite bms/#\ntopic read load/#\n"
"""Access list that denies the topic of the hook."""

HOOK = AlarmHook(topic="load/set", payload="$name $state")


@asynccontextmanager
async def run_hook(sink: Sink, **changes: Any) -> AsyncIterator[AlarmHooks]:
    """Run a sink and the hook with these changes."""
    hook = HOOK.model_copy(update=changes)
    async with sink, AlarmHooks([hook], "pack", sink.mqtt.publish_raw, None) as running:
        yield running


@pytest.fixture
def stopped_broker(tmp_path: Path) -> Broker:
    (tmp_path / "acl").write_text(DENIED)
    return Broker(tmp_path, f"allow_anonymous true\nacl_file {tmp_path / 'acl'}")


async def test_a_denied_message_makes_the_hook_fail_until_the_broker_accepts_it(
    stopped_broker: Broker, tmp_path: Path
) -> None:
    with stopped_broker as broker:
        with capture_logs() as lines:
            async with Listener(broker) as live, run_hook(Sink(broker.url)) as hooks:
                hooks.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
                health = await wait_for_health(hooks, lambda health: health.failures >= 2)
                assert health.done == 0
                [failing] = health.failing
                assert failing.startswith("publish on load/set: not delivered: Not authorized (135)")
                assert not hooks.finished_hashes
                (tmp_path / "acl").write_text("topic readwrite #\n")
                broker.reload()
                await live.wait("load/set", lambda payload: payload == b"soc_low raised")
                await wait_for_health(hooks, lambda health: (health.done, health.failing) == (1, []))
                assert hooks.finished_hashes
        assert [line["hook"] for line in lines if line["event"].startswith("alarm hook")] == ["publish on load/set"]


async def test_the_end_of_an_alarm_whose_message_was_denied_replaces_the_message(
    stopped_broker: Broker, tmp_path: Path
) -> None:
    with stopped_broker as broker:
        async with Listener(broker) as live, run_hook(Sink(broker.url)) as hooks:
            hooks.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
            await wait_for_health(hooks, lambda health: health.failures >= 1)
            hooks.on_alarm_change(Change(at_s=0.0, alarm=CLEARED))
            await wait_for_health(hooks, lambda health: health.failures >= 3)
            (tmp_path / "acl").write_text("topic readwrite #\n")
            broker.reload()
            await wait_for_health(hooks, lambda health: (health.done, health.failing) == (1, []))
            assert await live.wait("load/set") == b"soc_low cleared"


@pytest.mark.parametrize("cycles", range(10))  # in one of them, the denied job is due while the last one waits
async def test_a_denied_message_does_not_remove_the_job_of_a_newer_alarm(
    cycles: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job_hook, "FIRST_RETRY_S", 0.0)
    output, results = list[bytes](), list[OnResult]()

    def publish(_: str, payload: bytes, on_result: OnResult) -> None:
        output.append(payload)
        results.append(on_result)

    async with AlarmHooks([HOOK], "pack", publish, None) as hooks:
        for count, alarm in enumerate((RAISED, CLEARED, RAISED, CLEARED), 1):
            hooks.on_alarm_change(Change(at_s=0.0, alarm=alarm))
            await until(lambda count=count: len(output) == count)  # type: ignore[misc]
        results[1]("not authorized")
        for _ in range(cycles):
            await asyncio.sleep(0)
        hooks.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
    assert output == [b"soc_low raised", b"soc_low cleared"] * 2 + [b"soc_low raised"]


async def test_a_broker_with_mqtt_3_does_not_report_a_denied_message(stopped_broker: Broker) -> None:
    with stopped_broker as broker:
        async with Proxy(broker.port, supports_5=False) as proxy, run_hook(Sink(proxy.url)) as hooks:
            hooks.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
            assert (await wait_for_health(hooks, lambda health: health.done == 1)).failing == []


async def test_a_message_that_is_not_acknowledged_in_time_makes_the_hook_fail_until_it_is_delivered(
    stopped_broker: Broker, tmp_path: Path
) -> None:
    (tmp_path / "acl").write_text("topic readwrite #\n")
    async with run_hook(Sink(stopped_broker.url), timeout_s=0.05) as hooks:
        hooks.on_alarm_change(Change(at_s=0.0, alarm=RAISED))
        health = await wait_for_health(hooks, lambda health: health.failures == 1)
        assert health.done == 0
        assert health.failing == ["publish on load/set: not acknowledged by the broker within 0.05 s; still queued"]
        assert not hooks.finished_hashes
        with stopped_broker:
            await wait_for_health(hooks, lambda health: (health.done, health.failing) == (1, []))


async def test_a_full_outbox_drops_estimates_before_the_messages_of_hooks(broker: Broker) -> None:
    sink = Sink(broker.url, max_queued=4)
    async with Listener(broker) as live, AlarmHooks([HOOK], "pack", sink.mqtt.publish_raw, None) as hooks:
        for waiting, alarm in enumerate((RAISED, CLEARED), 1):
            hooks.on_alarm_change(Change(at_s=0.0, alarm=alarm))
            await until(lambda waiting=waiting: sink.delivery.waiting == waiting)  # type: ignore[misc]
        for number in range(20):
            sink.mqtt.publish(numbered_state(number))
        assert sink.delivery.waiting == 4
        async with sink:  # connects only now
            await live.wait(STATE_TOPIC, lambda payload: b'"frames_received":19' in payload)
            assert live.all("load/set") == [b"soc_low raised", b"soc_low cleared"]
            await wait_for_health(hooks, lambda health: health.done == 2)
