"""The outbox against a list: whatever is done to it and its disk, nothing is lost, out of order or doubled unasked."""

import asyncio
import random
import sqlite3
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from bms_estimator.mqtt.message import Message
from bms_estimator.store import outbox as outbox_module
from bms_estimator.store import outbox_queue as queue_module
from bms_estimator.store.database import Database, StoreError
from bms_estimator.store.outbox import Outbox

PAGE = 4
MEANWHILE = st.lists(st.sampled_from(["put", "take", "first", "last", "rewind"]), max_size=5)


class FaultyDatabase(Database):
    """One that can be told to fail, before or after it has written, and at which something happens meanwhile."""

    fails: str | None = None
    before: Callable[[], None] = staticmethod(lambda: None)
    after: Callable[[], None] = staticmethod(lambda: None)

    async def call(self, work: Callable[[sqlite3.Connection], Any]) -> Any:
        self.before()
        if self.fails == "before":
            raise StoreError("full")
        result = await super().call(work)
        self.after()
        if self.fails == "after":
            raise StoreError("nobody knows")
        return result


class Promises(RuleBasedStateMachine):
    """Numbers are put; ``pending`` is what the broker must still get, ``out`` is on its way, ``safe`` was on disk at last."""

    def __init__(self) -> None:
        super().__init__()
        self.patch = pytest.MonkeyPatch()
        self.patch.setattr(queue_module, "PAGE", PAGE)
        self.patch.setattr(outbox_module, "PAGE", PAGE)
        self.patch.setattr(outbox_module, "FLUSH_S", 1e6)  # when it is written is for the rules to say
        self.loop = asyncio.new_event_loop()
        self.folder = tempfile.TemporaryDirectory(prefix="store-")
        self.next, self.dropped = 0, 0
        self.pending: list[int] = []
        self.out: dict[int, int] = {}
        self.safe: set[int] = set()
        self.acknowledged: set[int] = set()
        self.strict = True

    @initialize(most=st.sampled_from([6, 15, 10_000]))
    def begin(self, most: int) -> None:
        self.most = most
        self.open()

    def open(self) -> None:
        self.database = FaultyDatabase(Path(self.folder.name) / "pack.sqlite", retry_s=0.0)
        self.outbox = Outbox(self.database, most=self.most)
        self.dropped = 0
        self.settle(write=False)

    def settle(self, *, write: bool) -> None:
        self.loop.run_until_complete(self.outbox._settle(write=write))

    @rule(count=st.integers(1, 9))
    def put(self, count: int) -> None:
        for _ in range(count):
            self.outbox.put(Message("t", str(self.next).encode(), 1, retain=False))
            self.pending.append(self.next)
            self.next += 1
            if len(self.pending) > self.most:
                self.pending.remove(next(number for number in self.pending if number not in self.out))
                self.dropped += 1

    @precondition(lambda self: len(self.pending) > len(self.out) and len(self.out) < 5)
    @rule(most=st.integers(1, 3))
    def take(self, most: int) -> None:
        self.settle(write=False)  # the page that it may wait for
        assert self.outbox._queue.can_hand_out or not self.strict
        self.hand_out(most)

    def hand_out(self, most: int) -> None:
        if not self.outbox._queue.can_hand_out:
            return
        taken = self.outbox._queue.take_next(most)
        numbers = [int(waiting.message.payload) for waiting in taken]
        ahead = [number for number in self.pending if number not in self.out]
        assert numbers
        assert set(numbers) <= set(ahead)
        if self.strict:
            assert numbers == ahead[: len(numbers)]
        self.out |= {int(waiting.message.payload): waiting.number for waiting in taken}

    @precondition(lambda self: self.out)
    @rule(data=st.data())
    def sent(self, data: st.DataObject) -> None:
        self.acknowledge(data.draw(st.sampled_from(sorted(self.out))))

    def acknowledge(self, number: int) -> None:
        self.outbox.sent(self.out.pop(number))
        self.pending.remove(number)
        self.acknowledged.add(number)

    @rule()
    def rewind(self) -> None:
        self.outbox.rewind()
        self.out.clear()

    @rule()
    def write(self) -> None:
        self.settle(write=True)
        if self.database.fails is None:
            self.safe = set(self.pending)

    @rule(before=MEANWHILE, after=MEANWHILE, write=st.booleans())
    def meanwhile(self, before: list[str], after: list[str], *, write: bool) -> None:
        """While the disk is at work all else goes on."""
        safe = set(self.pending)
        self.database.before, self.database.after = partial(self.go_on, before), partial(self.go_on, after)
        self.settle(write=write)
        del self.database.before, self.database.after
        if write and self.database.fails is None:
            self.safe = safe

    def go_on(self, steps: list[str]) -> None:
        for step in steps:
            if step == "put":
                self.put(3)
            elif step == "take" and len(self.out) < 5:
                self.hand_out(2)
            elif step in ("first", "last") and self.out:
                self.acknowledge(min(self.out) if step == "first" else max(self.out))
            elif step == "rewind":
                self.rewind()
            self.counted()

    @precondition(lambda self: self.most == 10_000)
    @rule(fails=st.sampled_from(["before", "after"]))
    def fail(self, fails: str) -> None:
        """What came last goes first while older ones cannot be read."""
        self.database.fails, self.strict = fails, False

    @rule()
    def heal(self) -> None:
        self.database.fails = None

    @rule(clean=st.booleans())
    def reopen(self, clean: bool) -> None:
        """End in good order, or by a kill; at most what was not on disk is missing, and what was doubled was acknowledged."""
        if clean and self.database.fails is None:
            self.outbox.rewind()
            self.settle(write=True)
            self.safe = set(self.pending)
        self.loop.run_until_complete(self.database.__aexit__())
        with sqlite3.connect(Path(self.folder.name) / "pack.sqlite") as connection:
            there = [int(payload) for (payload,) in connection.execute("SELECT payload FROM outbox ORDER BY number")]
        connection.close()
        assert len(set(there)) == len(there)
        assert self.safe & set(self.pending) <= set(there)
        if clean and self.database.fails is None:
            assert set(there) == set(self.pending)
        if self.strict:
            assert [number for number in there if number in self.pending] == [n for n in self.pending if n in there]
        self.pending, self.safe, self.out, self.strict = there, set(there), {}, True
        self.open()

    @invariant()
    def counted(self) -> None:
        if hasattr(self, "outbox") and self.strict:
            assert self.outbox.waiting == len(self.pending)
            assert self.outbox.dropped == self.dropped

    def teardown(self) -> None:
        if hasattr(self, "outbox"):
            self.database.fails = None
            self.outbox.rewind()
            self.out.clear()
            got: list[int] = []
            rounds = self.outbox.waiting + 10
            while self.outbox.waiting and (rounds := rounds - 1):
                self.settle(write=False)
                for waiting in self.outbox._queue.take_next(PAGE):
                    got.append(int(waiting.message.payload))
                    self.outbox.sent(waiting.number)
            assert sorted(got) == sorted(self.pending)
            assert not self.strict or got == self.pending
            self.settle(write=True)
            self.loop.run_until_complete(self.database.__aexit__())
            with sqlite3.connect(Path(self.folder.name) / "pack.sqlite") as connection:
                assert connection.execute("SELECT count(*) FROM outbox").fetchone() == (0,)
            connection.close()
        self.loop.close()
        self.folder.cleanup()
        self.patch.undo()


TestPromises = Promises.TestCase
TestPromises.settings = settings(max_examples=15, stateful_step_count=40, deadline=None)


@pytest.mark.parametrize("seed", range(4))
def test_a_full_outbox_at_a_slow_disk_keeps_them_over_a_long_walk(seed: int) -> None:
    """What hypothesis rarely comes to: pages that are read while the oldest of them are dropped."""
    dice, machine = random.Random(seed), Promises()
    machine.begin(12)

    def steps() -> list[str]:
        return dice.choices(["put", "take", "first", "last", "rewind"], [5, 2, 1, 1, 1], k=dice.randint(0, 3))

    for _ in range(60):
        machine.go_on(steps())
        machine.meanwhile(steps(), steps(), write=dice.random() < 0.6)
    machine.reopen(clean=True)
    machine.teardown()
