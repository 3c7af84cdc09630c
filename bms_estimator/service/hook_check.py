"""Check of the alarm hooks in a pack's settings."""

import shutil
from collections.abc import Iterator

from bms_estimator.model.errors import UserError
from bms_estimator.settings.alarm_kinds import ALARM_KINDS
from bms_estimator.settings.alarm_limits import STATE_LOST
from bms_estimator.settings.alarms import ALARMS, AlarmHook, AlarmSettings
from bms_estimator.settings.pack import Settings

LONG_RUN_S = 60.0
"""Timeout of a program above which a warning is given [s], because a new critical alarm waits for a running program."""


def has_relay(settings: Settings) -> bool:
    """Return True if the source has a relay pin. Only the firmware's board has one."""
    return settings.source is None and settings.sensor.protocol == "binary"


def require_output(i: int, hook: AlarmHook, *, broker: bool, relay: bool) -> None:
    """Reject the hook with index ``i`` in the settings if it needs a missing broker or relay.

    Raises:
        UserError: The broker or the relay is missing.
    """
    if hook.topic and not broker:
        raise UserError(f"alarms.hook.{i}.topic = {hook.topic}: there is no broker; add the section [mqtt]")
    if hook.relay and not relay:
        raise UserError(f"alarms.hook.{i}.relay: only the board of [sensor] with protocol = 'binary' has a relay pin")


def hook_warnings(settings: Settings) -> list[str]:
    """Return one line for each likely mistake in the hooks.

    Raises:
        UserError: A hook needs a missing broker or relay.
    """
    warnings = []
    for i, hook in enumerate(settings.alarms.hook):
        require_output(i, hook, broker=settings.mqtt is not None, relay=has_relay(settings))
        find = _relay_warnings if hook.relay else _job_warnings
        warnings += [f"alarms.hook.{i}.{text}" for text in find(hook, settings.alarms)]
    return warnings


def _relay_warnings(hook: AlarmHook, alarms: AlarmSettings) -> Iterator[str]:
    if hook.when_silent is None:
        yield (
            f"when_silent: not set, so the board switches its pin to {hook.relay}, as in an alarm, after "
            f'{hook.silent_s} s without the service; write {hook.relay!r} to confirm, or "keep"'
        )
    elif hook.when_silent not in (hook.relay, "keep"):
        yield (
            f"when_silent = {hook.when_silent!r}: the board ends the level of an alarm {hook.silent_s} s after the service has "
            f"stopped; write {hook.relay!r}"
        )
    names = hook.alarms or ALARMS
    critical = [name for name in names if name == STATE_LOST.name or getattr(alarms, name).severity == "critical"]
    if hook.relay == "high" and critical:
        yield (
            f'relay = "high": the pin is low after each reset and without power, which connects the load during an alarm; '
            f'for critical alarms, such as {critical[0]}, use relay = "low" and a normally open contact'
        )
    if all("cells" in ALARM_KINDS[name].needs for name in names):
        yield (
            "alarms: the board measures no cell voltages, so that none of these alarms is ever raised; add alarms of the "
            "pack, such as pack_over_voltage"
        )


def _job_warnings(hook: AlarmHook, _: AlarmSettings) -> Iterator[str]:
    if hook.run and shutil.which(hook.run[0]) is None:
        yield f"run = {hook.run[0]}: no such program here, or it may not be run"
    if hook.run and hook.timeout_s > LONG_RUN_S:
        yield f"timeout_s = {hook.timeout_s:g}: a new critical alarm may wait this long for a running program"
    if "cleared" in hook.on and len(hook.alarms) != 1:
        yield (
            "on: with several alarms, cleared is reported while others are still raised; use "
            'on = ["first_raised", "last_cleared"], or let the receiver check that BMS_RAISED ($raised) is empty'
        )
