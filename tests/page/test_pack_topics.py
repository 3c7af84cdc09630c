"""``PackTopics``, the hub of the page: the newest payload of each topic, for fast and slow readers."""

import json
import sys
from typing import Any

import pytest

from bms_estimator.page.event_stream import MAX_MESSAGE_BYTES, Reader
from bms_estimator.page.pack_topics import MAX_EVENT_CHARACTERS, RECENT_EVENTS, RECENT_STATES, PackTopics
from bms_estimator.store.history import epoch_s

TIME = "2026-11-22T16:00:{:06.3f}Z"


def state(second: float, **fields: object) -> dict[str, object]:
    """Return a state ``second`` seconds after 16:00, whose voltage is 13 V plus 1 V for each second."""
    return {"time": TIME.format(second), "voltage_v": 13.0 + second} | fields


async def read_message(reader: Reader) -> dict[str, Any]:
    """Return the next message to a reader, decoded."""
    return json.loads(await reader.next(1.0))


async def first_message(hub: PackTopics) -> dict[str, Any]:
    """Return the first message to a new reader, decoded."""
    with hub.reading() as reader:
        return await read_message(reader)


@pytest.fixture
def hub() -> PackTopics:
    return PackTopics()


async def test_new_reader_gets_the_last_values_of_all_packs(hub):
    hub.put("attic", "state", state(0.0))
    hub.put("attic", "state", state(1.0))
    hub.put("cellar", "availability", "online")
    messages = await first_message(hub)
    assert hub.packs == ["attic", "cellar"]
    assert messages["attic/state"] == state(1.0)
    assert messages["cellar/availability"] == "online"
    assert messages["attic/recent"]["voltage_v"] == [13.0, 14.0]


async def test_new_reader_gets_the_last_events_without_those_that_are_too_long(hub):
    for number in range(RECENT_EVENTS + 1):
        hub.put("attic", "event", {"time": TIME.format(number)})
    hub.put("attic", "event", {"text": "x" * MAX_EVENT_CHARACTERS})
    messages = await first_message(hub)
    assert messages["attic/event"] == [{"time": TIME.format(number)} for number in range(1, RECENT_EVENTS + 1)]


async def test_slow_reader_gets_only_the_newest_values(hub):
    with hub.reading() as reader:
        for number in range(10_000):
            hub.put("attic", "state", state(number % 60, frames_received=number))
            hub.put("attic", "health", {"uptime_s": number})
        assert len(reader._waiting) == 3  # state, health and the list of packs
        assert await read_message(reader) == {
            "attic/state": state(39, frames_received=9999),
            "attic/health": {"uptime_s": 9999},
            "packs": {"names": ["attic"], "hidden": 0},
        }
        assert await reader.next(0.0) == ""
    assert hub.readers == 0


async def test_pack_with_cleared_topics_is_removed(hub):
    hub.put("attic", "availability", "online")
    hub.put("attic", "state", state(0.0))
    hub.put("attic", "parameters", {"soc": 0.5, "elements": {"r_s_ohm": {"value": 1.0, "std": 0.1, "valid": True}}})
    for topic in ("state", "parameters", "availability"):
        assert hub.packs == ["attic"]
        hub.put("attic", topic, None)
    assert hub.packs == []
    hub.put("attic", "availability", "online")
    messages = await first_message(hub)
    assert messages["attic/recent"]["time_s"] == []
    assert messages["attic/elements"] == {}


def test_payload_nested_too_deeply_is_ignored(hub):
    nested = []
    for _ in range(sys.getrecursionlimit() + 1):
        nested = [nested]
    hub.put("attic", "state", nested)
    assert hub.packs == []


async def test_a_reader_ends_when_the_hub_closes(hub):
    with hub.reading() as reader:
        hub.close()
        assert await reader.next(60.0) == ""
        assert reader.closed


@pytest.mark.parametrize("topic", ["schema", "home_assistant", "home_assistant/problems", "response/state", "x"])
async def test_topics_that_the_page_does_not_show_are_not_stored(hub, topic):
    hub.put("attic", topic, {"a": 1})
    assert hub.packs == []


async def test_cleared_topic_is_removed_and_readers_are_notified(hub):
    hub.put("attic", "availability", "online")
    hub.put("attic", "alarm/soc_low", {"active": True})
    with hub.reading() as reader:
        await read_message(reader)
        hub.put("attic", "alarm/soc_low", None)
        assert await read_message(reader) == {"attic/alarm/soc_low": None}
    assert "attic/alarm/soc_low" not in await first_message(hub)


async def test_curves_have_one_point_a_second_and_a_bounded_number_of_points(hub):
    for tenth in range(100):
        hub.put("attic", "state", state(tenth / 10.0))
    assert (await first_message(hub))["attic/recent"]["voltage_v"] == [13.0 + s for s in range(10)]
    for number in range(2 * RECENT_STATES):
        hub.put("attic", "state", {"time": f"2026-11-23T{number // 3600:02}:{number // 60 % 60:02}:{number % 60:02}Z"})
    assert len((await first_message(hub))["attic/recent"]["time_s"]) == RECENT_STATES


@pytest.mark.parametrize(
    "payload", ["text", 3, [], {}, {"time": 3}, {"time": "x"}, {"time": TIME.format(1), "soc": "x"}]
)
@pytest.mark.parametrize("topic", ["state", "parameters", "health", "alarm/x"])
async def test_invalid_payloads_are_passed_on_and_not_evaluated(hub, topic, payload):
    hub.put("attic", topic, payload)
    assert (await first_message(hub))[f"attic/{topic}"] == payload


async def test_valid_elements_are_stored_by_percent_of_soc(hub):
    def report(soc, value, *, valid=True):
        return {"soc": soc, "elements": {"r_s_ohm": {"value": value, "std": 0.001, "valid": valid}, "e_o_v": None}}

    for soc, value, valid in [(0.5, 0.01, True), (0.501, 0.02, True), (0.7, 0.03, True), (0.8, 0.04, False)]:
        hub.put("attic", "parameters", report(soc, value, valid=valid))
    hub.put("attic", "parameters", {"soc": 7.0, "elements": {}})
    elements = (await first_message(hub))["attic/elements"]
    assert elements == {"r_s_ohm": {"50": [0.02, 0.001], "70": [0.03, 0.001]}}


@pytest.mark.parametrize("future_time", ["9999-01-01T00:00:00.000Z", "2026-11-23T23:00:00.000Z"])
async def test_a_state_dated_in_the_future_does_not_stop_the_curves(future_time: str) -> None:
    hub = PackTopics(lambda: epoch_s(TIME.format(0.0)))
    hub.put("attic", "state", state(0.0))
    hub.put("attic", "state", state(1.0) | {"time": future_time})
    hub.put("attic", "state", state(2.0))
    assert (await first_message(hub))["attic/recent"]["voltage_v"] == [13.0, 15.0]


async def test_message_size_is_limited_and_further_topics_follow_in_the_next_messages(hub: PackTopics) -> None:
    for number in range(100):
        hub.put("attic", f"alarm/{number}", "x" * 10_000)
    messages, sizes = dict[str, object](), list[int]()
    with hub.reading() as reader:
        while text := await reader.next(0.0):
            sizes.append(len(text))
            messages |= json.loads(text)
    assert max(sizes) < 1.1 * MAX_MESSAGE_BYTES
    assert len(sizes) > 1
    assert sum(key.startswith("attic/alarm/") for key in messages) == 100


async def test_dropped_pack_is_removed_from_the_list(hub: PackTopics) -> None:
    for pack in ("attic", "cellar"):
        hub.put(pack, "availability", "online")
    with hub.reading() as reader:
        assert (await read_message(reader))["packs"] == {"names": ["attic", "cellar"], "hidden": 0}
        hub.put("attic", "state", state(0.0))
        hub.drop("attic")
        hub.set_hidden_count(7)
        assert await read_message(reader) == {"packs": {"names": ["cellar"], "hidden": 7}}


async def test_link_state_is_sent_once_for_each_change(hub):
    hub.set_link_state("no broker")
    with hub.reading() as reader:
        assert (await read_message(reader))["link"] == {"up": False, "reason": "no broker"}
        hub.set_link_state("no broker")
        assert await reader.next(0.0) == ""
        hub.set_link_state(None)
        assert (await read_message(reader))["link"] == {"up": True, "reason": None}
