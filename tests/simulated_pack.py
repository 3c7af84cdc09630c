"""Simulated packs of cells with measured voltages, and their estimator."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bms_estimator.estimator.cell_estimator import CellEstimator
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import load_cell
from bms_estimator.model.clock import Clock
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.pack.pack import Pack
from bms_estimator.service.publisher import Publisher
from bms_estimator.settings.observer import BOARD
from bms_estimator.settings.pack import Settings
from bms_estimator.simulation.simulated_bank import BankCells, BankHistory, SimulatedBank
from bms_estimator.sources.source import ReceivedSamples
from bms_estimator.telemetry.alarms.definitions import Change
from tests.scripted_source import Collector, ScriptedSource

CELLS, CAPACITY_AH, STEP_S, BLOCK = 6, 20.0, 10.0, 30
"""Number of cells, their capacity [Ah], the interval of the samples [s], and the number of samples in a block."""
NOISE_V = 5e-4
"""Std of a cell's reading [V], which has a resolution of 1 mV."""
Wiring = Callable[[BankHistory], Floats]
"""Cell voltages that a battery monitor reads, by the true ones."""


class SimulatedPack:
    """Simulated pack with a battery monitor, and the estimators of the pack and of its cells.

    Args:
        cells: Properties of the cells; None: cells with usual differences.
        chemistry: Name of a generic cell file.
        seed: Seed of the random numbers.
    """

    def __init__(self, cells: BankCells | None = None, chemistry: str = "nmc", seed: int = 1) -> None:
        self.rng = np.random.default_rng(seed)
        cell = load_cell(chemistry, CAPACITY_AH)
        self.bank = SimulatedBank(cell, cells or BankCells.random(self.rng, CELLS, CAPACITY_AH, 0.9))
        self.model = cell.pack(self.bank.cells.soc.size, 1)
        self.estimator = Estimator(self.model, voltage_resolution_v=0.01, sampling=BOARD)
        self.cells = CellEstimator(self.estimator)
        self.pack = Pack(self.estimator, cells=self.cells)
        self.offset_v = 0.001 * self.rng.standard_normal(self.bank.cells.soc.size)
        self.changes = list[Change]()
        self._now_s, self._sink = 0.0, Collector()
        self._publisher = Publisher(
            Settings.model_validate({"publish": {"rate_hz": 0.1}}),
            self.pack,
            source=ScriptedSource(),
            sinks=[self._sink],
            clock=Clock(wall=lambda: self._now_s, monotonic=lambda: self._now_s),
            on_alarm=self.changes.append,
        )
        self._direction = 1.0

    def run(self, hours: float, wiring: Wiring = lambda history: history.cell_v) -> BankHistory:
        """Discharge and charge the pack between SOC 0.3 and 0.9 with a varying current. Return the last block."""
        for _ in range(round(hours)):
            soc = float(self.bank.soc.mean())
            self._direction = 1.0 if soc > 0.85 else -1.0 if soc < 0.35 else self._direction
            phase = np.arange(round(3600.0 / STEP_S)) / 7.0
            current_a = self._direction * CAPACITY_AH * (0.1 + 0.1 * np.sin(phase))
            history = self.bank.run(current_a, STEP_S)
            self.measure(history, wiring)
        return history

    def measure(self, history: BankHistory, wiring: Wiring = lambda history: history.cell_v) -> None:
        """Estimate from the samples of a block, and publish the estimates."""
        noise_v = NOISE_V * self.rng.standard_normal(history.cell_v.shape)
        cells_v = wiring(replace(history, cell_v=history.cell_v + self.offset_v + noise_v))
        samples = history.samples(self.rng, 2e-3, 0.01)
        for begin in range(0, samples.size, BLOCK):
            received = ReceivedSamples(samples[begin : begin + BLOCK], np.round(cells_v[begin : begin + BLOCK], 3))
            self._now_s = float(received.samples["time_s"][-1])
            self._publisher.add(received, self.pack.run(received.samples, received.cells_v))

    @property
    def published(self) -> Snapshot:
        """The last snapshot with an estimate."""
        return next(each for each in reversed(self._sink.snapshots) if each.estimate)

    def transitions(self, alarm: str) -> list[bool]:
        """Return the states to which an alarm has changed."""
        changes = [each for each in self.changes if each.alarm.name == alarm and each.field == "active"]
        return [change.alarm.active for change in changes]

    def short(self, cell: int, leak_ohm: float) -> None:
        """Connect a resistance across a cell; infinite: remove it."""
        leaks = self.bank.cells.leak_ohm.copy()
        leaks[cell] = leak_ohm
        self.bank.cells = replace(self.bank.cells, leak_ohm=leaks)


def with_contact(cell: int, ohm: float) -> Wiring:
    """Return the wiring with a resistance in the current path of one cell [ohm]."""

    def read(history: BankHistory) -> Floats:
        cell_v = history.cell_v.copy()
        cell_v[:, cell] -= ohm * history.current_a
        return cell_v

    return read


def with_offset(errors_v: dict[int, float]) -> Wiring:
    """Return the wiring with constant errors of some cells [V]."""

    def read(history: BankHistory) -> Floats:
        cell_v = history.cell_v.copy()
        for cell, error_v in errors_v.items():
            cell_v[:, cell] += error_v
        return cell_v

    return read


def stuck(cell: int) -> Wiring:
    """Return the wiring with a reading of one cell that is always 3.7 V."""

    def read(history: BankHistory) -> Floats:
        cell_v = history.cell_v.copy()
        cell_v[:, cell] = 3.7
        return cell_v

    return read
