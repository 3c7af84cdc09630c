"""Invariants of a world, and their limits."""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

from pydantic_core import from_json

from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.protocols.firmware.messages import DELIMITER, PROTOCOL_VERSION, MessageType, ProtocolError, unseal
from bms_estimator.telemetry.publish_window import ChargeEnergy
from tests.world.broker import Connection, Packet

MAX_STDS = 4.0
"""Maximum SOC error [standard deviations], in addition to ``SOC_TOLERANCE``."""
SOC_TOLERANCE = 0.004
"""Permitted SOC error in addition to ``MAX_STDS``, because the published SOC may belong to the previous sample."""
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


class ReferenceDecoder:
    """Independent decoder that counts the valid samples delivered to a process."""

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


class PublishedState(NamedTuple):
    """State that the service has published."""

    process: int
    """Number of the process."""
    published_s: float
    disk_failed: bool
    """True if this state may be missing on disk while older states wait there to be sent."""


class ProcessEnd(NamedTuple):
    """End of a process."""

    at_s: float
    """Time at which it last ran [s]: if it was frozen at its end, the begin of the freeze."""
    survival_age_s: float
    """Messages and acknowledgments older than this survive the end; infinite: all may be lost [s]."""


IN_FLIGHT_S = 15.0
"""Time for which a message may be in flight [s]."""


@dataclass
class PublishedStates:
    """States that the service has published, numbered from 0, and their deliveries to the broker."""

    payloads: dict[bytes, int] = field(default_factory=dict)
    """Number of each state by its payload."""
    states: list[PublishedState] = field(default_factory=list)
    newest: int = -1
    """Largest number of a state that the broker has received; -1: none."""
    received: dict[int, list[tuple[Connection, int]]] = field(default_factory=dict)
    """Deliveries of each state: connection and packet identifier."""
    ends: dict[int, ProcessEnd] = field(default_factory=dict)
    """Ends by number of process."""
    repeated_deliveries: int = 0
    """Number of repeated deliveries after a reconnect."""
    lost_at_kill: int = 0
    """Number of states lost by a kill or a power cut."""

    def record(self, payload: bytes, process: int, now_s: float, *, disk_failed: bool) -> None:
        """Record a published state."""
        self.payloads[payload] = len(self.states)
        self.states.append(PublishedState(process, now_s, disk_failed))

    def record_end(self, process: int, now_s: float, survival_age_s: float) -> None:
        """Record the end of a process."""
        self.ends[process] = ProcessEnd(now_s, survival_age_s)

    def check_received(self, packet: Packet, connection: Connection | None, *, in_order: bool) -> str:
        """Check a state that the broker has received.

        Args:
            packet: Message with the state.
            connection: Connection on which it arrived.
            in_order: True if it must be newer than all states received before, also than those of earlier processes.

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
            self.repeated_deliveries += 1
        elif number < self.newest:
            newest = self.states[self.newest]
            if self.states[number].process == newest.process or (in_order and not newest.disk_failed):
                return f"state {number} came after state {self.newest}"
        earlier.append((connection, packet.mid))
        self.newest = max(self.newest, number)
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

    def find_lost(self, now_s: float) -> list[int]:
        """Return the numbers of states whose loss no end of a process explains; count the others in ``lost_at_kill``."""
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
    """Number of states whose SOC error is at most ``INTERVAL_STDS`` standard deviations."""
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
        excess_stds = max(error - SOC_TOLERANCE, 0.0) / e.soc_std
        self.max_stds = max(self.max_stds, excess_stds)
        if excess_stds > MAX_STDS:
            return f"SOC {e.soc:.4f} +- {e.soc_std:.4f}, true {true_soc:.4f}"
        return ""


@dataclass
class ChargeTotals:
    """Published totals of charge and energy over all processes."""

    saved: ChargeEnergy = field(default_factory=ChargeEnergy)
    """Last published totals that were on disk; later ones must not be smaller."""

    def check(self, estimate: Estimate, *, saved: bool) -> str:
        """Check the totals of a state; ``saved``: they are on disk. Return the violation, or an empty text."""
        totals = ChargeEnergy(*(getattr(estimate, name) for name in ChargeEnergy._fields))
        decreased = any(total < saved_total for total, saved_total in zip(totals, self.saved, strict=True))
        violation = f"{totals} after {self.saved}" if decreased else ""
        if saved:
            self.saved = totals
        return violation


@dataclass
class AvailabilityCheck:
    """Availability: true value, and delay until the retained message agrees."""

    limit_s: float
    """Maximum delay [s]."""
    truth: str | None = None
    """True value at the last check; None: the broker could not know it."""
    disagrees_since_s: float | None = None
    max_delay_s: float = 0.0
    """Largest delay so far [s]."""

    def check(self, truth: str | None, retained: str | None, now_s: float) -> str:
        """Compare true and retained value. Return the violation, or an empty text.

        ``truth`` is None while the broker cannot know it. No retained message is as good as "offline".
        """
        agrees = truth is None or retained == truth or (truth == "offline" and retained is None)
        if agrees or truth != self.truth:
            self.disagrees_since_s = None if agrees else now_s
        elif self.disagrees_since_s is None:
            self.disagrees_since_s = now_s
        self.truth = truth
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
