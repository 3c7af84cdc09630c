"""Faults of a world and their times."""

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bms_estimator.protocols.firmware.messages import MODULUS
from tests.world.disk import Arm, PowerCutError
from tests.world.line import Noise
from tests.world.loop import KilledError

if TYPE_CHECKING:
    from tests.world.world import World

MIN_PAUSE_S, MAX_PAUSE_S = 5.0, 300.0
FIRST_S = 20.0
STOP_S = 90.0
"""Stop timeout after which systemd kills the service [s]."""


MIN_JUMP_S, MAX_JUMP_S = 3.0, 3600.0
"""Range of steps of the board's clock [s]: the service accepts a sample that is less than 2 s early."""
MAX_RANDOM_S = 5.0
"""Maximum duration of random timestamps of the board [s]."""


@dataclass(frozen=True)
class Fault:
    """Fault of the world at a time."""

    at_s: float
    kind: str
    seconds: float
    """Duration, or time until the service is started again [s]."""
    share: float
    """Severity, 0..1."""

    def apply(self, world: "World") -> None:
        """Apply the fault to a world."""
        KINDS[self.kind](world, self)

    def __str__(self) -> str:
        return f"{self.kind} for {self.seconds:.1f} s, share {self.share:.3f}"


def usual(*, auto: bool, text: bool) -> list[str]:
    """Return the kinds of faults that may occur in a world."""
    return [
        kind
        for kind in KINDS
        if kind not in CLOCK and not (kind == "boards swapped" and text) and not (kind == "port renamed" and not auto)
    ]


def schedule(dice: random.Random, until_s: float, kinds: Sequence[str]) -> list[Fault]:
    """Draw faults of some kinds, with their times."""
    likely = dice.sample(kinds, k=dice.randint(2, len(kinds)))
    faults = []
    at_s = FIRST_S * dice.random()
    while True:
        at_s += min(dice.expovariate(1.0 / 90.0) + MIN_PAUSE_S, MAX_PAUSE_S)
        if at_s >= until_s:
            return faults
        seconds = min(dice.expovariate(1.0 / 40.0) + 0.1, 400.0, until_s - at_s)
        faults.append(Fault(at_s, dice.choice(likely), seconds, dice.random()))


def _noisy(noise: Callable[[float], Noise]) -> Callable[["World", Fault], None]:
    def apply(world: "World", fault: Fault) -> None:
        world.cable.noise = noise(fault.share)
        world.timeline.after(fault.seconds, lambda: setattr(world.cable, "noise", Noise()))

    return apply


def _unplug(world: "World", fault: Fault) -> None:
    if world.cable.unplug() is not None:
        world.timeline.after(fault.seconds, lambda: _plug(world, world.port_name))


def _plug(world: "World", name: str) -> None:
    if world.cable.board is None:
        world.board.reset()
        world.cable.plug(world.board, name)


def _rename(world: "World", fault: Fault) -> None:
    if world.cable.unplug() is not None:
        world.timeline.after(fault.seconds, lambda: _plug(world, f"ttyACM{int(100 * fault.share)}"))


def _swap(world: "World", fault: Fault) -> None:
    if world.cable.unplug() is None:
        return
    world.foreigner.reset()
    world.cable.plug(world.foreigner, world.port_name)

    def back() -> None:
        if world.cable.board is world.foreigner:
            world.cable.unplug()
            _plug(world, world.port_name)

    world.timeline.after(fault.seconds, back)


def _reset_board(world: "World", fault: Fault) -> None:
    if world.cable.board is not None:
        world.cable.send(world.cable.board.reset())


def _jump_s(fault: Fault) -> float:
    """Return a clock step of seconds to an hour, ahead or back [s]."""
    size = abs(2.0 * fault.share - 1.0)
    return math.copysign(MIN_JUMP_S * (MAX_JUMP_S / MIN_JUMP_S) ** size, fault.share - 0.5)


def _clock_stepped(world: "World", fault: Fault) -> None:
    world.board.step_clock(_jump_s(fault))


def _stamp_wrong(world: "World", fault: Fault) -> None:
    world.board.stamps_off_us.append(round(_jump_s(fault) * 1e6))


def _clock_at_random(world: "World", fault: Fault) -> None:
    board, dice = world.board, world.dice["faults"]
    samples = math.ceil(min(fault.seconds, MAX_RANDOM_S) / board.period_s)
    board.stamps_off_us.extend(dice.randrange(MODULUS) for _ in range(samples))


def _broker_down(world: "World", fault: Fault) -> None:
    if world.broker.up:
        world.will_certain &= (
            world.process is not None or not world.broker.connections
        )  # the broker loses the will when it stops
        world.broker.stop(forgets=fault.share < 0.3)
        world.timeline.after(fault.seconds, world.broker.start)


def _broker_drops(world: "World", fault: Fault) -> None:
    world.broker.drop()


def _half_open(world: "World", fault: Fault) -> None:
    world.broker.half_open()


def _unreachable(world: "World", fault: Fault) -> None:
    world.broker.half_open()
    world.broker.reachable = False
    world.timeline.after(fault.seconds, lambda: setattr(world.broker, "reachable", True))


def _frozen_broker(world: "World", fault: Fault) -> None:
    world.broker.frozen_until_s = world.timeline.now_s + fault.seconds


def _wall_step(world: "World", fault: Fault) -> None:
    world.clocks.wall_offset_s += (fault.share - 0.5) * 10.0 ** (6.0 * world.dice["faults"].random())
    if fault.seconds > 60.0:
        world.clocks.synchronised = not world.clocks.synchronised


def _disk(attribute: str) -> Callable[["World", Fault], None]:
    def apply(world: "World", fault: Fault) -> None:
        setattr(world.disk, attribute, True)
        world.timeline.after(fault.seconds, lambda: setattr(world.disk, attribute, False))

    return apply


def _kill(world: "World", fault: Fault) -> None:
    world.kill_after = int(200 * fault.share)


def _kill_at_write(world: "World", fault: Fault) -> None:
    world.disk.arm = Arm(int(8 * fault.share), KilledError)


def _power_cut(world: "World", fault: Fault) -> None:
    if world.powered:
        world.cut_power(fault.seconds)


def _power_cut_at_write(world: "World", fault: Fault) -> None:
    world.disk.arm = Arm(int(8 * fault.share), PowerCutError)


def _clean_stop(world: "World", fault: Fault) -> None:
    process = world.process
    if process is None:
        return
    process.loop.call_soon(process.stop.set)

    def kill() -> None:
        if world.process is process:
            world.note("did not end in time: killed")
            world.end_process(silently=False)

    world.timeline.after(STOP_S, kill)


def _freeze(world: "World", fault: Fault) -> None:
    if world.process is not None:
        world.process.loop.freeze(world.timeline.now_s + min(fault.seconds, 120.0))


HOSTILE = (
    b"", b"{}", b"[]", b"null", b'{"soc":NaN}', b'{"soc":1e999}', b'{"soc":0.1}', b"\xff\xfe\x00", b"{" * 4000,
    b"[" * 100_000, b'{"transaction":[1]}', b'{"transaction":"x"}', b"0" * 20_000,
)  # fmt: skip
NAMES = ("state", "health", "parameters", "set_soc", "current_zero", "x" * 300, "../etc", "\0", "")


def _hostile(world: "World", fault: Fault) -> None:
    dice = world.dice["faults"]
    for _ in range(int(1 + 300 * fault.share**3)):
        topic = f"bms/pack/request/{dice.choice(NAMES)}"
        payload, retain = dice.choice(HOSTILE), dice.random() < 0.1
        world.timeline.after(
            dice.uniform(0.0, min(fault.seconds, 60.0)),
            lambda topic=topic, payload=payload, retain=retain: world.broker.say(topic, payload, retain=retain),
        )


def _forged(world: "World", fault: Fault) -> None:
    topic = "availability" if fault.share < 0.5 else "sensor/availability"
    world.broker.say(f"bms/pack/{topic}", b"offline" if fault.share % 0.2 < 0.1 else b"nonsense", retain=True)
    world.will_certain &= world.process is not None


def _birth(world: "World", fault: Fault) -> None:
    world.broker.say("homeassistant/status", b"online")


KINDS: dict[str, Callable[["World", Fault], None]] = {
    "bytes flipped": _noisy(lambda share: Noise(flip=10.0 ** (-4.0 + 3.0 * share))),
    "bytes lost": _noisy(lambda share: Noise(lose=10.0 ** (-4.0 + 3.0 * share))),
    "line mute": _noisy(lambda _: Noise(mute=True)),
    "port gone": _unplug,
    "port renamed": _rename,
    "board reset": _reset_board,
    "boards swapped": _swap,
    "broker down": _broker_down,
    "connections cut": _broker_drops,
    "connections half open": _half_open,
    "broker unreachable": _unreachable,
    "broker frozen": _frozen_broker,
    "wall clock stepped": _wall_step,
    "disk full": _disk("full"),
    "disk broken": _disk("broken"),
    "disk hung": _disk("hung"),
    "killed": _kill,
    "killed at a write": _kill_at_write,
    "power cut": _power_cut,
    "power cut at a write": _power_cut_at_write,
    "stopped": _clean_stop,
    "process frozen": _freeze,
    "hostile requests": _hostile,
    "availability forged": _forged,
    "birth message": _birth,
    "board's clock stepped": _clock_stepped,
    "one stamp wrong": _stamp_wrong,
    "board's clock at random": _clock_at_random,
}
CLOCK = ("board's clock stepped", "one stamp wrong", "board's clock at random")
"""Faults of the board's clock, only with the binary protocol. They are drawn separately, so that older seeds keep their other faults."""
