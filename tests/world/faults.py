"""Faults of a world and their times."""

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bms_estimator.protocols.firmware.messages import MODULUS
from tests.world.disk import ArmedFault, PowerCutError
from tests.world.line import Noise
from tests.world.loop import KilledError

if TYPE_CHECKING:
    from tests.world.world import World

MIN_PAUSE_S, MAX_PAUSE_S = 5.0, 300.0
"""Range of the time from the begin of a fault to that of the next [s]."""
MEAN_PAUSE_S = 90.0
"""Mean of the random part of that time; ``MIN_PAUSE_S`` is added [s]."""
MIN_DURATION_S, MAX_DURATION_S = 0.1, 400.0
"""Range of the duration of a fault [s]."""
MEAN_DURATION_S = 40.0
"""Mean of the random part of the duration; ``MIN_DURATION_S`` is added [s]."""
MAX_FIRST_S = 20.0
"""Maximum time before the first pause [s]."""
MAX_FREEZE_S = 120.0
"""Maximum duration for which a process is frozen [s]."""
MAX_HOSTILE_S = 60.0
"""Maximum time over which hostile requests are spread [s]."""
SYNC_CHANGE_S = 60.0
"""Minimum duration of a wall-clock fault that also changes whether the clock is synchronized [s]."""
STOP_S = 90.0
"""Stop timeout after which systemd kills the service [s]."""
MIN_JUMP_S, MAX_JUMP_S = 3.0, 3600.0
"""Range of the size of a step of the board's clock [s]. The service would accept a sample that is less than 2 s early."""
MAX_RANDOM_S = 5.0
"""Maximum duration of random timestamps of the board [s]."""
MAX_KILL_HANDLES = 200
"""Maximum number of handles of the event loop that still run before a kill."""
MAX_DISK_OPERATIONS = 8
"""Maximum number of operations on the disk that still succeed before a kill or a power cut at a write."""


@dataclass(frozen=True)
class Fault:
    """Fault of the world.

    Attributes:
        begin_s: Time since the start of the world [s].
        kind: Key of ``KINDS``.
    """

    begin_s: float
    kind: str
    duration_s: float
    """Duration, or time until the service is started again [s]."""
    severity: float
    """Random number of 0..1 that selects strength, direction or variant of the fault."""

    def apply(self, world: "World") -> None:
        """Apply the fault to a world."""
        KINDS[self.kind](world, self)

    def __str__(self) -> str:
        return f"{self.kind} for {self.duration_s:.1f} s, severity {self.severity:.3f}"


def ordinary_kinds(*, auto: bool, text: bool) -> list[str]:
    """Return the kinds of faults that may occur in a world, without those of the board's clock.

    Args:
        auto: True if the service searches for its port, so that it finds a renamed one.
        text: True if the board prints text, which has no serial number.
    """
    return [
        kind
        for kind in KINDS
        if kind not in CLOCK_FAULTS
        and not (kind == "boards swapped" and text)
        and not (kind == "port renamed" and not auto)
    ]


def schedule(dice: random.Random, until_s: float, kinds: Sequence[str]) -> list[Fault]:
    """Draw faults with their times. Each world has a random subset of ``kinds``."""
    drawn_kinds = dice.sample(kinds, k=dice.randint(2, len(kinds)))
    faults = []
    begin_s = MAX_FIRST_S * dice.random()
    while True:
        begin_s += min(dice.expovariate(1.0 / MEAN_PAUSE_S) + MIN_PAUSE_S, MAX_PAUSE_S)
        if begin_s >= until_s:
            return faults
        duration_s = min(dice.expovariate(1.0 / MEAN_DURATION_S) + MIN_DURATION_S, MAX_DURATION_S, until_s - begin_s)
        faults.append(Fault(begin_s, dice.choice(drawn_kinds), duration_s, dice.random()))


def _with_noise(noise: Callable[[float], Noise]) -> Callable[["World", Fault], None]:
    def apply(world: "World", fault: Fault) -> None:
        world.cable.noise = noise(fault.severity)
        world.timeline.after(fault.duration_s, lambda: setattr(world.cable, "noise", Noise()))

    return apply


def _unplug(world: "World", fault: Fault) -> None:
    if world.cable.unplug() is not None:
        world.timeline.after(fault.duration_s, lambda: _plug(world, world.port_name))


def _plug(world: "World", name: str) -> None:
    if world.cable.board is None:
        world.board.reset()
        world.cable.plug(world.board, name)


def _rename_port(world: "World", fault: Fault) -> None:
    if world.cable.unplug() is not None:
        world.timeline.after(fault.duration_s, lambda: _plug(world, f"ttyACM{int(100 * fault.severity)}"))


def _swap_boards(world: "World", fault: Fault) -> None:
    if world.cable.unplug() is None:
        return
    world.foreign_board.reset()
    world.cable.plug(world.foreign_board, world.port_name)

    def plug_own_board() -> None:
        if world.cable.board is world.foreign_board:
            world.cable.unplug()
            _plug(world, world.port_name)

    world.timeline.after(fault.duration_s, plug_own_board)


def _reset_board(world: "World", fault: Fault) -> None:
    if world.cable.board is not None:
        world.cable.send(world.cable.board.reset())


def _jump_s(fault: Fault) -> float:
    """Return a clock step, ahead or back, whose size is between ``MIN_JUMP_S`` and ``MAX_JUMP_S`` [s]."""
    size = abs(2.0 * fault.severity - 1.0)
    return math.copysign(MIN_JUMP_S * (MAX_JUMP_S / MIN_JUMP_S) ** size, fault.severity - 0.5)


def _randomize_stamps(world: "World", fault: Fault) -> None:
    board, dice = world.board, world.dice["faults"]
    samples = math.ceil(min(fault.duration_s, MAX_RANDOM_S) / board.period_s)
    board.stamp_errors_us.extend(dice.randrange(MODULUS) for _ in range(samples))


def _stop_broker(world: "World", fault: Fault) -> None:
    if world.broker.up:
        # A broker that stops does not publish the will of a process that has ended.
        world.will_certain &= world.process is not None or not world.broker.connections
        world.broker.stop(loses_retained=fault.severity < 0.3)
        world.timeline.after(fault.duration_s, world.broker.start)


def _block_broker(world: "World", fault: Fault) -> None:
    world.broker.half_open()
    world.broker.reachable = False
    world.timeline.after(fault.duration_s, lambda: setattr(world.broker, "reachable", True))


def _freeze_broker(world: "World", fault: Fault) -> None:
    world.broker.frozen_until_s = world.timeline.now_s + fault.duration_s


def _step_wall_clock(world: "World", fault: Fault) -> None:
    # The factor is between 1 s and 1e6 s, so that steps of all sizes up to six days occur, ahead and back.
    world.clocks.wall_offset_s += (fault.severity - 0.5) * 10.0 ** (6.0 * world.dice["faults"].random())
    if fault.duration_s > SYNC_CHANGE_S:
        world.clocks.synchronized = not world.clocks.synchronized


def _disk_fault(attribute: str) -> Callable[["World", Fault], None]:
    def apply(world: "World", fault: Fault) -> None:
        setattr(world.disk, attribute, True)
        world.timeline.after(fault.duration_s, lambda: setattr(world.disk, attribute, False))

    return apply


def _kill_service(world: "World", fault: Fault) -> None:
    world.handles_until_kill = int(MAX_KILL_HANDLES * fault.severity)


def _kill_service_at_write(world: "World", fault: Fault) -> None:
    world.disk.armed_fault = ArmedFault(int(MAX_DISK_OPERATIONS * fault.severity), KilledError)


def _cut_power(world: "World", fault: Fault) -> None:
    if world.powered:
        world.cut_power(fault.duration_s)


def _cut_power_at_write(world: "World", fault: Fault) -> None:
    world.disk.armed_fault = ArmedFault(int(MAX_DISK_OPERATIONS * fault.severity), PowerCutError)


def _stop_service(world: "World", fault: Fault) -> None:
    process = world.process
    if process is None:
        return
    process.loop.call_soon(process.stop.set)

    def kill() -> None:
        if world.process is process:
            world.note("did not end in time: killed")
            world.end_process(silently=False)

    world.timeline.after(STOP_S, kill)


def _freeze_process(world: "World", fault: Fault) -> None:
    if world.process is not None:
        world.process.loop.freeze(world.timeline.now_s + min(fault.duration_s, MAX_FREEZE_S))


HOSTILE_PAYLOADS = (
    b"", b"{}", b"[]", b"null", b'{"soc":NaN}', b'{"soc":1e999}', b'{"soc":0.1}', b"\xff\xfe\x00", b"{" * 4000,
    b"[" * 100_000, b'{"transaction":[1]}', b'{"transaction":"x"}', b"0" * 20_000,
)  # fmt: skip
REQUEST_NAMES = ("state", "health", "parameters", "set_soc", "current_zero", "x" * 300, "../etc", "\0", "")


def _send_hostile_requests(world: "World", fault: Fault) -> None:
    dice = world.dice["faults"]
    for _ in range(int(1 + 300 * fault.severity**3)):  # mostly few requests
        topic = f"bms/pack/request/{dice.choice(REQUEST_NAMES)}"
        payload, retain = dice.choice(HOSTILE_PAYLOADS), dice.random() < 0.1
        world.timeline.after(
            dice.uniform(0.0, min(fault.duration_s, MAX_HOSTILE_S)),
            lambda topic=topic, payload=payload, retain=retain: world.broker.publish_as_other(
                topic, payload, retain=retain
            ),
        )


def _forge_availability(world: "World", fault: Fault) -> None:
    # Different digits of the severity select topic and payload.
    topic = "availability" if fault.severity < 0.5 else "sensor/availability"
    world.broker.publish_as_other(
        f"bms/pack/{topic}", b"offline" if fault.severity % 0.2 < 0.1 else b"nonsense", retain=True
    )
    world.will_certain &= world.process is not None  # without a process, the forged message remains


KINDS: dict[str, Callable[["World", Fault], None]] = {
    "bytes flipped": _with_noise(lambda severity: Noise(flip=10.0 ** (-4.0 + 3.0 * severity))),
    "bytes lost": _with_noise(lambda severity: Noise(lose=10.0 ** (-4.0 + 3.0 * severity))),
    "line mute": _with_noise(lambda _: Noise(mute=True)),
    "port gone": _unplug,
    "port renamed": _rename_port,
    "board reset": _reset_board,
    "boards swapped": _swap_boards,
    "broker down": _stop_broker,
    "connections cut": lambda world, _: world.broker.drop(),
    "connections half open": lambda world, _: world.broker.half_open(),
    "broker unreachable": _block_broker,
    "broker frozen": _freeze_broker,
    "wall clock stepped": _step_wall_clock,
    "disk full": _disk_fault("full"),
    "disk broken": _disk_fault("broken"),
    "disk hung": _disk_fault("hung"),
    "killed": _kill_service,
    "killed at a write": _kill_service_at_write,
    "power cut": _cut_power,
    "power cut at a write": _cut_power_at_write,
    "stopped": _stop_service,
    "process frozen": _freeze_process,
    "hostile requests": _send_hostile_requests,
    "availability forged": _forge_availability,
    "birth message": lambda world, _: world.broker.publish_as_other("homeassistant/status", b"online"),
    "board's clock stepped": lambda world, fault: world.board.step_clock(_jump_s(fault)),
    "one stamp wrong": lambda world, fault: world.board.stamp_errors_us.append(round(_jump_s(fault) * 1e6)),
    "board's clock at random": _randomize_stamps,
}
CLOCK_FAULTS = ("board's clock stepped", "one stamp wrong", "board's clock at random")
"""Faults of the board's clock, which only the binary protocol transmits.

They are drawn separately, so that a seed has the same other faults as before these faults existed.
"""
