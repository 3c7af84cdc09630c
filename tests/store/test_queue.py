"""The order of what waits, without a disk."""

from bms_estimator.mqtt.message import Message
from bms_estimator.store.outbox_queue import LOWEST, PAGE, Queue


def filled(count: int) -> Queue:
    """So many messages, all of them written."""
    queue = Queue(most=10 * PAGE)
    for number in range(count):
        queue.put(Message("t", str(number).encode(), 1, retain=False))
    queue.writing(queue.unwritten())
    queue.wrote()
    return queue


def numbers(queue: Queue, most: int) -> list[int]:
    return [int(waiting.message.payload) for waiting in queue.take_next(most)]


def test_after_a_lost_connection_what_was_on_its_way_goes_before_what_was_ready():
    queue = filled(5)
    assert numbers(queue, 2) == [0, 1]
    queue.rewind()
    assert numbers(queue, 5) == [0, 1, 2, 3, 4]


def test_memory_keeps_a_page_of_what_is_written_and_nothing_newer_passes_what_is_on_disk():
    queue = filled(PAGE + 7)
    assert list(queue.stored) == [range(PAGE, PAGE + 7)]
    queue.put(Message("t", b"9999", 1, retain=False))
    assert numbers(queue, 2 * PAGE) == list(range(PAGE))
    assert not queue.can_hand_out
    assert queue.needs_page
    queue.skip_disk = True
    assert numbers(queue, 5) == [9999]


def test_what_is_acknowledged_is_removed_from_disk_if_it_ever_was_there():
    queue = filled(2)
    queue.put(Message("t", b"2", 1, retain=False))
    _, second, third = queue.take_next(3)
    queue.sent(third.number)
    assert not queue.stale, "it never was there"
    queue.sent(second.number)
    assert queue.stale
    assert queue.gaps() == [(LOWEST, 0), (1, 3)]
