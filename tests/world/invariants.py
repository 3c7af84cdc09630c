"""Invariants of a world, and their limits."""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

from pydantic_core import from_json

from bms_estimator.model.payloads import Estimate, Snapshot
from bms_estimator.protocols.firmware.messages import DELIMITER, PROTOCOL_VERSION, MessageType, ProtocolError, unseal
from bms_estimator.telemetry.charge_energy import ChargeEnergy
from tests.world.broker import Connection, Packet

MAX_STDS = 4.0
"""Maximum SOC error [standard deviations], in addition to ``SOC_FLOOR``."""
SOC_FLOOR = 0.004
"""Permitted SOC error in addition to ``MAX_STDS``: the published SOC may belong to the previous sample."""
USUAL_STDS = 2.0
MAX_TASKS = 40
MAX_READS = 64
MAX_READY = 2000


class InvariantError(Exception):
    """Violated invariant."""


class Reference:
    """Reference count of the valid samples delivered to a process, by a decoder of single messages."""

    def __init__(self) -> None:
        self._rest = b""
        self.samples = 0

    def feed(self, data: bytes) -> bool:
        """Decode bytes; return True if they completed a sample."""
        before = self.samples
        *frames, self._rest = (self._rest + data).split(DELIMITER)
        for frame in frames:
            try:
                packet = unseal(frame) if frame else b""
            except ProtocolError:
                continue
            self.samples += len(packet) == 22 and packet[:2] == bytes((PROTOCOL_VERSION, MessageType.SAMPLE))
        return self.samples > before


class State(NamedTuple):
    """State that the service has published."""

    process: int
    said_s: float
    disk_failed: bool
    """True if the state may not be on disk, while older ones wait there."""


class End(NamedTuple):
    """End of a process."""

    at_s: float
    """Time at which it last ran [s]: a frozen process saves nothing."""
    forgotten_s: float
    """Age beyond which its sent and received messages survive [s]."""


IN_FLIGHT_S = 15.0
"""Time for which a message may be in flight [s]."""


@dataclass
class PublishedStates:
    """Published states, and those that the broker has received."""

    payloads: dict[bytes, int] = field(default_factory=dict)
    """Number of a state by payload."""
    states: list[State] = field(default_factory=list)
    last: int = -1
    """Number of the newest state at the broker."""
    received: dict[int, list[tuple[Connection, int]]] = field(default_factory=dict)
    """Deliveries of each state: connection and packet identifier."""
    ends: dict[int, End] = field(default_factory=dict)
    """Ends of processes."""
    doubled: int = 0
    forgotten: int = 0
    """Number of states lost by a kill or a power cut."""

    def say(self, payload: bytes, process: int, now_s: float, *, disk_failed: bool) -> None:
        """Record a published state."""
        self.payloads[payload] = len(self.states)
        self.states.append(State(process, now_s, disk_failed))

    def end(self, process: int, now_s: float, forgotten_s: float) -> None:
        """Record the end of a process."""
        self.ends[process] = End(now_s, forgotten_s)

    def take(self, packet: Packet, connection: Connection | None, *, in_order: bool) -> str:
        """Check a state that the broker has received; ``in_order``: it must be newer than earlier ones. Return the violation, or an empty text."""
        number = self.payloads.get(packet.payload)
        if number is None:
            return "a state that nobody said"
        if connection is None:
            return "a state that came without a connection"
        earlier = self.received.setdefault(number, [])
        for other, mid in earlier:
            if other is connection:
                return f"state {number} came twice on one connection"
            if self._known(other, mid, connection, self.states[number].process):
                return f"state {number} came again though its acknowledgement had come"
        if earlier:
            self.doubled += 1
        elif number < self.last:
            last = self.states[self.last]
            if self.states[number].process == last.process or (in_order and not last.disk_failed):
                return f"state {number} came after state {self.last}"
        earlier.append((connection, packet.mid))
        self.last = max(self.last, number)
        return ""

    def _known(self, other: Connection, mid: int, connection: Connection, process: int) -> bool:
        """Return True if the sender on ``connection`` knows that the broker acknowledged the message on ``other``."""
        heard_s = other.acknowledged.get(mid)
        if heard_s is None:
            return False
        if other.loop is connection.loop:
            return True
        ends = [end for number, end in self.ends.items() if number >= process]
        return not any(heard_s > end.at_s - end.forgotten_s for end in ends)

    def lost(self, now_s: float) -> list[int]:
        """Return the states that were lost without an explanation."""
        missing = [n for n in range(len(self.states)) if n not in self.received]
        ends = self.ends.items()
        lost = []
        for n in missing:
            state = self.states[n]
            if state.said_s > now_s - IN_FLIGHT_S:
                continue
            if any(p >= state.process and state.said_s > end.at_s - end.forgotten_s for p, end in ends):
                self.forgotten += 1
            else:
                lost.append(n)
        return lost


@dataclass
class Band:
    """Statistics of the SOC error."""

    states: int = 0
    inside: int = 0
    worst_stds: float = 0.0
    worst_error: float = 0.0

    def take(self, snapshot: Snapshot, true_soc: float) -> str:
        """Check a snapshot against the true SOC. Return the violation, or an empty text."""
        e = snapshot.estimate
        if e is None or e.soc is None or e.soc_std is None:
            return ""
        error = abs(e.soc - true_soc)
        self.states += 1
        self.inside += error <= USUAL_STDS * e.soc_std
        self.worst_error = max(self.worst_error, error)
        beyond = max(error - SOC_FLOOR, 0.0) / e.soc_std
        self.worst_stds = max(self.worst_stds, beyond)
        if beyond > MAX_STDS:
            return f"SOC {e.soc:.4f} +- {e.soc_std:.4f}, true {true_soc:.4f}"
        return ""


@dataclass
class Flowed:
    """Published totals of charge and energy over all processes."""

    kept: ChargeEnergy = field(default_factory=ChargeEnergy)
    """Last published totals that were on disk."""

    def take(self, estimate: Estimate, *, kept: bool) -> str:
        """Check the totals of a state; ``kept``: they are on disk. Return the violation, or an empty text."""
        flow = ChargeEnergy(*(getattr(estimate, name) for name in ChargeEnergy._fields))
        wrong = f"{flow} after {self.kept}" if any(a < b for a, b in zip(flow, self.kept, strict=True)) else ""
        if kept:
            self.kept = flow
        return wrong


@dataclass
class Truth:
    """Availability: true value, and delay until the retained message agrees."""

    within_s: float
    """Maximum delay [s]."""
    now: str | None = None
    wrong_since_s: float | None = None
    longest_s: float = 0.0
    """Largest delay so far [s]."""

    def check(self, truth: str | None, told: str | None, now_s: float) -> str:
        """Compare true and retained value; ``truth`` is None while the broker cannot know it. Return the violation, or an empty text."""
        right = truth is None or told == truth or (truth == "offline" and told is None)
        if right or truth != self.now:
            self.wrong_since_s = None if right else now_s
        elif self.wrong_since_s is None:
            self.wrong_since_s = now_s
        self.now = truth
        wrong_s = 0.0 if self.wrong_since_s is None else now_s - self.wrong_since_s
        self.longest_s = max(self.longest_s, wrong_s)
        return f"{told}, but {truth} for {wrong_s:.0f} s" if wrong_s > self.within_s else ""


def text(payload: bytes | None) -> str | None:
    """Return a payload as text."""
    return None if payload is None else payload.decode(errors="replace")


@lru_cache(maxsize=64)
def is_json(payload: bytes) -> bool:
    """Return True if a payload is strict JSON without NaN and infinity. Cached, because large payloads repeat at each connection."""
    try:
        from_json(payload, allow_inf_nan=False, cache_strings="none")
    except ValueError:
        return False
    return True
