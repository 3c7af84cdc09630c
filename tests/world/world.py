"""World of a simulation, determined by a seed: pack, board, cable, machine, disk, broker, the service, and faults."""

import asyncio
import contextlib
import hashlib
import math
import random
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import structlog

from bms_estimator.checkpoint.state_files import CheckpointFile
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.pack.state import REFUSED, PackState
from bms_estimator.service import pack_service as service
from bms_estimator.settings.connections import MqttSettings
from bms_estimator.settings.observer import IdentifierSettings
from bms_estimator.settings.pack import PackSettings, PublishSettings, Settings, StateSettings
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.simulation.virtual_adc import BoardParts
from bms_estimator.sinks.sink import Sink
from bms_estimator.sources import factory
from bms_estimator.sources.serial.board_check import MAX_PENDING_READS, BoardCheck
from bms_estimator.sources.serial.port_list import KnownBoardFile
from tests.world import invariants
from tests.world.broker import Broker, Connection, Packet
from tests.world.disk import Disk, PowerCutError
from tests.world.faults import CLOCK_FAULTS, Fault, ordinary_kinds, schedule
from tests.world.invariants import (
    AvailabilityCheck,
    ChargeTotals,
    InvariantError,
    PublishedStates,
    ReferenceDecoder,
    SocErrors,
)
from tests.world.line import Board, Cable
from tests.world.loop import KilledError, ProcessLoop, Timeline
from tests.world.pack import CELL, new_pack
from tests.world.seams import Clocks, replace_in_package
from tests.world.threads import Threads

NAME = "pack"
ROOT = f"bms/{NAME}"
PUBLISH_HZ = 0.1
"""Publish rate of the service [Hz]."""
RESOLUTION_V, NOISE_V = 5.0 / 1024, 0.001
"""Resolution and noise of a board that measures the cell without a divider [V]."""
FAULT_FREE_S = 420.0
"""Duration at the end without faults, after which all invariants must hold [s]."""
KNOWN_SOC_FRACTION, KNOWN_SOC_STD = 0.5, (0.005, 0.02)
"""Fraction of worlds with a known initial SOC, and range of its standard deviation.

The SOC intervals of these worlds are narrow, so that small errors violate an invariant.
"""
CLOCK_FAULT_FRACTION = 0.5
"""Fraction of worlds with the binary protocol in which the board's clock has faults."""
SHARED_MEMORY = Path("/dev/shm")
"""File system in memory for the folders of the worlds, if it exists."""
MAX_LOG_LINES = 60
"""Maximum number of lines in the log of a world; earlier lines are dropped."""
UNREAD_BY_AIOMQTT = "Future exception was never retrieved: MqttCodeError('Unexpected disconnection')"
"""Permitted exception at the loop. aiomqtt does not read it if a connection is opened and lost while the process is frozen."""
BOOT_S = 5.0
"""Time from the return of the power to the start of the service [s]."""
STALE_S = 2.0
"""Time without a sample after which the sensor counts as silent [s]."""
DECODE_S = 0.05
"""Time for the service to decode delivered bytes [s]."""
EXPENSIVE_CHECK_S = 5.0
"""Interval of the expensive checks [s]."""
KILL_LOSS_S = 6.0
"""Messages of this time before a kill may be lost or repeated [s].

The queue is written each second, but only after 3 s without an acknowledgment while the broker is connected.
"""
POWER_LOSS_S = 37.0
"""Messages of this time before a power cut may be lost or repeated [s]: the database is synced within half a minute."""
MAX_LEAD_S = 3.0
"""Maximum lead that the samples' clock may gain [s]. The service accepts a step of the board's clock by less than 2 s."""
THAW_S = 15.0
"""Time after a freeze in which states may be old [s]. A board reset during the freeze cannot be distinguished from an outage."""
DISK_RETRY_S = 25.0
"""Maximum time from the end of a disk fault until the disk is used again [s]: 10 s timeout of a hung call, 10 s to the next call."""
MAX_ONLINE_DELAY_S = 45.0
"""Maximum time until the retained availability is correct [s], once the broker can receive it."""
MAX_SENSOR_ONLINE_DELAY_S = 50.0
"""Maximum time until the sensor's retained availability is correct [s]: samples count as missing after three publish periods of 10 s."""


@dataclass
class Result:
    """Result of a world."""

    seed: int
    seconds: float
    violation: str = ""
    """First violation of an invariant, with its time; empty: none."""
    digest: str = ""
    """Digest of all published messages and their times."""
    log: list[str] = field(default_factory=list)
    soc_errors: SocErrors = field(default_factory=SocErrors)
    figures: dict[str, float] = field(default_factory=dict)
    """Statistics of the world by name."""


class Probe(Sink):
    """Sink that passes each snapshot of the service to the world."""

    def __init__(self, take: Callable[[Snapshot], None]) -> None:
        self.publish = take  # type: ignore[method-assign]


@dataclass
class Process:
    """One run of the service."""

    number: int
    """Number of the run, from 1."""
    loop: ProcessLoop
    stop: asyncio.Event
    main: asyncio.Task[Any] | None = None
    source: Any = None
    """``SerialSource`` of the service, once it exists."""
    snapshot: Snapshot | None = None
    """Last published snapshot."""
    reference: ReferenceDecoder = field(default_factory=ReferenceDecoder)
    delivered_s: float = 0.0
    """Time of the last delivery of bytes from the board [s]."""
    delivered_bytes: int = 0
    last_sample_s: float = 0.0
    """Time at which the last delivered valid sample was sent [s]."""
    withheld: int = 0
    """Number of samples that had arrived before the board's hello, at the last check."""
    first_ahead_s: float | None = None
    """First lead of the samples' clock over the true time since ``thawed_s`` [s]; None: not measured yet."""
    thawed_s: float = 0.0
    """End of the last freeze [s]. Data that arrived during the freeze are read late."""
    has_uncounted_samples: bool = False
    """True if the samples at its decoder may differ from those of ``reference``, so that the counts are not compared."""
    disk_failed: bool = False
    """True if its published charge and energy may not be on disk."""


class World:
    """Simulated world.

    Args:
        seed: Seed of all random values.
        seconds: Duration [s].
        faults: Faults; None: drawn from the seed.
    """

    def __init__(self, seed: int, seconds: float, faults: list[Fault] | None = None) -> None:
        dice = random.Random(seed)
        self.dice = {
            name: random.Random(dice.randrange(1 << 62))
            for name in ("time", "service", "threads", "pack", "board", "cable", "disk", "broker", "faults", "drawn")
        }
        self.seed, self.seconds = seed, seconds
        self.timeline = Timeline(self.dice["time"])
        self.clocks = Clocks(lambda: self.timeline.now_s)
        self.pack = new_pack(self.dice["pack"])
        self.settings = self._draw_settings(dice)
        self.folder = Path(tempfile.mkdtemp(prefix="bms-world-", dir=SHARED_MEMORY if SHARED_MEMORY.is_dir() else None))
        self._path = str(self.folder).encode()
        self.disk = Disk(self.folder / "state", self.dice["disk"])
        self.cable = Cable(self.folder / "dev", self.timeline, self.dice["cable"], self._on_readable)
        self.cable.on_delivered = self._on_delivered
        self.broker = Broker(self.timeline, self.dice["broker"], self._on_received)
        self.broker.supports_mqtt5 = dice.random() < 0.8
        text = self.settings.sensor.protocol == "text"
        first_rate_hz = dice.choice((1, 10, 100))
        self.board = Board(
            dice.randrange(1, 1 << 32), BoardParts(divider=1.0), self.dice["board"], text=text,
            first_rate_hz=1 if text else first_rate_hz,
        )  # fmt: skip
        self.foreign_board = Board(
            dice.randrange(1, 1 << 32), BoardParts(divider=1.08), self.dice["board"], text=text, first_rate_hz=1
        )
        self.cable.resets_when_opened = dice.random() < 0.7
        self.port_name = "ttyACM0"
        self.cable.plug(self.board, self.port_name)
        self.sampled_soc = self.pack.soc
        """True SOC at the last sample that the pack's board has sent."""
        self.sampled_s = 0.0
        """Time of that sample [s]."""
        self.powered = True
        self.process: Process | None = None
        self.runs = 0
        self.handles_until_kill: int | None = None
        """Number of handles that the process still runs before it is killed; None: no kill is due."""
        self.threads: Threads | None = None
        self.disk_usable_s = 0.0
        """Time from which on the service must use the disk again after its last fault [s]."""
        self.published, self.soc_errors, self.charge_totals = PublishedStates(), SocErrors(), ChargeTotals()
        self.online = AvailabilityCheck(MAX_ONLINE_DELAY_S)
        self.sensor_online = AvailabilityCheck(MAX_SENSOR_ONLINE_DELAY_S)
        self.will_certain = True
        """True if availability must become offline when no process runs, because the broker publishes the will."""
        self._digest = hashlib.sha256()
        self.log: deque[str] = deque(maxlen=MAX_LOG_LINES)
        self.figures: dict[str, float] = {"handles": 0, "runs": 0, "states": 0}
        self.faults = self._draw_faults(seconds - FAULT_FREE_S, text=text) if faults is None else faults
        self.log_messages = False
        """True to log each message at the broker, for debugging."""

    def _draw_faults(self, until_s: float, *, text: bool) -> list[Fault]:
        """Draw the faults of the world, in some worlds also of the board's clock."""
        faults = schedule(self.dice["drawn"], until_s, ordinary_kinds(auto=self.auto, text=text))
        clock_dice = random.Random(f"{self.seed} clock")
        has_clock_faults = not text and clock_dice.random() < CLOCK_FAULT_FRACTION
        return faults + schedule(clock_dice, until_s, CLOCK_FAULTS) if has_clock_faults else faults

    def _draw_settings(self, dice: random.Random) -> Settings:
        text = dice.random() < 0.2
        rate_hz = 10 if dice.random() < 0.03 else 1
        self.auto = dice.random() < 0.5
        pack, identifier = PackSettings(name=NAME, cell="chen_mora"), IdentifierSettings()
        # A separate generator: without a known SOC, the world is otherwise the same.
        soc_dice = random.Random(f"{self.seed} known")
        if soc_dice.random() < KNOWN_SOC_FRACTION:
            std = soc_dice.uniform(*KNOWN_SOC_STD)
            initial_soc = min(max(soc_dice.gauss(self.pack.soc, std), 0.0), 1.0)
            pack, identifier = pack.model_copy(update={"initial_soc": initial_soc}), IdentifierSettings(soc_std=std)
        return Settings(
            pack=pack,
            identifier=identifier,
            sensor=SensorSettings(
                port="auto", protocol="text" if text else "binary", sample_rate_hz=rate_hz,
                voltage_resolution_v=RESOLUTION_V, voltage_noise_v=NOISE_V,
            ),
            publish=PublishSettings(rate_hz=PUBLISH_HZ),
            mqtt=MqttSettings(url="mqtt://broker"),
            state=StateSettings(checkpoint_s=dice.choice((60.0, 300.0, 300.0))),
        )  # fmt: skip

    # the run

    def run(self) -> Result:
        """Run to the end or to the first violated invariant."""
        if not self.auto:  # only now is the path of the port known
            port = str(self.cable.folder / self.port_name)
            sensor = self.settings.sensor.model_copy(update={"port": port})
            self.settings = self.settings.model_copy(update={"sensor": sensor})
        violation = ""
        with contextlib.ExitStack() as stack:
            stack.callback(shutil.rmtree, self.folder, ignore_errors=True)
            stack.enter_context(
                replace_in_package(self.clocks, self.dice["service"], self._threads_of_process, self.disk)
            )
            stack.enter_context(self.disk.installed())
            stack.enter_context(self.cable.installed())
            stack.enter_context(self.broker.installed())
            stack.enter_context(self._record_log())
            stack.enter_context(self._track_source())
            stack.enter_context(self._check_checkpoints())
            stack.callback(self.end_process, silently=False)
            try:
                self._run_events()
            except InvariantError as error:
                violation = f"at {self.timeline.now_s:.3f} s: {error}"
            except (Exception, KilledError, PowerCutError) as error:  # noqa: BLE001 - any error is a result of the seed
                violation = f"at {self.timeline.now_s:.3f} s: the simulation: {error!r}"
        return self._result(violation)

    def _result(self, violation: str) -> Result:
        self.figures |= {
            "online_s": self.online.max_delay_s,
            "sensor_online_s": self.sensor_online.max_delay_s,
            "doubled": self.published.repeated_deliveries,
            "forgotten": self.published.lost_at_kill,
            "faults": len(self.faults),
            "runs": self.runs,
        }
        digest = self._digest.hexdigest()[:16]
        return Result(self.seed, self.timeline.now_s, violation, digest, list(self.log), self.soc_errors, self.figures)

    def _run_events(self) -> None:
        self._sample_board()
        self._check_invariants()
        self.start_process()
        for fault in self.faults:
            self.timeline.at(fault.begin_s, lambda fault=fault: self._apply_fault(fault))
        self.timeline.at(self.seconds - FAULT_FREE_S, self._disarm_faults)
        while self.timeline.now_s < self.seconds:
            process = self.process
            if process is not None and process.loop.busy:
                self._step(process)
            else:
                self.timeline.step()
        self._check_end()

    def _disarm_faults(self) -> None:
        """Disarm faults that wait for the next write or handle."""
        self.disk.armed_fault = self.handles_until_kill = None

    def _step(self, process: Process) -> None:
        """Run one handle of the service, or kill it if that is due."""
        if self.handles_until_kill is not None:
            self.handles_until_kill -= 1
            if self.handles_until_kill < 0:
                self.handles_until_kill = None
                self.note("killed")
                self.end_process(silently=False)
                return
        process.loop.step()
        errors = [text for text in process.loop.uncaught_exceptions if text != UNREAD_BY_AIOMQTT]
        if errors:
            self.fail(f"uncaught exception: {errors[0]}")
        if process.main is not None and process.main.done():
            self._on_process_end(process)

    def _on_process_end(self, process: Process) -> None:
        """Handle the end of the service: fail if it ended with an error."""
        error = None if process.main is None or process.main.cancelled() else process.main.exception()
        if isinstance(error, InvariantError):
            raise error
        if error is not None:
            self.fail(f"the service has ended: {error!r}")
        self.note("ended in good order")
        self.end_process(silently=False)

    def _survival_age_s(self, *, clean: bool, silently: bool) -> float:
        """Return the age [s] of messages beyond which they survive the end of the process.

        Args:
            clean: True if the service ended by itself.
            silently: True if the power was cut.
        """
        if self.disk.is_faulty or self.timeline.now_s < self.disk_usable_s + (POWER_LOSS_S if silently else 0.0):
            return math.inf
        if silently:
            return POWER_LOSS_S
        return 0.0 if clean else KILL_LOSS_S

    def _on_end_in_thread(self, how: type[BaseException]) -> None:
        """Handle a kill or a power cut during a write."""
        self.note(f"{how.__name__} at a write")
        if how is PowerCutError:
            self.cut_power(self.dice["faults"].uniform(1.0, 300.0))
        else:
            self.end_process(silently=False)

    def _threads_of_process(self) -> Threads:
        if self.threads is None:
            raise KilledError
        return self.threads

    def start_process(self) -> None:
        """Start the service if there is power and it does not run."""
        if not self.powered or self.process is not None or self.timeline.now_s >= self.seconds:
            return
        self.runs += 1
        loop = ProcessLoop(self.timeline)
        process = Process(self.runs, loop, asyncio.Event())
        self.threads = Threads(self.timeline, self.dice["threads"], loop, self.disk, self._on_end_in_thread)
        self.process = process
        self.broker.loop = loop
        self.note(f"start {self.runs}")
        process.main = loop.start(
            service.run_pack_service(
                self.settings,
                CELL,
                sinks=[Probe(lambda snapshot: self._on_published(process, snapshot))],
                stop=process.stop,
                folder=self.disk.folder,
            )
        )

    def end_process(self, *, silently: bool) -> None:
        """End the process; ``silently``: without closing its connections, because the machine ends too."""
        process, self.process = self.process, None
        if process is None:
            return
        clean = process.main is not None and process.main.done()
        self.published.record_end(
            process.number, process.loop.ran_until_s, self._survival_age_s(clean=clean, silently=silently)
        )
        self.figures["handles"] += process.loop.handles
        self.handles_until_kill = None
        self.disk.armed_fault = None
        self.broker.loop = None
        has_will = any(c.loop is process.loop and c.broker_open and c.accepted for c in self.broker.connections)
        self.will_certain = has_will or self.broker.retained.get(f"{ROOT}/availability") in (None, b"offline")
        process.loop.kill()
        self.disk.end_process()
        self.cable.close_all()
        self.broker.process_ended(process.loop, silently=silently)
        # The service starts again after 0.2 to 300 s, mostly within a minute.
        self.timeline.after(min(self.dice["faults"].expovariate(1.0 / 20.0) + 0.2, 300.0), self.start_process)

    def cut_power(self, off_s: float) -> None:
        """Cut the power of the machine and its board, and restore it after ``off_s``."""
        self.note("power cut")
        self.powered = False
        self.end_process(silently=True)
        self.disk.cut_power(self.timeline.now_s)

        def restore_power() -> None:
            self.powered = True
            self.clocks.boot = f"boot {self.timeline.now_s}"
            self.clocks.boot_s = self.timeline.now_s
            self.board.reset()
            self.note("power back")
            self.timeline.after(BOOT_S, self.start_process)

        self.timeline.after(off_s, restore_power)

    # the board

    def _sample_board(self) -> None:
        """Let the board measure and send a sample, and schedule the next one."""
        board = self.cable.board or self.board
        now_s = self.timeline.now_s
        reading = self.pack(now_s)
        if self.powered and board.has_measured:
            sent = board.sample(reading)
            if self.cable.board is not None and self.cable.open_port is not None and not self.cable.noise.mute:
                if board is self.board:
                    self.sampled_soc, self.sampled_s = self.pack.soc, now_s
                self.cable.send(sent)
        board.begin_window()
        self.timeline.after(board.period_s, self._sample_board)

    def _on_readable(self, descriptor: int) -> None:
        if self.process is not None:
            self.process.loop.notify_reader(descriptor)

    def _on_delivered(self, data: bytes) -> None:
        if self.process is not None:
            source = self.process.source
            # The service drops and does not count samples beyond this limit.
            no_room = source is not None and len(source.board_check._pending) == MAX_PENDING_READS
            self.process.has_uncounted_samples |= no_room or self.cable.board is self.foreign_board
            if not self.board.text and self.process.reference.feed(data):
                self.process.last_sample_s = self.sampled_s
            self.process.delivered_s = self.timeline.now_s
            self.process.delivered_bytes += len(data)

    # messages of the service

    def _on_published(self, process: Process, snapshot: Snapshot) -> None:
        """Check a snapshot of the service."""
        process.snapshot = snapshot
        if snapshot.estimate is None:
            return
        payload = snapshot.estimate.model_dump_json().encode()
        self.published.record(payload, process.number, self.timeline.now_s, disk_failed=self._disk_fails)
        self.figures["states"] += 1
        process.disk_failed |= self._disk_fails
        if violation := self.charge_totals.check(snapshot.estimate, saved=not process.disk_failed):
            self.fail(violation)
        is_behind = self._waiting_reads(process) > 0  # after a freeze the state is older than the waiting samples
        if not is_behind and (violation := self.soc_errors.check(snapshot, self.sampled_soc)):
            self.fail(violation)
        self._check_time(process, snapshot.estimate.board_time_s)

    def _on_received(self, packet: Packet, connection: Connection | None) -> None:
        """Check a message that reached the broker."""
        self._digest.update(f"{self.timeline.now_s:.9f} {packet.topic}".encode())
        self._digest.update(packet.payload.replace(self._path, b"."))
        if self.log_messages:
            self.note(f"broker: {packet.topic} {packet.payload[:60]!r}")
        if connection is not None and packet.payload[:1] == b"{" and not invariants.is_json(packet.payload):
            self.fail(f"{packet.topic} is no strict JSON: {packet.payload[:200]!r}")
        if packet.topic == f"{ROOT}/state" and (
            violation := self.published.check_received(packet, connection, in_order=not self._disk_fails)
        ):
            self.fail(violation)

    @property
    def _disk_fails(self) -> bool:
        """True if the disk is faulty, or was until recently."""
        return self.disk.is_faulty or self.timeline.now_s < self.disk_usable_s

    # invariants

    def _check_invariants(self) -> None:
        """Check the invariants; called once a second."""
        now_s = self.timeline.now_s
        process = self.process
        is_idle = process is not None and not process.loop.busy and now_s >= process.loop.frozen_until_s
        if process is not None and is_idle and now_s % EXPENSIVE_CHECK_S < 1.0:
            self._check_counts(process)
            self._check_memory(process)
            self._check_board(process)
        self._check_availability(now_s)
        if self.disk.is_faulty:
            self.disk_usable_s = now_s + DISK_RETRY_S
        self.timeline.after(1.0, self._check_invariants)

    def _check_counts(self, process: Process) -> None:
        """Check that each byte was decoded or counted, and each valid sample used, or dropped and counted."""
        if process.source is None:
            return
        board_check, counters = process.source.board_check, process.source.counters
        is_pending = board_check.pending_protocol is not None  # the samples' board is not identified yet
        if self.timeline.now_s - process.delivered_s <= DECODE_S or self._waiting_reads(process):
            return
        counted_bytes = (
            counters["bytes_received"]
            + counters["unadmitted_bytes"]
            + sum(len(data) for _, data in board_check._pending)
        )
        if counted_bytes != process.delivered_bytes:
            self.fail(f"{process.delivered_bytes} bytes came, {counted_bytes} are counted: {counters}")
        if self.settings.sensor.protocol == "binary" and not process.has_uncounted_samples:
            names = ("frames_received", "duplicates", "out_of_order", "before_hello")
            counted_samples = sum(counters[name] for name in names)
            if counted_samples != process.reference.samples and not is_pending:
                self.fail(f"{process.reference.samples} samples came, {counted_samples} are counted: {counters}")

    def _discount_samples(self, process: Process, board_check: BoardCheck, on_port_opened: Callable[[], None]) -> None:
        """Discount the samples of a port that was lost before its board was identified, then call ``on_port_opened``."""
        if board_check.pending_protocol is not None:
            unidentified = ReferenceDecoder()
            unidentified.feed(b"".join(data for _, data in board_check._pending))
            process.reference.samples -= unidentified.samples
        on_port_opened()

    def _check_board(self, process: Process) -> None:
        """Check that the used samples are from the pack's own board."""
        if process.source is None:
            return
        serial = process.source.board.get("serial")
        if serial == f"{self.foreign_board.serial_number:08x}":
            self.fail(f"board {serial} is used as the pack's")

    def _check_time(self, process: Process, time_s: float) -> None:
        """Check that the samples' clock gains no time on the true time.

        Skipped while samples wait for the board's hello, and right after a freeze, because the state is then older.
        """
        before, process.withheld = process.withheld, process.source.counters.get("before_hello", 0)
        if process.withheld != before:
            return
        # The reference decoder does not read text.
        ahead_s = time_s - (self.sampled_s if self.board.text else process.last_sample_s)
        thawed_s = process.loop.frozen_until_s
        if self.timeline.now_s - thawed_s <= THAW_S:
            return
        if process.first_ahead_s is None or process.thawed_s != thawed_s:
            process.first_ahead_s, process.thawed_s = ahead_s, thawed_s
        if ahead_s > process.first_ahead_s + MAX_LEAD_S:
            self.fail(f"{ahead_s - process.first_ahead_s:.1f} s too much are counted")

    def _waiting_reads(self, process: Process) -> int:
        return int(process.source._port._chunks.qsize())

    def _check_memory(self, process: Process) -> None:
        """Check the limits of tasks, handles and reads."""
        tasks = sum(not task.done() for task in process.loop._tasks)
        if tasks > invariants.MAX_TASKS:
            self.fail(f"{tasks} tasks")
        if process.loop.ready_count > invariants.MAX_READY:
            self.fail(f"{process.loop.ready_count} handles wait")
        if process.source is not None and self._waiting_reads(process) > invariants.MAX_READS:
            self.fail(f"{self._waiting_reads(process)} reads wait")

    def _check_availability(self, now_s: float) -> None:
        """Check the retained availability messages."""
        broker, process = self.broker, self.process
        broker_responds = broker.up and broker.reachable and now_s >= broker.frozen_until_s
        truth = None
        if (
            broker_responds
            and process is not None
            and now_s >= process.loop.frozen_until_s
            and not process.stop.is_set()
        ):
            truth = "online"
        elif broker_responds and process is None and self.will_certain:
            truth = "offline"
        retained = broker.retained.get
        if violation := self.online.check(truth, invariants.decode_text(retained(f"{ROOT}/availability")), now_s):
            self.fail(f"availability: {violation}")
        if truth == "online":
            silent_s = now_s - self.sampled_s
            truth = "online" if silent_s < STALE_S else "offline"
        else:
            truth = None
        noisy = (
            self.cable.noise.flip or self.cable.noise.lose or (process is not None and process.has_uncounted_samples)
        )
        sensor_availability = invariants.decode_text(retained(f"{ROOT}/sensor/availability"))
        if violation := self.sensor_online.check(None if noisy else truth, sensor_availability, now_s):
            self.fail(f"sensor availability: {violation}")

    def _check_end(self) -> None:
        """Check the end state after the time without faults."""
        process = self.process
        if process is None:
            self.fail("the service does not run")
        if process is not None and process.source is not None and (serial := process.source.board.get("serial")):
            stored_serial = KnownBoardFile(self.disk.folder, NAME).load().get("serial")
            if stored_serial != serial:
                self.fail(f"board {serial} is not remembered, but {stored_serial}")
        if lost := self.published.find_lost(self.timeline.now_s):
            self.fail(f"the broker never got the states {lost}")

    def fail(self, violation: str) -> None:
        """Report a violated invariant.

        Raises:
            InvariantError: Always. If the service catches it, it is raised again when the service has ended.
        """
        raise InvariantError(violation)

    # faults

    def _apply_fault(self, fault: Fault) -> None:
        self.note(f"fault: {fault}")
        fault.apply(self)

    # log and access to the service

    def note(self, line: str) -> None:
        """Add a line to the log of the world."""
        self.log.append(f"{self.timeline.now_s:10.3f} {line}")

    @contextlib.contextmanager
    def _record_log(self) -> Iterator[None]:
        """Add the service's log lines to the log of the world."""
        original = structlog.get_config()

        def record(_: Any, level: str, event: dict[str, Any]) -> str:
            text = " ".join(f"{name}={value}" for name, value in event.items() if name != "event")
            self.note(f"  {level}: {event.get('event')} {text}"[:300])
            raise structlog.DropEvent

        structlog.configure(processors=[record])
        try:
            yield
        finally:
            structlog.configure(**original)

    @contextlib.contextmanager
    def _check_checkpoints(self) -> Iterator[None]:
        """Check that no checkpoint is rejected at a start."""
        load = CheckpointFile.load

        def load_and_check(file: CheckpointFile) -> PackState:
            content = load(file)
            for reason in content.reasons.values():
                if reason.startswith(REFUSED):
                    self.fail(f"the checkpoint is {reason}")
            return content

        CheckpointFile.load = load_and_check
        try:
            yield
        finally:
            CheckpointFile.load = load

    @contextlib.contextmanager
    def _track_source(self) -> Iterator[None]:
        """Store the service's serial source in ``Process``, so that the checks can read its counters."""
        original = factory.SerialSource

        def make_source(*arguments: Any, **named: Any) -> Any:
            source = original(*arguments, **named)
            if self.process is not None:
                self.process.source = source
                source.board_check.on_port_opened = partial(
                    self._discount_samples, self.process, source.board_check, source.board_check.on_port_opened
                )
            return source

        factory.SerialSource = make_source
        try:
            yield
        finally:
            factory.SerialSource = original
