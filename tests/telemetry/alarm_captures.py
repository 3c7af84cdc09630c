"""Captures of a board that prints JSON lines, and their replay through estimator and publisher."""

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.cell_slots import CellSlots
from bms_estimator.model.clock import Clock
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.pack.pack import new_pack
from bms_estimator.service.publisher import Publisher
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.captures.raw_capture import CaptureWriter, make_header
from bms_estimator.sources.captures.replay import Replay, open_capture
from bms_estimator.telemetry.alarms.definitions import Change
from tests.estimator.anywhere.cases import OXIDE
from tests.estimator.anywhere.truth import curve_of, simulate
from tests.scripted_source import Collector

WALL_S = 1_700_000_000.0
"""Wall clock at the start of a capture [s since 1970]."""
PACK = load_cell("nmc", 10.0).pack(2, 1)
"""Pack of two cells in series. Its alarms have limits of 5.4 and 8.5 V, 10 A of charge and 50 A of discharge."""

KNEE_S = 700
"""Duration of the discharge of ``knee_lines`` [s]."""


class Line(NamedTuple):
    """Part of a capture: a constant reading that the board prints once per period for a number of seconds."""

    seconds: float
    """Duration of the part [s]."""
    voltage_v: float = 7.4
    current_a: float = 0.0
    temperature_c: float | None = 25.0
    cells_v: tuple[float, ...] = ()
    temperatures_c: tuple[float, ...] = ()
    """Temperatures of several probes, in place of ``temperature_c``."""
    silent: bool = False
    """True: the board prints nothing."""

    def text(self, time_s: float = math.nan) -> bytes:
        """Return the printed line, with the board's time unless it is NaN."""
        reading: dict[str, Any] = {"voltage": self.voltage_v, "current": self.current_a}
        reading |= {} if math.isnan(time_s) else {"time_s": time_s}
        if self.temperatures_c:
            reading["temperatures_c"] = self.temperatures_c
        elif self.temperature_c is not None:
            reading["temperature"] = self.temperature_c
        reading |= {"cells": self.cells_v} if self.cells_v else {}
        return json.dumps(reading).encode() + b"\n"


@dataclass
class ReplayResult:
    """Results of a replay: changes of alarms, published snapshots, and saved alarms at the end."""

    changes: list[Change] = field(default_factory=list)
    snapshots: list[Snapshot] = field(default_factory=list)
    saved_state: str = ""

    def transitions(self, name: str) -> list[tuple[float, bool]]:
        """Return the times at which an alarm was raised (True) and cleared (False), in seconds of the capture."""
        changes = [change for change in self.changes if change.alarm.name == name and change.field == "active"]
        return [(round(change.at_s, 3), change.alarm.active) for change in changes]

    def watched(self, name: str) -> list[tuple[float, bool]]:
        """Return the times at which an alarm became watched (True) or unwatched (False), in seconds of the capture."""
        changes = [change for change in self.changes if change.alarm.name == name and change.field == "watched"]
        return [(round(change.at_s, 3), change.alarm.watched) for change in changes]


def record(path: Path, lines: Iterable[Line], period_s: float = 1.0, jitter_s: float = math.nan) -> Path:
    """Write a raw capture of these parts; return its path.

    Args:
        path: Path of the capture.
        lines: Parts of the capture.
        period_s: Time between two printed lines [s].
        jitter_s: Amount by which each second printed time is ahead [s]; NaN: no times are printed.
    """
    arrival_s = 100.0  # any time
    writer = CaptureWriter(path, make_header(settings().sensor))
    writer.write(arrival_s, b"\n")  # the decoder skips all bytes up to the first end of a line
    for line in lines:
        for n in range(round(line.seconds / period_s)):
            if not line.silent:
                writer.write(arrival_s, line.text(arrival_s + jitter_s * (n % 2)))
            arrival_s += period_s
    writer.close()
    return path


def knee_lines(charge_s: int = 900) -> list[Line]:
    """Return a simulated discharge of ``PACK`` at 1 C from SOC 0.25 down the knee, and a charge of ``charge_s`` [s] at C/2."""
    one_c, cells = PACK.cell.capacity_ah, PACK.cell.series_count
    current_a = np.r_[np.full(KNEE_S, one_c), np.full(charge_s, -0.5 * one_c)]
    scale = OXIDE.capacity_ah / one_c
    curves = curve_of("nmc"), OXIDE.per_kelvin_v, OXIDE.hysteresis_v, scale * OXIDE.ohm
    voltage_v, _ = simulate(1.0, current_a, np.full(current_a.size, 25.0), 0.25, -1.0, one_c, *curves)
    return [Line(1, round(cells * v, 3), i) for v, i in zip(voltage_v.tolist(), current_a.tolist(), strict=True)]


def settings(alarms: dict[str, Any] | None = None, **sections: Any) -> Settings:
    """Return settings of a board that prints text, with these alarms and other sections."""
    tables = {"sensor": {"protocol": "text"}, "pack": {"initial_soc": 0.5}, "alarms": alarms or {}}
    return Settings.model_validate(tables | sections)


async def replayed(
    path: Path,
    settings_: Settings,
    cell: CellModel = PACK,
    saved_state: str = "",
    *,
    at_once: bool = False,
    begin_s: float = WALL_S,
) -> ReplayResult:
    """Replay a capture through estimator and publisher with the clock of the capture.

    Args:
        path: Path of the capture.
        settings_: Settings of the pack.
        cell: Model of the pack.
        saved_state: Saved alarms of an earlier run.
        at_once: True: the blocks are as long as the capture allows. False: each block has one sample.
        begin_s: Wall clock at the start of the capture [s since 1970].
    """
    now_s, result, sink = 0.0, ReplayResult(), Collector()
    source = Replay(open_capture(path, settings_.sensor), max_block_s=math.inf if at_once else 0.05)
    identifier = settings_.identifier.model_copy(update={"pack_model": False})
    publish = settings_.publish.model_copy(update={"rate_hz": 0.1})  # changed alarms are published at once
    settings_ = settings_.model_copy(update={"identifier": identifier, "publish": publish})
    pack = new_pack(settings_, cell)
    clock = Clock(wall=lambda: begin_s + now_s, monotonic=lambda: now_s)
    publisher = Publisher(settings_, pack, source=source, sinks=[sink], clock=clock, on_alarm=result.changes.append)
    publisher.alarm_monitor.restore(saved_state)
    slots = CellSlots(cell.cell.series_count)
    async for each in source:
        received = each._replace(cells_v=slots.select(each.cells_v))
        now_s = float(received.samples["time_s"][-1])
        publisher.add(received, pack.run(received.samples), slots.fault)
    publisher.publish_last()
    result.snapshots, result.saved_state = sink.snapshots, publisher.alarm_monitor.alarms.saved_state
    return result
