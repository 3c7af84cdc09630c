"""Records of histories in long form, a value of one entity in each row: Home Assistant (CSV, JSON) and InfluxDB (CSV)."""

import itertools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.tables.cell_values import Quantity, find_unit
from bms_estimator.sources.captures.tables.layout_finder import LayoutFinder, shorten_cells
from bms_estimator.sources.captures.tables.text_file import TextFile
from bms_estimator.sources.captures.tables.text_table import (
    MAX_HEADER_CHARACTERS,
    MAX_HEADER_LINES,
    SEPARATORS,
    is_data,
    split_cells,
    unquote,
)


class _Form(NamedTuple):
    """Names of the columns of a long form."""

    value: str
    times: tuple[str, ...]
    """Columns of the time; the first one that is not empty counts."""
    name: str | None = None
    """Column that alone names the entity; None: all other columns do."""


_HOME_ASSISTANT = _Form("state", ("last_updated", "last_changed"), "entity_id")
_COMPRESSED = _Form("s", ("lu", "lc"), "entity_id")
"""Short keys of Home Assistant's WebSocket."""
_FORMS = (
    _HOME_ASSISTANT,
    _Form("_value", ("_time",)),
    _Form("value", ("time",)),
    _Form("Value", ("Time",), "Series"),
)
"""Columns of Home Assistant, InfluxDB 2, InfluxDB 1 and Grafana."""
_UNIT = "unit_of_measurement"
_MEASUREMENTS = ("_measurement", "name")
"""Columns of InfluxDB with the name of the measurement. Home Assistant writes the unit as this name."""
_SAMPLE_QUANTITIES: tuple[Quantity, ...] = ("voltage", "current", "temperature")
_NO_LABELS = frozenset({"", "result", "table", "_start", "_stop", _UNIT})
"""Columns that do not name an entity."""
_JSON_CHARACTERS = 256
"""Number of characters that show whether a file is JSON."""
_JSON = re.compile(r'\s*(?:\[\s*[\[{\]]|\{\s*["}])')
"""Beginning of a JSON list or object. Preambles of cyclers contain lines such as ``[Summary]``."""

Labels = tuple[tuple[str, str], ...]
"""Names and cells of the columns that name an entity."""


class Record(NamedTuple):
    """Value of an entity at a time, as text."""

    labels: Labels
    unit: str
    """Unit; empty if the file states none."""
    time: str
    value: str
    place: str
    """Line or position, for messages."""


class CsvRecords:
    """Records of a text table in long form.

    Args:
        path: The file.
        finder: Contains the column of the time, if the user named one.
        form: Names of the columns.
        header: Cells of the header.
        first_line: Number of the line after the header, counted from 1.
        separator: Separator of columns.

    Attributes:
        description: Kind of the file for messages.
        times: Columns of the time.
        warning: Description of an incomplete last row; empty without one.

    Raises:
        UserError: The table has no column of the time.
    """

    def __init__(
        self, path: Path, finder: LayoutFinder, form: _Form, header: Sequence[str], first_line: int, separator: str
    ) -> None:
        self._path, self._form, self._header = path, form, header
        self._first_line, self._separator, self.warning = first_line, separator, ""
        self.description = f"text, separator {SEPARATORS[separator]}"
        self.times = _time_columns(finder, form)
        if set(self.times).isdisjoint(header):
            raise UserError(f"{path}: no column {self.times[0]} for the time; found {shorten_cells(header)}")

    def __iter__(self) -> Iterator[Record]:
        """Yield the records. InfluxDB writes a header above each of its tables.

        Raises:
            UserError: The file cannot be read, or a row is too short.
        """
        header = self._header
        with TextFile(self._path).open() as text:
            for number, line in enumerate(itertools.islice(text, self._first_line - 1, None), self._first_line):
                if not is_data(line):
                    continue
                cells = _split(line, self._separator)
                if self._form.value in cells and _find_form(cells) == self._form:
                    header = cells
                    continue
                if self.warning:
                    raise UserError(f"{self._path}: {self.warning}")
                if len(cells) < len(header):
                    self.warning = f"line {number}: {len(cells)} values, but the header has {len(header)} columns"
                elif any(cells):
                    cell_by_column = dict(zip(header, cells, strict=False))
                    yield _record(cell_by_column, self._form, self.times, f"line {number}")


class JsonRecords:
    """Records of the JSON of Home Assistant: a list with a history of each entity, or an object with the entities as keys.

    With ``minimal_response`` only the first record of a history names the entity.

    Args:
        path: The file.
        finder: Gives the key of the time, if the user named one.
        text: Content of the file.

    Attributes:
        description: Kind of the file for messages.
        times: Keys of the time.
        warning: Empty.

    Raises:
        UserError: The text is not JSON.
    """

    description, warning = "JSON", ""

    def __init__(self, path: Path, finder: LayoutFinder, text: str) -> None:
        self._path = path
        try:
            self._value = json.loads(text)
        except (ValueError, RecursionError) as error:
            if str(error).startswith("Extra data: line 2"):
                raise UserError(
                    f"{path}: JSON with one object in each line: convert it to a table, for example with jq -r "
                    "'[.time, .current, .voltage] | @csv', and add a line time,current,voltage above"
                ) from None
            raise UserError(f"{path}: JSON damaged or cut short: {error}; export it again") from None
        self._times = {form: _time_columns(finder, form) for form in (_HOME_ASSISTANT, _COMPRESSED)}
        self.times = self._times[_HOME_ASSISTANT]

    def __iter__(self) -> Iterator[Record]:
        """Yield the records.

        Raises:
            UserError: An item is not a record of a history.
        """
        histories = self._value.items() if isinstance(self._value, dict) else enumerate(self._value, 1)
        for key, history in histories:
            labels = {"entity_id": _text(key) if isinstance(key, str) else "", _UNIT: ""}
            for number, item in enumerate(history if isinstance(history, list) else [history], 1):
                yield self._read(item, labels, f"history {_text(key)}, record {number}")

    def _read(self, item: object, labels: dict[str, str], place: str) -> Record:
        """Return the record of an item. Its name and unit, if any, replace those of earlier records in ``labels``."""
        if isinstance(item, dict):
            attributes = item.get("attributes") or item.get("a")
            unit = attributes.get(_UNIT) if isinstance(attributes, dict) else None
            found = {"entity_id": _text(item.get("entity_id")), _UNIT: _text(unit)}
            labels.update((name, text) for name, text in found.items() if text)
            cells = {name: _text(value) for name, value in item.items()} | labels
            for form, times in self._times.items():
                if form.value in cells and labels["entity_id"] and any(map(cells.get, times)):
                    return _record(cells, form, times, place)
        raise UserError(
            f"{self._path}: {place}: has no entity_id, state or last_changed, as Home Assistant's /api/history/period "
            "returns them; "
            "convert other JSON to a table with the columns time, current and voltage"
        )


def open_records(path: Path, finder: LayoutFinder) -> CsvRecords | JsonRecords | None:
    """Return the records of a history; None if the file is neither JSON nor a table in long form.

    A table in which ``finder`` finds a column of each quantity is not in long form.

    Args:
        path: The file.
        finder: Finder of the columns of a table, with the names given by the user.

    Raises:
        UserError: The file cannot be read.
    """
    with TextFile(path).open() as text:
        head = text.read(_JSON_CHARACTERS)
        if _JSON.match(head):
            return JsonRecords(path, finder, head + text.read())
    with TextFile(path).open() as text:
        lines = enumerate((text.readline(MAX_HEADER_CHARACTERS) for _ in range(MAX_HEADER_LINES)), 1)
        number, line = next(((number, line) for number, line in lines if not line or is_data(line)), (0, ""))
    for separator in SEPARATORS:
        header = _split(line, separator)
        form = _find_form(header)
        if form and finder.find(header) is None:
            return CsvRecords(path, finder, form, header, number + 1, separator)
    return None


def _split(line: str, separator: str) -> list[str]:
    return [cell.strip() for cell in split_cells(unquote(line), separator)]


def _text(value: object) -> str:
    """Return a JSON value as text that can be printed; None is empty."""
    return "" if value is None else str(value).encode(errors="replace").decode()


def _find_form(header: Sequence[str]) -> _Form | None:
    """Return the long form whose columns a header has; None without one."""
    present = set(header)
    for form in _FORMS:
        names = {form.name} if form.name else present - _NO_LABELS - {form.value, *form.times}
        if form.value in present and not present.isdisjoint(form.times) and names and names <= present:
            return form
    return None


def _time_columns(finder: LayoutFinder, form: _Form) -> tuple[str, ...]:
    """Return the column of the time that the user named, otherwise those of the form."""
    return (finder.given["time"],) if "time" in finder.given else form.times


def _record(cells: Mapping[str, str], form: _Form, times: Sequence[str], place: str) -> Record:
    """Return the record in the cells of a row."""
    excluded = {form.value, *times, *_NO_LABELS}
    names = [form.name] if form.name else [column for column, cell in cells.items() if cell and column not in excluded]
    measurements = (cells[column] for column in _MEASUREMENTS if column in cells)
    units = (text for text in measurements if any(find_unit(quantity, text) for quantity in _SAMPLE_QUANTITIES))
    return Record(
        labels=tuple((name, cells[name]) for name in names),
        unit=cells.get(_UNIT) or next(units, ""),
        time=next((cells[column] for column in times if cells.get(column)), ""),
        value=cells[form.value],
        place=place,
    )
