"""Replay of a capture as a source, at full speed or paced by its timestamps."""

import asyncio
import itertools
import math
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from pathlib import Path
from typing import Protocol, Self, get_args

import numpy as np

from bms_estimator.model.arrays import (
    NO_PROBES,
    NO_SOC,
    SAMPLE,
    CellBlock,
    CurrentSign,
    Floats,
    ProbeBlock,
    SampleBlock,
)
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.progress import Progress, no_progress
from bms_estimator.protocols.registry import make_protocol
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.captures.capture_records import RECORD_OVERHEAD_BYTES
from bms_estimator.sources.captures.raw_capture import is_capture, read_capture, read_sensor_settings
from bms_estimator.sources.captures.tables.column_tables import ColumnTable
from bms_estimator.sources.captures.tables.current_sign import UserSign
from bms_estimator.sources.captures.tables.layout import ColumnMap
from bms_estimator.sources.captures.tables.table_reader import convert_table, open_table
from bms_estimator.sources.source import ReceivedSamples

PACED_INTERVAL_S = 0.05
"""Interval at which a paced replay yields due samples [s]."""


class Capture(Protocol):
    """Recorded samples. Each iteration starts at the first one."""

    @property
    def fraction(self) -> float:
        """Fraction of the file that has been read, 0..1."""

    @property
    def implausible(self) -> int:
        """Number of implausible readings, which were replaced by NaN."""

    @property
    def cells(self) -> CellBlock:
        """Cell voltages of the last block; empty without any."""

    @property
    def note(self) -> str:
        """Text that says what was guessed about the file; empty if nothing was."""

    @property
    def warning(self) -> str:
        """Contradiction in the file that the user should resolve; empty without one."""

    def __iter__(self) -> Iterator[SampleBlock]:
        """Yield blocks of samples.

        Raises:
            UserError: The file cannot be read.
        """


class RawCapture:
    """Samples of a raw capture, decoded from its bytes.

    Args:
        path: File written by ``CaptureWriter``.
        sensor: Settings of the decoder; None: the settings in the capture's header.
        current_sign: Direction of positive current; None: the direction of ``sensor``.

    Attributes:
        decoder: Decoder that has been fed the bytes read so far.
        damaged: True if the next record is damaged; the rest of the file is not read.
        unread_bytes: Number of bytes of an incomplete record at the end, because of a truncated file or a damaged length.
        note: Empty, because the file describes itself.
        warning: Empty.

    Raises:
        UserError: The file is not a raw capture, or has a later version.
    """

    note = warning = ""

    def __init__(
        self, path: Path, sensor: SensorSettings | None = None, current_sign: CurrentSign | None = None
    ) -> None:
        recorded = read_sensor_settings(path)
        decoder_settings = sensor or recorded
        if decoder_settings.protocol != recorded.protocol:
            raise UserError(
                f"{path}: recorded with protocol {recorded.protocol!r}, but sensor.protocol is {decoder_settings.protocol!r}: "
                f"give settings with protocol {recorded.protocol!r}, or no settings"
            )
        self.decoder = make_protocol(
            decoder_settings.model_copy(update={"current_sign": current_sign or decoder_settings.current_sign})
        )
        self.damaged, self.unread_bytes = False, 0
        self._path = path
        self._read_bytes, self._size = 0, path.stat().st_size

    @property
    def fraction(self) -> float:
        """Fraction that has been read, 0..1. It is too large for a compressed file, because it counts decompressed bytes."""
        return min(self._read_bytes / self._size, 1.0)

    @property
    def implausible(self) -> int:
        """Number of implausible values counted by the decoder."""
        return self.decoder.counters["implausible"]

    @property
    def cells(self) -> CellBlock:
        """Cell voltages of the last block; empty without any."""
        return self.decoder.cells

    @property
    def probes(self) -> ProbeBlock:
        """Temperature probes of the last block; empty without a list of them."""
        return self.decoder.probes

    def __iter__(self) -> Iterator[SampleBlock]:
        """Yield blocks of samples."""
        for batch in read_capture(self._path):
            self._read_bytes += batch.data.size + RECORD_OVERHEAD_BYTES * batch.ends.size
            self.damaged, self.unread_bytes = batch.damaged, batch.unread_bytes
            block = self.decoder.feed_reads(batch.arrivals_s, batch.ends, batch.data)
            if block.size:
                yield block


def no_samples_error(path: object, capture: Capture) -> UserError:
    """Return the error for a capture without a sample. The capture is read again to find the fault of its bytes."""
    for _ in capture:
        pass
    fault = capture.decoder.fault if isinstance(capture, RawCapture) else None
    return UserError(f"{path}: contains no sample" + (f": {fault}" if fault else ""))


class Replay:
    """Source of the samples of a capture; it ends after the last one.

    The estimates do not depend on the division of the samples into blocks.

    Args:
        capture: Capture to replay.
        speed: Speed relative to the recording; None: full speed.
        max_block_s: At full speed, maximum duration of a block on the samples' clock [s].
        monotonic: Monotonic clock [s].

    Attributes:
        samples: Number of samples so far.
        fraction: Fraction of the capture that was replayed, 0..1.
    """

    silence_reason: str | None = None
    """Reason why no samples arrive; None, because a capture always has a next sample or ends."""

    conflict = ""
    """A capture does not record which publisher sent a sample."""

    def __init__(
        self,
        capture: Capture,
        *,
        speed: float | None = None,
        max_block_s: float = math.inf,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self.capture = capture
        self._decoder = capture.decoder if isinstance(capture, RawCapture) else None
        self._speed, self._max_block_s, self._monotonic = speed, max_block_s, monotonic
        self.samples, self.fraction = 0, 0.0

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters of the decoder; for a table the number of rows and of implausible temperatures."""
        if self._decoder:
            return self._decoder.counters
        return {"frames_received": self.samples, "implausible": self.capture.implausible}

    @property
    def board(self) -> Mapping[str, str]:
        """Properties from the board's hello in the capture; empty without one."""
        return self._decoder.board if self._decoder else {}

    @property
    def clock_ppm(self) -> float | None:
        """Rate error of the board's clock when it was recorded [1e-6]; None for a table."""
        return self._decoder.clock_ppm if self._decoder else None

    @property
    def clock_fault(self) -> str:
        """Description of a fault of the device's clock when it was recorded; empty without one and for a table."""
        return self._decoder.clock_fault if self._decoder else ""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        """Do nothing; the file is closed by the iteration."""

    async def __aiter__(self) -> AsyncIterator[ReceivedSamples]:
        """Yield blocks of samples; none of them is empty."""
        async for received in self._unpaced() if self._speed is None else self._paced(self._speed):
            self.samples += received.samples.size
            yield received

    async def _unpaced(self) -> AsyncIterator[ReceivedSamples]:
        for block in self.capture:
            cells, probes = self.capture.cells, self._probes
            before = self.fraction
            for part in _parts(block["time_s"], self._max_block_s):
                self._advance(before, part.stop / block.size)
                yield ReceivedSamples(block[part], cells[part], probes[part], self._device_soc[part])

    @property
    def _probes(self) -> ProbeBlock:
        """Temperature probes of the last block, which only a raw capture has."""
        return self.capture.probes if isinstance(self.capture, RawCapture) else NO_PROBES

    @property
    def _device_soc(self) -> Floats:
        """SOC that the device reported in the last block, which only a raw capture has."""
        return self._decoder.device_soc if self._decoder else NO_SOC

    def _advance(self, before: float, fraction_of_block: float) -> None:
        """Set ``fraction`` within a block, which began at the fraction ``before``."""
        self.fraction = before + (self.capture.fraction - before) * fraction_of_block

    async def _paced(self, speed: float) -> AsyncIterator[ReceivedSamples]:
        """Yield each sample when it is due; the first one immediately."""
        start_s, last_s, elapsed_s = self._monotonic(), math.nan, 0.0
        for block in self.capture:
            due_s = elapsed_s + _elapsed(block["time_s"], last_s)
            first, before = 0, self.fraction
            while first < block.size:
                now_s = speed * (self._monotonic() - start_s)
                end = int(np.searchsorted(due_s, now_s, side="right"))
                if end > first:
                    self._advance(before, end / block.size)
                    part = slice(first, end)
                    yield ReceivedSamples(
                        block[part], self.capture.cells[part], self._probes[part], self._device_soc[part]
                    )
                    first = end
                else:
                    await asyncio.sleep(min((due_s[first] - now_s) / speed + PACED_INTERVAL_S, 1.0))
            last_s, elapsed_s = float(block["time_s"][-1]), float(due_s[-1])


def _parts(time_s: Floats, max_block_s: float) -> Iterator[slice]:
    """Yield slices that divide a block into parts of limited duration."""
    if math.isinf(max_block_s):
        yield slice(0, time_s.size)
        return
    part_number = np.floor(_elapsed(time_s, float(time_s[0])) / max_block_s)
    edges = [0, *(np.flatnonzero(np.diff(part_number)) + 1).tolist(), time_s.size]
    for first, end in itertools.pairwise(edges):
        yield slice(first, end)


def _elapsed(time_s: Floats, last_s: float) -> Floats:
    """Return the time elapsed since ``last_s`` [s]; backward steps and timestamps that are not finite count as 0."""
    steps = np.diff(time_s, prepend=last_s)
    return np.cumsum(np.where(np.isfinite(steps), steps, 0.0).clip(min=0.0))


def open_capture(
    path: Path,
    sensor: SensorSettings | None = None,
    *,
    current_sign: CurrentSign | None = None,
    column_map: ColumnMap | None = None,
) -> Capture:
    """Open a capture. The content of the file shows whether it is a raw capture or a table.

    Args:
        path: The file.
        sensor: Settings that decode a raw capture. If they contain the current sign or the device, their sign also applies to
            a table without one. If None, a raw capture is decoded with the settings in its header.
        current_sign: Direction of positive current, which overrides ``sensor``, header, format and voltage.
        column_map: Columns of a table by quantity; None: recognize them by their names.

    Raises:
        UserError: The file does not exist, is empty, or is neither a table nor a raw capture.
    """
    if not path.is_file():
        raise UserError(f"{path}: {_why_no_file(path)}")
    if path.stat().st_size == 0:
        raise UserError(f"{path}: is empty")
    if is_capture(path):
        return RawCapture(path, sensor, current_sign)
    has_sign = sensor is not None and not sensor.model_fields_set.isdisjoint({"current_sign", "protocol"})
    return open_table(path, UserSign(current_sign, sensor.current_sign if sensor and has_sign else None), column_map)


def _why_no_file(path: Path) -> str:
    """Return the reason why a path is no regular file, as text."""
    if path.is_dir():
        return "is a directory"
    return "is a pipe or a device; give - and redirect it to standard input" if path.exists() else "no such file"


def load_capture(
    source: str | Path | ColumnTable,
    *,
    current_sign: CurrentSign | None = None,
    column_map: ColumnMap | None = None,
) -> Columns:
    """Load all samples of a capture into memory.

    Args:
        source: Path of a raw capture or of a table (docs/cell/captures.md), or a table in memory: a DataFrame, a dict of
            arrays. A table has the columns of this project or of a cycler.
        current_sign: Direction of positive current, ``discharge_positive`` or ``charge_positive``; None: the
            format's direction; if it defines none, the direction that the voltage shows, otherwise discharge.
        column_map: Names of a table's columns for some of ``time``, ``current``, ``voltage`` and ``temperature``, and
            of a spreadsheet's ``sheet``; the others are recognized.

    Returns:
        ``time_s``, ``current_a`` (positive on discharge), ``voltage_v``, ``temperature_c`` (NaN without a sensor),
        ``temperature_min_c``, ``temperature_max_c`` (lowest and highest probe, with one probe equal to ``temperature_c``) and ``status``, bits of ``SampleStatus``. Attributes ``note`` and ``warning`` say what was guessed about a table.

    Raises:
        UserError: The file does not exist or cannot be read, a column is missing, or ``current_sign`` is not valid.
    """
    if current_sign not in (None, *get_args(CurrentSign)):
        raise UserError(f"current_sign = {current_sign!r}: must be one of {', '.join(get_args(CurrentSign))}")
    capture: Capture
    if isinstance(source, str | Path):
        name, capture = Path(source).name, open_capture(Path(source), current_sign=current_sign, column_map=column_map)
    else:
        name, capture = "capture", convert_table(source, UserSign(current_sign), column_map)
    return Columns(read_samples(capture), name, capture.note, capture.warning)


def read_samples(capture: Capture, progress: Progress = no_progress) -> SampleBlock:
    """Return all samples of a capture.

    Args:
        capture: The capture.
        progress: Receives the fraction of the file that has been read.

    Raises:
        UserError: The file cannot be read.
    """
    blocks = []
    for block in capture:
        blocks.append(block.copy())
        progress(capture.fraction)
    return np.concatenate(blocks) if blocks else np.zeros(0, dtype=SAMPLE)
