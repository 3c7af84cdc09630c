"""What a soak is judged by: the SOC and its band, jumps at restarts, and where each second of samples has gone."""

import itertools
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.table import Row

BAND = 3.0
"""Half the width of the band of the SOC, in its published standard deviations."""
MOST_JUMP = 0.005
"""Of the SOC at a restart, beyond what flowed meanwhile."""
SHORT_S, SETTLED_STD = 10.0, 0.03
"""A jump is judged where the service was off for no longer [s], and knew its SOC so well before: of an unknown load that
goes on for minutes, as where it is killed again and again while it starts, nobody knows what flows."""
UNSEEN_S = 5.0
"""States come twice a second: so long without one is a gap, unless it is known why; a busy machine is late [s]."""
MOST_RSS_MIB = 300.0

Interval = tuple[float, float]
"""Wall clock, from and to [s]."""


class State(NamedTuple):
    """One message on the state topic, by its own time [s since 1970]."""

    time_s: float
    soc: float
    soc_std: float


@dataclass
class Account:
    """All that was seen; times are the wall clock's [s].

    Attributes:
        truth: Time and SOC of the pack.
        states: As they came.
        kills: When the service was killed.
        unplugged: When the line was.
        silent: While the broker did not answer.
        stalls: While this machine gave even the judge no time.
        outcomes: What became of the checkpoint, of each start.
        opened: When the service opened the line.
    """

    truth: list[tuple[float, float]] = field(default_factory=list)
    states: list[State] = field(default_factory=list)
    kills: list[float] = field(default_factory=list)
    unplugged: list[float] = field(default_factory=list)
    silent: list[Interval] = field(default_factory=list)
    stalls: list[Interval] = field(default_factory=list)
    outcomes: list[str] = field(default_factory=list)
    opened: list[float] = field(default_factory=list)
    tracebacks: int = 0
    ended_alone: int = 0
    rss_bytes: int = 0
    state_bytes: int = 0

    def read_log(self, text: str) -> None:
        """What the service said of its checkpoints and its line."""
        self.tracebacks = text.count("Traceback")
        for line in text.splitlines():
            if not line.startswith("{") or not line.endswith("}"):
                continue  # cut off by a kill
            entry = json.loads(line)
            if entry["event"] == "checkpoint":
                self.outcomes.append(entry["outcome"])
            elif entry["event"] == "port opened":
                self.opened.append(datetime.fromisoformat(entry["timestamp"]).timestamp())

    def unmeasured(self) -> list[Interval]:
        """While nobody measured: from a kill or an unplugging until the line was opened again."""
        opened = np.sort(np.array(self.opened))
        found = []
        for begin_s in (*self.kills, *self.unplugged):
            later = opened[np.searchsorted(opened, begin_s) :]
            found.append((begin_s, float(later[0]) if later.size else np.inf))
        return found

    def held_in_memory(self) -> list[Interval]:
        """While the broker did not answer and before the service, which could not know yet, was killed."""
        return [(begin, kill) for begin, end in self.silent for kill in self.kills if begin <= kill <= end]


def gaps(times_s: Iterable[float], known: list[Interval]) -> Iterator[Interval]:
    """Longer than ``UNSEEN_S`` without a state, what is known left out."""
    ordered = sorted(set(times_s))
    for before_s, after_s in itertools.pairwise(ordered):
        for begin_s, end_s in without(before_s, after_s, known) if after_s - before_s > UNSEEN_S else ():
            if end_s - begin_s > UNSEEN_S:
                yield begin_s, end_s


def without(begin_s: float, end_s: float, known: list[Interval]) -> Iterator[Interval]:
    """What is left of an interval."""
    for from_s, to_s in sorted(known):
        if to_s <= begin_s or from_s >= end_s:
            continue
        yield begin_s, from_s
        begin_s = max(begin_s, to_s)
    yield begin_s, end_s


def judged(account: Account) -> Iterator[Row]:
    """The table."""
    true_s, true_soc = np.array(account.truth).T
    came = np.array(account.states)
    _, first = np.unique(came[:, 0], return_index=True)
    time_s, soc, std = came[first].T
    truth = np.interp(time_s, true_s, true_soc)
    error = np.abs(soc - truth)
    outside = int(np.sum(error > BAND * std))
    yield Row("states, each once", "-", f"{time_s.size:,} of {came.shape[0]:,} messages", None)
    yield Row("SOC in its band, 3 soc_std", "at all times", f"{outside} states outside", outside == 0)
    yield Row(
        "  inside 2 soc_std",
        "-",
        f"{np.mean(error <= 2.0 * std):.1%}; soc_std {std.mean():.2%} in the mean, from {std.min():.2%} to {std.max():.2%}",
        None,
    )
    yield Row(
        "  error, mean and worst",
        "-",
        f"{error.mean():.2%}, {error.max():.2%}; true SOC moved {np.ptp(true_soc):.0%}",
        None,
    )
    restart = np.searchsorted(time_s, account.kills)
    restart = np.unique(restart[(restart > 0) & (restart < time_s.size)])
    jumps, off_s = np.abs(np.diff(soc - truth)[restart - 1]), np.diff(time_s)[restart - 1]
    short = (off_s <= SHORT_S) & (std[restart - 1] <= SETTLED_STD)
    met = bool(jumps[short].max(initial=0.0) <= MOST_JUMP)
    yield Row("jump of the SOC at a restart, beyond what flowed", "at most 0.5 %", _worst(jumps[short]), met)
    yield Row(f"  off for more than {SHORT_S:.0f} s, or soc_std above 3 % before", "-", _worst(jumps[~short]), None)
    known = [*account.unmeasured(), *account.stalls]
    lost, held = list(gaps(time_s, known)), list(gaps(time_s, known + account.held_in_memory()))
    yield Row("gaps in the states while the service measured", "none", _of(held), not held)
    yield Row("  with those held for a silent broker by a service killed then", "-", _of(lost), None)
    backward = int(np.sum(np.diff(came[np.sort(first), 0]) < 0.0))
    yield Row("states out of order", "none", str(backward), backward == 0)
    refused = [outcome for outcome in account.outcomes[1:] if not outcome.startswith("restored")]
    yield Row(
        "checkpoints taken up", "all", f"{len(account.outcomes) - 1 - len(refused)}, not {refused[:3]}", not refused
    )
    yield Row(
        "ended by itself, tracebacks",
        "never",
        f"{account.ended_alone}, {account.tracebacks}",
        not account.ended_alone + account.tracebacks,
    )
    rss_mib = account.rss_bytes / 2**20
    yield Row(
        "highest memory of the service",
        f"at most {MOST_RSS_MIB:.0f} MiB",
        f"{rss_mib:.0f} MiB",
        rss_mib <= MOST_RSS_MIB,
    )
    yield Row("its folder of state", "-", f"{account.state_bytes / 1024:.0f} KiB", None)


def _worst(jumps: NDArray[np.float64]) -> str:
    return f"worst {jumps.max():.2%}, mean {jumps.mean():.2%} of {jumps.size} restarts" if jumps.size else "no restart"


def _of(found: list[Interval]) -> str:
    return f"{len(found)}, {sum(end - begin for begin, end in found):.1f} s in all"
