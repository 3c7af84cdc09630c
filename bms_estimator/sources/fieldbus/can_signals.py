"""Decoder from frames of a CAN bus to readings. Its only I/O is reading the DBC file."""

import math
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import cantools
from cantools.database import DecodeError
from cantools.database.can import Database, Message

from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.reading import Reading
from bms_estimator.settings.sources.fieldbus import CanSource, Signal

DECIMALS = 5
"""Number of decimals of values in V, A and degC. Rounding removes errors of binary fractions: 5234 times 0.01 is 52.34."""
MAX_AGE_S = 30.0
"""Maximum age of a value in a reading [s]. Batteries send temperatures and cell voltages only every few seconds."""
MAX_DISTANCE_PERIODS = 3.0
"""Maximum time between voltage and current of one reading, in sample periods."""
MAX_SHOWN_NAMES = 20
"""Maximum number of signal names of a DBC file in an error text."""
MAX_ERROR_CHARACTERS = 300
"""Maximum length of the shown error of a DBC file [characters]."""


class FrameId(NamedTuple):
    """Identifier of the frame that holds a value."""

    id: int
    extended: bool

    def __str__(self) -> str:
        return f"0x{self.id:08X}" if self.extended else f"0x{self.id:03X}"


SignalKey = tuple[str, int]
"""Name of the quantity in ``[source]``, and number of the cell or probe from 0; 0 for other quantities."""


class _Frame(NamedTuple):
    """Frame that contains signals of the settings."""

    message: Message
    signals: list[tuple[SignalKey, Signal]]

    def values(self, data: bytes) -> Iterator[tuple[SignalKey, float | None]]:
        """Yield the values of the signals [V, A, degC]. Signals of another multiplexer value are skipped.

        A value is NaN if the device reports it as absent, and None if ``data`` is too short for its signal.
        """
        decoded = _decode(self.message, data)
        is_multiplexed = bool(decoded) and self.message.is_multiplexed()
        for key, signal in self.signals:
            raw = decoded.get(signal.signal.split(".")[-1])  # without the name of the message
            if raw is None and is_multiplexed:
                continue
            if raw is None:
                yield key, None
                continue
            is_absent = signal.absent is not None and math.isclose(raw, signal.absent)
            value = math.nan if is_absent else raw * signal.scale + signal.offset
            yield key, round(value, DECIMALS) if math.isfinite(value) else math.nan


class CanDecoder:
    """Decoder that assembles readings from the latest values of a bus. The current has the sign of the bus.

    A reading is complete when voltage and current have both been updated. It contains the latest temperature and cells.

    Args:
        settings: Signals of the values.

    Raises:
        UserError: The DBC file cannot be read, or lacks a signal.
    """

    def __init__(self, settings: CanSource) -> None:
        self._frames: dict[FrameId, _Frame] = {}
        database = _load_profile(settings.profile) if settings.dbc is None else _load_dbc(settings.dbc)
        for key, signal in _signals(settings):
            message = _find_message(key[0], signal.signal, database)
            frame_id = FrameId(message.frame_id, message.is_extended_frame)
            self._frames.setdefault(frame_id, _Frame(message, [])).signals.append((key, signal))
        self._probe_count = len(settings.temperature)
        self._cell_count = sum(cells.count for cells in settings.cells)
        self._max_distance_s = min(MAX_DISTANCE_PERIODS * settings.interval_s, MAX_AGE_S)
        self._newest_values: dict[SignalKey, tuple[float, float]] = {}  # arrival time [s] and value
        self._updated_quantities: set[str] = set()
        self._short_frames = self._absent_values = 0

    @property
    def counters(self) -> Mapping[str, int]:
        """Number of frames that are too short for a signal, and of values that the device does not measure, since start."""
        return {"short_frames": self._short_frames, "not_measured": self._absent_values}

    @property
    def frame_ids(self) -> Sequence[FrameId]:
        """Identifiers of the decoded frames."""
        return tuple(self._frames)

    @property
    def missing(self) -> str | None:
        """Signals that are missing for the next reading, as text; None if none is missing."""
        missing = {
            quantity: str(frame_id)
            for frame_id, frame in self._frames.items()
            for (quantity, _), _ in frame.signals
            if quantity in ("voltage", "current") and quantity not in self._updated_quantities
        }
        return ", ".join(f"source.{quantity} (frame {frame_id})" for quantity, frame_id in missing.items()) or None

    def feed(self, arrival_s: float, identifier: int, extended: bool, data: bytes) -> Reading | None:
        """Decode a frame. Return the reading that it completes, if any.

        Args:
            arrival_s: Arrival time, on any clock that never steps back [s].
            identifier: Identifier of the frame.
            extended: True for an identifier of 29 bits.
            data: Content of the frame.
        """
        frame = self._frames.get(FrameId(identifier, extended))
        if frame is None:
            return None
        values = dict(frame.values(data))
        self._short_frames += None in values.values()
        for key, value in values.items():
            if value is None:
                continue
            self._newest_values[key] = arrival_s, value
            self._absent_values += math.isnan(value)
            self._updated_quantities.add(key[0])
        if not {"voltage", "current"} <= self._updated_quantities:
            return None
        self._updated_quantities.clear()
        reading = self._make_reading(arrival_s)
        return None if math.isnan(reading.voltage_v) or math.isnan(reading.current_a) else reading

    def _make_reading(self, now_s: float) -> Reading:
        cells_v = tuple(self._newest_value("cells", now_s, number) for number in range(self._cell_count))
        return Reading(
            self._newest_value("voltage", now_s, max_age_s=self._max_distance_s),
            self._newest_value("current", now_s, max_age_s=self._max_distance_s),
            tuple(self._newest_value("temperature", now_s, number) for number in range(self._probe_count)),
            () if all(map(math.isnan, cells_v)) else cells_v,
            soc=self._newest_value("soc", now_s) / 100.0,
        )

    def _newest_value(self, quantity: str, now_s: float, number: int = 0, max_age_s: float = MAX_AGE_S) -> float:
        """Return the newest value; NaN if it is missing or too old."""
        arrival_s, value = self._newest_values.get((quantity, number), (-math.inf, math.nan))
        return value if now_s - arrival_s <= max_age_s else math.nan


def _signals(settings: CanSource) -> Iterator[tuple[SignalKey, Signal]]:
    """Yield all signals of the settings."""
    yield ("voltage", 0), settings.voltage
    yield ("current", 0), settings.current
    yield from ((("temperature", number), signal) for number, signal in enumerate(settings.temperature))
    if settings.soc is not None:
        yield ("soc", 0), settings.soc
    cell_signals = [signal for group in settings.cells for signal in group.cell_signals()]
    yield from ((("cells", number), signal) for number, signal in enumerate(cell_signals))


def _load_profile(profile: str | None) -> Database:
    """Load the DBC file of a profile, which settings without ``dbc`` always have."""
    database = Database()
    database.add_dbc_string((resources.files("bms_estimator.sources.fieldbus") / f"{profile}.dbc").read_text())
    return database


def _load_dbc(path: Path) -> Database:
    """Load the DBC file of the settings.

    Raises:
        UserError: The file cannot be read, or defines no frames.
    """
    try:
        loaded = cantools.database.load_file(path)
    except OSError as error:
        raise UserError(f"source.dbc = {path}: cannot be read: {error.strerror}") from None
    except (cantools.Error, ValueError) as error:
        raise UserError(f"source.dbc = {path}: {str(error)[:MAX_ERROR_CHARACTERS]}") from None
    if not isinstance(loaded, Database):
        raise UserError(f"source.dbc = {path}: it describes no frames of a CAN bus")
    return loaded


def _find_message(quantity: str, signal: str, database: Database) -> Message:
    """Return the message that contains a signal.

    Raises:
        UserError: No message contains the signal, or several do.
    """
    *message_name, name = signal.split(".")
    matches = [
        message
        for message in database.messages
        if (not message_name or message.name == message_name[0]) and name in (s.name for s in message.signals)
    ]
    if len(matches) == 1:
        return matches[0]
    if matches:
        reason = f"several messages have it: write {' or '.join(f'{message.name}.{name}' for message in matches)}"
    else:
        signal_names = sorted(s.name for message in database.messages for s in message.signals)
        shown = ", ".join(signal_names[:MAX_SHOWN_NAMES]) + (
            f" and {len(signal_names) - MAX_SHOWN_NAMES} more" if len(signal_names) > MAX_SHOWN_NAMES else ""
        )
        reason = f"the DBC file has no such signal; it has {shown or 'none'}"
    raise UserError(f"source.{quantity}: signal = {signal!r}: {reason}")


def _decode(message: Message, data: bytes) -> Mapping[str, float]:
    """Return the values by name in the units of the DBC file. Signals beyond a short frame are omitted."""
    try:
        values = message.decode(data, decode_choices=False, allow_truncated=True)
    except (DecodeError, ValueError, KeyError):
        return {}
    return (
        {name: float(value) for name, value in values.items() if isinstance(value, int | float)}
        if isinstance(values, dict)
        else {}
    )
