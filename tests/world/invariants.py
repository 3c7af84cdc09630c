"""What must hold, whatever happens. Each number that bounds something stands here."""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

from pydantic_core import from_json

from bms_estimator.model.payloads import Estimate, Snapshot
from bms_estimator.protocols.firmware.messages import DELIMITER, PROTOCOL_VERSION, MessageType, ProtocolError, unseal
from bms_estimator.telemetry.charge_energy import ChargeEnergy
from tests.world.broker import Connection, Packet

MAX_STDS = 4.0
"""The true SOC is never further from the estimate than so many of its standard deviations, and ``SOC_FLOOR``."""
SOC_FLOOR = 0.004
"""What a published SOC may be off whatever its std says: the sample that it belongs to may be the one before."""
USUAL_STDS = 2.0
MAX_TASKS = 40
MAX_READS = 64
MAX_READY = 2000


class InvariantError(Exception):
    """Something that must hold does not."""


class Reference:
    """The valid samples in the bytes that a process was given, by the codec that decodes one message at a time."""

    def __init__(self) -> None:
        self._rest = b""
        self.samples = 0

    def feed(self, data: bytes) -> bool:
        """Returns whether samples have come."""
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
    """One that the service has given away."""

    process: int
    said_s: float
    disk_failed: bool
    """It may never have been on disk, where older ones still wait."""


class End(NamedTuple):
    """How a process has ended."""

    at_s: float
    """When it last ran: a process that is frozen saves nothing."""
    forgotten_s: float
    """What it had said or heard for longer outlives it."""


IN_FLIGHT_S = 15.0
"""What was said last may still be on its way [s]."""


@dataclass
class Said:
    """States that the service has given away, and what the broker has of them."""

    payloads: dict[bytes, int] = field(default_factory=dict)
    """Payload -> its number."""
    states: list[State] = field(default_factory=list)
    last: int = -1
    """The newest that the broker has."""
    received: dict[int, list[tuple[Connection, int]]] = field(default_factory=dict)
    """Number -> on which connections it came, and under which packet identifier."""
    ends: dict[int, End] = field(default_factory=dict)
    """Of processes."""
    doubled: int = 0
    forgotten: int = 0
    """States that a kill or a power cut has cost."""

    def say(self, payload: bytes, process: int, now_s: float, *, disk_failed: bool) -> None:
        """The service gives one away."""
        self.payloads[payload] = len(self.states)
        self.states.append(State(process, now_s, disk_failed))

    def end(self, process: int, now_s: float, forgotten_s: float) -> None:
        """A process has ended."""
        self.ends[process] = End(now_s, forgotten_s)

    def take(self, packet: Packet, connection: Connection | None, *, in_order: bool) -> str:
        """The broker has received a state; ``in_order``: not before one that came already. Returns what is wrong with that."""
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
        """Whether who sends on ``connection`` knows that the broker has acknowledged what came on ``other``."""
        heard_s = other.acknowledged.get(mid)
        if heard_s is None:
            return False
        if other.loop is connection.loop:
            return True
        ends = [end for number, end in self.ends.items() if number >= process]
        return not any(heard_s > end.at_s - end.forgotten_s for end in ends)

    def lost(self, now_s: float) -> list[int]:
        """What the broker never got though nothing explains it."""
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
    """How the SOC did."""

    states: int = 0
    inside: int = 0
    worst_stds: float = 0.0
    worst_error: float = 0.0

    def take(self, snapshot: Snapshot, true_soc: float) -> str:
        """A snapshot with its truth. Returns what is wrong with that."""
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
    """Charge and energy that the service has told, over all its processes."""

    kept: ChargeEnergy = field(default_factory=ChargeEnergy)
    """What it told that was on disk."""

    def take(self, estimate: Estimate, *, kept: bool) -> str:
        """A state; ``kept``: the disk has taken what it tells. Returns what is wrong with that."""
        flow = ChargeEnergy(*(getattr(estimate, name) for name in ChargeEnergy._fields))
        wrong = f"{flow} after {self.kept}" if any(a < b for a, b in zip(flow, self.kept, strict=True)) else ""
        if kept:
            self.kept = flow
        return wrong


@dataclass
class Truth:
    """Something that others are told of: since when it holds, and whether they know."""

    within_s: float
    """So long after it has come to hold they must know."""
    now: str | None = None
    wrong_since_s: float | None = None
    longest_s: float = 0.0
    """It took them at most."""

    def check(self, truth: str | None, told: str | None, now_s: float) -> str:
        """Compare; ``truth`` is None while nobody can be told. Returns what is wrong."""
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
    """A payload for people."""
    return None if payload is None else payload.decode(errors="replace")


@lru_cache(maxsize=64)
def is_json(payload: bytes) -> bool:
    """Whether a payload is strict JSON: no NaN, no infinity. The longest come again with each connection."""
    try:
        from_json(payload, allow_inf_nan=False, cache_strings="none")
    except ValueError:
        return False
    return True
