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
"""Maximum SOC error [standard deviations], in addition to ``SOC_TOLERANCE``."""
SOC_TOLERANCE = 0.004
"""Permitted SOC error in addition to ``MAX_STDS``: the published SOC may belong to the previous sample."""
INTERVAL_STDS = 2.0
"""Half width of the interval whose coverage is reported [standard deviations]."""
MAX_TASKS = 40
"""Maximum number of unfinished tasks of a process."""
MAX_READS = 64
"""Maximum number of reads of the port that wait for the estimator."""
MAX_READY = 2000
"""Maximum number of ready handles of the event loop."""
SAMPLE_BYTES = 22
"""Length of an unsealed sample message of the firmware's protocol [bytes]."""


class InvariantError(Exception):
    """Violated invariant."""


class Reference:
    """Reference count of the valid samples delivered to a process, by a decoder of single messages."""

    def __init__(self) -> None:
        self._buffer = b""
        self.samples = 0

    def feed(self, data: bytes) -> bool:
        """Decode bytes; return True if they completed a sample."""
        before = self.samples
        *frames, self._buffer = (self._buffer + data).split(DELIMITER)
        for frame in frames:
            try:
                packet = unseal(frame) if frame else b""
            except ProtocolError:
                continue
            self.samples += len(packet) == SAMPLE_BYTES and packet[:2] == bytes((PROTOCOL_VERSION, MessageType.SAMPLE))
        return self.samples > before


class State(NamedTuple):
    """State that the service has published."""

    process: int
    published_s: float
    disk_failed: bool
    """True if the state may not be on disk, while older ones wait there."""


class End(NamedTuple):
    """End of a process."""

    at_s: float
    """Time at which it last ran [s]: a frozen process saves nothing."""
    survival_age_s: float
    """Age beyond which its sent and received messages survive the end [s]."""


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
    """Number of repeated deliveries after a reconnect."""
    lost_at_kill: int = 0
    """Number of states lost by a kill or a power cut."""

    def record(self, payload: bytes, process: int, now_s: float, *, disk_failed: bool) -> None:
        """Record a published state."""
        self.payloads[payload] = len(self.states)
        self.states.append(State(process, now_s, disk_failed))

    def end(self, process: int, now_s: float, survival_age_s: float) -> None:
        """Record the end of a process."""
        self.ends[process] = End(now_s, survival_age_s)

    def check_received(self, packet: Packet, connection: Connection | None, *, in_order: bool) -> str:
        """Check a state that the broker has received.

        Args:
            packet: Message with the state.
            connection: Connection on which it arrived.
            in_order: True if it must be newer than earlier ones also after a restart.

        Returns:
            Description of the violation; empty: none.
        """
        number = self.payloads.get(packet.payload)
        if number is None:
            return "a state that the service never published"
        if connection is None:
            return "a state that came without a connection"
        earlier = self.received.setdefault(number, [])
        for other, mid in earlier:
            if other is connection:
                return f"state {number} came twice on one connection"
            if self._acknowledgment_known(other, mid, connection, self.states[number].process):
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

    def _acknowledgment_known(self, other: Connection, mid: int, connection: Connection, process: int) -> bool:
        """Return True if the sender on ``connection`` knows that the broker acknowledged the message on ``other``."""
        acknowledged_s = other.acknowledged.get(mid)
        if acknowledged_s is None:
            return False
        if other.loop is connection.loop:
            return True
        ends = [end for number, end in self.ends.items() if number >= process]
        return not any(acknowledged_s > end.at_s - end.survival_age_s for end in ends)

    def lost(self, now_s: float) -> list[int]:
        """Return the states that were lost without an explanation."""
        missing = [n for n in range(len(self.states)) if n not in self.received]
        ends = self.ends.items()
        lost = []
        for n in missing:
            state = self.states[n]
            if state.published_s > now_s - IN_FLIGHT_S:
                continue
            if any(p >= state.process and state.published_s > end.at_s - end.survival_age_s for p, end in ends):
                self.lost_at_kill += 1
            else:
                lost.append(n)
        return lost


@dataclass
class SocErrors:
    """Statistics of the SOC error."""

    states: int = 0
    """Number of published states with an SOC."""
    within_interval: int = 0
    """Number of states whose SOC error is at most ``INTERVAL_STDS``."""
    max_stds: float = 0.0
    """Maximum SOC error beyond ``SOC_TOLERANCE`` [standard deviations]."""
    max_error: float = 0.0
    """Maximum SOC error."""

    def check(self, snapshot: Snapshot, true_soc: float) -> str:
        """Check a snapshot against the true SOC. Return the violation, or an empty text."""
        e = snapshot.estimate
        if e is None or e.soc is None or e.soc_std is None:
            return ""
        error = abs(e.soc - true_soc)
        self.states += 1
        self.within_interval += error <= INTERVAL_STDS * e.soc_std
        self.max_error = max(self.max_error, error)
        beyond = max(error - SOC_TOLERANCE, 0.0) / e.soc_std
        self.max_stds = max(self.max_stds, beyond)
        if beyond > MAX_STDS:
            return f"SOC {e.soc:.4f} +- {e.soc_std:.4f}, true {true_soc:.4f}"
        return ""


@dataclass
class ChargeTotals:
    """Published totals of charge and energy over all processes."""

    saved: ChargeEnergy = field(default_factory=ChargeEnergy)
    """Last published totals that were on disk."""

    def check(self, estimate: Estimate, *, saved: bool) -> str:
        """Check the totals of a state; ``saved``: they are on disk. Return the violation, or an empty text."""
        flow = ChargeEnergy(*(getattr(estimate, name) for name in ChargeEnergy._fields))
        violation = f"{flow} after {self.saved}" if any(a < b for a, b in zip(flow, self.saved, strict=True)) else ""
        if saved:
            self.saved = flow
        return violation


@dataclass
class AvailabilityCheck:
    """Availability: true value, and delay until the retained message agrees."""

    limit_s: float
    """Maximum delay [s]."""
    now: str | None = None
    disagrees_since_s: float | None = None
    max_delay_s: float = 0.0
    """Largest delay so far [s]."""

    def check(self, truth: str | None, retained: str | None, now_s: float) -> str:
        """Compare true and retained value; ``truth`` is None while the broker cannot know it. Return the violation, or an empty text."""
        agrees = truth is None or retained == truth or (truth == "offline" and retained is None)
        if agrees or truth != self.now:
            self.disagrees_since_s = None if agrees else now_s
        elif self.disagrees_since_s is None:
            self.disagrees_since_s = now_s
        self.now = truth
        delay_s = 0.0 if self.disagrees_since_s is None else now_s - self.disagrees_since_s
        self.max_delay_s = max(self.max_delay_s, delay_s)
        return f"{retained}, but {truth} for {delay_s:.0f} s" if delay_s > self.limit_s else ""


def decode_text(payload: bytes | None) -> str | None:
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
