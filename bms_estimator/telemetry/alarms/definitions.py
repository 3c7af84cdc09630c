"""Definitions of a pack's alarms as records of the kernels, and the kernel with its buffers."""

from collections.abc import Iterable
from typing import Any, NamedTuple, Self, get_args

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.kernels.alarms.evaluate import evaluate
from bms_estimator.kernels.alarms.records import EVALUATION_IO, LIMITS, LOG, NAMES, SAMPLE_ALARMS, SETTINGS
from bms_estimator.kernels.alarms.values import BROKEN_WIRE_V
from bms_estimator.model.arrays import Floats
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.pack_model import PackModel
from bms_estimator.model.sample import CellBlock, SampleBlock
from bms_estimator.settings.alarm_kinds import Quantity
from bms_estimator.settings.alarm_limits import AlarmDefinition, min_charge_current_a, voltage_limits
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.impossible import PackBounds

QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
"""All measured quantities, by their positions in the kernels."""
SENSOR_SUSPECTS = (
    InputFault.SIGN_OF_CURRENT | InputFault.OFFSET | InputFault.OUTLIERS | InputFault.VOLTAGE | InputFault.CURRENT
)
"""Input faults that raise ``sensor_fault``."""
MODEL_SUSPECTS = InputFault.CAPACITY | InputFault.OCV
"""Input faults that raise ``model_mismatch``."""
UNKNOWN_RISK = np.full(1, np.nan)
"""Probability of a cut-off for a pack without forecasts."""
_MAX_CHANGES_PER_SAMPLE = len(NAMES)
"""Maximum number of changes by a sample and its estimate."""


class AlarmDefinitions(NamedTuple):
    """Alarms of a pack."""

    by_position: dict[int, AlarmDefinition]
    """Definition of each monitored alarm by its position in ``NAMES``."""
    limits: NDArray[np.void]
    """Shape (number of ``NAMES``,), dtype ``LIMITS``."""
    settings: NDArray[np.void]
    """Shape (1,), dtype ``SETTINGS``."""
    bounds: PackBounds

    @classmethod
    def of(cls, definitions: Iterable[AlarmDefinition], settings: Settings, model: PackModel, gap_s: float) -> Self:
        """Return the definitions for settings and model of a whole pack.

        Args:
            definitions: The monitored alarms.
            settings: Settings of the pack.
            model: Model of the whole pack.
            gap_s: Minimum length of a gap between samples [s].
        """
        by_position = {NAMES.index(each.name): each for each in definitions}
        limits, bounds = np.zeros(len(NAMES), LIMITS), PackBounds.of(model)
        for k, each in by_position.items():
            needs = sum(1 << QUANTITIES.index(name) for name in each.kind.needs)
            sign = 1.0 if each.kind.is_upper_limit else -1.0
            numbers = (each.limit, each.clear, each.delay_s, each.clear_delay_s)
            limits[k] = (1, each.severity == "critical", sign, *numbers, needs, each.latch)
        limit_of = {each.name: each.limit for each in by_position.values()}
        broken_v, n = BROKEN_WIRE_V * bounds.series, bounds.series
        values: dict[str, Any] = {
            "gap_s": gap_s,
            "lost_s": settings.alarms.lost_s,
            "charging_a": min_charge_current_a(model),
            "series": n,
            "max_a": bounds.max_a,
            "range_a": bounds.range_a,
            "low_v": bounds.range_v[0],
            "high_v": bounds.range_v[1],
            "wire_v": limit_of.get("pack_under_voltage", broken_v),
            "wire_low_cell_v": limit_of.get("cell_under_voltage", BROKEN_WIRE_V),
            "wire_high_cell_v": limit_of.get("cell_over_voltage", np.inf),
            "steep_v": voltage_limits(model).steep_v,
            "sensor_suspects": int(SENSOR_SUSPECTS),
            "model_suspects": int(MODEL_SUSPECTS),
        }
        record = np.zeros(1, SETTINGS)
        for name, value in values.items():
            record[name] = value
        return cls(by_position, limits, record, bounds)


class EvaluationKernel:
    """Kernel that evaluates the alarms, with its buffers.

    Attributes:
        io: Further inputs of the kernel, and its results, shape (1,), dtype ``EVALUATION_IO``.
        log: Buffer of the changes, dtype ``LOG``; ``entries`` returns those since the last call of ``clear``.
    """

    def __init__(self) -> None:
        self.io, self.log = np.zeros(1, EVALUATION_IO), np.zeros(_MAX_CHANGES_PER_SAMPLE, LOG)
        for name in ("cells_at_s", "short_a", "reading_v", "weak_cell_std"):
            self.io[name] = np.nan
        self._scratch = np.zeros((6, SAMPLE_ALARMS))  # rows that the kernel requires

    def run(
        self,
        alarms: NDArray[np.void],
        definitions: AlarmDefinitions,
        estimator: NDArray[np.void],
        samples: SampleBlock,
        cells_v: CellBlock,
        trace: TraceBlock,
        cutoff_risk: Floats = UNKNOWN_RISK,
    ) -> bool:
        """Evaluate all alarms with buffers that are long enough.

        ``kernels.alarms.evaluate`` describes arguments and result.
        """
        if self._scratch.shape[1] < samples.size:
            self._scratch = np.zeros((6, samples.size))
        rows = int(self.io["logged"][0]) + _MAX_CHANGES_PER_SAMPLE * (
            samples.size + 1
        )  # + 1: alarms evaluated once a call
        if self.log.size < rows:
            self.log = np.concatenate((self.entries, np.empty(rows, LOG)))
        return evaluate(
            alarms,
            definitions.limits,
            definitions.settings,
            self.io,
            estimator,
            samples,
            np.ascontiguousarray(cells_v),
            trace,
            cutoff_risk,
            self._scratch,
            self.log,
        )

    @property
    def entries(self) -> NDArray[np.void]:
        """Changes since the last call of ``clear``, oldest first, dtype ``LOG``."""
        return self.log[: int(self.io["logged"][0])]

    def clear(self) -> None:
        """Remove all changes."""
        self.io["logged"] = 0
