"""Definitions of the alarms of a type of packs, as records for the kernels."""

from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.alarms import BROKEN_WIRE_V, LIMITS, NAMES, SETTINGS
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.settings.alarm_limits import AlarmDefinition, min_charge_current_a, monitored_alarms
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.alarms.estimate_alarms import MODEL_SUSPECTS
from bms_estimator.telemetry.alarms.evaluator import SENSOR_SUSPECTS
from bms_estimator.telemetry.alarms.inputs import QUANTITIES
from bms_estimator.telemetry.impossible import PackBounds


class AlarmDefinitions(NamedTuple):
    """Alarms that a worker evaluates for the packs of a type."""

    by_position: dict[int, AlarmDefinition]
    """Definition of each monitored alarm by its position in ``kernels.alarms.NAMES``."""
    limits: NDArray[np.void]
    """Shape (number of ``NAMES``,), dtype ``kernels.alarms.LIMITS``."""
    settings: NDArray[np.void]
    """Shape (1,), dtype ``kernels.alarms.SETTINGS``."""
    bounds: PackBounds

    @classmethod
    def of(cls, settings: Settings, model: PackModel, gap_s: float) -> Self:
        """Return the definitions for settings and model of a whole pack.

        Args:
            settings: Settings of the pack.
            model: Model of the whole pack.
            gap_s: Minimum length of a gap between samples [s].

        Raises:
            UserError: A clear level lies beyond its limit.
        """
        monitored = {each.name: each for each in monitored_alarms(settings, model)}
        by_position = {k: monitored[name] for k, name in enumerate(NAMES) if name in monitored}
        limits, bounds = np.zeros(len(NAMES), LIMITS), PackBounds.of(model)
        for k, each in by_position.items():
            needs = sum(1 << QUANTITIES.index(name) for name in each.kind.needs)
            sign = 1.0 if each.kind.is_upper_limit else -1.0
            numbers = (each.limit, each.clear, each.delay_s, each.clear_delay_s)
            limits[k] = (1, each.severity == "critical", sign, *numbers, needs)
        broken_v, n = BROKEN_WIRE_V * bounds.series, bounds.series

        def limit(name: str, default: float) -> float:
            return monitored[name].limit if name in monitored else default

        values: dict[str, Any] = {
            "gap_s": gap_s,
            "lost_s": settings.alarms.lost_s,
            "charging_a": min_charge_current_a(model),
            "series": n,
            "max_a": bounds.max_a,
            "range_a": bounds.range_a,
            "low_v": bounds.range_v[0],
            "high_v": bounds.range_v[1],
            "wire_v": limit("pack_under_voltage", broken_v),
            "wire_low_cell_v": limit("cell_under_voltage", BROKEN_WIRE_V),
            "wire_high_cell_v": limit("cell_over_voltage", np.inf),
        }
        values |= {"sensor_suspects": int(SENSOR_SUSPECTS), "model_suspects": int(MODEL_SUSPECTS)}
        record = np.zeros(1, SETTINGS)
        for name, value in values.items():
            record[name] = value
        return cls(by_position, limits, record, bounds)
