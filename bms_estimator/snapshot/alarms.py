"""All alarms of a pack: from every sample, and what the estimator made of it, to what is raised.

Each sample is judged, not the means that are published, and on the samples' own clock: a replay raises the same. What the
sensors say counts as it came, also what the estimator takes for a glitch; the delays keep single ones out.
"""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.kernels.sample_step import GAP_RATIO
from bms_estimator.kernels.state import TRACE
from bms_estimator.model.alarm_limits import Watched
from bms_estimator.model.alarm_settings import AlarmName
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.estimate import Alarm
from bms_estimator.model.sample import SAMPLE, CellBlock, SampleBlock, SampleStatus
from bms_estimator.model.suspect import Suspect
from bms_estimator.snapshot.alarm_state import AlarmState, Floats, Raising, Turn
from bms_estimator.snapshot.alarm_text import alarm_text

SENSOR_SUSPECTS = Suspect.SIGN_OF_CURRENT | Suspect.OFFSET | Suspect.OUTLIERS | Suspect.VOLTAGE | Suspect.CURRENT
MODEL_SUSPECTS = Suspect.CAPACITY | Suspect.OCV
ALWAYS: frozenset[AlarmName] = frozenset(("sensor_fault", "link_lost"))
"""These are watched before anything was measured."""
WAITING_ROWS = 256
"""Room for so many samples to begin with."""
SHARE_S = 1.0
"""Lost and unusable samples are set against the good ones of so long at least [s]."""


class Counts(NamedTuple):
    """Samples since start."""

    good: int
    bad: int
    """Lost on the line, damaged, or refused by the estimator for what they hold."""


class Change(NamedTuple):
    """That an alarm was raised or ended."""

    at_s: float
    """On the samples' clock [s]."""
    alarm: Alarm


class Reasons(NamedTuple):
    """What else is known of an alarm's cause."""

    suspects: Suspect
    texts: tuple[str, ...]


class Told(NamedTuple):
    """What is told of an alarm."""

    raising: Raising | None
    gone: bool
    reasons: tuple[str, ...]


_NO_REASONS = Reasons(Suspect(0), ())


@dataclass
class _Steps:
    """Times between samples: what is between is taken to be as at both ends, unless it is a gap.

    Attributes:
        gap_s: What is shorter is none [s].
    """

    gap_s: float
    _last_s: float = math.nan
    _step_s: float = math.inf

    def of(self, times_s: Floats) -> tuple[Floats, Floats]:
        """Shape (n,) each: the time before each sample [s], 0 where the clock was set back; and 0 in gaps, too."""
        passed_s = np.diff(times_s, prepend=self._last_s)
        passed_s = np.where(passed_s > 0.0, passed_s, 0.0)
        before_s = np.concatenate(([self._step_s], passed_s[:-1]))
        seen_s = np.where(passed_s > np.maximum(self.gap_s, GAP_RATIO * before_s), 0.0, passed_s)
        self._last_s, self._step_s = float(times_s[-1]), float(passed_s[-1]) or self._step_s
        return passed_s, seen_s


class _Rows:
    """Rows of one dtype that wait: written in place, since to join hundreds of short structured arrays takes milliseconds."""

    def __init__(self, dtype: Any, columns: tuple[int, ...] = ()) -> None:
        self._rows = np.zeros((WAITING_ROWS, *columns), dtype=dtype)
        self.size = 0

    def add(self, values: Any, count: int) -> None:
        """Append ``count`` rows."""
        end = self.size + count
        if end > len(self._rows):
            more = np.zeros((end, *self._rows.shape[1:]), dtype=self._rows.dtype)
            self._rows = np.concatenate((self._rows, more))
        self._rows[self.size : end] = values
        self.size = end

    def take(self) -> Any:
        """All of them; valid until the next call of ``add``."""
        rows, self.size = self._rows[: self.size], 0
        return rows


class Alarms:
    """The alarms of one pack.

    Args:
        watched: What is watched.
        charging_a: From this current into the pack on it is charged [A].
        gap_s: A time between samples that is shorter is no gap [s].

    Attributes:
        rows: Samples that wait to be judged.
        kept: What outlives a restart, as ``restore`` takes it.
    """

    def __init__(self, watched: Sequence[Watched], charging_a: float, gap_s: float) -> None:
        self._states = {each.name: AlarmState(each) for each in watched}
        self._charging_a = charging_a
        self._sampled, self._traced, self._shared = _Steps(gap_s), _Steps(gap_s), _Steps(math.inf)
        self._samples, self._traces, self._extremes = _Rows(SAMPLE), _Rows(TRACE), _Rows(np.float64, (2,))
        self._counts: Counts | None = None
        self._counted_s = -math.inf
        self._at_s = 0.0  # of the last sample
        self._mismatch_suspected = False
        self._reasons: dict[AlarmName, Reasons] = {}
        self._changes: list[Change] = []
        self._unshown: dict[AlarmName, Told] = {}
        self.kept = ""

    @property
    def rows(self) -> int:
        """Samples that wait to be judged."""
        return self._samples.size

    def add(self, block: SampleBlock, trace: TraceBlock, cells: CellBlock) -> None:
        """Take a block, what the estimator made of it, and the cells beside it; ``judge`` looks at them."""
        self._samples.add(block, block.size)
        self._traces.add(trace, trace.size)
        self._extremes.add(_extremes(cells) if len(cells) == block.size else math.nan, block.size)

    def judge(self, arrival_s: float, counts: Counts, suspects: Suspect, suspicions: Sequence[str]) -> None:
        """Judge all that waits.

        Args:
            arrival_s: Wall clock at the arrival of the last of it [s since 1970].
            counts: Samples since start.
            suspects: What the identifier suspects now.
            suspicions: The same in sentences.
        """
        if not self.rows:
            return
        samples, trace, extremes_v = self._samples.take(), self._traces.take(), self._extremes.take()
        known = np.isfinite(samples["time_s"])
        if not known.all():
            samples, extremes_v = samples[known], extremes_v[known]
        self._suspect("sensor_fault", suspects & SENSOR_SUSPECTS, suspicions)
        self._suspect("model_mismatch", suspects & MODEL_SUSPECTS, suspicions)
        if samples.size:
            wall_s = arrival_s - float(samples["time_s"][-1])
            self._judge_samples(samples, extremes_v[:, 0], extremes_v[:, 1], wall_s)
            self._judge_share(float(samples["time_s"][-1]), counts, suspects, wall_s)
        if trace.size:
            self._judge_estimates(trace, suspects, arrival_s - float(trace["time_s"][-1]))
        self._keep()

    def silent(self, silent_s: float, now_s: float, reason: str) -> None:
        """No sample has come for so long.

        Args:
            silent_s: On the monotonic clock [s].
            now_s: Wall clock [s since 1970].
            reason: Why, as far as that is known.
        """
        state = self._states.get("link_lost")
        if state is None or silent_s < state.watched.limit:
            return
        if state.gone:  # it latches, and is back
            state.gone = False
            self._keep()
        if state.raising is None:
            self._reasons["link_lost"] = Reasons(Suspect(0), (reason,) if reason else ())
            self._note(state, state.raise_at(self._at_s, Raising(now_s, silent_s)))
            self._keep()

    def acknowledge(self, name: AlarmName | None) -> list[AlarmName]:
        """Somebody knows of an alarm, or of all. Returns which ones: those whose cause is gone have ended by that.

        Args:
            name: Which; None: all.
        """
        found = [state for key, state in self._states.items() if state.raising and name in (None, key)]
        for state in found:
            if state.acknowledge():
                self._changes.append(Change(self._at_s, self._alarm(state)))
        self._keep()
        return [state.watched.name for state in found]

    def names(self) -> tuple[AlarmName, ...]:
        """Of all that are watched."""
        return tuple(self._states)

    @property
    def active(self) -> tuple[AlarmName, ...]:
        """Of those that are raised."""
        return tuple(name for name, state in self._states.items() if state.raising is not None)

    def changes(self) -> list[Change]:
        """What was raised and ended since the last call."""
        changes, self._changes = self._changes, []
        return changes

    def report(self) -> tuple[Alarm, ...]:
        """All that are watched. What was raised since the last call is shown as it was raised, though it may have ended."""
        unshown, self._unshown = self._unshown, {}
        return tuple(
            _alarm(state.watched, unshown[name]) if state.raising is None and name in unshown else self._alarm(state)
            for name, state in self._states.items()
            if state.known or state.raising is not None or name in ALWAYS
        )

    def restore(self, kept: str) -> None:
        """Go on from what a run before has ``kept``.

        Raises:
            ValueError, TypeError, LookupError: It is damaged.
        """
        for name, told in json.loads(kept or "{}").items():
            state = self._states.get(name)
            if state is None or (told["gone"] and not state.watched.latch):
                continue
            since_s, value = float(told["since_s"]), told["value"]
            iso_utc(since_s)
            if value is not None and not math.isfinite(value):
                raise ValueError(f"{name}: value = {value}")
            raising = Raising(since_s, None if value is None else float(value))
            state.restore(raising, gone=bool(told["gone"]), acknowledged=bool(told["acknowledged"]))
        self._keep()

    def _judge_samples(self, samples: SampleBlock, lowest_v: Floats, highest_v: Floats, wall_s: float) -> None:
        times_s = samples["time_s"]
        self._at_s = float(times_s[-1])
        passed_s, seen_s = self._sampled.of(times_s)
        voltage_v, temperature_c = samples["voltage_v"], samples["temperature_c"]
        at_end = (samples["status"] & SampleStatus.CURRENT_SATURATED) != 0
        current_a = np.where(at_end, np.copysign(np.inf, samples["current_a"]), samples["current_a"])
        charged_c = np.where(current_a <= -self._charging_a, temperature_c, np.inf)
        charged_c[np.isnan(current_a) | np.isnan(temperature_c)] = np.nan
        values: dict[AlarmName, Floats] = {
            "pack_over_voltage": voltage_v,
            "pack_under_voltage": voltage_v,
            "cell_over_voltage": highest_v,
            "cell_under_voltage": lowest_v,
            "cell_imbalance": highest_v - lowest_v,
            "discharge_over_current": current_a,
            "charge_over_current": -current_a,
            "over_temperature": temperature_c,
            "under_temperature": temperature_c,
            "charging_below_freezing": charged_c,
        }
        for name, of in values.items():
            self._take(name, times_s, seen_s, of, wall_s)
        self._take("link_lost", times_s, passed_s, np.where(seen_s < passed_s, passed_s, 0.0), wall_s)

    def _judge_share(self, at_s: float, counts: Counts, suspects: Suspect, wall_s: float) -> None:
        """Of samples that are lost or unusable among all."""
        if 0.0 <= at_s - self._counted_s < SHARE_S:
            return
        before, self._counts, self._counted_s = self._counts, counts, at_s
        _, seen_s = self._shared.of(np.array([at_s]))
        good, bad = (counts.good - before.good, counts.bad - before.bad) if before else (0, 0)
        share = bad / (good + bad) if good + bad > 0 else math.nan
        if suspects & SENSOR_SUSPECTS:
            share = math.inf
        self._take("sensor_fault", np.array([at_s]), seen_s, np.array([share]), wall_s)

    def _judge_estimates(self, trace: TraceBlock, suspects: Suspect, wall_s: float) -> None:
        times_s = trace["time_s"]
        _, seen_s = self._traced.of(times_s)
        soc, std = trace["soc"], trace["soc_std"]
        lost = (trace["lock"] == 0) | self._mismatch_suspected
        self._mismatch_suspected = bool(suspects & MODEL_SUSPECTS)
        lost[-1] |= self._mismatch_suspected  # since when, nobody knows: not before
        values: dict[AlarmName, Floats] = {
            "soc_low": soc - np.where(np.isnan(std), 0.0, std),
            "stability_margin_low": trace["stability_margin"],
            "model_mismatch": np.where(lost, np.inf, np.abs(trace["innovation_v"])),
        }
        for name, of in values.items():
            self._take(name, times_s, seen_s, of, wall_s)

    def _take(self, name: AlarmName, times_s: Floats, steps_s: Floats, values: Floats, wall_s: float) -> None:
        state = self._states.get(name)
        if state is not None:
            self._note(state, state.take(times_s, steps_s, values, wall_s))

    def _note(self, state: AlarmState, turns: Iterable[Turn]) -> None:
        name = state.watched.name
        for turn in turns:
            told = Told(turn.raising, gone=False, reasons=self._reasons.get(name, _NO_REASONS).texts)
            if turn.raising is not None:
                self._unshown[name] = told
            self._changes.append(Change(turn.at_s, _alarm(state.watched, told)))

    def _suspect(self, name: AlarmName, suspects: Suspect, suspicions: Sequence[str]) -> None:
        """Keep the sentences as they were when one came or went: numbers in them may change each second."""
        state, before = self._states.get(name), self._reasons.get(name, _NO_REASONS)
        if state is not None and suspects != before.suspects and (suspects or state.raising is None):
            texts = tuple(said for said in suspicions for suspect in suspects if said.endswith(suspect.text))
            self._reasons[name] = Reasons(suspects, texts)

    def _alarm(self, state: AlarmState) -> Alarm:
        reasons = self._reasons.get(state.watched.name, _NO_REASONS).texts
        return _alarm(state.watched, Told(state.raising, gone=state.gone, reasons=reasons))

    def _keep(self) -> None:
        """What is raised outlives a restart: a relay that has cut the load must not let it on again for that."""
        kept = {
            name: {**state.raising._asdict(), "gone": state.gone, "acknowledged": state.acknowledged}
            for name, state in self._states.items()
            if state.raising is not None
        }
        self.kept = json.dumps(kept) if kept else ""


def _alarm(watched: Watched, told: Told) -> Alarm:
    raising, value = told.raising, told.raising.value if told.raising else None
    return Alarm(
        name=watched.name,
        severity=watched.severity,
        active=raising is not None,
        latched=told.gone,
        since=iso_utc(raising.since_s) if raising else None,
        value=value,
        limit=watched.limit,
        unit=watched.unit,
        text=alarm_text(watched, value, told.reasons, gone=told.gone) if raising else "",
    )


def _extremes(cells: CellBlock) -> Floats:
    """Lowest and highest cell voltage of each sample [V], NaN where none was told. Shape (n, 2)."""
    return np.stack((np.fmin.reduce(cells, axis=1), np.fmax.reduce(cells, axis=1)), axis=1)
