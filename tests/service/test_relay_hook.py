"""Relay hook with a scripted board and clock."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, Literal

import pytest

from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.protocols.base.relay import Relay
from bms_estimator.service import relay_hook
from bms_estimator.service.alarm_hooks import AlarmHooks
from bms_estimator.service.relay_hook import FIRST_HOLD_S
from bms_estimator.settings.alarms import AlarmHook
from bms_estimator.telemetry.alarms.definitions import Change
from tests.patience import LONG_S
from tests.sinks.snapshots import SOC_LOW_ALARM

ALARM = SOC_LOW_ALARM.model_copy(update={"name": "pack_over_voltage", "severity": "critical"})


class Board:
    """Board whose resets and silence are scripted, beside a clock that tests set."""

    def __init__(self) -> None:
        self.boots, self.now_s, self.is_silent = 0, 0.0, False
        self.high, self.switchings, self.commands = False, 0, 0
        self.last: Relay | None = None

    async def relay(self, relay: Relay, boots: int) -> None:
        if self.is_silent or boots != self.boots:
            raise UserError("no answer")
        self.switchings += relay.high != self.high
        self.high, self.last = relay.high, relay
        self.commands += 1

    def reset(self) -> None:
        self.boots += 1
        self.high = False


@pytest.fixture(autouse=True)
def fast_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the intervals of the hook's loop, which has no clock of its own."""
    for name in ("COMMAND_INTERVAL_S", "COMMAND_RETRY_S", "RESET_POLL_S"):
        monkeypatch.setattr(relay_hook, name, 0.001)


@asynccontextmanager
async def run_hook(level: Literal["high", "low"], *restored: Alarm) -> AsyncIterator[tuple[AlarmHooks, Board]]:
    """Run a relay hook that has sent its first level."""
    board = Board()
    settings = AlarmHook(alarms=("pack_over_voltage",), relay=level)
    hooks = AlarmHooks([settings], "pack", None, board, lambda: board.now_s)
    hooks.restore_active(restored)
    async with hooks:
        yield hooks, board


async def until(condition: Callable[[], Any]) -> None:
    """Wait for a condition."""
    async with asyncio.timeout(LONG_S):
        while not condition():  # noqa: ASYNC110 - a pin has no event
            await asyncio.sleep(0.001)


async def later_command(board: Board) -> None:
    """Wait until the hook has sent its level twice more, so that the level follows from the present state."""
    commands = board.commands
    await until(lambda: board.commands > commands + 1)


async def test_a_hook_without_when_silent_sets_the_alarm_level_as_the_fallback_of_the_pin() -> None:
    async with run_hook("low") as (_, board):
        await until(lambda: board.last == Relay(high=True, high_when_silent=False, silent_s=30))


async def test_after_a_reset_the_load_stays_off_for_30_s_and_the_hook_fails_until_the_level_has_held() -> None:
    async with run_hook("low") as (hooks, board):
        await until(lambda: board.high)
        board.reset()
        await until(lambda: hooks.health and hooks.health.relay_resets == 1)
        await later_command(board)
        assert hooks.health
        assert "was reset after a relay command" in hooks.health.failing[0]
        board.now_s = 0.9 * FIRST_HOLD_S
        await later_command(board)
        assert not board.high
        board.now_s = FIRST_HOLD_S
        await until(lambda: board.high)
        await until(lambda: hooks.health and hooks.health.failing == [])


async def test_a_relay_that_is_safe_when_high_is_set_again_at_once_after_one_reset_and_later_after_more() -> None:
    async with run_hook("high", ALARM) as (hooks, board):
        await until(lambda: board.high)
        board.reset()
        await until(lambda: board.high)
        assert hooks.health
        assert hooks.health.failing
        board.reset()
        await until(lambda: hooks.health and hooks.health.relay_resets == 2)
        assert not board.high
        board.now_s = FIRST_HOLD_S
        await until(lambda: board.high)


async def test_a_new_alarm_is_not_delayed_by_earlier_resets_where_high_is_safe() -> None:
    async with run_hook("high") as (hooks, board):
        await until(lambda: board.commands)
        for _ in range(10):
            board.reset()
        await until(lambda: hooks.health and hooks.health.relay_resets == 10)
        hooks.on_alarm_change(Change(at_s=0.0, alarm=ALARM))
        await until(lambda: board.high)
        assert board.switchings == 1


async def test_a_load_stays_off_at_the_start_of_a_service_whose_hook_had_failed() -> None:
    async with run_hook("low", ALARM.model_copy(update={"name": "hook_failed"})) as (_, board):
        await later_command(board)
        assert not board.high
        board.now_s = FIRST_HOLD_S
        await until(lambda: board.high)


async def test_a_silent_board_is_a_failure_and_gets_the_level_when_it_answers_again() -> None:
    async with run_hook("low") as (hooks, board):
        await until(lambda: board.high)
        board.is_silent = True
        await until(lambda: hooks.health and hooks.health.failing == ["relay pin high: no answer"])
        hooks.on_alarm_change(Change(at_s=0.0, alarm=ALARM))
        board.is_silent = False
        await until(lambda: not board.high)
        await until(lambda: hooks.health and hooks.health.failing == [])


async def test_only_the_level_in_alarms_is_sent_while_alarms_are_not_watched() -> None:
    async with run_hook("low") as (hooks, board):
        await later_command(board)
        hooks.stop_watching()
        polls = list[bool]()
        hooks.check_watching = lambda: bool(polls.append(False))
        await until(lambda: polls)
        commands = board.commands
        await until(lambda: len(polls) > 5)
        assert board.commands == commands
        hooks.on_alarm_change(Change(0.0, ALARM))
        await later_command(board)
        assert not board.high
