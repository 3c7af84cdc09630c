"""Estimation of one block of a pack, and the messages that result from it."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bms_estimator.checkpoint.identity import without_observer
from bms_estimator.edge.block import Block
from bms_estimator.estimator.estimator import Estimator, TraceBlock
from bms_estimator.fleet.fits.messages import FitResult
from bms_estimator.fleet.hour_row import HOUR_S
from bms_estimator.fleet.packs.pack_type import Digest, PackType, PackTypes
from bms_estimator.fleet.worker import hour_summary
from bms_estimator.fleet.worker.block_order import MAX_TIMESTAMP_S, Arrival, clock_error_s
from bms_estimator.fleet.worker.block_result import BlockResult
from bms_estimator.fleet.worker.pack_alarms import PackAlarms
from bms_estimator.fleet.worker.pack_fits import PackFits
from bms_estimator.fleet.worker.pack_state import (
    CONFIG_DIGEST,
    LAST_STORE_NS,
    MAX_CELLS,
    PACK_STATE,
    STATE_DIGEST,
    Fields,
    UnpackedRecord,
)
from bms_estimator.forecast.available_power import Forecast, unknown_values
from bms_estimator.forecast.capability import write_usable_charge
from bms_estimator.kernels.cells.records import BANK_STATE, CELL
from bms_estimator.model.arrays import NO_CELLS, CellBlock, SampleBlock
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.payloads.health import Payload
from bms_estimator.pack.state import CHECKPOINT, REFUSED
from bms_estimator.telemetry.cells import estimate_fields, make_cells_payload
from bms_estimator.telemetry.parameters import make_parameters_payload
from bms_estimator.telemetry.publish_window import ChargeEnergy, Window
from bms_estimator.telemetry.state import make_state_payload, remaining_capacity_ah

MAX_WALL_S = 2.0**34
"""Latest plausible wall clock [s since 1970]: the year 2514."""
MAX_PART_SAMPLES = 1024
"""Maximum number of samples that are estimated at a time. It limits the buffer of estimates of 200 bytes each, which
exists for each type of packs of a partition."""
NO_PEAK_A = 0.0
"""Peak current for ``write_usable_charge`` [A]. A worker does not store the peaks of the load. With 0, the mean current is
used."""
NO_CELL_STATES = np.zeros(0, CELL)
"""Empty array of states of single cells."""
NO_FORECAST_REASON = "a fleet worker makes no forecasts"


class BlockProcessor:
    """Processor of blocks, which all packs of a partition share.

    Args:
        unpacked: Record of dtype ``PACK_STATE``. The caller loads the state of a pack into it before each ``step``.
        counters: Counters of the partition; updated.
        wall: Wall clock for publish times [s since 1970].

    Attributes:
        types: Types of packs, whose estimators are bound to the record.
    """

    def __init__(self, unpacked: UnpackedRecord, counters: Counter[str], wall: Callable[[], float]) -> None:
        record = unpacked.record
        self._record, self._counters, self._wall = record, counters, wall
        self._unpacked, self._fits, self._alarms = unpacked, PackFits(record, counters), PackAlarms(record)
        self.types = PackTypes(record, self._fits.advance)
        self._delivery, self._charge_energy, self._hour = (record[0][name] for name in ("delivery", "flow", "hour"))
        self._observer = record[0]["estimator"]["observer"]
        self._window = Window()

    def step(
        self, pack: str, block: Block, arrival: Arrival, pack_type: PackType, unmigrated_fields: Fields | None
    ) -> BlockResult:
        """Estimate the pack's next block.

        Args:
            pack: Name of the pack.
            block: The block; its implausible timestamps are set to NaN.
            arrival: Arrival of the block at the server.
            pack_type: Type of the pack; its estimator is bound to the record.
            unmigrated_fields: Estimator fields that another version saved; None if they are already in the record.
        """
        self._remove_implausible_times(block.samples)
        self._fits.use_curves(pack, pack_type)
        if self._restore_or_reset(pack_type, unmigrated_fields, block):
            self._fits.use_curves(pack, pack_type)
        self._fits.begin_block(pack, pack_type, arrival.sequence)
        self._load_cells(pack_type)
        is_new_time_base = int(self._delivery[LAST_STORE_NS]) != block.store_created_ns
        rows, is_new_hour = self._roll_over_hour(pack, block, arrival, pack_type, is_new_time_base=is_new_time_base)
        self._record_clock_error(block, arrival)
        self._alarms.begin_block(pack_type, is_new_time_base=is_new_time_base)
        self._resume_after_store_change(pack_type, block)
        # another pack may have used the window meanwhile
        self._window.previous_end_s = float(self._observer["time_s"]) if self._observer["started"] else math.nan
        self._window.soc_known = self._alarms.is_soc_known
        self._record_last_sample(block)
        arrival_s, now_s = self._arrival_s(block), self._wall()
        trace = self._estimate(block, pack_type, arrival_s)
        state = self._state_payload(pack_type, now_s)
        parameters = cells = None
        if is_new_hour and state is not None:
            parameters = self._parameters_payload(pack_type.estimator, arrival_s, now_s)
            cells = self._cells_payload(pack_type, now_s)
        return BlockResult(
            pack,
            state=state,
            parameters=parameters,
            cells=cells,
            alarms=self._alarms.messages(pack_type, trace, now_s, include_unchanged=is_new_hour),
            hours=rows,
            history=self._fits.take_messages(),
        )

    def receive_fit(self, result: FitResult, sequence: int, pack_type: PackType) -> bool:
        """Process the result of a fit (``PackFits.receive``)."""
        return self._fits.receive(result, sequence, pack_type)

    def reset_window(self) -> None:
        """Drop the samples of a failed block from the publish window."""
        self._window = Window()

    def _restore_or_reset(self, pack_type: PackType, unmigrated_fields: Fields | None, block: Block) -> bool:
        """Adapt the pack's state to its present settings and this version, or reset it. Return True if it has changed."""
        delivery, record = self._delivery, self._record[0]
        is_same_config = _digest(delivery[CONFIG_DIGEST]) == pack_type.config_digest
        if is_same_config and unmigrated_fields is None:
            return False
        has_state = bool(self._hour["store"])  # 0 before the first block
        if _digest(delivery[STATE_DIGEST]) == pack_type.state_digest and has_state:
            self._load_cells(pack_type)
            state = pack_type.pack.state(CHECKPOINT)
            saved = state.record_fields if unmigrated_fields is None else unmigrated_fields
            record["estimator"] = np.zeros((), PACK_STATE["estimator"])
            # the observer's state also depends on settings outside ``STATE_DIGEST``; other states do not
            valid = saved if is_same_config else without_observer(saved)
            pack_type.cells.use_state(NO_CELL_STATES, np.zeros(1, BANK_STATE))
            state = replace(state, record=valid, curves=self._fits.curves_in_force())
            outcomes = pack_type.pack.restore(state, self._gap_s(block))
            self._store_cells(pack_type)
            # the restored estimator has no last sample, and its counters begin at 0
            self._charge_energy["sums"]["counted"] = 0
            self._hour["outliers_before"] = self._hour["searches_before"] = 0
            self._counters["not_taken_over" if outcomes[CHECKPOINT].startswith(REFUSED) else "taken_over"] += 1
        else:
            for name in ("flow", "hour", "fit", "estimator"):
                record[name] = np.zeros((), PACK_STATE[name])
            delivery[LAST_STORE_NS] = delivery["hour"] = delivery["clock_error_s"] = 0
            self._unpacked.start_cells(0)
            self._counters["begun_anew"] += has_state
        self._fits.restart(pack_type)
        delivery[CONFIG_DIGEST], delivery[STATE_DIGEST] = pack_type.config_digest, pack_type.state_digest
        return True

    def _load_cells(self, pack_type: PackType) -> None:
        """Let the estimators of the single cells use the state in the record; without one, an empty state."""
        cells, unpacked = pack_type.cells, self._unpacked
        if unpacked.cell_count:
            cells.use_state(unpacked.cells, unpacked.bank)
        else:
            cells.use_state(NO_CELL_STATES, np.zeros(1, BANK_STATE))

    def _store_cells(self, pack_type: PackType) -> None:
        """Copy the state of the single cells to the record, which gets space for their number."""
        cells = pack_type.cells
        self._unpacked.start_cells(cells.cells.size)
        if cells.cells.size:
            self._unpacked.cells[...], self._unpacked.bank[...] = cells.cells, cells.bank

    def _resume_after_store_change(self, pack_type: PackType, block: Block) -> None:
        """Resume the estimator after a gap if the block has another store than the last sample.

        Timestamps count from the creation of the store, and therefore the estimator cannot compute the gap.
        """
        if int(self._delivery[LAST_STORE_NS]) == block.store_created_ns:
            return
        self._charge_energy["sums"]["counted"] = 0  # no charge is counted over the gap
        # ``time_s`` is infinite if ``_restore_or_reset`` has already resumed the estimator
        has_time_base = math.isfinite(self._observer["time_s"])
        if self._observer["started"] and has_time_base:
            gap_s = self._gap_s(block)
            pack_type.estimator.resume(gap_s)
            pack_type.cells.resume(gap_s)

    def _estimate(self, block: Block, pack_type: PackType, arrival_s: float) -> TraceBlock:
        """Estimate the samples; add the estimates to the hour, the charge and energy meter and the publish window.

        Evaluate the alarms. Return the last estimates.
        """
        observer, counters, cells = self._observer, self._counters, pack_type.cells
        accepted_before, steps_back_before = int(observer["samples"]), int(observer["time_steps_back"])
        pack_type.meter.continue_from(
            ChargeEnergy(*(float(self._charge_energy[name]) for name in ChargeEnergy._fields))
        )
        has_all_cells = block.cells_v.shape[1] == cells.estimated_cells <= MAX_CELLS
        cells_v = block.cells_v if has_all_cells else NO_CELLS
        wall_offset_s = arrival_s - float(self._delivery["last_s"])
        for start in range(0, block.samples.size, MAX_PART_SAMPLES):
            part = slice(start, start + MAX_PART_SAMPLES)
            samples, trace = block.samples[part], pack_type.pack.run(block.samples[part], cells_v[part]).trace
            hour_summary.add(self._record["hour"], trace, samples.size, block.store_created_ns, pack_type.estimator)
            pack_type.meter.add(trace)
            self._window.add(trace, arrival_s, known_voltages(block.cells_v[part]))
            self._alarms.add(pack_type, samples, block.cells_v[part], trace, wall_offset_s)
        if cells.cells.size != self._unpacked.cell_count:  # the first block with cell voltages
            self._store_cells(pack_type)
        counters["blocks"] += 1
        counters["samples"] += block.samples.size
        counters["dropped_samples"] += block.samples.size - (int(observer["samples"]) - accepted_before)
        counters["time_steps_back"] += int(observer["time_steps_back"]) - steps_back_before
        return trace

    def _state_payload(self, pack_type: PackType, now_s: float) -> bytes | None:
        """Return the payload of topic ``state`` from the publish window; None if no sample was accepted."""
        totals, window, delivery = pack_type.meter.update_totals(), self._window.take(), self._delivery
        for name, value in zip(ChargeEnergy._fields, totals, strict=True):
            self._charge_energy[name] = value
        if window is None:
            return None
        # ``blocks`` does not count the present block yet
        counters = {"frames_received": int(delivery["blocks"]) + 1, "frames_lost": int(delivery["lost_blocks"])}
        values = unknown_values()
        write_usable_charge(values, pack_type.estimator, pack_type.cutoff_v, NO_PEAK_A, pack_type.cells.deviations)
        forecast = Forecast(float(window.last["time_s"]), values, NO_FORECAST_REASON, None)
        remaining_ah = remaining_capacity_ah(pack_type.estimator)
        return _json(
            make_state_payload(
                window,
                remaining_ah,
                forecast,
                counters,
                now_s,
                totals,
                pack_type.capacity_ah,
                estimate_fields(pack_type.pack),
            )
        )

    def _parameters_payload(self, estimator: Estimator, arrival_s: float, now_s: float) -> bytes:
        """Return the payload of topic ``parameters``. Its ages refer to the arrival time of the samples."""
        return _json(make_parameters_payload(estimator, arrival_s).model_copy(update={"publish_time": iso_utc(now_s)}))

    def _cells_payload(self, pack_type: PackType, now_s: float) -> bytes | None:
        """Return the payload of topic ``cells``; None without an estimate."""
        cells = pack_type.cells.deviations
        return None if cells is None else _json(make_cells_payload(cells, pack_type.short_limit_a, now_s))

    def _remove_implausible_times(self, samples: SampleBlock) -> None:
        """Set implausible timestamps to NaN."""
        times = samples["time_s"]
        plausible = (times >= 0.0) & (times <= MAX_TIMESTAMP_S)
        if not plausible.all():
            self._counters["no_time"] += int(np.count_nonzero(~plausible))
            times[~plausible] = math.nan

    def _record_clock_error(self, block: Block, arrival: Arrival) -> None:
        """Record an error of the edge's clock, which quarantines the row of the current hour."""
        if error_s := clock_error_s(block, arrival.received_s):
            self._delivery["clock_error_s"] = error_s
            self._counters["clock_ahead" if error_s > 0.0 else "clock_behind"] += 1

    def _gap_s(self, block: Block) -> float:
        """Return the length of the gap before a block [s]; infinite if unknown."""
        delivery, times_s = self._delivery, _finite_times_s(block.samples)
        if not delivery[LAST_STORE_NS] or not times_s.size:
            return math.inf
        gap_s = (block.store_created_ns - int(delivery[LAST_STORE_NS])) / 1e9 + float(times_s[0] - delivery["last_s"])
        return gap_s if gap_s >= 0.0 else math.inf

    def _roll_over_hour(
        self, pack: str, block: Block, arrival: Arrival, pack_type: PackType, *, is_new_time_base: bool
    ) -> tuple[tuple[tuple[str, bytes], ...], bool]:
        """If the block is of a later hour, finish the current hour and begin the new one.

        Also begin an earlier hour if the block is the first of a new store, whose clock may be days behind. Otherwise the pack
        would have no row until this clock has reached the current hour.

        Returns:
            Message id and row of the finished hour, empty for the first hour of a pack; and True if a new hour has begun.
        """
        hour, current = hour_summary.hour_of(block), int(self._delivery["hour"])
        if hour == current or (hour < current and not is_new_time_base):
            return (), False
        rows: tuple[tuple[str, bytes], ...] = ()
        if current:
            settings = pack_type.settings.model_copy(update={"name": pack})
            row = hour_summary.row(settings, current, self._record["hour"], pack_type.estimator)
            cells, alarms = pack_type.cells.deviations, {"alarms": " ".join(self._alarms.raised) or None}
            row = row.model_copy(update=hour_summary.cell_fields(cells) | alarms | self._origin(arrival))
            # the collector sets missing values to null, so that a pack without cell voltages has a shorter row
            rows = ((f"{pack}.{current}.{arrival.sequence}", row.model_dump_json(exclude_defaults=True).encode()),)
        hour_summary.begin(self._record["hour"], self._record[0]["estimator"])
        self._delivery["hour"], self._delivery["clock_error_s"] = hour, 0.0
        return rows, True

    def _origin(self, arrival: Arrival) -> dict[str, float | None]:
        """Return the fields of a row about the block that finished the hour, and about the clock of the edge."""
        received_s, error_s = arrival.received_s, float(self._delivery["clock_error_s"])
        return {
            "revision": arrival.sequence,
            "received_hour": None if received_s is None else received_s // HOUR_S,
            "clock_error_s": error_s or None,
        }

    def _record_last_sample(self, block: Block) -> None:
        """Record store and timestamp of the last valid sample."""
        times_s = _finite_times_s(block.samples)
        if times_s.size:
            self._delivery[LAST_STORE_NS], self._delivery["last_s"] = block.store_created_ns, times_s[-1]

    def _arrival_s(self, block: Block) -> float:
        """Return the arrival time of the last sample at the edge [s since 1970].

        An implausible arrival time is replaced by the timestamp of the last sample.
        """
        if 0.0 <= block.arrival_s <= MAX_WALL_S:
            return block.arrival_s
        self._counters["no_arrival"] += 1
        return block.store_created_ns / 1e9 + float(self._delivery["last_s"])


def _finite_times_s(samples: SampleBlock) -> NDArray[np.float64]:
    """Return the finite timestamps [s]."""
    times: NDArray[np.float64] = samples["time_s"]
    finite: NDArray[np.float64] = times[np.isfinite(times)]
    return finite


def known_voltages(cells_v: CellBlock) -> CellBlock:
    """Return the rows with a voltage. In a large block, an edge sends no cell voltages for some samples."""
    return cells_v[np.isfinite(cells_v).any(axis=1)] if cells_v.size else cells_v


def _digest(words: NDArray[np.uint64]) -> Digest:
    first, second = words.tolist()
    return first, second


def _json(report: Payload) -> bytes:
    return report.model_dump_json().encode()
