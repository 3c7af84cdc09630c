"""Estimation of a block of the pack on the bench, and its publications."""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bms_estimator.checkpoint.identity import fields, without_observer
from bms_estimator.checkpoint.restore import restore_state
from bms_estimator.edge.block import Block
from bms_estimator.estimator import Estimator
from bms_estimator.fleet.packs.pack_type import Digest, PackType
from bms_estimator.fleet.worker import hour_summary
from bms_estimator.fleet.worker.density import MAX_STORE_S
from bms_estimator.fleet.worker.pack_state import PACK_STATE, Fields
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.payloads import Payload
from bms_estimator.model.sample import SampleBlock
from bms_estimator.telemetry.charge_energy import ChargeEnergy
from bms_estimator.telemetry.parameters import make_parameters_payload
from bms_estimator.telemetry.publish_window import Window
from bms_estimator.telemetry.remaining_charge import remaining_charge
from bms_estimator.telemetry.state import make_state_payload

LAST_WALL_S = 2.0**34
"""No wall clock shows a later time: the year 2514 [s since 1970]."""
AT_ONCE = 4096
"""Samples: each estimate takes 200 bytes, for each type of pack in each partition."""
Published = tuple[bytes | None, bytes | None, tuple[tuple[str, bytes], ...]]
"""Topics ``state`` and ``parameters``, and the rows of finished hours, each with an id."""


class BlockProcessor:
    """Steps the pack on the bench.

    Args:
        record: The bench's, shape (1,), dtype ``PACK_STATE``.
        counters: Faults are counted here.
        wall: Wall clock of the publications [s since 1970].
    """

    def __init__(self, record: NDArray[np.void], counters: Counter[str], wall: Callable[[], float]) -> None:
        self._record, self._counters, self._wall = record, counters, wall
        self._delivery, self._flows, self._hour = (record[0][name] for name in ("delivery", "flow", "hour"))
        self._observer = record[0]["estimator"]["observer"]
        self._window = Window()

    def step(self, pack: str, block: Block, of_type: PackType, former: Fields | None) -> Published:
        """Take the pack's next block.

        Args:
            pack: Name of the pack.
            block: It; time stamps that cannot be become NaN.
            of_type: The pack's type; its estimator works on the bench.
            former: Fields of its estimator as another version left them; None: they are on the bench.
        """
        self._check_times(block.samples)
        self._settle(of_type, former, block)
        rows, turned = self._turn_hour(pack, block, of_type)
        self._follow_clock(of_type.estimator, block)
        self._window.previous_end_s = float(self._observer["time_s"]) if self._observer["started"] else math.nan
        self._note_clock(block)
        arrival_s, now_s = self._arrival_s(block), self._wall()
        self._estimate(block, of_type, arrival_s)
        state = self._state(of_type, now_s)
        told = turned and state is not None
        return state, self._parameters(of_type.estimator, arrival_s, now_s) if told else None, rows

    def forget(self) -> None:
        """Drop the samples of a failed block from the publish window."""
        self._window = Window()

    def _settle(self, of_type: PackType, former: Fields | None, block: Block) -> None:
        """Make the pack one of its type: as it is, or taken over from other settings or from another version."""
        d, record = self._delivery, self._record[0]
        same = _digest(d["made_of"]) == of_type.made_of
        if same and former is None:
            return
        known = bool(self._hour["store"])
        if _digest(d["meaning"]) == of_type.state_digest and known:
            saved = former if former is not None else {name: v.copy() for name, v in fields(self._record["estimator"])}
            record["estimator"] = np.zeros((), PACK_STATE["estimator"])
            wrong = restore_state(of_type.estimator, saved if same else without_observer(saved), self._unseen_s(block))
            self._flows["sums"]["counted"] = self._hour["outliers_before"] = self._hour["searches_before"] = 0
            self._counters["not_taken_over" if wrong else "taken_over"] += 1
        else:
            for name in ("flow", "hour", "estimator"):
                record[name] = np.zeros((), PACK_STATE[name])
            d["clock"] = d["hour"] = 0
            self._counters["begun_anew"] += known
        d["made_of"], d["meaning"] = of_type.made_of, of_type.state_digest

    def _follow_clock(self, estimator: Estimator, block: Block) -> None:
        """Time stamps of another store have nothing to do with those before."""
        if int(self._delivery["clock"]) == block.store:
            return
        self._flows["sums"]["counted"] = 0
        if self._observer["started"] and math.isfinite(
            self._observer["time_s"]
        ):  # otherwise it already awaits another store
            estimator.resume(self._unseen_s(block))

    def _estimate(self, block: Block, of_type: PackType, arrival_s: float) -> None:
        """Step the samples, and pass the estimates to hour, meter and window."""
        observer, counters = self._observer, self._counters
        accepted, steps_back = int(observer["samples"]), int(observer["time_steps_back"])
        of_type.meter.continue_from(ChargeEnergy(*(float(self._flows[name]) for name in ChargeEnergy._fields)))
        for part in _parts(block):
            trace = of_type.estimator.run(part.samples)
            hour_summary.add(self._record["hour"], trace, part, of_type.estimator)
            of_type.meter.add(trace)
            self._window.add(trace, arrival_s)
        counters["blocks"] += 1
        counters["samples"] += block.samples.size
        counters["dropped_samples"] += block.samples.size - (int(observer["samples"]) - accepted)
        counters["time_steps_back"] += int(observer["time_steps_back"]) - steps_back

    def _state(self, of_type: PackType, now_s: float) -> bytes | None:
        """Topic ``state`` of the window; None when no sample was accepted."""
        flow, window, d = of_type.meter.flow, self._window.take(), self._delivery
        for name, value in zip(ChargeEnergy._fields, flow, strict=True):
            self._flows[name] = value
        if window is None:
            return None
        counters = {"frames_received": int(d["blocks"]) + 1, "frames_lost": int(d["lost_blocks"])}
        remaining = remaining_charge(of_type.estimator, window.current_a)
        return _json(make_state_payload(window, remaining, counters, now_s, flow, of_type.capacity_ah))

    def _parameters(self, estimator: Estimator, arrival_s: float, now_s: float) -> bytes:
        """Topic ``parameters``; ages in it are counted from the samples' arrival, however late they are worked off."""
        return _json(make_parameters_payload(estimator, arrival_s).model_copy(update={"publish_time": iso_utc(now_s)}))

    def _check_times(self, samples: SampleBlock) -> None:
        """Set implausible timestamps to NaN."""
        times = samples["time_s"]
        fit = (times >= 0.0) & (times <= MAX_STORE_S)
        if not fit.all():
            self._counters["no_time"] += int(np.count_nonzero(~fit))
            times[~fit] = math.nan

    def _unseen_s(self, block: Block) -> float:
        """Return the length of the gap before a block [s]; infinite if unknown."""
        d, known_s = self._delivery, _known(block.samples)
        if not d["clock"] or not known_s.size:
            return math.inf
        passed_s = (block.store - int(d["clock"])) / 1e9 + (float(known_s[0]) - float(d["last_s"]))
        return passed_s if passed_s >= 0.0 else math.inf

    def _turn_hour(self, pack: str, block: Block, of_type: PackType) -> tuple[tuple[tuple[str, bytes], ...], bool]:
        """Finish the hour before if a block is of a later one, and begin the new one; return the row if it has data."""
        present, before = hour_summary.hour_of(block), int(self._delivery["hour"])
        if present <= before:
            return (), False
        rows: tuple[tuple[str, bytes], ...] = ()
        if before:
            settings = of_type.settings.model_copy(update={"name": pack})
            rows = (
                (
                    f"{pack}.{before}",
                    _json(hour_summary.row(settings, before, self._record["hour"], of_type.estimator)),
                ),
            )
        hour_summary.begin(self._record["hour"], self._record[0]["estimator"])
        self._delivery["hour"] = present
        return rows, True

    def _note_clock(self, block: Block) -> None:
        known_s = _known(block.samples)
        if known_s.size:
            self._delivery["clock"], self._delivery["last_s"] = block.store, known_s[-1]

    def _arrival_s(self, block: Block) -> float:
        """Wall clock at the last sample's arrival at the edge, if plausible [s since 1970]."""
        if 0.0 <= block.arrival_s <= LAST_WALL_S:
            return block.arrival_s
        self._counters["no_arrival"] += 1
        return block.store / 1e9 + float(self._delivery["last_s"])


def _parts(block: Block) -> Iterator[Block]:
    """Split a block into parts of at most ``AT_ONCE`` samples."""
    if block.samples.size <= AT_ONCE:
        yield block
        return
    for first in range(0, block.samples.size, AT_ONCE):
        yield replace(block, samples=block.samples[first : first + AT_ONCE])


def _known(samples: SampleBlock) -> NDArray[np.float64]:
    """Time stamps that can be [s]."""
    times: NDArray[np.float64] = samples["time_s"]
    return times[np.isfinite(times)]


def _digest(words: NDArray[np.uint64]) -> Digest:
    first, second = words.tolist()
    return first, second


def _json(report: Payload) -> bytes:
    return report.model_dump_json().encode()
