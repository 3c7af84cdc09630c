"""Checks for valid but implausible settings, such as a wrong unit or a wrong number of cells, and the end of the forecast."""

import functools
import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from bms_estimator.estimator.anchor_settings import (
    MAX_EMPTY_SOC,
    MIN_FULL_SOC,
    between_limits,
    soc_at_cutoff,
    soc_at_full,
)
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.fuel_cell import polarisation
from bms_estimator.kernels.observer.records import LEARNABLE
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import FuelCellModel, PackModel
from bms_estimator.settings.alarm_limits import monitored_alarms
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sources.fieldbus import CanSource, ModbusSource


def forecast_end_v(settings: Settings, cell: CellModel) -> float:
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
            raise UserError(
                f"pack.cutoff_v = {pack.cutoff_v:g}: must be below {full_v:.4g} V, the voltage of the full pack"
            )
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
MIN_REST_S = 600.0
"""Duration of a rest after which the voltage is within ``RESTING_V`` of the OCV also after a charge or discharge [s]."""
COUNTED_SOC, COUNTED_V = (0.3, 0.7), 0.15
"""SOC above and below which the counted charge narrows the range no further, and maximum deviation from the OCV there [V].
It includes differences between manufacturers: 0.07 V on the plateau of LFP, 0.1 V for NMC that is charged to 4.35 V."""
MAX_OFFSET_C = 0.02
"""Offset of a current sensor relative to the capacity [1/h], which the counted charge may contain."""
MAX_GAP_S = 120.0
"""Time between two samples from which on the charge between them is unknown [s]."""
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
    return list(
        cell.by_kind(lambda battery: _battery_lines(settings, battery), lambda stack: _stack_lines(settings, stack))
    )


def implausible_measurement(
    cell: PackModel,
    voltage_v: float,
    current_a: float,
    device_ah: float,
    soc_range: tuple[float, float] | None = None,
) -> list[str]:
    """Return one line for each setting of a battery that the values of its device contradict.

    Args:
        cell: Model of the whole pack.
        voltage_v: Voltage of the pack [V]; NaN: unknown.
        current_a: Current [A]; NaN: unknown.
        device_ah: Capacity that the device reports [Ah]; NaN: unknown.
        soc_range: Lowest and highest SOC that the pack can have after its rest; None: it may have been charged or loaded just before.
    """
    return list(_comparison(cell)(voltage_v, current_a, device_ah, soc_range))


def _comparison(cell: PackModel) -> Callable[[float, float, float, tuple[float, float] | None], Iterable[str]]:
    """Return ``_contradictions`` of a pack, with its OCV, which takes most of the time and is computed only once."""
    return cell.by_kind(
        lambda battery: functools.partial(_contradictions, battery, ocv_grid(battery)[0] / battery.cell.series_count),
        lambda _: lambda *_: (),
    )


class Contradictions:
    """Settings that the values of a device contradict, until its values at rest agree with them.

    The first values are compared. Later ones are compared after ``MIN_REST_S`` at rest, in the range of SOC that the charge
    since the first sample leaves, because a pack that was just charged or is empty has another voltage.

    Args:
        cell: Model of the whole pack.

    Attributes:
        texts: One line for each setting, with the values that contradicted it first.
    """

    def __init__(self, cell: PackModel) -> None:
        self._one_c_a, self._compare, self._is_compared, self.texts = (
            cell.one_c_a,
            _comparison(cell),
            False,
            list[str](),
        )
        self._device_ah, self._time_s, self._rest_s, self._soc_range = math.nan, math.nan, 0.0, (0.0, 1.0)

    def add(self, time_s: float, voltage_v: float, current_a: float, device_ah: float) -> list[str]:
        """Compare the values of a sample. Return the lines that are new.

        Args:
            time_s: Time of the sample [s].
            voltage_v: Voltage of the pack [V]; NaN: unknown.
            current_a: Current [A]; NaN: unknown.
            device_ah: Capacity that the device reports [Ah]; NaN: unknown.
        """
        has_first_capacity = math.isnan(self._device_ah) and not math.isnan(device_ah)
        is_first = not math.isnan(voltage_v) and (not self._is_compared or has_first_capacity)
        self._device_ah, before = self._device_ah if math.isnan(device_ah) else device_ah, self.texts
        rests = abs(current_a) <= MAX_RESTING_C * self._one_c_a
        self._count(time_s, current_a, rests=rests)
        compare = functools.partial(self._compare, voltage_v, current_a, self._device_ah)
        later = list(compare(self._soc_range)) if self._rest_s >= MIN_REST_S else []
        if is_first or later or (before and rests):
            self._is_compared, known = True, {"capacity" in text: text for text in before}
            found = {"capacity" in line: line for line in [*compare(None), *later]}
            self.texts = [
                known.get(key, line)
                for key, line in (known | found).items()
                if is_first or (key in found and (key in known or line in later))
            ]
        return [text for text in self.texts if text not in before]

    def _count(self, time_s: float, current_a: float, *, rests: bool) -> None:
        """Change the duration of the rest, and the range of SOC by the charge since the sample before. Reset both after a gap."""
        elapsed_s, self._time_s = time_s - self._time_s, time_s
        change = -current_a * elapsed_s / (3600.0 * self._one_c_a)
        if not 0.0 <= elapsed_s <= MAX_GAP_S or math.isnan(change):
            self._rest_s, self._soc_range = 0.0, (0.0, 1.0)
            return
        changes = change * (1.0 + CAPACITY_TOLERANCE), change / (1.0 + CAPACITY_TOLERANCE)
        drift, (low, high) = MAX_OFFSET_C * elapsed_s / 3600.0, self._soc_range
        self._rest_s = self._rest_s + elapsed_s if rests else 0.0
        self._soc_range = max(low + min(changes) - drift, 0.0), min(high + max(changes) + drift, 1.0)


def _contradictions(
    cell: CellModel,
    ocv_v: Floats,
    voltage_v: float,
    current_a: float,
    device_ah: float,
    soc_range: tuple[float, float] | None,
) -> Iterator[str]:
    """Yield the lines of ``implausible_measurement``. ``ocv_v`` is the OCV of one cell at evenly spaced SOCs 0..1 [V]."""
    capacity_ah, series = cell.cell.capacity_ah, cell.cell.series_count
    if abs(device_ah - capacity_ah) > CAPACITY_TOLERANCE * max(device_ah, capacity_ah):
        yield f"pack.capacity_ah: the pack has {capacity_ah:g} Ah, but its device reports {device_ah:g} Ah"
    low_soc, high_soc = (
        (min(soc_range[0], COUNTED_SOC[0]), max(soc_range[1], COUNTED_SOC[1])) if soc_range else RESTING_SOC
    )
    low_v, mid_v, high_v = np.interp((low_soc, 0.5, high_soc), np.linspace(0.0, 1.0, ocv_v.size), ocv_v)
    rests, cell_v = abs(current_a) <= MAX_RESTING_C * capacity_ah, voltage_v / series
    if soc_range:
        low_v, high_v, state = (
            low_v - COUNTED_V,
            high_v + (COUNTED_V if high_soc <= COUNTED_SOC[1] else ABOVE_FULL_V),
            f"after a rest at an SOC of {low_soc:.2f} to {high_soc:.2f}",
        )
    elif rests:
        low_v, high_v, state = (
            low_v - RESTING_V,
            high_v + RESTING_V,
            "at rest, unless they were just charged or are empty",
        )
    else:
        low_v, high_v, state = ocv_v[0] - BELOW_EMPTY_V, ocv_v[-1] + ABOVE_FULL_V, "under load or charge"
    if not low_v <= cell_v <= high_v and voltage_v > 0.0:
        yield (
            f"pack.series = {series}: {voltage_v:.2f} V are {cell_v:.2f} V a cell, but {cell.cell.name} has {low_v:.2f} to "
            f"{high_v:.2f} V {state}; {round(voltage_v / mid_v)} in series is likely, or another pack.cell"
        )
    elif rests and not soc_range and mid_v >= MIN_OTHER_V and LFP_PLATEAU_V[0] <= cell_v <= LFP_PLATEAU_V[1]:
        yield f"pack.cell: {cell_v:.2f} V a cell is what LFP has at rest, and {cell.cell.name} is nearly empty there"


def _battery_lines(settings: Settings, cell: CellModel) -> Iterator[str]:
    """Yield one line for each implausible setting of a battery."""
    yield from _implausible_cells(settings, cell)
    yield from _end_of_forecast_off_curve(settings, cell)
    yield from _more_cells_than_series(settings, cell)
    yield from _voltage_out_of_range(settings, float(ocv_grid(cell)[0][-1]), "when full")
    yield from _end_voltages_off_curve(settings, cell)
    yield from _current_limits_without_effect(settings, cell)


def _stack_lines(settings: Settings, cell: FuelCellModel) -> Iterator[str]:
    """Yield one line for each implausible setting, and for each setting that a fuel cell ignores."""
    no_load_v, _ = polarisation(cell.a, np.zeros(LEARNABLE), np.zeros(1), np.full(1, np.nan))
    yield from _voltage_out_of_range(settings, float(no_load_v[0]), "at no load")
    if "law" in settings.observer.model_fields_set and settings.observer.law != "learning":
        yield f"observer.law = {settings.observer.law!r}: ignored: a fuel cell ({cell.cell.name}) always has 'learning'"
    if "enabled" in settings.identifier.model_fields_set and settings.identifier.enabled:
        yield f"identifier.enabled = true: ignored: the identifier is of batteries, {cell.cell.name} is a fuel cell"


def _implausible_cells(settings: Settings, cell: CellModel) -> Iterator[str]:
    """Yield a line for each implausible capacity, voltage and number of cells. ``cell`` is the whole pack."""
    pack, c = settings.pack, cell.cell
    capacity_ah, file_series = c.capacity_ah / pack.parallel, c.series_count // pack.series
    cell_v = c.nominal_voltage_v / c.series_count
    if capacity_ah > MAX_CAPACITY_AH:
        section = "cell" if pack.capacity_ah is None else "pack"
        yield f"{section}.capacity_ah = {capacity_ah:g}: no cell holds more than {MAX_CAPACITY_AH:g} Ah; is it in mAh?"
    if pack.series > 1 and file_series > 1:
        yield (
            f"pack.series = {pack.series}: the cell file is of {file_series} cells in series already (series_count), which makes "
            f"{c.series_count}; is the file the whole pack, and series 1?"
        )
    if not PLAUSIBLE_CELL_V[0] <= cell_v <= PLAUSIBLE_CELL_V[1]:
        yield (
            f"{c.nominal_voltage_v:g} V nominal of {c.series_count} in series: {cell_v:.3g} V a cell, but "
            f"Li-ion cells have {PLAUSIBLE_CELL_V[0]:g} to {PLAUSIBLE_CELL_V[1]:g} V; is series_count of the cell file right?"
        )
    if pack.parallel == 1 and c.capacity_ah <= SMALL_CELL_AH and c.series_count > MAX_SINGLE_ROW:
        yield f"{c.series_count} in series of {c.capacity_ah:g} Ah: a single row of small cells; is pack.parallel right?"


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


def _end_of_forecast_off_curve(settings: Settings, cell: CellModel) -> Iterator[str]:
    """Yield a line if the load is switched off while the pack is half full, or where samples are invalid."""
    cutoff_v, ocv_v = forecast_end_v(settings, cell), ocv_grid(cell)[0]
    soc = float(np.interp(cutoff_v, ocv_v, np.linspace(0.0, 1.0, ocv_v.size)))
    if settings.pack.cutoff_v is not None and (soc > MAX_LOAD_CUTOFF_SOC or cutoff_v < cell.cell.voltage_min_v):
        yield (
            f"pack.cutoff_v = {cutoff_v:g}: the OCV of {cell.cell.name} has SOC {soc:.2f} there, and samples below "
            f"{cell.cell.voltage_min_v:.4g} V are dropped as invalid (voltage_min_v); is it the voltage of the whole pack?"
        )


def _more_cells_than_series(settings: Settings, cell: CellModel) -> Iterator[str]:
    """Yield a line if the source reads more cells than are in series."""
    source, series, count = settings.source, cell.cell.series_count, 0
    if isinstance(source, CanSource):
        count = sum(cells.count for cells in source.cells)
    elif isinstance(source, ModbusSource) and source.cells:
        count = source.cells.count
    if count > series:
        yield (
            f"source.cells: {count} cells, but the pack has {series} in series: the others must read 0 V; is pack.series right?"
        )


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


def _voltage_out_of_range(settings: Settings, highest_v: float, when: str) -> Iterator[str]:
    """Yield a line if the board of the project cannot measure the highest voltage of the pack."""
    sensor = settings.sensor
    range_v = CONVERTER_STEPS * sensor.voltage_resolution_v
    if sensor.protocol == "binary" and highest_v > range_v:
        yield (
            f"sensor.voltage_resolution_v = {sensor.voltage_resolution_v:.4g}: the board's range ends at {range_v:.1f} V, "
            f"but this pack has {highest_v:.1f} V {when}; it needs another divider, and its resolution here"
        )
