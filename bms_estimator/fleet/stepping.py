"""A block of the pack on the bench: through the estimator, and what is published of it."""

import math
from collections import Counter
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.fleet import hour
from bms_estimator.fleet.block import Block
from bms_estimator.fleet.pack_state import PACK_STATE, Fields
from bms_estimator.fleet.pack_type import Digest, PackType
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.sample import SampleBlock
from bms_estimator.model.settings import PackSettings
from bms_estimator.service.checkpoint import fields, without_observer
from bms_estimator.service.resume import resume
from bms_estimator.snapshot.flow import Flow, Last
from bms_estimator.snapshot.parameters import parameter_report
from bms_estimator.snapshot.remaining import remaining_charge
from bms_estimator.snapshot.topics import estimate_report
from bms_estimator.snapshot.window import Window

LONGEST_STORE_S = 1e9
"""No store is in use for so long: a sample that is told to be later has no time [s]."""
LAST_WALL_S = 2.0**34
"""No wall clock shows a later time: the year 2514 [s since 1970]."""
Published = tuple[bytes | None, bytes | None, tuple[tuple[str, bytes], ...]]
"""Topics ``state`` and ``parameters``, and the rows of finished hours, each with an id."""


class Stepping:
    """Steps the pack on the bench.

    Args:
        record: The bench's, shape (1,), dtype ``PACK_STATE``.
        counters: Faults are counted here.
        wall: Wall clock, for what is published [s since 1970].
    """

    def __init__(self, record: NDArray[np.void], counters: Counter[str], wall: Callable[[], float]) -> None:
        self._record, self._counters, self._wall = record, counters, wall
        self._window = Window()

    def settle(self, of_type: PackType, former: Fields | None, block: Block) -> None:
        """Make the pack one of its type: as it is, or taken over from other settings or from another version.

        Args:
            of_type: Its type.
            former: Fields of its estimator as another version left them; None: they are on the bench.
            block: The next one.
        """
        record = self._record[0]
        d = record["delivery"]
        same = _digest(d["made_of"]) == of_type.made_of
        if same and former is None:
            return
        known = bool(record["hour"]["store"])
        if _digest(d["meaning"]) == of_type.meaning and known:
            saved = former if former is not None else {name: v.copy() for name, v in fields(self._record["estimator"])}
            record["estimator"] = np.zeros((), PACK_STATE["estimator"])
            saved = saved if same else without_observer(saved)
            wrong = resume(of_type.estimator, saved, self._unseen_s(block))
            record["hour"]["outliers_before"] = record["hour"]["searches_before"] = 0
            self._counters["not_taken_over" if wrong else "taken_over"] += 1
        else:
            for name in ("flow", "hour", "estimator"):
                record[name] = np.zeros((), PACK_STATE[name])
            d["clock"] = d["hour"] = 0
            self._counters["begun_anew"] += known
        d["made_of"], d["meaning"] = of_type.made_of, of_type.meaning

    def step(self, block: Block, of_type: PackType, settings: PackSettings) -> Published:
        """Take the pack's next block.

        Args:
            block: It; time stamps that cannot be become NaN.
            of_type: The pack's type; its estimator works on the bench.
            settings: Of the pack.
        """
        record, estimator = self._record[0], of_type.estimator
        d, sums, observer = record["delivery"], self._record["hour"], record["estimator"]["observer"]
        self._check_times(block.samples)
        rows, turned = self._turn_hour(block, of_type, settings)
        if int(d["clock"]) != block.store and observer["started"]:
            estimator.resume(self._unseen_s(block))
        before_s = float(observer["time_s"]) if observer["started"] else math.nan
        steps_back = int(observer["time_steps_back"])
        trace = estimator.run(block.samples)
        hour.add(sums, trace, block, estimator)
        flow = self._flow(trace, of_type, block)
        self._note_clock(d, block)
        self._counters["blocks"] += 1
        self._counters["samples"] += block.samples.size
        self._counters["dropped_samples"] += block.samples.size - trace.size
        self._counters["time_steps_back"] += int(observer["time_steps_back"]) - steps_back
        if not trace.size:
            return None, None, rows
        arrival_s = self._arrival_s(block)
        self._window.before_s = before_s
        self._window.add(trace, arrival_s)
        window = self._window.take()
        assert window is not None  # noqa: S101 - there are rows
        now_s = self._wall()
        counted = {"frames_received": int(d["blocks"]) + 1, "frames_lost": int(d["lost_blocks"])}
        remaining = remaining_charge(estimator, window.current_a)
        state = estimate_report(window, remaining, counted, now_s, flow, of_type.capacity_ah)
        parameters = None
        if turned:  # ages are counted from the samples, however late they come
            report = parameter_report(estimator, arrival_s).model_copy(update={"publish_time": iso_utc(now_s)})
            parameters = report.model_dump_json().encode()
        return state.model_dump_json().encode(), parameters, rows

    def _check_times(self, samples: SampleBlock) -> None:
        """A sample whose time cannot be has none."""
        times = samples["time_s"]
        fit = (times >= 0.0) & (times <= LONGEST_STORE_S)
        if not fit.all():
            self._counters["no_time"] += int(np.count_nonzero(~fit))
            times[~fit] = math.nan

    def _unseen_s(self, block: Block) -> float:
        """How long nobody measured before a block [s]; infinite when nobody knows."""
        d, known_s = self._record[0]["delivery"], _known(block.samples)
        if not d["clock"] or not known_s.size:
            return math.inf
        passed_s = (block.store - int(d["clock"])) / 1e9 + (float(known_s[0]) - float(d["last_s"]))
        return passed_s if passed_s >= 0.0 else math.inf

    def _turn_hour(
        self, block: Block, of_type: PackType, settings: PackSettings
    ) -> tuple[tuple[tuple[str, bytes], ...], bool]:
        """Where a block is of a later hour: the row of the one before, if anything came in it, and begin the new one."""
        d, sums = self._record[0]["delivery"], self._record["hour"]
        present, before = hour.hour_of(block), int(d["hour"])
        if present <= before:
            return (), False
        rows: tuple[tuple[str, bytes], ...] = ()
        if before:
            row = hour.row(settings, before, sums, of_type.estimator)
            rows = ((f"{settings.name}.{before}", row.model_dump_json().encode()),)
        hour.begin(sums, self._record[0]["estimator"])
        d["hour"] = present
        return rows, True

    def _flow(self, trace: TraceBlock, of_type: PackType, block: Block) -> Flow:
        """What has flowed, with a block."""
        f, meter = self._record[0]["flow"], of_type.meter
        total, last = Flow(*(float(f[name]) for name in Flow._fields)), Last()
        if f["counted"] and int(self._record[0]["delivery"]["clock"]) == block.store:
            last = Last(float(f["last_s"]), float(f["last_a"]), float(f["last_w"]), float(f["step_s"]))
        meter.go_on(total, last)
        meter.add(trace)
        flow, last = meter.flow, meter.last
        for name, value in zip(
            PACK_STATE["flow"].names or (), (*flow, int(trace.size > 0 or f["counted"]), *last), strict=True
        ):
            f[name] = value
        return flow

    def _note_clock(self, d: np.void, block: Block) -> None:
        known_s = _known(block.samples)
        if known_s.size:
            d["clock"], d["last_s"] = block.store, known_s[-1]

    def _arrival_s(self, block: Block) -> float:
        """Wall clock at the last sample's arrival, as the edge says, where that can be [s since 1970]."""
        if 0.0 <= block.arrival_s <= LAST_WALL_S:
            return block.arrival_s
        self._counters["no_arrival"] += 1
        return block.store / 1e9 + float(self._record[0]["delivery"]["last_s"])


def _known(samples: SampleBlock) -> NDArray[np.float64]:
    """Time stamps that can be [s]."""
    times: NDArray[np.float64] = samples["time_s"]
    return times[np.isfinite(times)]


def _digest(words: NDArray[np.uint64]) -> Digest:
    first, second = words.tolist()
    return first, second
