"""Checks for valid but implausible settings, such as a wrong unit or a wrong number of cells, and the cut-off voltage."""

import math
from collections.abc import Iterator

import numpy as np

from bms_estimator.estimator.anchor_settings import (
    MAX_EMPTY_SOC,
    MIN_FULL_SOC,
    between_limits,
    soc_at_cutoff,
    soc_at_full,
)
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.fuel_cell_open_loop import polarisation
from bms_estimator.kernels.observer.learning_records import LEARNABLE
from bms_estimator.model.cell import CellModel
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import FuelCellModel, PackModel
from bms_estimator.settings.alarm_limits import monitored_alarms
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sources.fieldbus import CanSource, ModbusSource


def load_cutoff_v(settings: Settings, cell: CellModel) -> float:
    """Return the terminal voltage at which the load is switched off and the forecast ends [V].

    It is the first configured value of ``pack.cutoff_v``, ``pack.cutoff_voltage_v``, the limit of the alarm
    ``pack_under_voltage``; otherwise the OCV at SOC 0.

    Args:
        settings: Settings of the pack.
        cell: Model of the whole pack (``CellModel.pack``).

    Raises:
        UserError: ``pack.cutoff_v`` is not below the voltage of the full pack.
    """
    pack, ocv_v = settings.pack, ocv_grid(cell)[0]
    if pack.cutoff_v is not None:
        full_v = float(ocv_v[-1]) if pack.full_voltage_v is None else pack.full_voltage_v
        if pack.cutoff_v >= full_v:
            message = f"must be below {full_v:.4g} V, the voltage of the full pack"
            raise UserError(f"pack.cutoff_v = {pack.cutoff_v:g}: {message}")
        return pack.cutoff_v
    if pack.cutoff_voltage_v is not None:
        return pack.cutoff_voltage_v
    limits_v = (alarm.limit for alarm in monitored_alarms(settings, cell) if alarm.name == "pack_under_voltage")
    return next(limits_v, float(ocv_v[0]))


MAX_CAPACITY_AH = 2000.0
"""Maximum plausible capacity of a cell [Ah]. The largest Li-ion cells on sale have some 1300 Ah."""
PLAUSIBLE_CELL_V = 1.5, 4.5
"""Lowest and highest plausible nominal voltage of a Li-ion cell [V]. Titanate has 2.3 V, NMC 3.7 V."""
SMALL_CELL_AH = 5.5
"""Maximum capacity of a 18650 or 21700 cell [Ah]."""
MAX_SINGLE_ROW = 8
"""Number of cells in series above which cells of up to ``SMALL_CELL_AH`` are rarely used without cells in parallel."""
MAX_LOAD_CUTOFF_SOC = 0.5
"""Maximum plausible SOC of the OCV curve at the cut-off voltage of the load. Inverters of LFP packs switch off at up to 3.2 V per
cell, at which the OCV curve of the generic cell has 0.11."""
CAPACITY_TOLERANCE = 0.2
"""Maximum relative deviation from the capacity that the device reports. A worn pack may have a fifth less than rated."""
MAX_RESTING_C = 0.05
"""Current relative to the capacity [1/h]. Up to it, the voltage is within ``RESTING_V`` of the OCV."""
RESTING_SOC = 0.02, 0.98
"""SOC between which the OCV is compared. Beyond, the curve is steep, and cells leave it soon after a charge or discharge."""
RESTING_V = 0.05
"""Maximum deviation of a resting cell from the OCV [V]: error of a voltage sensor, and relaxation."""
BELOW_EMPTY_V, ABOVE_FULL_V = 0.5, 0.3
"""Margins below the OCV at SOC 0, for a load, and above the OCV at SOC 1, for a charger [V]. Both include differences
between manufacturers."""
LFP_PLATEAU_V = 3.2, 3.36
"""Voltage of a resting LFP cell between SOC 0.15 and 0.95 [V]. Other cells with an OCV above ``MIN_OTHER_V`` are nearly empty there."""
MIN_OTHER_V = 3.5
"""Lowest OCV at SOC 0.5 of cells that are not LFP or LTO [V]."""
CONVERTER_STEPS = 1024
"""Number of steps of the firmware's voltage converter."""


def implausible_settings(settings: Settings, cell: PackModel) -> list[str]:
    """Return one line for each implausible setting, with a possible correction.

    Args:
        settings: Settings of the pack.
        cell: The pack as one two-terminal object (``CellModel.pack``).

    Raises:
        UserError: The cut-off voltage of the load is not below the voltage of the full pack.
    """
    lines = cell.by_kind(lambda battery: _battery_lines(settings, battery), lambda stack: _stack_lines(settings, stack))
    return [line for line in lines if line]


def implausible_measurement(cell: PackModel, voltage_v: float, current_a: float, device_ah: float) -> list[str]:
    """Return one line for each setting of a battery that the first values of its device contradict.

    Args:
        cell: Model of the whole pack.
        voltage_v: Voltage of the pack [V]; NaN: unknown.
        current_a: Current [A]; NaN: unknown.
        device_ah: Capacity that the device reports [Ah]; NaN: unknown.
    """
    return cell.by_kind(
        lambda battery: list(_contradictions(battery, voltage_v, current_a, device_ah)), lambda _: list[str]()
    )


class Contradictions:
    """Settings that the first values of a device contradict, until its values at rest agree with them.

    If the first values agree, later ones are not compared, because a pack that was just charged or is empty has another voltage.

    Args:
        cell: Model of the whole pack.

    Attributes:
        texts: One line for each setting, with the values of the first comparison.
    """

    def __init__(self, cell: PackModel) -> None:
        self._cell, self._device_ah, self._is_compared, self.texts = cell, math.nan, False, list[str]()

    def add(self, voltage_v: float, current_a: float, device_ah: float) -> bool:
        """Compare the values of a sample. Return True for those of the first sample, and the first capacity of the device.

        Args:
            voltage_v: Voltage of the pack [V]; NaN: unknown.
            current_a: Current [A]; NaN: unknown.
            device_ah: Capacity that the device reports [Ah]; NaN: unknown.
        """
        has_first_capacity = math.isnan(self._device_ah) and not math.isnan(device_ah)
        is_first = not math.isnan(voltage_v) and (not self._is_compared or has_first_capacity)
        self._device_ah = self._device_ah if math.isnan(device_ah) else device_ah
        if is_first or (self.texts and abs(current_a) <= MAX_RESTING_C * self._cell.one_c_a):
            lines = implausible_measurement(self._cell, voltage_v, current_a, self._device_ah)
            settings = [line.split()[0] for line in lines]
            self.texts = [text for text in self.texts if (text.split()[0] in settings) != is_first] + lines * is_first
            self._is_compared = True
        return is_first


def _contradictions(cell: CellModel, voltage_v: float, current_a: float, device_ah: float) -> Iterator[str]:
    capacity_ah, series = cell.cell.capacity_ah, cell.cell.series_count
    if abs(device_ah - capacity_ah) > CAPACITY_TOLERANCE * max(device_ah, capacity_ah):
        yield f"pack.capacity_ah: the pack has {capacity_ah:g} Ah, but its device reports {device_ah:g} Ah"
    ocv_v = ocv_grid(cell)[0] / series
    low_v, mid_v, high_v = np.interp((RESTING_SOC[0], 0.5, RESTING_SOC[1]), np.linspace(0.0, 1.0, ocv_v.size), ocv_v)
    rests, cell_v = abs(current_a) <= MAX_RESTING_C * capacity_ah, voltage_v / series
    if rests:
        low_v, high_v = low_v - RESTING_V, high_v + RESTING_V
    else:
        low_v, high_v = ocv_v[0] - BELOW_EMPTY_V, ocv_v[-1] + ABOVE_FULL_V
    if not low_v <= cell_v <= high_v and voltage_v > 0.0:
        state = "at rest, unless they were just charged or are empty" if rests else "under load or charge"
        yield (
            f"pack.series = {series}: {voltage_v:.2f} V are {cell_v:.2f} V a cell, but {cell.cell.name} has {low_v:.2f} to "
            f"{high_v:.2f} V {state}; {round(voltage_v / mid_v)} in series is likely, or another pack.cell"
        )
    elif rests and mid_v >= MIN_OTHER_V and LFP_PLATEAU_V[0] <= cell_v <= LFP_PLATEAU_V[1]:
        yield f"pack.cell: {cell_v:.2f} V a cell is what LFP has at rest, and {cell.cell.name} is nearly empty there"


def _battery_lines(settings: Settings, cell: CellModel) -> Iterator[str | None]:
    """Yield one line for each implausible setting of a battery; None: the setting is plausible."""
    checks = (
        _too_large_capacity,
        _series_counted_twice,
        _implausible_cell_voltage,
        _missing_parallel,
        _implausible_load_cutoff,
        _more_cells_than_series,
    )
    yield from (check(settings, cell) for check in checks)
    yield _voltage_out_of_range(settings, float(ocv_grid(cell)[0][-1]), "when full")
    yield from _end_voltages_off_curve(settings, cell)
    yield from _current_limits_without_effect(settings, cell)


def _stack_lines(settings: Settings, cell: FuelCellModel) -> Iterator[str | None]:
    """Yield one line for each implausible setting, and for each setting that a fuel cell ignores."""
    no_load_v, _ = polarisation(cell.a, np.zeros(LEARNABLE), np.zeros(1), np.full(1, np.nan))
    yield _voltage_out_of_range(settings, float(no_load_v[0]), "at no load")
    if "law" in settings.observer.model_fields_set and settings.observer.law != "learning":
        yield f"observer.law = {settings.observer.law!r}: ignored: a fuel cell ({cell.cell.name}) always has 'learning'"
    if "enabled" in settings.identifier.model_fields_set and settings.identifier.enabled:
        yield f"identifier.enabled = true: ignored: the identifier is of batteries, {cell.cell.name} is a fuel cell"


def _too_large_capacity(settings: Settings, cell: CellModel) -> str | None:
    capacity_ah = cell.cell.capacity_ah / settings.pack.parallel
    section = "cell" if settings.pack.capacity_ah is None else "pack"
    text = f"{section}.capacity_ah = {capacity_ah:g}: no cell holds more than {MAX_CAPACITY_AH:g} Ah; is it in mAh?"
    return text if capacity_ah > MAX_CAPACITY_AH else None


def _series_counted_twice(settings: Settings, cell: CellModel) -> str | None:
    series = settings.pack.series
    file_series = cell.cell.series_count // series  # ``cell`` is the whole pack
    text = (
        f"pack.series = {series}: the cell file is of {file_series} cells in series already (series_count), which makes "
        f"{cell.cell.series_count}; is the file the whole pack, and series 1?"
    )
    return text if series > 1 and file_series > 1 else None


def _implausible_cell_voltage(_: Settings, cell: CellModel) -> str | None:
    cell_v = cell.cell.nominal_voltage_v / cell.cell.series_count
    text = (
        f"{cell.cell.nominal_voltage_v:g} V nominal of {cell.cell.series_count} in series: {cell_v:.3g} V a cell, but "
        f"Li-ion cells have {PLAUSIBLE_CELL_V[0]:g} to {PLAUSIBLE_CELL_V[1]:g} V; is series_count of the cell file right?"
    )
    return None if PLAUSIBLE_CELL_V[0] <= cell_v <= PLAUSIBLE_CELL_V[1] else text


def _missing_parallel(settings: Settings, cell: CellModel) -> str | None:
    c = cell.cell
    is_single_row = settings.pack.parallel == 1 and c.capacity_ah <= SMALL_CELL_AH and c.series_count > MAX_SINGLE_ROW
    text = f"{c.series_count} in series of {c.capacity_ah:g} Ah: a single row of small cells; is pack.parallel right?"
    return text if is_single_row else None


def _end_voltages_off_curve(settings: Settings, cell: CellModel) -> Iterator[str]:
    """Yield a line for the full voltage and for the cut-off voltage of the protection, if they correct no SOC."""
    limits, c = settings.charge_limits, cell.cell
    ocv_v = ocv_grid(between_limits(cell, limits))[0]
    full_soc, empty_soc = soc_at_full(ocv_v, limits), soc_at_cutoff(ocv_v, limits)
    full_v, cutoff_v = limits.full_voltage_v, limits.cutoff_voltage_v
    for key, value_v, soc, is_off, end in (
        ("full", full_v, full_soc, full_soc < MIN_FULL_SOC or (full_v or 0.0) > c.voltage_max_v, -1),
        ("cutoff", cutoff_v, empty_soc, empty_soc > MAX_EMPTY_SOC or (cutoff_v or math.inf) < c.voltage_min_v, 0),
    ):
        if is_off:
            yield (
                f"pack.{key}_voltage_v = {value_v:g}: the OCV of {c.name} has SOC {soc:.2f} there and SOC {-end} at "
                f"{ocv_v[end]:.2f} V, so that the end of a {'charge' if end else 'discharge'} does not correct the SOC; is it the "
                "voltage of the whole pack, and pack.series right? If the pack ends there, make a cell file to this voltage "
                "(bms-estimator ocv)"
            )


def _implausible_load_cutoff(settings: Settings, cell: CellModel) -> str | None:
    cutoff_v, ocv_v = load_cutoff_v(settings, cell), ocv_grid(cell)[0]
    if settings.pack.cutoff_v is None:
        return None
    soc = float(np.interp(cutoff_v, ocv_v, np.linspace(0.0, 1.0, ocv_v.size)))
    if soc <= MAX_LOAD_CUTOFF_SOC and cutoff_v >= cell.cell.voltage_min_v:
        return None
    return (
        f"pack.cutoff_v = {cutoff_v:g}: the OCV of {cell.cell.name} has SOC {soc:.2f} there, and samples below "
        f"{cell.cell.voltage_min_v:.4g} V are dropped as invalid (voltage_min_v); is it the voltage of the whole pack?"
    )


def _more_cells_than_series(settings: Settings, cell: CellModel) -> str | None:
    source, series = settings.source, cell.cell.series_count
    if isinstance(source, CanSource):
        count = sum(cells.count for cells in source.cells)
    else:
        count = source.cells.count if isinstance(source, ModbusSource) and source.cells else 0
    if count <= series:
        return None
    return f"source.cells: {count} cells, but the pack has {series} in series: the others must read 0 V; is pack.series right?"


def _current_limits_without_effect(settings: Settings, cell: CellModel) -> Iterator[str]:
    """Yield a line for each current limit above the limit of an alarm or of the cell file, which then applies."""
    alarms: dict[str, float] = {alarm.name: alarm.limit for alarm in monitored_alarms(settings, cell)}
    for key, alarm in (
        ("max_discharge_a", "discharge_over_current"),
        ("max_charge_a", "charge_over_current"),
        ("tail_current_a", "charge_over_current"),
    ):
        limit_a, alarm_a, file_a = getattr(settings.pack, key), alarms.get(alarm, math.inf), cell.cell.current_max_a
        if limit_a is not None and limit_a > min(alarm_a, file_a):
            lower = f"the alarm {alarm}" if alarm_a < file_a else "valid samples (current_max_a of the cell file)"
            yield (
                f"pack.{key} = {limit_a:g}: above {min(alarm_a, file_a):.4g} A, the limit of {lower}, which applies "
                "instead; is it the current of the whole pack, in A?"
            )


def _voltage_out_of_range(settings: Settings, highest_v: float, when: str) -> str | None:
    sensor = settings.sensor
    range_v = CONVERTER_STEPS * sensor.voltage_resolution_v
    if sensor.protocol != "binary" or highest_v <= range_v:
        return None
    return (
        f"sensor.voltage_resolution_v = {sensor.voltage_resolution_v:.4g}: the board's range ends at {range_v:.1f} V, "
        f"but this pack has {highest_v:.1f} V {when}; it needs another divider, and its resolution here"
    )
