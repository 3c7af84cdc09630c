"""Re-identify a pack from its stored samples, and judge the result on samples that had no part in it.

Two thirds of the samples, the earlier ones, go to two ways of finding the cell: what the estimator's filter has learned of
it by their end, and from there the fit of ``calibration.elements.identify`` to their longest piece without a gap. The last third
judges: open loop, the voltage that each cell predicts from the current, for hours at a time, against the measured one.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from bms_estimator.calibration.elements.identify import identify
from bms_estimator.calibration.validate import validate
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import identified_cell
from bms_estimator.fleet.packs.pack_row import PackSpec, cell_of, settings_of
from bms_estimator.kernels.cell_model.chen_mora import r_s
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.cell_file import cell_text
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock
from bms_estimator.settings.sampling import Sampling

TRAINING = 2.0 / 3.0
"""Fraction of the time whose samples identify; the others judge."""
MIN_S = 6 * 3600.0
"""Fewer samples are not enough to do both [s]."""
MIN_MOVED = 1.0
"""Nor is it where less charge was moved, out and in, in capacities."""
GAP_S = 60.0
"""Two samples further apart belong to two pieces [s]."""
MIN_PIECE_S = 900.0
"""A shorter piece neither identifies nor judges [s]."""
WINDOW_S = 3 * 3600.0
"""Open loop is begun again after it, from the SOC that an estimator with the cell has by then: errors of the counted charge
do not swamp those of the resistances [s]."""
UNSURE_SOC = 0.05
"""An SOC with a larger standard deviation begins no fit."""
MIN_GAIN = 0.03
"""A new cell is taken where the judges' RMS error is smaller by this part at least."""
ROWS = 65_536
"""Samples that are estimated at a time."""


@dataclass(frozen=True)
class HoldoutError:
    """One cell on the samples that judge.

    Attributes:
        rms_v: RMS of measured minus predicted voltage of one cell-file object [V]; infinite if its SOC left 0..1.
        samples: Number of samples above SOC 0.1.
    """

    rms_v: float
    samples: int


@dataclass(frozen=True)
class ReidentificationResult:
    """Result for one pack.

    Attributes:
        pack: Name of the pack.
        reason: Why it has no new cell; empty where it has one.
        method: ``learned`` or ``fitted``: how the best new cell was found; empty without any.
        cell_file: The text of the new cell's file; empty without one that is better.
        hours: Duration from the first to the last sample.
        capacity_ah, capacity_std_ah: Capacity of the best new cell, one object of its file; NaN without any.
        capacity_before_ah: Capacity of the old cell.
        r_s_ohm, r_s_before_ohm: Series resistance at SOC 0.5 and 25 C of the same.
        rms_before_v, rms_v: Judged: of the cell that it had, and of the best new one.
        judged: Samples that judged.
        remark: Why the fit is not among the ways, where it is not.
    """

    pack: str
    reason: str = ""
    method: str = ""
    cell_file: str = ""
    hours: float = math.nan
    capacity_ah: float = math.nan
    capacity_std_ah: float = math.nan
    capacity_before_ah: float = math.nan
    r_s_ohm: float = math.nan
    r_s_before_ohm: float = math.nan
    rms_before_v: float = math.nan
    rms_v: float = math.nan
    judged: int = 0
    remark: str = ""


class _NotEnoughError(ValueError):
    """Why the samples do not suffice."""


def cell_name(pack: str) -> str:
    """Return the name of a pack's re-identified cell."""
    return f"of-{pack}"


def reidentify(pack: str, samples: SampleBlock, kind: PackSpec, cell_file: str | None) -> ReidentificationResult:
    """Identify one pack.

    Args:
        pack: Name of the pack.
        samples: Dtype ``SAMPLE``, as the pack has sent them.
        kind: Row of the pack's kind.
        cell_file: The text of the cell file that it names, if it does.
    """
    seconds = float(np.ptp(samples["time_s"])) if samples.size else 0.0
    outcome = ReidentificationResult(pack, hours=seconds / 3600.0)
    try:
        cell = _battery(kind, cell_file)
        outcome = replace(outcome, capacity_before_ah=cell.cell.capacity_ah, r_s_before_ohm=_r_s(cell))
        return _Pack(outcome, _of_one(samples, kind), kind, cell).found()
    except (_NotEnoughError, UserError) as error:
        return replace(outcome, reason=_in_a_line(error))


class _Pack:
    """One pack's samples, as those of one object of its cell file."""

    def __init__(self, outcome: ReidentificationResult, samples: SampleBlock, kind: PackSpec, cell: CellModel) -> None:
        self._outcome, self._kind, self._cell = outcome, kind, cell
        seconds = 3600.0 * outcome.hours
        if seconds < MIN_S:
            raise _NotEnoughError(f"{seconds / 3600.0:.1f} h of samples: at least {MIN_S / 3600.0:g} h are needed")
        pieces = [piece for piece in _pieces(samples) if np.ptp(piece["time_s"]) >= MIN_PIECE_S]
        moved = sum(map(_moved_ah, pieces)) / cell.cell.capacity_ah
        if moved < MIN_MOVED:
            raise _NotEnoughError(
                f"{moved:.2f} capacities were moved in {seconds / 3600.0:.1f} h: at least {MIN_MOVED:g} is needed"
            )
        split_s = samples["time_s"][0] + TRAINING * seconds
        self._training = list(_clipped(pieces, -math.inf, split_s))
        self._judges = list(_clipped(pieces, split_s, math.inf))
        if not self._training or not self._judges:
            raise _NotEnoughError(f"no {MIN_PIECE_S / 60.0:g} min without a gap: the edge's link or its board is away")

    def found(self) -> ReidentificationResult:
        """Return the better method's result if it beats the old cell; else None."""
        learned, soc, std = self._learn()
        ways = {"learned": learned}
        remark = ""
        try:
            ways["fitted"] = self._fit(learned, soc, std)
        except (UserError, _NotEnoughError) as error:
            remark = _in_a_line(error)
        before = self._judge(self._cell)
        judged = {way: self._judge(cell) for way, cell in ways.items()}
        best = min(judged, key=lambda way: judged[way].rms_v)
        cell, rms_v = ways[best], judged[best].rms_v
        outcome = replace(
            self._outcome,
            method=best,
            capacity_ah=cell.cell.capacity_ah,
            capacity_std_ah=cell.cell.capacity_ah * (cell.cell.capacity_std or math.nan),
            r_s_ohm=_r_s(cell),
            rms_before_v=before.rms_v,
            rms_v=rms_v,
            judged=judged[best].samples,
            remark=remark,
        )
        if not judged[best].samples:
            return replace(outcome, reason="none of the samples that judge is above SOC 0.1")
        if not rms_v < (1.0 - MIN_GAIN) * before.rms_v:
            return replace(outcome, reason="not better than the cell that it has")
        return replace(outcome, cell_file=self._written(cell, best, before.rms_v, rms_v))

    def _learn(self) -> tuple[CellModel, Floats, Floats]:
        """Return the cell that the filter has learned at the end of the training, and SOC with its std at the training samples."""
        estimator = self._estimator(self._cell)
        soc, std = _estimated(estimator, np.concatenate(self._training))
        if not estimator.state[0]["started"]:
            raise _NotEnoughError("no sample is one that this cell can have: are series, parallel and cell right?")
        return identified_cell(estimator, self._cell, 1), soc, std

    def _fit(self, cell: CellModel, soc: Floats, std: Floats) -> CellModel:
        """Resistances and OCV fitted to the longest piece of the training, SOC counted from where it is known best."""
        moved = list(map(_moved_ah, self._training))
        longest = int(np.argmax(moved))
        piece = self._training[longest]
        first = sum(part.size for part in self._training[:longest])
        where = first + int(np.argmin(std[first : first + piece.size]))
        if not std[where] <= UNSURE_SOC:
            raise _NotEnoughError(
                f"its SOC is known to {100.0 * std[where]:.0f} % at best: rests, or a charge to the top, are missing"
            )
        drawn_ah = _drawn_ah(piece)[where - first]
        start = float(np.clip(soc[where] + drawn_ah / cell.cell.capacity_ah, 0.0, 1.0))
        return identify([Columns(piece, self._outcome.pack)], cell, initial_soc=start).cell

    def _judge(self, cell: CellModel) -> HoldoutError:
        """Open loop over each window of the judges, its SOC at first as an estimator with that cell has it by then."""
        estimator = self._estimator(cell)
        _estimated(estimator, np.concatenate(self._training))
        squares, count = 0.0, 0
        for window in _windows(self._judges):
            start = float(estimator.state["soc"][0])
            try:
                errors = validate(Columns(window, self._outcome.pack), cell, initial_soc=start).above
            except UserError:  # its SOC leaves 0..1, or most samples cannot be its own
                return HoldoutError(math.inf, count)
            if errors.samples:
                squares, count = squares + errors.samples * errors.voltage_rms_v**2, count + errors.samples
            _estimated(estimator, window)
        return HoldoutError(math.sqrt(squares / count) if count else math.inf, count)

    def _estimator(self, cell: CellModel) -> Estimator:
        settings = settings_of(self._kind)
        sensor, told = settings.sensor, settings.sampling
        series, parallel = self._kind.series, self._kind.parallel
        return Estimator(
            cell,
            settings.observer,
            identifier=settings.identifier,
            voltage_resolution_v=sensor.voltage_resolution_v / series,
            voltage_noise_v=None if sensor.voltage_noise_v is None else sensor.voltage_noise_v / series,
            initial_soc=settings.pack.initial_soc,
            sampling=Sampling(told.period_s, told.current_resolution_a / parallel, told.current_dead_band_a / parallel),
        )

    def _written(self, cell: CellModel, way: str, before_v: float, after_v: float) -> str:
        name = cell_name(self._outcome.pack)
        described = {"learned": "as an estimator's filter has learned it", "fitted": "as fitted to its longest piece"}
        remarks = [
            f"{self._kind.cell} of the pack {self._outcome.pack}, {described[way]}, from {self._outcome.hours:.1f} h.",
            f"RMS error of the voltage where it had no part: {1e3 * before_v:.1f} mV before, {1e3 * after_v:.1f} mV after.",
        ]
        return cell_text(cell.model_copy(update={"cell": cell.cell.model_copy(update={"name": name})}), remarks)


def _battery(kind: PackSpec, cell_file: str | None) -> CellModel:
    cell = cell_of(kind, cell_file)
    if not isinstance(cell, CellModel):
        raise _NotEnoughError(f"{kind.cell} is a fuel cell: `identify` finds it from polarisation curves")
    return cell


def _of_one(samples: SampleBlock, kind: PackSpec) -> SampleBlock:
    """Return voltage and current of one cell-file object; only samples with increasing time."""
    latest_s = np.maximum.accumulate(np.r_[-math.inf, samples["time_s"][:-1]])
    one = samples[samples["time_s"] > latest_s]
    one["voltage_v"] /= kind.series
    one["current_a"] /= kind.parallel
    return one


def _pieces(samples: SampleBlock) -> list[SampleBlock]:
    """Cut at gaps."""
    return np.split(samples, np.flatnonzero(np.diff(samples["time_s"]) > GAP_S) + 1)


def _clipped(pieces: list[SampleBlock], since_s: float, until_s: float) -> Iterator[SampleBlock]:
    """Return the pieces within ``since_s`` and ``until_s`` that are long enough."""
    for piece in pieces:
        part = piece[(piece["time_s"] >= since_s) & (piece["time_s"] < until_s)]
        if part.size and np.ptp(part["time_s"]) >= MIN_PIECE_S:
            yield part


def _windows(pieces: list[SampleBlock]) -> Iterator[SampleBlock]:
    """Pieces cut so that none is longer than ``WINDOW_S``, equally long."""
    for piece in pieces:
        yield from np.array_split(piece, math.ceil(np.ptp(piece["time_s"]) / WINDOW_S))


def _estimated(estimator: Estimator, samples: SampleBlock) -> tuple[Floats, Floats]:
    """SOC and its standard deviation at each sample; NaN and infinite before the first one that was accepted."""
    soc, std = np.empty(samples.size), np.empty(samples.size)
    for first in range(0, samples.size, ROWS):
        block = samples[first : first + ROWS]
        trace = estimator.run(block)
        last = np.searchsorted(trace["time_s"], block["time_s"], side="right") - 1
        part = slice(first, first + block.size)
        soc[part] = np.where(last >= 0, trace["soc"][last], np.nan) if trace.size else np.nan
        std[part] = np.where(last >= 0, trace["soc_std"][last], np.inf) if trace.size else np.inf
    return soc, std


def _drawn_ah(piece: SampleBlock) -> Floats:
    """Charge drawn since its first sample [Ah]."""
    drawn_as: Floats = np.r_[0.0, np.cumsum(piece["current_a"][:-1] * np.diff(piece["time_s"]))]
    return drawn_as / 3600.0


def _moved_ah(piece: SampleBlock) -> float:
    """Charge moved either way [Ah]."""
    return float(np.abs(np.diff(_drawn_ah(piece))).sum())


def _in_a_line(error: Exception) -> str:
    return str(error).replace("\n", "; ")


def _r_s(cell: CellModel) -> float:
    """Return R_s at SOC 0.5 [ohm]."""
    return float(r_s(0.5, cell.a))
