"""Lost sensor: while a pack is charged, its temperature and later its cell voltages become null.

Service and Mosquitto are separate processes. The critical alarm that needs the lost quantity can then no longer be raised.
Its hook must run nevertheless, although the hook does not list ``sensor_fault``.
"""

import asyncio
import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from pathlib import Path

import aiomqtt

from tests.benchmarks.table import Row
from tests.mosquitto import Broker, Listener
from tests.patience import until

CHARGE_A = -30.0
"""Current of the pack, a charge [A]."""
PERIOD_S = 0.1
"""Interval of the publisher [s]."""
LATE_S = 3.0
"""Maximum time from the end of the alarm's delay to the start of the hook's program [s]."""
ALARM_OF_QUANTITY = {"t": "over_temperature", "cells": "cell_over_voltage"}
"""Alarm that needs each quantity that becomes null, by the name of the quantity in the published messages."""
PACK_TOML = """
[pack]
name = "attack"
cell = "lfp"
series = 4
capacity_ah = 100.0
[source]
kind = "mqtt"
topic = "home/pack"
voltage = "u"
current = "i"
temperature = "t"
cells = "cells"
interval_s = 1.0
[mqtt]
url = "{url}"
[state]
folder = "{folder}"
[alarms]
lost_s = {lost_s}
sensor_fault = {{clear_delay_s = 1.0}}
"""
HOOK_TOML = """
[[alarms.hook]]
alarms = ["{alarm}"]
run = ["{program}"]
"""


@dataclass(frozen=True)
class Loss:
    """Consequences of a quantity that became null.

    Attributes:
        alarm: Alarm that needs the quantity.
        fault_s: Time until ``sensor_fault`` [s].
        hook_s: Time until the hook's program ran [s].
        runs: Alarm and state of each run of the program.
    """

    alarm: str
    fault_s: float
    hook_s: float
    runs: tuple[str, ...]


async def lose_quantities(broker: Broker, folder: Path, lost_s: float) -> list[Loss]:
    """Run the service; remove and restore one quantity after the other.

    ``lost_s`` is the delay of the alarm, as in the settings [s].
    """
    out, program = folder / "ran", folder / "hook"
    out.touch()
    program.write_text(f'#!/bin/sh\necho "$BMS_NAME $BMS_STATE" >> {out}\n')
    program.chmod(0o700)
    text = PACK_TOML.format(url=broker.url, folder=folder, lost_s=lost_s)
    pack = folder / "attack.toml"
    pack.write_text(
        text + "".join(HOOK_TOML.format(alarm=alarm, program=program) for alarm in ALARM_OF_QUANTITY.values())
    )
    values: dict[str, object] = {"u": 13.4, "i": CHARGE_A, "t": 25.0, "cells": [3.35] * 4}
    async with Listener(broker, "bms/attack/alarm/#") as live, _service(pack, folder), _publisher(broker, values):
        return [
            await _lose_quantity(live, out, values, quantity, alarm) for quantity, alarm in ALARM_OF_QUANTITY.items()
        ]


async def _lose_quantity(live: Listener, out: Path, values: dict[str, object], quantity: str, alarm: str) -> Loss:
    """Publish null for a quantity until the hook of ``alarm`` has run; then restore the quantity."""
    fault, topic, runs_before = "bms/attack/alarm/sensor_fault", f"bms/attack/alarm/{alarm}", len(_lines(out))
    await live.wait_json(topic, lambda message: message["watched"] and not message["active"])
    value, lost_at_s, messages_before = values[quantity], time.monotonic(), len(live.messages)
    values[quantity] = None
    await live.wait_json(fault, lambda message: message["active"] and alarm in message["text"], messages_before)
    fault_s = time.monotonic() - lost_at_s
    await _wait_for_lines(out, runs_before + 1)
    hook_s = time.monotonic() - lost_at_s
    values[quantity], messages_before = value, len(live.messages)
    await _wait_for_lines(out, runs_before + 2)  # the run for the cleared alarm
    await live.wait_json(fault, lambda message: not message["active"], messages_before)
    return Loss(alarm, fault_s, hook_s, tuple(_lines(out)[runs_before:]))


@contextlib.asynccontextmanager
async def _service(pack: Path, folder: Path) -> AsyncIterator[None]:
    """Run the service while the context lasts."""
    program = Path(sys.executable).with_name("bms-estimator")
    with (folder / "log").open("w") as log:
        service = await asyncio.create_subprocess_exec(program, "run", "--no-view", pack, stdout=log, stderr=log)
    try:
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(service.pid, signal.SIGINT)
        await service.wait()


@contextlib.asynccontextmanager
async def _publisher(broker: Broker, values: dict[str, object]) -> AsyncIterator[None]:
    """Publish ``values``, which may change meanwhile, while the context lasts."""

    async def publish() -> None:
        async with aiomqtt.Client("127.0.0.1", broker.port) as client:
            while True:
                await client.publish("home/pack", json.dumps(values))
                await asyncio.sleep(PERIOD_S)

    task = asyncio.create_task(publish())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def _wait_for_lines(out: Path, lines: int) -> None:
    await until(lambda: len(_lines(out)) >= lines)


def _lines(out: Path) -> list[str]:
    return out.read_text().splitlines()


def rows(broker: Broker, folder: Path, lost_s: float) -> Iterator[Row]:
    """Measure the reaction to each lost quantity."""
    latest_s = lost_s + LATE_S
    for loss in asyncio.run(lose_quantities(broker, folder, lost_s)):
        in_time = lost_s <= loss.fault_s <= latest_s and lost_s <= loss.hook_s <= latest_s
        ran_as_expected = loss.runs == (f"{loss.alarm} raised", f"{loss.alarm} cleared")
        yield Row(
            f"a charged pack loses what {loss.alarm} needs",
            f"alarm and hook after {lost_s:g} to {latest_s:g} s",
            f"sensor_fault after {loss.fault_s:.1f} s, hook after {loss.hook_s:.1f} s",
            in_time and ran_as_expected,
        )
