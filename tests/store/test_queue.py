"""Order of queued messages, without a disk."""

from bms_estimator.mqtt.connection import Message, QueuedMessage
from bms_estimator.store.outbox_queue import MAX_TAIL, MIN_NUMBER, PAGE, NumberRanges, OutboxQueue


def queue_with(count: int) -> OutboxQueue:
    """Return a queue with the messages 0 to ``count`` - 1, all of them written."""
    queue = OutboxQueue(max_messages=10 * PAGE)
    for number in range(count):
        queue.put(Message("t", str(number).encode(), 1, retain=False))
    queue.mark_writing(queue.unwritten())
    queue.mark_written()
    return queue


def put_awaited(queue: OutboxQueue, number: int) -> list[str]:
    """Put a message whose result is awaited. Return the list that receives the result."""
    results: list[str] = []
    queue.put(Message("t", str(number).encode(), 1, retain=False), results.append)
    return results


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


def test_messages_whose_disk_is_not_writable_are_dropped_before_those_with_an_awaited_result():
    queue = OutboxQueue(max_messages=10 * MAX_TAIL)
    results = put_awaited(queue, 0)
    for number in range(1, 2 * MAX_TAIL):
        queue.put(Message("t", str(number).encode(), 1, retain=False))
    assert take_numbers(queue, 2) == [0, MAX_TAIL + 1]
    assert (results, queue.dropped) == ([], MAX_TAIL)


def test_a_message_that_a_damaged_disk_has_lost_is_reported():
    queue = queue_with(PAGE)
    kept, lost, unread = (put_awaited(queue, PAGE + i) for i in range(3))
    queue.mark_writing(queue.unwritten())
    queue.mark_written()
    queue.retain_stored(NumberRanges([range(PAGE, PAGE + 1), range(PAGE + 2, PAGE + 3)]))
    assert (kept, lost, unread) == ([], ["lost because the disk is damaged"], [])
    queue.take_next(PAGE)
    queue.add_page([QueuedMessage(PAGE, Message("t", b"1000", 1, retain=False))], PAGE + 3)
    assert unread == lost
    assert take_numbers(queue, 2) == [PAGE]
    queue.acknowledge(PAGE, "not authorized")
    assert kept == ["not authorized"]


def test_the_result_of_a_message_that_was_put_before_the_backlog_was_read_is_reported():
    queue = OutboxQueue(max_messages=10)
    results = put_awaited(queue, 7)
    queue.prepend_backlog(NumberRanges([range(5)]))
    queue.add_page([QueuedMessage(number, Message("t", b"0", 1, retain=False)) for number in range(5)], 5)
    *_, last = queue.take_next(6)
    queue.acknowledge(last.number)
    assert (last.message.payload, results) == (b"7", [""])
