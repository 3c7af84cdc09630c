"""Relay of the firmware in simavr while the board is reset again and again and an alarm is latched."""

import asyncio
import os
from pathlib import Path
from typing import NamedTuple

import pytest

from bms_estimator.model.arrays import SampleStatus
from bms_estimator.model.cell import load_cell
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.protocols.firmware.messages import MessageType, command
from bms_estimator.service import relay_hook
from bms_estimator.service.pack_service import run_pack_service
from bms_estimator.settings.pack import Settings
from tests.patience import LONG_S, until
from tests.scripted_source import Collector
from tests.simavr_board import SimavrBoard, write_readings

pytestmark = pytest.mark.usefixtures("firmware")

LOAD_A = 5.0
RESETS = 10
"""Number of resets of the board while the alarm is latched."""
SAMPLES = 30
"""Number of samples between two resets, in which a service that does not wait would switch the relay."""

MAX_RISES = {"low": 0, "high": 1}
"""Maximum number of times that the pin goes high, by the hook's level. If low is safe, the pin stays low. If high is safe, one
more attempt follows the first reset."""


class PinMonitor:
    """Receiver of the service's bytes that counts how often the pin goes high, from the current that it disconnects."""

    missed_reads = 0

    def __init__(self) -> None:
        self._decoder = FrameDecoder()
        self.is_high, self.rises, self.resets = False, 0, 0
        self.samples = 0  # number of samples since the last reset

    def write(self, arrival_s: float, data: bytes) -> None:
        for sample in self._decoder.feed(arrival_s, data):
            is_high = bool(sample["current_a"] < 0.9 * LOAD_A)  # also if the pin was high for a part of the sample
            self.rises += is_high > self.is_high
            self.is_high = is_high
            self.samples = 1 if sample["status"] & SampleStatus.RESET else self.samples + 1
        self.resets = self._decoder.counters.resets


def raised(snapshot: Snapshot) -> dict[str, str]:
    """Return the texts of all raised alarms, by name."""
    return {alarm.name: alarm.text for alarm in snapshot.alarms if alarm.active}


class ResetLoop(NamedTuple):
    """Result of the resets."""

    rises: int
    """Number of times that the pin went high since the first reset."""
    texts: dict[str, str]
    """Texts of the raised alarms, by name."""
    relay_resets: int
    """Number of resets that undid a relay level, by the health message."""


async def reset_loop(folder: Path, relay: str) -> ResetLoop:
    """Reset the board ``RESETS`` times while an alarm is latched whose hook sets the relay."""
    readings = write_readings(folder / "readings.csv", [(0.0, LOAD_A, 25.9, 25.0)])
    pin, sink, stop = PinMonitor(), Collector(), asyncio.Event()
    with pytest.MonkeyPatch.context() as patch, SimavrBoard(readings, speed=10.0, relay=True) as board:
        # several commands between two resets of the accelerated board
        patch.setattr(relay_hook, "COMMAND_INTERVAL_S", 0.02)
        patch.setattr(relay_hook, "RESET_POLL_S", 0.02)
        settings = Settings.model_validate(
            {
                "sensor": {"port": board.path},
                "publish": {"rate_hz": 10.0},
                "alarms": {
                    "pack_over_voltage": {"limit_v": 25.5, "delay_s": 0.5},
                    "hook": [{"alarms": ["pack_over_voltage"], "relay": relay, "when_silent": "keep"}],
                },
            }
        )
        cell = load_cell("thunder_power_6s")
        service = asyncio.create_task(run_pack_service(settings, cell, sinks=[sink], tap=pin, stop=stop))
        await sink.until(lambda snapshot: "pack_over_voltage" in raised(snapshot))
        await until(lambda: pin.is_high == (relay == "high"))
        rises = pin.rises
        line = os.open(board.path, os.O_WRONLY | os.O_NOCTTY)  # a second writer, unknown to the service
        try:
            for resets in range(1, RESETS + 1):
                os.write(line, b"\0" + command(MessageType.COMMAND_RESTART))
                await until(lambda resets=resets: pin.resets >= resets and pin.samples >= SAMPLES)  # type: ignore[misc]
            snapshot = await sink.until(lambda snapshot: snapshot.health.line["resets"] >= RESETS)
        finally:
            os.close(line)
        stop.set()
        await asyncio.wait_for(service, LONG_S)
    assert snapshot.health.hooks is not None
    return ResetLoop(pin.rises - rises, raised(snapshot), snapshot.health.hooks.relay_resets)


@pytest.mark.parametrize("relay", MAX_RISES)
async def test_a_board_in_a_reset_loop_does_not_chatter_its_relay_and_raises_alarms(tmp_path: Path, relay: str) -> None:
    loop = await reset_loop(tmp_path, relay)
    assert loop.rises <= MAX_RISES[relay]
    assert "was reset after a relay command" in loop.texts["hook_failed"]
    assert "reset at least 3 times" in loop.texts["sensor_fault"]
    assert "pack_over_voltage" in loop.texts
    assert loop.relay_resets >= RESETS - 1
