"""Re-identification of a pack from its stored samples, validated on later samples.

The first two thirds of the time are the training samples of two methods. The first method uses the cell that the
estimator's filter has learned at their end. The second method starts from this cell and fits the piece without a gap that
has the largest charge throughput (``calibration.elements.identify``). The last third is the holdout: each cell predicts
the voltage from the current in open loop for some hours at a time, and the prediction is compared with the measured
voltage.

All quantities are those of one cell-file object, which is the cell, module or block that the cell file describes.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from bms_estimator.calibration.elements.identify import identify
from bms_estimator.calibration.validate import validate
from bms_estimator.estimator.estimator import Estimator, make_estimator
from bms_estimator.estimator.identified_parameters import identified_cell
from bms_estimator.fleet.packs.pack_row import PackSpec, cell_of, settings_of
from bms_estimator.kernels.cell_model.chen_mora import r_s
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, with_name
from bms_estimator.model.cell_file import cell_text
from bms_estimator.model.charge_count import charge_ah, step_charges_as
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock
from bms_estimator.settings.pack import Settings

TRAINING_FRACTION = 2.0 / 3.0
"""Fraction of the time used for training; the rest is the holdout."""
MIN_DURATION_S = 6 * 3600.0
"""Minimum duration of the samples [s]."""
MIN_THROUGHPUT = 1.0
"""Minimum charge throughput, out and in together, as a multiple of the capacity."""
GAP_S = 60.0
"""Maximum interval between two samples of one piece [s]."""
MIN_PIECE_S = 900.0
"""Minimum duration of a used piece [s]."""
WINDOW_S = 3 * 3600.0
"""Maximum duration of an open-loop prediction [s]. Each prediction starts at the SOC of an estimator with the predicting
cell, so that errors of the counted charge do not hide errors of the resistances."""
MAX_SOC_STD = 0.05
"""Maximum standard deviation of the SOC at which a fit starts."""
MIN_GAIN = 0.03
"""Minimum relative reduction of the RMS error on the holdout for which a new cell replaces the old cell."""
PACK_VOLTAGES = {"voltage_resolution_v", "voltage_noise_v", "full_voltage_v", "cutoff_voltage_v"}
"""Columns with voltages of a whole pack."""
PACK_CURRENTS = {"current_resolution_a", "current_dead_band_a", "tail_current_a", "current_offset_std_a"}
"""Columns with currents of a whole pack."""
MAX_BLOCK_SAMPLES = 65_536
"""Maximum number of samples that are estimated at a time."""


@dataclass(frozen=True)
class HoldoutError:
    """Error of one cell on the holdout.

    Attributes:
        rms_v: RMS of measured minus predicted voltage of one cell-file object [V]; infinite if the SOC left 0..1.
        samples: Number of samples above SOC 0.1.
    """

    rms_v: float
    samples: int


@dataclass(frozen=True)
class ReidentificationResult:
    """Result for one pack.

    Attributes:
        pack: Name of the pack.
        reason: Why there is no new cell; empty if there is one.
        method: Method of the best new cell, ``learned`` or ``fitted``; empty without one.
        cell_file: Text of the new cell file; empty if no new cell is better than the old one.
        hours: Duration from the first to the last sample [h].
        capacity_ah, capacity_std_ah: Capacity of the best new cell, for one cell-file object; NaN without one.
        capacity_before_ah: Capacity of the old cell.
        r_s_ohm, r_s_before_ohm: Series resistance at SOC 0.5 and 25 C of the new and the old cell.
        rms_before_v, rms_v: RMS error on the holdout of the old and the best new cell.
        judged: Number of holdout samples that were compared.
        remark: Why the method ``fitted`` failed; empty if it did not.
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


class _UnsuitableError(ValueError):
    """Samples or pack that cannot be identified; the message gives the reason."""


def cell_name(pack: str) -> str:
    """Return the name of a pack's re-identified cell."""
    return f"of-{pack}"


def reidentify(pack: str, samples: SampleBlock, spec: PackSpec, cell_file: str | None) -> ReidentificationResult:
    """Re-identify one pack.

    Args:
        pack: Name of the pack.
        samples: Samples of the pack, dtype ``SAMPLE``.
        spec: Row of the pack in the table of packs.
        cell_file: Text of the cell file that the row names; None for a shipped cell.
    """
    seconds = float(np.ptp(samples["time_s"])) if samples.size else 0.0
    outcome = ReidentificationResult(pack, hours=seconds / 3600.0)
    try:
        cell = _battery(spec, cell_file)
        outcome = replace(
            outcome, capacity_before_ah=cell.cell.capacity_ah, r_s_before_ohm=_series_resistance_ohm(cell)
        )
        return _Pack(outcome, _single_cell_samples(samples, spec), spec, cell).reidentify()
    except (_UnsuitableError, UserError) as error:
        return replace(outcome, reason=_on_one_line(error))


class _Pack:
    """Samples of one pack, converted to one cell-file object."""

    def __init__(self, outcome: ReidentificationResult, samples: SampleBlock, spec: PackSpec, cell: CellModel) -> None:
        self._outcome, self._spec, self._cell = outcome, spec, cell
        seconds = 3600.0 * outcome.hours
        if seconds < MIN_DURATION_S:
            raise _UnsuitableError(
                f"{seconds / 3600.0:.1f} h of samples: at least {MIN_DURATION_S / 3600.0:g} h are needed"
            )
        pieces = [piece for piece in _pieces(samples) if np.ptp(piece["time_s"]) >= MIN_PIECE_S]
        throughput = sum(map(_throughput_ah, pieces)) / cell.cell.capacity_ah
        if throughput < MIN_THROUGHPUT:
            raise _UnsuitableError(
                f"{throughput:.2f} capacities were charged and discharged in {seconds / 3600.0:.1f} h: at least {MIN_THROUGHPUT:g} is needed"
            )
        split_s = samples["time_s"][0] + TRAINING_FRACTION * seconds
        self._training = list(_clipped(pieces, -math.inf, split_s))
        self._holdout = list(_clipped(pieces, split_s, math.inf))
        if not self._training or not self._holdout:
            raise _UnsuitableError(
                f"no {MIN_PIECE_S / 60.0:g} min without a gap: check the edge's connection and its board"
            )

    def reidentify(self) -> ReidentificationResult:
        """Return the result of the better method, with a cell file if it beats the old cell."""
        learned, soc, std = self._learn()
        cells = {"learned": learned}
        remark = ""
        try:
            cells["fitted"] = self._fit(learned, soc, std)
        except (UserError, _UnsuitableError) as error:
            remark = _on_one_line(error)
        old_error = self._holdout_error(self._cell)
        new_errors = {method: self._holdout_error(cell) for method, cell in cells.items()}
        best = min(new_errors, key=lambda method: new_errors[method].rms_v)
        cell, rms_v = cells[best], new_errors[best].rms_v
        outcome = replace(
            self._outcome,
            method=best,
            capacity_ah=cell.cell.capacity_ah,
            capacity_std_ah=cell.cell.capacity_ah * (cell.cell.capacity_std or math.nan),
            r_s_ohm=_series_resistance_ohm(cell),
            rms_before_v=old_error.rms_v,
            rms_v=rms_v,
            judged=new_errors[best].samples,
            remark=remark,
        )
        if not new_errors[best].samples:
            return replace(outcome, reason="no holdout sample is above SOC 0.1")
        if not rms_v < (1.0 - MIN_GAIN) * old_error.rms_v:
            return replace(outcome, reason="not better than the present cell")
        return replace(outcome, cell_file=self._cell_file(cell, best, old_error.rms_v, rms_v))

    def _learn(self) -> tuple[CellModel, Floats, Floats]:
        """Return the cell that the filter has learned from the training samples, and their SOC with its standard deviation."""
        estimator = self._estimator(self._cell)
        soc, std = _estimate(estimator, np.concatenate(self._training))
        if not estimator.state[0]["started"]:
            raise _UnsuitableError("no sample is plausible for this cell: check series, parallel and cell")
        return identified_cell(estimator, self._cell, 1), soc, std

    def _fit(self, cell: CellModel, soc: Floats, std: Floats) -> CellModel:
        """Fit resistances and OCV to the training piece with the largest charge throughput.

        The SOC is counted from the sample with the smallest standard deviation of the SOC.
        """
        selected = int(np.argmax(list(map(_throughput_ah, self._training))))
        piece = self._training[selected]
        first = sum(part.size for part in self._training[:selected])
        start_sample = first + int(np.argmin(std[first : first + piece.size]))
        if not std[start_sample] <= MAX_SOC_STD:
            raise _UnsuitableError(
                f"its SOC is known to {100.0 * std[start_sample]:.0f} % at best: rests, or a charge to the top, are missing"
            )
        drawn_ah = charge_ah(piece["time_s"], piece["current_a"])[start_sample - first]
        # SOC at the beginning of the piece, by counting back
        start = float(np.clip(soc[start_sample] + drawn_ah / cell.cell.capacity_ah, 0.0, 1.0))
        return identify([Columns(piece, self._outcome.pack)], cell, initial_soc=start).cell

    def _holdout_error(self, cell: CellModel) -> HoldoutError:
        """Return the open-loop error of a cell on the holdout. Each window starts at the SOC of an estimator with this cell."""
        estimator = self._estimator(cell)
        _estimate(estimator, np.concatenate(self._training))
        squares, count = 0.0, 0
        for window in _windows(self._holdout):
            start = float(estimator.state["soc"][0])
            try:
                report = validate(Columns(window, self._outcome.pack), cell, initial_soc=start)
            except UserError:  # the SOC leaves 0..1, or most samples are implausible for this cell
                return HoldoutError(math.inf, count)
            errors = report.above  # above SOC 0.1
            if errors.samples:
                squares, count = squares + errors.samples * errors.voltage_rms_v**2, count + errors.samples
            _estimate(estimator, window)
        return HoldoutError(math.sqrt(squares / count) if count else math.inf, count)

    def _estimator(self, cell: CellModel) -> Estimator:
        estimator = make_estimator(single_cell_settings(self._spec), cell)
        # the samples are one recording of hours, all of which the filter may learn from
        estimator.settings_record["filter"]["learning_soc"] = math.inf
        return estimator

    def _cell_file(self, cell: CellModel, method: str, before_v: float, after_v: float) -> str:
        name = cell_name(self._outcome.pack)
        origins = {
            "learned": "as learned by the estimator's filter",
            "fitted": "fitted to its longest piece without a gap",
        }
        remarks = [
            f"{self._spec.cell} of the pack {self._outcome.pack}, {origins[method]}, from {self._outcome.hours:.1f} h.",
            f"RMS error of the voltage on later samples: {1e3 * before_v:.1f} mV before, {1e3 * after_v:.1f} mV after.",
        ]
        return cell_text(with_name(cell, name), remarks)


def _battery(spec: PackSpec, cell_file: str | None) -> CellModel:
    cell = cell_of(spec, cell_file)
    if not isinstance(cell, CellModel):
        raise _UnsuitableError(f"{spec.cell} is a fuel cell: its cell file is identified from polarisation curves")
    return cell


def _single_cell_samples(samples: SampleBlock, spec: PackSpec) -> SampleBlock:
    """Return the samples with increasing time, converted to one cell-file object."""
    latest_s = np.maximum.accumulate(np.r_[-math.inf, samples["time_s"][:-1]])
    one = samples[samples["time_s"] > latest_s]
    one["voltage_v"] /= spec.series
    one["current_a"] /= spec.parallel
    return one


def single_cell_settings(spec: PackSpec) -> Settings:
    """Return the settings of a pack, with voltages and currents converted to one cell-file object."""
    settings = settings_of(spec)
    scaled = {}
    for section in ("pack", "sensor", "identifier"):
        values = getattr(settings, section)
        scaled[section] = values.model_copy(
            update={
                name: getattr(values, name) / (spec.series if name in PACK_VOLTAGES else spec.parallel)
                for name in PACK_VOLTAGES | PACK_CURRENTS
                if getattr(values, name, None) is not None
            }
        )
    return settings.model_copy(update=scaled)


def _pieces(samples: SampleBlock) -> list[SampleBlock]:
    """Split samples at gaps."""
    return np.split(samples, np.flatnonzero(np.diff(samples["time_s"]) > GAP_S) + 1)


def _clipped(pieces: list[SampleBlock], since_s: float, until_s: float) -> Iterator[SampleBlock]:
    """Yield the parts of the pieces between ``since_s`` and ``until_s`` that are long enough."""
    for piece in pieces:
        part = piece[(piece["time_s"] >= since_s) & (piece["time_s"] < until_s)]
        if part.size and np.ptp(part["time_s"]) >= MIN_PIECE_S:
            yield part


def _windows(pieces: list[SampleBlock]) -> Iterator[SampleBlock]:
    """Split each piece into windows of equal size, none longer than ``WINDOW_S``."""
    for piece in pieces:
        yield from np.array_split(piece, math.ceil(np.ptp(piece["time_s"]) / WINDOW_S))


def _estimate(estimator: Estimator, samples: SampleBlock) -> tuple[Floats, Floats]:
    """Return SOC and its standard deviation at each sample: NaN and infinity before the first accepted sample."""
    soc, std = np.empty(samples.size), np.empty(samples.size)
    for first in range(0, samples.size, MAX_BLOCK_SAMPLES):
        block = samples[first : first + MAX_BLOCK_SAMPLES]
        trace = estimator.run(block)
        last = np.searchsorted(trace["time_s"], block["time_s"], side="right") - 1
        part = slice(first, first + block.size)
        soc[part] = np.where(last >= 0, trace["soc"][last], np.nan) if trace.size else np.nan
        std[part] = np.where(last >= 0, trace["soc_std"][last], np.inf) if trace.size else np.inf
    return soc, std


def _throughput_ah(piece: SampleBlock) -> float:
    """Return the charge throughput, out and in together [Ah]."""
    return float(np.abs(step_charges_as(piece["time_s"], piece["current_a"])).sum()) / 3600.0


def _on_one_line(error: Exception) -> str:
    return str(error).replace("\n", "; ")


def _series_resistance_ohm(cell: CellModel) -> float:
    """Return R_s at SOC 0.5 [ohm]."""
    return float(r_s(0.5, cell.a))
