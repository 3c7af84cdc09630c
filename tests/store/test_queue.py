"""Order of queued messages, without a disk."""

from bms_estimator.mqtt.message import Message
from bms_estimator.store.outbox_queue import MIN_NUMBER, PAGE, OutboxQueue


def queue_with(count: int) -> OutboxQueue:
    """Return a queue with the messages 0 to ``count`` - 1, all of them written."""
    queue = OutboxQueue(max_messages=10 * PAGE)
    for number in range(count):
        queue.put(Message("t", str(number).encode(), 1, retain=False))
    queue.mark_writing(queue.unwritten())
    queue.mark_written()
    return queue


def take_numbers(queue: OutboxQueue, max_messages: int) -> list[int]:
    """Take messages. Return the numbers in their payloads."""
    return [int(waiting.message.payload) for waiting in queue.take_next(max_messages)]


def test_messages_in_flight_precede_ready_ones_after_a_rewind():
    queue = queue_with(5)
    assert take_numbers(queue, 2) == [0, 1]
    queue.rewind()
    assert take_numbers(queue, 5) == [0, 1, 2, 3, 4]


def test_memory_contains_one_page_and_newer_messages_wait_for_those_on_disk():
    queue = queue_with(PAGE + 7)
    assert list(queue.stored) == [range(PAGE, PAGE + 7)]
    queue.put(Message("t", b"9999", 1, retain=False))
    assert take_numbers(queue, 2 * PAGE) == list(range(PAGE))
    assert not queue.can_take
    assert queue.needs_page
    queue.skip_disk = True
    assert take_numbers(queue, 5) == [9999]


def test_acknowledged_messages_are_deleted_only_if_written():
    queue = queue_with(2)
    queue.put(Message("t", b"2", 1, retain=False))
    _, second, third = queue.take_next(3)
    queue.acknowledge(third.number)
    assert not queue.has_stale_rows, "it was never written"
    queue.acknowledge(second.number)
    assert queue.has_stale_rows
    assert queue.gaps() == [(MIN_NUMBER, 0), (1, 3)]  # only number 0 is still queued
