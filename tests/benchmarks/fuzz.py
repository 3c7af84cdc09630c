"""Mutated inputs to all readers of foreign bytes: only documented errors, and no hang.

    make fuzz ARGS="--decoders 10_000_000 --parsers 1_000_000 --seed 1 --only frames text"

Inputs are made from a kept corpus (tests/data/fuzz, a folder for each reader), the same ones by the same seed. What fails is
kept there under its digest, and the tests try the whole corpus.
"""

import argparse
import binascii
import faulthandler
import functools
import gzip
import hashlib
import io
import json
import logging
import math
import mmap
import multiprocessing as mp
import random
import struct
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import structlog
from rich.console import Console
from serial.tools.list_ports_common import ListPortInfo

from bms_estimator.checkpoint.checkpoint_file import CheckpointFile
from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.model.fuel_cell import load_any
from bms_estimator.mqtt.delivery_stats import DeliveryStats
from bms_estimator.mqtt.topic_cache import TopicCache
from bms_estimator.protocols.base.device_protocol import DeviceProtocol
from bms_estimator.protocols.devices import daly, jbd, jk
from bms_estimator.protocols.devices.junctek import JunctekProtocol
from bms_estimator.protocols.devices.pylontech import PylontechProtocol
from bms_estimator.protocols.devices.text import TextProtocol
from bms_estimator.protocols.devices.vedirect import VeDirectProtocol
from bms_estimator.protocols.firmware.messages import DELIMITER, Ack, Hello, ProtocolError, SampleMessage, seal, unseal
from bms_estimator.protocols.firmware.protocol import BoardProtocol
from bms_estimator.protocols.registry import make_protocol
from bms_estimator.settings.pack import Settings, load_settings
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sinks.mqtt.requests import RequestDispatcher, number
from bms_estimator.sinks.terminal import text_line
from bms_estimator.sinks.terminal.panels import Screen
from bms_estimator.sinks.terminal.scene import ScreenState
from bms_estimator.sources.captures.curves import read_curve
from bms_estimator.sources.captures.raw_capture import MAGIC
from bms_estimator.sources.captures.replay import load_capture
from bms_estimator.sources.serial.known_board_file import KnownBoardFile
from bms_estimator.sources.serial.port_list import NoPortError, may_be_board, resolve_port

CORPUS = Path(__file__).parents[1] / "data" / "fuzz"
LONGEST = 4096
"""No input is longer [bytes]."""
HANG_S = 240.0
"""Time for a batch of inputs after which it counts as a hang [s]."""
BATCH = 200
ROOM = 1 << 20
"""A repaired input is no longer [bytes]."""
PROCESSES = 2

Read = Callable[[bytes], object]
"""Reads an input; raises only documented errors."""
Repair = Callable[[random.Random, bytes], bytes]
"""Makes a damaged input whole again where a checksum would keep it from going deeper."""


@dataclass(frozen=True)
class Target:
    """A reader of foreign bytes.

    Attributes:
        make: From a folder of its own to who reads.
        tokens: What its inputs are made of.
        repair: See ``Repair``.
        decoder: Has the decoders' number of inputs.
    """

    make: Callable[[Path], Read]
    tokens: Sequence[bytes] = ()
    repair: Repair = lambda _, data: data
    decoder: bool = False


def _frames(_: Path) -> Read:
    def read(data: bytes) -> None:
        dialect = BoardProtocol(rate_hz=100)
        dialect.feed(1.0, data[: len(data) // 2])
        dialect.on_port_opened()
        dialect.serial_number_in(data[len(data) // 2 :])
        dialect.feed(2.0, data[len(data) // 2 :])
        dialect.next_output(3.0)
        assert dialect.counters["bytes_received"] <= len(data)
        _ = dialect.fault, dialect.board, dialect.description, dialect.clock_ppm

    return read


def _text(_: Path) -> Read:
    def read(data: bytes) -> None:
        dialect = TextProtocol()
        dialect.feed(1.0, data)
        _ = dialect.fault, dialect.description, dialect.counters

    return read


def _meter(make: Callable[[], DeviceProtocol]) -> Callable[[Path], Read]:
    """Return a decoder that only needs bytes."""

    def read(data: bytes) -> None:
        dialect = make()
        dialect.feed(1.0, data[: len(data) // 2])
        dialect.next_output(1.5)
        dialect.feed(2.0, data[len(data) // 2 :])
        _ = dialect.fault, dialect.description, dialect.counters

    return lambda _: read


def _asked(protocol: str) -> Callable[[Path], Read]:
    """Return the decoder of a polled BMS."""

    def make(_: Path) -> Read:
        def read(data: bytes) -> None:
            dialect = make_protocol(SensorSettings.model_validate({"protocol": protocol}))
            dialect.feed(1.0, data[: len(data) // 2])
            dialect.next_output(1.5)
            dialect.on_port_opened()
            dialect.feed(2.0, data[len(data) // 2 :])
            dialect.next_output(3.0)
            assert dialect.counters["noise_bytes"] <= dialect.counters["bytes_received"] == len(data)
            _ = dialect.fault, dialect.description, dialect.allowed_silence_s

        return read

    return make


def _messages(_: Path) -> Read:
    def read(data: bytes) -> None:
        for decode in (Hello.decode, Ack.decode, SampleMessage.decode):
            try:
                decode(unseal(data))
            except ProtocolError:
                continue

    return read


def _file(name: str, load: Callable[[Path], object]) -> Callable[[Path], Read]:
    """Return a file reader; its errors name the file."""

    def make(folder: Path) -> Read:
        path = folder / name

        def read(data: bytes) -> None:
            path.write_bytes(data)
            try:
                load(path)
            except UserError as error:
                assert name in str(error), f"an error without the name of the file: {error}"  # noqa: PT017

        return read

    return make


def _requests(_: Path) -> Read:
    counts = DeliveryStats()
    requests = RequestDispatcher(counts, ("set_soc",), monotonic=lambda: float(sum(counts.requests.values())) * 60.0)

    async def set_soc(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"soc": number(arguments, "soc", 0.0, 1.0)}

    requests.register("set_soc", set_soc)

    def read(data: bytes) -> None:
        answering = requests.handle("set_soc", data)
        try:
            answering.send(None)
        except StopIteration as answered:
            if answered.value is not None:
                json.loads(answered.value)
        assert not counts.requests.get("failed"), "a fault of the service's own"

    return read


def _published(_: Path) -> Read:
    """Read messages of a subscriber, as a screen and as lines."""
    topics = ("state", "health", "info", "parameters", "availability", "alarm/soc_low")
    console = Console(file=io.StringIO(), width=80, height=24, force_terminal=True, color_system=None)

    def read(data: bytes) -> None:
        published = TopicCache("bms")
        for topic in topics:
            heard = published.take(f"bms/pack/{topic}", data, 0.0)
            told = text_line.line(heard) if heard else None
            assert told is None or told.isprintable(), told
        if data:
            scene = ScreenState("pack", published.devices["pack"].topics, 0.0, 0.0)
            drawn = "".join(segment.text for segment in console.render(Screen(scene)))
            assert all(each.isprintable() or each == "\n" for each in drawn), drawn

    return read


def _checkpoint(folder: Path) -> Read:
    file = CheckpointFile(folder, Settings(), load_cell("ncr18650"))

    def read(data: bytes) -> None:
        file.path.write_bytes(data)
        file.load()

    return read


def _memory(folder: Path) -> Read:
    memory = KnownBoardFile(folder, "pack")

    def read(data: bytes) -> None:
        memory.path.write_bytes(data)
        memory.load()

    return read


def _ports(_: Path) -> Read:
    def read(data: bytes) -> None:
        text = data.decode("utf-8", "surrogateescape")
        port = ListPortInfo("ttyUSB0")
        port.vid, port.pid, port.manufacturer, port.product, port.description = 0x1A86, 0x7523, text, text, text
        may_be_board(port)
        try:
            resolve_port(text)
        except NoPortError as error:
            str(error)

    return read


def _sealed(random: random.Random, data: bytes) -> bytes:
    """Frames with right CRCs again."""
    frames = data.split(DELIMITER)
    at = random.randrange(len(frames))
    packet = frames[at] or b"\x01\x02"
    try:
        packet = unseal(packet)
    except ProtocolError:
        packet = packet[1:-2] or b"\x01\x02"
    packet = bytearray(packet)
    if random.random() < 0.5:
        packet[random.randrange(len(packet))] = random.randrange(256)
    frames[at] = seal(bytes(packet)).removesuffix(DELIMITER)
    return DELIMITER.join(frames)


def _summed(random: random.Random, data: bytes) -> bytes:
    """VE.Direct blocks with right checksums again."""
    if random.random() < 0.3:
        return data
    blocks = data.split(b"\r\nChecksum\t")
    return b"".join(
        (whole := (b[1:] if n else b) + b"\r\nChecksum\t") + bytes((-sum(whole) & 0xFF,)) for n, b in enumerate(blocks)
    )


def _counted(random: random.Random, data: bytes) -> bytes:
    """Answers of a Junctek with right checksums again."""
    if random.random() < 0.3:
        return data
    fixed = []
    for line in data.split(b"\n"):
        head, *values = line.strip().split(b",")
        numbers = [int(v) for v in values[1:] if v.isdigit() and len(v) < 20]
        fixed.append(b",".join([head, b"%d" % (sum(numbers) % 255 + 1), *values[1:]]))
    return b"\n".join(fixed)


def _jbd_summed(random: random.Random, data: bytes) -> bytes:
    """Correct the checksum of one frame of any stated length."""
    at = data.find(b"\xdd", random.randrange(len(data) + 1))
    end = at + 4 + data[at + 3] if 0 <= at < len(data) - 4 else len(data)
    return data[:end] + jbd.checksum(data[at + 2 : end]) + b"\x77" + data[end + 3 :] if end < len(data) else data


def _daly_summed(random: random.Random, data: bytes) -> bytes:
    at = data.find(b"\xa5", random.randrange(len(data) + 1))
    return data[:at] + daly.with_checksum(data[at : at + 12]) + data[at + 13 :] if at >= 0 else data


def _jk_summed(random: random.Random, data: bytes) -> bytes:
    """The first frame of either family."""
    newer, at = data.find(jk.START), data.find(jk.OLD_START)
    if newer >= 0:
        frame = data[newer : newer + 299].ljust(299, b"\0")
        return data[:newer] + frame + bytes((sum(frame) & 0xFF,)) + data[newer + 300 :]
    if at < 0 or random.random() < 0.3:
        return data
    body = data[at + 4 :][:480]
    frame = jk.OLD_START + (len(body) + 7).to_bytes(2, "big") + body + bytes((jk.OLD_END,))
    return data[:at] + jk.with_old_checksum(frame)


def _headed(random: random.Random, data: bytes) -> bytes:
    """Correct length and CRC of a capture's header."""
    begin, end = data.find(b"{"), data.find(b"}") + 1
    if not 0 <= begin < end or random.random() < 0.3:
        return data
    text = data[begin:end]
    crc = binascii.crc_hqx(text, 0xFFFF).to_bytes(2, "little")
    return MAGIC + len(text).to_bytes(4, "little") + text + crc + data[end + 2 :]


def _zipped(random: random.Random, data: bytes) -> bytes:
    """Damage a member of a checkpoint, with right CRCs."""
    if random.random() < 0.3:
        return data
    content, members = io.BytesIO(), _checkpoint_members()
    damaged = random.choice([*members, *["state.npy"] * len(members)])
    with zipfile.ZipFile(content, "w") as made:
        for name, member in members.items():
            made.writestr(name, _overwritten(random, member) if name == damaged else member)
    return content.getvalue()


def _overwritten(random: random.Random, member: bytes) -> bytes:
    """Some numbers of an array are others; or anything is."""
    if random.random() < 0.3:
        return mutated(random, member, TOKENS, [member])
    changed = bytearray(member)
    for _ in range(1 << random.randrange(4)):
        at = 8 * random.randrange(len(changed) // 8)
        changed[at : at + 8] = random.choice((*DOUBLES, random.randbytes(8)))
    return bytes(changed)


@functools.cache
def _checkpoint_members() -> Mapping[str, bytes]:
    with zipfile.ZipFile(CORPUS / "checkpoint" / "seed.npz") as seed:
        return {name: seed.read(name) for name in seed.namelist()}


NUMBERS = (
    b"1e308",
    b"-1e308",
    b"1e999",
    b"nan",
    b"-inf",
    b"3_9",
    "٣".encode(),
    b"0x1F",
    b"-0",
    b"0",
    b"1" * 400,
    b"true",
)
DOUBLES = tuple(struct.pack("<d", x) for x in (0.0, -1.0, 1e308, 1e-308, math.nan, math.inf))
TOKENS = (*NUMBERS, b"\0", b"\xff", b"\n", b"\r\n", b",", b"=", b'"', b"[" * 40, b"{", b"}", b"_", b"#")
_TOML = (
    b"[pack]\n",
    b"[sensor]\n",
    b"[cell]\n",
    b"[ocv]\n",
    b"capacity_ah = true\n",
    b"[[pack]]\n",
    b"= [",
    b'"""',
    b"1979-05-27",
)
_JSON = (b"null", b'"version"', b": [", b'{"a":', b"\\ud800", b'"soc"', b'"transaction"')

TARGETS: Mapping[str, Target] = {
    "frames": Target(_frames, (DELIMITER, b"\x01\x01", b"\x01\x02", b"\xff\xff\xff\xff"), _sealed, decoder=True),
    "text": Target(_text, (b"V=", b"I=", b"T=", b"cells=", b'{"voltage":', b";", b" mA", b"kV"), decoder=True),
    "vedirect": Target(_meter(VeDirectProtocol), (b"\r\nV\t", b"\r\nI\t", b"\r\nChecksum\t", b":7F0"), _summed),
    "junctek": Target(_meter(JunctekProtocol), (b":r50=1,", b",", b":R50=1,2,1,\r\n"), _counted),
    "pylontech": Target(_meter(PylontechProtocol), (b"pylon>", b"Power Volt", b"Absent", b"bat 2", b" - ")),
    "jbd": Target(_asked("jbd"), (b"\xdd\x03\0", b"\xdd\x04\0", b"\x77"), _jbd_summed, decoder=True),
    "daly": Target(_asked("daly"), (b"\xa5\x01\x90\x08", b"\xa5\x01\x95\x08"), _daly_summed, decoder=True),
    "jk": Target(
        _asked("jk"), (jk.OLD_START, jk.START, jk.START + b"\x02", b"\xc0\x01", b"\x79"), _jk_summed, decoder=True
    ),
    "messages": Target(_messages, (DELIMITER, b"\x01\x02"), _sealed),
    "settings": Target(_file("pack.toml", load_settings), _TOML),
    "cell": Target(_file("cell.toml", load_any), _TOML),
    "csv": Target(_file("table.csv", load_capture), (b"time_s", b"current_a", b"Voltage / V", b",,", b"\xef\xbb\xbf")),
    "csv.gz": Target(
        _file("table.csv.gz", load_capture), repair=lambda r, data: gzip.compress(data, 1) if r.random() < 0.5 else data
    ),
    "parquet": Target(_file("table.parquet", load_capture), (b"PAR1",)),
    "curve": Target(_file("curve.csv", read_curve), (b"soc", b"ocv_v", b"hysteresis_v", b",,")),
    "capture": Target(_file("line.bms", load_capture), _JSON, _headed),
    "requests": Target(_requests, _JSON),
    "published": Target(_published, (*_JSON, b"\\u001b[2J", b'"active":true', b'"text":"', b'"cells_v":[')),
    "checkpoint": Target(_checkpoint, (b"PK\x03\x04", b"{'descr':", b"'|O'", b"'<f8'", b"(1,)"), _zipped),
    "memory": Target(_memory, _JSON),
    "ports": Target(_ports, (b"zigbee", b"auto", b"/dev/", b"../")),
}


def mutated(random: random.Random, data: bytes, tokens: Sequence[bytes], corpus: Sequence[bytes]) -> bytes:
    """``data`` changed in one to eight places."""
    changed = bytearray(data)
    for _ in range(1 << random.randrange(4)):
        at = random.randrange(len(changed) + 1)
        end = min(at + random.randrange(1, 33), len(changed))
        match random.randrange(7):
            case 0 if changed:
                changed[at % len(changed)] ^= 1 << random.randrange(8)
            case 1 if changed:
                changed[at % len(changed)] = random.randrange(256)
            case 2:
                changed[at:end] = b""
            case 3:
                changed[at:at] = changed[at:end]
            case 4:
                changed[at:end] = random.choice(tokens)
            case 5:
                changed[at:at] = random.choice(tokens)
            case _:
                other = random.choice(corpus)
                begin = random.randrange(len(other) + 1)
                changed[at:at] = other[begin : begin + random.randrange(65)]
    return bytes(changed[:LONGEST])


def inputs(name: str, seed: str, count: int) -> Iterator[bytes]:
    """``count`` inputs of a reader, the same ones by the same seed and corpus."""
    target, chosen, corpus = TARGETS[name], random.Random(f"{name} {seed}"), seeds(name, "seed*")
    tokens = (*TOKENS, *target.tokens)
    for _ in range(count):
        yield target.repair(chosen, mutated(chosen, chosen.choice(corpus), tokens, corpus))


def seeds(name: str, pattern: str = "*") -> list[bytes]:
    """The corpus of a reader: what inputs are made from, and what once failed."""
    return [path.read_bytes() for path in sorted((CORPUS / name).glob(pattern))]


class FuzzError(Exception):
    """An input made a reader raise an undocumented error."""

    def __init__(self, data: bytes, error: BaseException) -> None:
        super().__init__(f"{type(error).__name__}: {error}")
        self.data = data


def attempt(name: str, tried: Iterator[bytes], noted: Callable[[bytes], None] = lambda _: None) -> int:
    """Let a reader read inputs. Returns how many.

    Args:
        name: Of the reader.
        tried: Inputs.
        noted: Is told of each input before it is read.

    Raises:
        FuzzError: The first that fails.
    """
    count = 0
    with tempfile.TemporaryDirectory(dir=_memory_disk()) as folder:
        read = TARGETS[name].make(Path(folder))
        try:
            for data in tried:
                if count % BATCH == 0:
                    faulthandler.dump_traceback_later(HANG_S, exit=True)
                noted(data)
                try:
                    read(data)
                except Exception as error:
                    raise FuzzError(data, error) from error
                count += 1
        finally:
            faulthandler.cancel_dump_traceback_later()
    return count


def keep(name: str, data: bytes) -> Path:
    """Put an input that fails into the corpus."""
    path = CORPUS / name / f"failed-{hashlib.sha256(data).hexdigest()[:12]}"
    path.write_bytes(data)
    return path


def quiet() -> None:
    """Suppress the log lines of readers about each input."""
    warnings.simplefilter("ignore")
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))


def _memory_disk() -> str | None:
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def _work(name: str, seed: str, count: int, room: mmap.mmap, fault: "mp.Queue[str]") -> None:
    """Process inputs; the current one is in ``room`` in case the process dies."""
    quiet()

    def note(data: bytes) -> None:
        room[:4] = len(data).to_bytes(4, "little")
        room[4 : 4 + len(data)] = data

    try:
        attempt(name, inputs(name, seed, count), note)
    except FuzzError as error:
        fault.put(f"{error} <- {error.__cause__!r}")
        sys.exit(1)


def fuzz(name: str, seed: int, count: int) -> bool:
    """Try ``count`` inputs in all processes, and print the result. Returns whether none failed."""
    fork = mp.get_context("fork")
    begin_s, workers = time.monotonic(), []
    for i in range(PROCESSES):
        room, fault = mmap.mmap(-1, ROOM), fork.Queue()
        worker = fork.Process(target=_work, args=(name, f"{seed}.{i}", count // PROCESSES, room, fault))
        worker.start()
        workers.append((worker, room, fault))
    good = True
    for worker, room, fault in workers:
        worker.join()
        if worker.exitcode:
            good = False
            path = keep(name, bytes(room[4 : 4 + int.from_bytes(room[:4], "little")]))
            why = "hung or died" if fault.empty() else fault.get()
            sys.stdout.write(f"{name}: {why}\n  kept: {path}\n")
    passed_s = time.monotonic() - begin_s
    per_minute = count / passed_s * 60.0
    sys.stdout.write(
        f"{name:12} {count:>12,} inputs in {passed_s:6.0f} s, {per_minute:>12,.0f} a minute {'' if good else 'FAILED'}\n"
    )
    sys.stdout.flush()
    return good


def main() -> None:
    """Fuzz the requested readers; return 1 after a failure."""
    parser = argparse.ArgumentParser(
        prog="make fuzz", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--decoders", type=int, default=10_000_000, help="inputs to each decoder of the line")
    parser.add_argument("--parsers", type=int, default=1_000_000, help="inputs to each other reader")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="*", default=list(TARGETS), choices=list(TARGETS))
    options = parser.parse_args()
    good = True
    for name in options.only:
        attempt(name, iter(seeds(name)[:1]))  # compiles
        target = TARGETS[name]
        good &= fuzz(name, options.seed, options.decoders if target.decoder else options.parsers)
    sys.exit(not good)


if __name__ == "__main__":
    main()
