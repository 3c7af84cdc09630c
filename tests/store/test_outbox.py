"""The outbox against what it promises: in order, nothing lost but what found no room."""

import asyncio

from bms_estimator.sinks.messages import Message
from bms_estimator.store.outbox import Outbox
from tests.patience import LONG_S


def message(number: int) -> Message:
    return Message("bms/pack/state", str(number).encode(), 1, retain=False)


def filled(count: int, *, most: int = 100) -> Outbox:
    outbox = Outbox(None, most=most)
    for number in range(count):
        outbox.put(message(number))
    return outbox


async def taken(outbox: Outbox, most: int) -> list[int]:
    async with asyncio.timeout(LONG_S):
        return [int(waiting.message.payload) for waiting in await outbox.take(most)]


async def test_messages_are_handed_out_once_and_in_order():
    outbox = filled(5)
    assert await taken(outbox, 2) == [0, 1]
    assert await taken(outbox, 9) == [2, 3, 4]
    assert outbox.waiting == 5


async def test_what_was_not_acknowledged_is_handed_out_again_before_newer_ones():
    outbox = filled(3)
    first, *_ = await outbox.take(3)
    outbox.sent(first.number)
    outbox.put(message(3))
    outbox.rewind()
    assert await taken(outbox, 9) == [1, 2, 3]
    assert outbox.waiting == 3


async def test_who_takes_waits_for_a_message():
    outbox = filled(0)
    task = asyncio.create_task(taken(outbox, 1))
    await asyncio.sleep(0)
    assert not task.done()
    outbox.put(message(7))
    assert await task == [7]


async def test_without_room_the_oldest_goes_that_is_not_on_its_way_and_is_counted():
    outbox = filled(3, most=3)
    assert await taken(outbox, 1) == [0]
    outbox.put(message(3))
    outbox.put(message(4))
    assert outbox.dropped == 2
    assert await taken(outbox, 9) == [3, 4]
    outbox.rewind()
    assert await taken(outbox, 9) == [0, 3, 4]
