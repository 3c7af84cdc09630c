"""Estimators of the single cells of a pack in a worker, for packs whose blocks have cell voltages."""

from typing import Any

import numpy as np

from bms_estimator.edge.block import Block
from bms_estimator.estimator.cell_estimator import CellDeviations, CellEstimator
from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.fleet.worker.pack_state import MAX_CELLS, UnpackedRecord
from bms_estimator.model.payloads.snapshot import CellsReport
from bms_estimator.model.sample import CellBlock
from bms_estimator.telemetry.cells import make_cells_payload, weakest_cell_fields


class SingleCells:
    """Estimators of the single cells of the pack that is loaded into a record.

    A pack has a state of its cells from the first block with the voltages of all cells in series on. From then on, each
    sample is processed, because ``replay`` of these samples also processes those without cell voltages.

    Args:
        unpacked: Record that holds the state of a pack.
    """

    def __init__(self, unpacked: UnpackedRecord) -> None:
        self._unpacked = unpacked
        self._cells: CellEstimator | None = None  # of the loaded pack
        self._is_loaded = False  # ``_cells`` uses the state in the record

    def begin(self, cells: CellEstimator) -> None:
        """Begin a block of a pack with the estimators of its type."""
        self._cells, self._is_loaded = cells, False
        if self._unpacked.cell_count:
            self._load()

    def run(self, block: Block, trace: TraceBlock) -> None:
        """Process samples of the block and their estimates."""
        if not (self._is_loaded or block.cells_v.size) or self._cells is None:
            return
        count, cells_v = self._cells.estimated_cells, block.cells_v
        is_complete = cells_v.shape == (block.samples.size, count)
        if not self._is_loaded:
            if not is_complete or count > MAX_CELLS:
                return
            self._unpacked.start_cells(count)
            self._load()
        if not is_complete:
            cells_v = np.full((block.samples.size, count), np.nan)
        self._cells.run(block.samples, cells_v, trace)

    def resume(self, gap_s: float) -> None:
        """Prepare for samples with another time base, after a gap of ``gap_s`` [s]; infinite if unknown."""
        if self._is_loaded and self._cells is not None:
            self._cells.resume(gap_s)

    def restore(self, cells: CellEstimator, gap_s: float, *, is_valid: bool) -> None:
        """Adapt the state in the record to other settings of the pack.

        Args:
            cells: Estimators of the pack's present type.
            gap_s: Gap before the next sample [s]; infinite if unknown.
            is_valid: True if the state of the pack was restored.
        """
        if not (is_valid and self._unpacked.cell_count == cells.estimated_cells):
            self.reset()
            return
        self.begin(cells)
        self.resume(gap_s)

    def reset(self) -> None:
        """Remove the state of the single cells from the record."""
        if self._unpacked.cell_count:
            self._unpacked.start_cells(0)

    def state_fields(self) -> dict[str, Any]:
        """Return the fields of topic ``state``; empty without an estimate."""
        deviations = self._deviations
        return {} if deviations is None else weakest_cell_fields(deviations)

    def payload(self, short_limit_a: float, now_s: float) -> CellsReport | None:
        """Return the payload of topic ``cells``; None without an estimate.

        Args:
            short_limit_a: Minimum proven self-discharge of a cell with an internal short [A].
            now_s: Wall clock [s since 1970].
        """
        deviations = self._deviations
        return None if deviations is None else make_cells_payload(deviations, short_limit_a, now_s)

    def row_fields(self) -> dict[str, Any]:
        """Return the fields of an hourly row; empty without an estimate."""
        d = self._deviations
        if d is None:
            return {}
        leaking = int(np.argmax(d.self_discharge_a / d.self_discharge_std_a))
        return {
            "weakest_cell": d.weakest + 1,
            "weakest_cell_soc_deviation": float(d.soc_deviation[d.weakest]),
            "weakest_cell_resistance_ratio": float(d.resistance_ratio[d.weakest]),
            "cell_soc_spread": float(np.ptp(d.soc_deviation)),
            "self_discharge_cell": leaking + 1,
            "self_discharge_a": float(d.self_discharge_a[leaking]),
            "self_discharge_std_a": float(d.self_discharge_std_a[leaking]),
        }

    @property
    def _deviations(self) -> CellDeviations | None:
        return self._cells.deviations if self._is_loaded and self._cells is not None else None

    def _load(self) -> None:
        """Let the estimators use the state in the record."""
        if self._cells is not None:
            self._cells.use_state(self._unpacked.cells, self._unpacked.bank)
            self._is_loaded = True


def known_voltages(cells_v: CellBlock) -> CellBlock:
    """Return the rows with a voltage, because an edge does not send the cell voltages of all samples of a large block."""
    return cells_v[np.isfinite(cells_v).any(axis=1)] if cells_v.size else cells_v
