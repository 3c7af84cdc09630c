"""Monitored alarms, derived from ``[alarms]`` and the cell: limits, and levels at which the alarms end.

The sources of the default limits are in docs/pack/alarms.md.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Literal, NamedTuple

from bms_estimator.model.cell import CellModel
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import FuelCellModel, PackModel
from bms_estimator.settings.alarm_kinds import ALARM_KINDS, AlarmKind
from bms_estimator.settings.alarms import ALARMS, AlarmName, AlarmRule
from bms_estimator.settings.false_alarm_limits import (
    DEFAULT_WEAK_CELL_FALSE_ALARMS_PER_MONTH,
    collapse_limit,
    weak_cell_limit,
)
from bms_estimator.settings.pack import PackSettings, Settings

MIN_SILENT_LIMIT_S = 10.0
"""Minimum default limit of ``link_lost`` [s]."""
SILENT_PERIODS = 3
"""Default limit of ``link_lost`` as a multiple of the sample period or the publish period, whichever is longer."""


class AlarmDefinition(NamedTuple):
    """Limits and delays of a monitored alarm."""

    name: AlarmName
    severity: Literal["warning", "critical"]
    limit: float
    clear: float
    """Level at which the alarm ends; equal to ``limit`` without hysteresis."""
    delay_s: float
    clear_delay_s: float
    latch: bool

    @property
    def kind(self) -> AlarmKind:
        """Properties of this alarm that are equal for all packs."""
        return ALARM_KINDS[self.name]


STATE_LOST = AlarmDefinition("alarm_state_lost", "critical", 1.0, 1.0, 0.0, 0.0, latch=True)
"""Alarm that replaces lost alarms of earlier runs. It has no settings, so that it cannot be switched off. Its limit has no
meaning."""


class VoltageLimits(NamedTuple):
    """Default voltage limits of a cell [V], and the levels at which their alarms end [V]."""

    over_v: float
    over_clear_v: float
    under_v: float
    under_clear_v: float
    steep_v: float
    """Voltage of the highest cell from which the cells are not compared [V]; infinite: they always are. At the steep end of a charge
    balanced LFP cells differ by more than the limit of ``cell_imbalance``. Below 3.38 V they do not, because the flat part of the
    OCV curve before it has 3.34 V."""


_VOLTAGE_LIMITS = (
    # over_v, over_clear_v, under_v, under_clear_v, steep_v
    (2.8, VoltageLimits(2.85, 2.70, 1.60, 1.90, math.inf)),  # LTO: charged to 2.7..2.8 V, empty at 1.5 V
    (3.45, VoltageLimits(3.65, 3.40, 2.70, 3.10, 3.38)),  # LFP: factory settings of the Seplos BMS 3.0
    (math.inf, VoltageLimits(4.25, 4.15, 2.70, 3.00, math.inf)),  # all chemistries that are charged to 4.2 V
)
"""Pairs of a maximum nominal voltage of a cell [V] and the limits of cells up to this nominal voltage. The first pair that
matches applies."""

MIN_CHARGE_C = 0.02
"""Minimum charge current as a C-rate [1/h]. A smaller current may be the sensor's offset."""
CLEAR_DECIMALS = 9
"""Number of decimals to which clear levels are rounded, so that 0.1 - 0.08 gives 0.02."""
MAX_DISCHARGE_C = 5.0
"""Default limit of the discharge current as a C-rate [1/h]. ``current_max_a`` of a generic cell file would be too high a
default: it only rejects invalid samples, and lies far above the continuous current of most cells."""
COLLAPSE_CLEAR_FRACTION = 0.5
"""Clear level of ``collapse_risk`` as a fraction of its limit."""
WEAK_CELL_STD = weak_cell_limit(DEFAULT_WEAK_CELL_FALSE_ALARMS_PER_MONTH)
"""Default limit of ``weak_cell``: deviation of a discharge from the bank's reference [std]. A discharge
that exceeds it does not become part of the reference."""
WEAK_CELL_CLEAR_FRACTION = 0.5
"""Clear level of ``weak_cell`` as a fraction of its limit."""
CURRENT_CLEAR_FRACTION = 0.95
"""Default clear level of a current as a fraction of its limit."""


MIN_CELLS = 3
"""Minimum number of cells that are compared with each other. With two cells nothing shows which one deviates."""
MIN_SHORT_C = 1 / 30_000
"""Default limit of the self-discharge of a cell above that of the others, as a C-rate [1/h]: 2.4 % a month."""
MIN_READING_ERROR_V = 0.01
"""Default limit of the error of a cell's reading [V]: ten steps of the usual converter."""
BALANCING_BELOW_V = 0.25
"""Distance below the default limit of ``cell_over_voltage`` from which balancers are usually active [V]: 3.40 V for LFP,
4.00 V for cells that are charged to 4.2 V."""


PLAUSIBLE_TEMPERATURES_C: Mapping[AlarmName, tuple[float, float]] = {
    "over_temperature": (30.0, 120.0),
    "under_temperature": (-60.0, 40.0),
}
"""Ranges of plausible limits [degrees Celsius]."""
LONG_DELAY_S = 3600.0
"""Delay of a critical alarm above which a warning is given [s]."""


class _Default(NamedTuple):
    """Default limit and clear level of an alarm."""

    limit: float | None
    """None: the alarm is not monitored unless a limit is configured."""
    clear: float | None
    """Level at which the alarm ends; None: equal to the limit."""


_UNMONITORED = _Default(None, None)


def monitored_alarms(settings: Settings, cell: PackModel) -> tuple[AlarmDefinition, ...]:
    """Return the monitored alarms of a pack, in the order of ``ALARMS``.

    Args:
        settings: Settings of the pack.
        cell: Model of the whole pack (``CellModel.pack``).

    Raises:
        UserError: A clear level lies beyond its limit.
    """
    defaults = _defaults(settings, cell)
    configured = (name for name in ALARMS if name != STATE_LOST.name)
    definitions = (_definition(name, getattr(settings.alarms, name), defaults[name]) for name in configured)
    return (*(each for each in definitions if each is not None), STATE_LOST)


def short_limit_a(settings: Settings, cell: PackModel) -> float:
    """Return the limit of the alarm ``cell_short`` [A]; infinite if it is not monitored."""
    return next((each.limit for each in monitored_alarms(settings, cell) if each.name == "cell_short"), math.inf)


def silent_limit_s(settings: Settings) -> float:
    """Return the time without a sample after which ``link_lost`` is raised and no other alarm is monitored [s]."""
    rule = settings.alarms.link_lost
    return (rule.limit_s or _default_silent_limit_s(settings)) + rule.delay_s


def _default_silent_limit_s(settings: Settings) -> float:
    return max(
        MIN_SILENT_LIMIT_S, SILENT_PERIODS * max(1.0 / settings.publish.rate_hz, settings.sensor.sample_period_s)
    )


def min_charge_current_a(cell: PackModel) -> float:
    """Return the minimum current that counts as charging [A]."""
    return MIN_CHARGE_C * cell.one_c_a


def balancing_voltage_v(cell: PackModel) -> float:
    """Return the cell voltage from which a balancer may be active [V].

    Args:
        cell: Model of the whole pack.
    """
    return voltage_limits(cell).over_v - BALANCING_BELOW_V


def implausible_limits(settings: Settings, cell: PackModel) -> list[str]:
    """Return a warning for each implausible limit, and for each long delay of a critical alarm."""
    return list(_implausible_limits(monitored_alarms(settings, cell), cell))


def _implausible_limits(alarms: tuple[AlarmDefinition, ...], cell: PackModel) -> Iterator[str]:
    c = cell.cell
    n, nominal_v = c.series_count, c.nominal_voltage_v
    ranges = {
        "pack_over_voltage": (nominal_v, c.voltage_max_v),
        "pack_under_voltage": (c.voltage_min_v, nominal_v),
        "cell_over_voltage": (nominal_v / n, c.voltage_max_v / n),
        "cell_under_voltage": (c.voltage_min_v / n, nominal_v / n),
        "discharge_over_current": (0.0, c.current_max_a),
        "charge_over_current": (0.0, c.current_max_a),
        **PLAUSIBLE_TEMPERATURES_C,
        "cell_imbalance": (0.001, 1.0),
    }
    for alarm in alarms:
        low, high = ranges.get(alarm.name, (-math.inf, math.inf))
        if not low <= alarm.limit <= high:
            unit = alarm.kind.unit or ""
            hint = (
                f"the plausible range; is the value in {'mV' if unit == 'V' else 'degrees Fahrenheit'}?"
                if alarm.name in (*PLAUSIBLE_TEMPERATURES_C, "cell_imbalance")
                else "the range of the cell file; is the value for one cell instead of the pack, or the reverse?"
            )
            key = f"alarms.{alarm.name}.limit_{unit[-1:].lower()}"  # limit_v, limit_a or limit_c
            yield f"{key} = {alarm.limit:g}: outside {low:.4g} to {high:.4g} {unit}, {hint}"
        if alarm.severity == "critical" and alarm.delay_s > LONG_DELAY_S:
            yield (
                f"alarms.{alarm.name}.delay_s = {alarm.delay_s:g}: this critical alarm is raised only if its cause lasts "
                "longer than an hour"
            )


def _definition(name: AlarmName, rule: AlarmRule, default: _Default) -> AlarmDefinition | None:
    """Return the monitored alarm; None if it is switched off or has no limit."""
    configured, kind = rule.model_dump(exclude_none=True), ALARM_KINDS[name]
    # limit_v, limit_a, limit_c, limit_s or limit, depending on the rule; ``hook_failed`` has none
    key = next((key for key in type(rule).model_fields if key.startswith("limit")), "limit")
    limit = configured.get(key, default.limit)
    if not rule.enabled or limit is None:
        return None
    hysteresis = 0.0 if default.clear is None or default.limit is None else default.clear - default.limit
    clear_key = key.replace("limit", "clear")
    clear = configured.get(clear_key, round(limit + hysteresis, CLEAR_DECIMALS))
    if (clear > limit) if kind.is_upper_limit else (clear < limit):
        beyond = "above" if kind.is_upper_limit else "below"
        raise UserError(
            f"alarms.{name}.{clear_key} = {clear:g}: must not be {beyond} {key} = {limit:g}, which raises the alarm"
        )
    delay_s = rule.delay_s
    if name == "link_lost":  # its value is the time without a sample, so that a delay is the same as a higher limit
        limit, clear, delay_s = limit + delay_s, clear + delay_s, 0.0
    return AlarmDefinition(name, rule.severity, limit, clear, delay_s, rule.clear_delay_s, rule.latch)


def _defaults(settings: Settings, cell: PackModel) -> dict[AlarmName, _Default]:
    n = cell.cell.series_count
    all_packs: dict[AlarmName, _Default] = {
        "over_temperature": _Default(60.0, 55.0),
        "under_temperature": _Default(-20.0, -15.0),
        "charging_below_freezing": _Default(0.0, 2.0),
        "soc_low": _Default(0.1, 0.15),
        "collapse_risk": _collapse_default(settings),
        "stability_margin_low": _Default(0.05, 0.08),
        "cell_imbalance": _Default(0.05, 0.03),
        "weak_cell": _weak_cell_default(settings) if n > 1 else _UNMONITORED,
        "sensor_fault": _Default(0.1, 0.02),
        "model_mismatch": _Default(0.05 * n, 0.03 * n),
        "link_lost": _Default(_default_silent_limit_s(settings), None),
        # the value is infinite after a failure, otherwise 0
        "hook_failed": _Default(1.0 if settings.alarms.hook else None, 1.0),
    }
    return all_packs | cell.by_kind(lambda battery: _battery_defaults(settings.pack, battery), _stack_defaults)


def _collapse_default(settings: Settings) -> _Default:
    """Return the limit for the accepted rate of false alarms. Without a forecast the alarm is not monitored."""
    if not settings.identifier.enabled:
        return _UNMONITORED
    limit = collapse_limit(settings.alarms.collapse_risk.false_alarms_per_month)
    return _Default(limit, COLLAPSE_CLEAR_FRACTION * limit)


def _weak_cell_default(settings: Settings) -> _Default:
    """Return the limit for the accepted rate of false alarms."""
    limit = weak_cell_limit(settings.alarms.weak_cell.false_alarms_per_month)
    return _Default(limit, WEAK_CELL_CLEAR_FRACTION * limit)


def voltage_limits(cell: PackModel) -> VoltageLimits:
    """Return the default voltage limits of a cell of a pack."""
    nominal_v = cell.cell.nominal_voltage_v / cell.cell.series_count
    return next(limits for max_nominal_v, limits in _VOLTAGE_LIMITS if nominal_v < max_nominal_v)


def _battery_defaults(pack: PackSettings, cell: CellModel) -> dict[AlarmName, _Default]:
    c, n = cell.cell, cell.cell.series_count
    v = voltage_limits(cell)
    short_a = MIN_SHORT_C * c.capacity_ah
    can_compare = n >= MIN_CELLS
    # most cells are charged at one C or less
    charge_a = min(pack.max_charge_a or c.capacity_ah, c.current_max_a)
    discharge_a = min(pack.max_discharge_a or MAX_DISCHARGE_C * c.capacity_ah, c.current_max_a)
    return {
        "pack_over_voltage": _Default(n * v.over_v, n * v.over_clear_v),
        "pack_under_voltage": _Default(n * v.under_v, n * v.under_clear_v),
        "cell_over_voltage": _Default(v.over_v, v.over_clear_v),
        "cell_under_voltage": _Default(v.under_v, v.under_clear_v),
        "discharge_over_current": _Default(discharge_a, CURRENT_CLEAR_FRACTION * discharge_a),
        "charge_over_current": _Default(charge_a, CURRENT_CLEAR_FRACTION * charge_a),
        "cell_short": _Default(short_a, 0.5 * short_a) if can_compare else _UNMONITORED,
        "cell_sensor_fault": _Default(MIN_READING_ERROR_V, 0.5 * MIN_READING_ERROR_V) if can_compare else _UNMONITORED,
    }


def _stack_defaults(cell: FuelCellModel) -> dict[AlarmName, _Default]:
    """Return the defaults of a fuel cell, which has neither SOC nor cell voltages and must not be charged."""
    c = cell.cell
    return {
        "pack_over_voltage": _Default(c.voltage_max_v, 0.98 * c.voltage_max_v),
        "pack_under_voltage": _Default(c.voltage_min_v, 1.1 * c.voltage_min_v),
        "cell_over_voltage": _UNMONITORED,
        "cell_under_voltage": _UNMONITORED,
        "cell_short": _UNMONITORED,
        "cell_sensor_fault": _UNMONITORED,
        "discharge_over_current": _Default(c.current_max_a, CURRENT_CLEAR_FRACTION * c.current_max_a),
        "charge_over_current": _UNMONITORED,
        "charging_below_freezing": _UNMONITORED,
        "soc_low": _UNMONITORED,
        "stability_margin_low": _UNMONITORED,
        "weak_cell": _UNMONITORED,
        "collapse_risk": _UNMONITORED,
        "over_temperature": _Default(90.0, 85.0),
    }
