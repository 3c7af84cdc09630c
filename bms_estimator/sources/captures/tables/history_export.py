"""Reader of histories in long form, such as that of Home Assistant. It chooses the entities of a battery.

Voltage and current change at different times. A sample has the last value of each.
"""

import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bms_estimator.model.arrays import Floats, SampleStatus
from bms_estimator.model.decimal_text import measured
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.tables.cell_values import (
    MAX_TEXT_CHARACTERS,
    SI_UNITS,
    CellKind,
    Quantity,
    Unit,
    find_unit,
    parse_date_time,
)
from bms_estimator.sources.captures.tables.dialects import Dialect
from bms_estimator.sources.captures.tables.history_records import CsvRecords, JsonRecords, Labels, Record
from bms_estimator.sources.captures.tables.layout import Column, ColumnRole, Layout, RawBlock, Role
from bms_estimator.sources.captures.tables.layout_finder import LayoutFinder, shorten_cells, split_given_unit
from bms_estimator.sources.captures.tables.time_base import unix_unit

SETTLE_S = 0.5
"""Maximum time between the voltage and the current of one sample [s], the default of an MQTT source."""
MAX_SILENT_S = 3600.0
"""Maximum pause of both values in which they are repeated [s]. In a longer pause the recording probably stopped."""
MAX_HELD_S = 86_400.0
"""Maximum time for which a value holds while the other one changes [s]."""
REPEAT_PERIODS = 1.5
"""Time without a change after which the values are repeated, in periods of the recording."""
MIN_REPEAT_S = 5.0
"""Minimum interval of repeated values [s], to limit their number. Longer intervals would be gaps in a fast recording."""
PERIOD_QUANTILE = 0.1
"""Quantile of the times between two changes that estimates the period. A value often stays the same for several periods."""
MIN_STEPS = 20
"""Minimum number of steps of the current that determine its period. With fewer, the steps of the voltage count too."""
MIN_PERIOD_S, MAX_PERIOD_S = 0.1, 60.0
"""Range of the period [s]. Longer steps are those of a value that rarely changes."""


class TimedValues(NamedTuple):
    """Values of a quantity at the times at which they changed."""

    time_s: Floats
    """Times [s], increasing."""
    value: Floats
    """Values from these times on; NaN from the time at which the value became unavailable."""

    def index_at(self, times_s: Floats) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """Return the number of changes up to and including each time."""
        return np.searchsorted(self.time_s, times_s, side="right")

    def at(self, times_s: Floats) -> Floats:
        """Return the value at each time; NaN before the first one, and later than ``MAX_HELD_S`` after a change."""
        index = self.index_at(times_s)
        since_s: Floats = np.concatenate([[-np.inf], self.time_s])[index]
        value: Floats = np.concatenate([[np.nan], self.value])[index]
        return np.where(times_s - since_s <= MAX_HELD_S, value, np.nan)


def assemble(voltage: TimedValues, current: TimedValues, temperature: TimedValues | None) -> RawBlock:
    """Return a sample at each change of voltage or current, in the units of the values.

    A voltage and a current within ``SETTLE_S`` of each other belong to one sample. A sample with only a new current is marked as
    having a held voltage. A sample with only a new voltage has the last current. If the next current is recorded within a period,
    the sample is marked as having a held current, because the current may already have changed. An unchanged current is
    repeated, with a held voltage, until one period before its next change, so that its charge counts. There are no samples
    while voltage or current is unavailable, and no repeated ones in a pause longer than ``MAX_SILENT_S``.
    """
    period_s = _period(voltage, current)
    changes_s = _sample_times(voltage, current)
    has_voltage, has_current = (np.diff(series.index_at(changes_s), prepend=0) > 0 for series in (voltage, current))
    repeats_s = _repeat_times(voltage, current, changes_s, period_s)
    time_s = np.concatenate([changes_s, repeats_s])
    absent = np.zeros(repeats_s.size, dtype=bool)
    new_voltage, new_current = (np.concatenate([has, absent]) for has in (has_voltage, has_current))
    next_current = np.append(current.time_s, np.inf)[current.index_at(time_s)]
    status = np.where(new_voltage, 0, SampleStatus.VOLTAGE_HELD)
    status[new_voltage & ~new_current & (next_current - time_s <= period_s)] = SampleStatus.CURRENT_HELD
    block: RawBlock = {
        Role.TIME: time_s,
        Role.VOLTAGE: voltage.at(time_s),
        Role.CURRENT: current.at(time_s),
        Role.STATUS: status.astype(np.float64),
    }
    if temperature is not None:
        block[Role.TEMPERATURE] = temperature.at(time_s)
    order = np.argsort(time_s, kind="stable")
    kept = order[np.isfinite(block[Role.VOLTAGE][order]) & np.isfinite(block[Role.CURRENT][order])]
    return {role: values[kept] for role, values in block.items()}


def _period(voltage: TimedValues, current: TimedValues) -> float:
    """Return the period at which the recorded device measures the current [s]."""
    steps_s = np.diff(current.time_s)
    if steps_s.size < MIN_STEPS:
        steps_s = np.concatenate([steps_s, np.diff(voltage.time_s)])
    period_s = float(np.quantile(steps_s, PERIOD_QUANTILE)) if steps_s.size else MIN_PERIOD_S
    return min(max(period_s, MIN_PERIOD_S), MAX_PERIOD_S)


def _sample_times(voltage: TimedValues, current: TimedValues) -> Floats:
    """Return the times of samples with a change [s]. A change waits up to ``SETTLE_S`` for one of the other quantity."""
    times = []
    for series, other in ((voltage, current), (current, voltage)):
        next_s = np.append(other.time_s, np.inf)[other.index_at(series.time_s)]
        times.append(np.where(next_s - series.time_s <= SETTLE_S, next_s, series.time_s))
    return np.unique(np.concatenate(times))


def _repeat_times(voltage: TimedValues, current: TimedValues, changes_s: Floats, period_s: float) -> Floats:
    """Return the times at which an unchanged current is repeated [s]: at a fixed interval, and a period before it changes."""
    if changes_s.size == 0:
        return changes_s
    before_s, after_s = changes_s[:-1], changes_s[1:]
    before_a = current.at(before_s)
    is_repeated = np.isfinite(before_a) & np.isfinite(voltage.at(before_s)) & (after_s - before_s <= MAX_SILENT_S)
    has_changed = (current.at(after_s) != before_a) | ~np.isfinite(voltage.at(after_s))
    last_s = after_s - period_s
    interval_s = max(REPEAT_PERIODS * period_s, MIN_REPEAT_S)
    counts = np.where(is_repeated, np.ceil((last_s - before_s) / interval_s).clip(min=1.0) - 1.0, 0.0).astype(np.int64)
    # number of each repetition after its change, from 1
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    has_last = is_repeated & has_changed & (last_s - before_s > 0.5 * period_s)
    return np.concatenate([np.repeat(before_s, counts) + number * interval_s, last_s[has_last]])


DIALECT = Dialect("history of entities", time=(), current=(), voltage=())
NAME_COLUMNS = ("entity_id", "_field")
"""Preferred columns for the names of entities, if each entity has a cell of its own there."""
UNAVAILABLE = frozenset({"", "unavailable", "unknown", "none", "null"})
"""States without a value. The value before them ends there."""
WORDS: dict[Quantity, frozenset[str]] = {
    "voltage": frozenset({"voltage", "volt", "volts", "spannung"}),
    "current": frozenset({"current", "amps", "ampere", "amperes", "strom"}),
}
"""Words by which entities without a unit are recognized."""
_WORD = re.compile(r"[^\W\d_]+")


class _Entity:
    """Values of one entity.

    Attributes:
        labels: Names and cells of the columns that identify it.
        unit: Unit as text; empty if the file states none.
        name: Name for messages.
        invalid: Place and text of the first value that is not a number; empty without one.
    """

    def __init__(self, labels: Labels) -> None:
        self.labels, self.unit, self.name, self.invalid = labels, "", "", ""
        self._times, self._values = array("d"), array("d")

    def add(self, record: Record, time: float) -> None:
        """Add a value."""
        self.unit = self.unit or record.unit
        value, text = np.nan, record.value.strip()
        if text.lower() not in UNAVAILABLE:
            try:
                value = measured(text)
            except ValueError:
                self.invalid = self.invalid or f"{record.place}: {text[:MAX_TEXT_CHARACTERS]!r}"
        self._times.append(time)
        self._values.append(value)

    @property
    def times(self) -> Floats:
        """Times in the order of the file."""
        return np.array(self._times)

    @property
    def has_numbers(self) -> bool:
        """True if a value is a number."""
        return bool(np.isfinite(np.array(self._values)).any())

    def timed_values(self, time_unit: Unit) -> TimedValues:
        """Return the values in the order of time; of several values at one time, the last one in the file."""
        times_s = self.times * time_unit.factor
        order = np.argsort(times_s, kind="stable")
        is_last = np.append(np.diff(times_s[order]) > 0.0, True)
        return TimedValues(times_s[order][is_last], np.array(self._values)[order][is_last])

    def looks_like(self, quantity: Quantity) -> bool:
        """Return True if the unit is one of the quantity. Without a unit, a word for the quantity must be in the labels."""
        if self.unit:
            return find_unit(quantity, self.unit) is not None
        words = {word.lower() for _, cell in self.labels for word in _WORD.findall(cell)}
        return not words.isdisjoint(WORDS[quantity])


class HistoryExport:
    """Reader of a history, as one block.

    Args:
        path: The file.
        finder: Names given by the user: the entity of each quantity, and the column with the time.
        records: Records of the file.

    Attributes:
        description: Kind of the file for messages.
        layout: The entities as columns.
        warning: Fault of the file; empty without one.

    Raises:
        UserError: A record is not valid, or it is not clear which entities are voltage and current.
    """

    fraction = 1.0

    def __init__(self, path: Path, finder: LayoutFinder, records: CsvRecords | JsonRecords) -> None:
        self._path, self._given, self.description = path, finder.given, records.description
        self._entities = self._read(records)
        self.warning = records.warning
        pooled = np.concatenate([np.empty(0), *(entity.times for entity in self._entities)])
        time_unit = unix_unit(pooled) or SI_UNITS["time"]
        voltage, current = self._choose("voltage"), self._choose("current")
        temperature = self._choose("temperature") if "temperature" in self._given else None
        columns: dict[ColumnRole, Column] = {
            Role.TIME: Column(0, records.times[-1], SI_UNITS["time"], kind=CellKind.DATE_TIME),
            Role.VOLTAGE: self._column("voltage", voltage),
            Role.CURRENT: self._column("current", current),
            Role.STATUS: Column(0, "status", Unit("")),
        }
        if temperature:
            columns[Role.TEMPERATURE] = self._column("temperature", temperature)
        self.layout = Layout(DIALECT, columns, bool(self._given))
        self._block = assemble(
            voltage.timed_values(time_unit),
            current.timed_values(time_unit),
            temperature.timed_values(time_unit) if temperature else None,
        )
        if not self._block[Role.TIME].size:
            raise UserError(
                f"{path}: {voltage.name} and {current.name} have no values at the same time: export both for the same days"
            )

    def blocks(self) -> Iterator[RawBlock]:
        """Yield all samples."""
        yield self._block

    def _read(self, records: CsvRecords | JsonRecords) -> Sequence[_Entity]:
        """Return the entities that have numbers, and set their names."""
        entities = dict[Labels, _Entity]()
        for record in records:
            try:
                time = _parse_time(record.time)
            except (ValueError, OverflowError):
                cell = record.time[:MAX_TEXT_CHARACTERS]
                raise UserError(
                    f"{self._path}: {record.place}: time = {cell!r}: must be a date and time, year first, or Unix time"
                ) from None
            entity = entities.get(record.labels)
            if entity is None:
                entity = entities[record.labels] = _Entity(record.labels)
            entity.add(record, time)
        numeric = [entity for entity in entities.values() if entity.has_numbers]
        for entity, name in zip(numeric, _names([dict(entity.labels) for entity in numeric]), strict=True):
            entity.name = name
        return numeric

    def _choose(self, quantity: Quantity) -> _Entity:
        """Return the entity of a quantity: the one that the user named, or the only one that looks like it."""
        given = self._given.get(quantity)
        if given is None:
            found, reason = self._find_similar(quantity), f"look like a {quantity}"
        else:
            found, reason = self._by_name(given) or self._by_name(split_given_unit(given)[0]), f"have the name {given}"
        if len(found) != 1:
            raise self._ambiguity_error(f"{len(found) or 'no'} entities {reason}")
        entity = found[0]
        if entity.invalid:
            raise UserError(
                f"{self._path}: {entity.invalid} of {entity.name}: must be a number, unavailable or unknown; "
                "choose other entities by --map"
            )
        return entity

    def _by_name(self, name: str) -> Sequence[_Entity]:
        """Return the entities with a name, or with the name in one of their columns."""
        found = [entity for entity in self._entities if entity.name == name]
        return found or [entity for entity in self._entities if name in dict(entity.labels).values()]

    def _ambiguity_error(self, reason: str) -> UserError:
        """Return the error of an ambiguous or missing entity. It lists the entities and shows the option that chooses one."""
        names = [entity.name for entity in self._entities]
        examples = {"voltage": self._find_similar("voltage"), "current": self._find_similar("current")}
        example = ",".join(
            f"{quantity}={similar[0].name if similar else f'NAME_OF_{quantity.upper()}'}"
            for quantity, similar in examples.items()
        )
        return UserError(
            f"{self._path}: {reason}; entities with numbers: {shorten_cells(names) or 'none'}; name voltage and current as in "
            f'--map "{example}" (in Python: column_map)'
        )

    def _find_similar(self, quantity: Quantity) -> Sequence[_Entity]:
        """Return the entities that look like a quantity."""
        return [entity for entity in self._entities if entity.looks_like(quantity)]

    def _column(self, quantity: Quantity, entity: _Entity) -> Column:
        """Return the column of an entity with its unit.

        Raises:
            UserError: The unit is not one of the quantity.
        """
        given = self._given.get(quantity, entity.name)
        text = (None if self._by_name(given) else split_given_unit(given)[1]) or entity.unit
        unit = find_unit(quantity, text) if text else SI_UNITS[quantity]
        if unit is None:
            raise UserError(
                f"{self._path}: {entity.name}: {text!r} is not a unit of {quantity}; choose another entity by --map, or "
                f'give its unit, as in --map "{quantity}={entity.name} [{SI_UNITS[quantity].symbol}]"'
            )
        return Column(0, entity.name, unit, assumed=not text)


def _parse_time(cell: str) -> float:
    """Return a number or the Unix time of a date with the year first.

    Raises:
        ValueError: The text is neither.
    """
    if cell[:4].isdecimal() and cell[4:5] in ("-", "/"):
        return parse_date_time(cell)
    time = measured(cell)
    if not np.isfinite(time):
        raise ValueError
    return time


def _names(labels: Sequence[Mapping[str, str]]) -> Sequence[str]:
    """Return the name of each entity: its cell in a column without repetitions, otherwise its cells in all differing columns."""
    columns = list(dict.fromkeys(column for each in labels for column in each))
    for column in sorted(columns, key=lambda column: column not in NAME_COLUMNS):
        names = [each.get(column, "") for each in labels]
        if all(names) and len(set(names)) == len(names):
            return names
    differing = [column for column in columns if len({each.get(column) for each in labels}) > 1]
    return [" ".join(each[column] for column in differing if column in each) for each in labels]
