"""File with counters and alarms of a pack. Its name contains only the pack's name, so that it survives edited settings.

A checksum in its first line reveals any damage. Other files use the same checksum. The devices and cells of a pack
distinguish a new pack from a renamed one.
"""

import contextlib
import io
import json
import re
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeGuard

import numpy as np
import structlog

from bms_estimator.model.payloads.health import Totals
from bms_estimator.process.state_folder import is_locked, overwrite_private, read_private, write_private
from bms_estimator.settings.pack import BmsSettings, Settings
from bms_estimator.settings.sources.source import BleSource
from bms_estimator.telemetry.publish_window import ChargeEnergy, new_totals

SERIAL_IDS = "/dev/serial/by-id/"
"""Folder of the names of serial ports that contain the serial number of the device."""


class PackDescription(NamedTuple):
    """Devices and cells of a pack."""

    devices: tuple[tuple[str, str], ...] = ()
    """Kind and address of each device. The kind is empty if the hardware does not give the address."""
    cells: str = ""
    """Cell and number of cells in series."""

    @classmethod
    def of(cls, settings: Settings) -> Self:
        """Return the description of a pack."""
        devices = tuple(_device(each) for each in (settings, settings.bms) if each)
        return cls(devices, f"{settings.pack.series} {settings.pack.cell}")

    def differs(self, devices: object, cells: object) -> bool:
        """Return True only if a saved description is surely that of another pack.

        No device may be the same. Besides, either the cells must differ, or both devices must have an address of one
        kind that the hardware gives: Bluetooth address, or serial number of a USB adapter. A topic or host may have been
        renamed together with the pack, and a latched alarm must survive this.

        Args:
            devices: Saved devices, as JSON; None: unknown.
            cells: Saved cells.
        """
        saved = [tuple(each) for each in devices] if isinstance(devices, list) else []
        if not saved or not self.devices or set(saved) & set(self.devices):
            return False
        return cells != self.cells or saved[0][0] == self.devices[0][0] != ""


def _device(settings: Settings | BmsSettings) -> tuple[str, str]:
    """Return kind and address of a device."""
    source = settings.source
    if isinstance(source, BleSource) and source.address:
        return "bluetooth", source.address.upper()
    address = settings.sensor.port if source is None else source.short_description
    return ("serial" if address.startswith(SERIAL_IDS) else ""), address


CHECKSUM_BYTES = 9
"""Length of the first line [bytes]."""


def add_checksum(body: bytes) -> bytes:
    """Return ``body`` after a line with its CRC-32."""
    return b"%08x\n%b" % (zlib.crc32(body), body)


def verify_checksum(content: bytes) -> bytes:
    """Return the body of a file that ``add_checksum`` made.

    Raises:
        ValueError: The file is damaged.
    """
    line, _, body = content.partition(b"\n")
    if line != b"%08x" % zlib.crc32(body):
        raise ValueError("its checksum is wrong")
    return body


FORMAT = 1
"""Version of the file's layout. Increment it when a key changes its meaning."""
MAX_FILE_BYTES = 1 << 16
"""Maximum size of the file [bytes]. A file with all alarms raised has about 4 kB."""
MAX_CHECKPOINT_BYTES = 1 << 20
"""Maximum size of a checkpoint of a former version [bytes]. A normal one has about 112 kB."""
MAX_SLOTS = 1024
"""Maximum plausible number of cell slots of a device."""
MAX_COUNT = 1e15
"""Maximum plausible value of a counter: the number of samples of 30,000 years at 1,000 a second."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class RunCounters:
    """Counters of the runs of a pack, and its alarms.

    Attributes:
        restarts: Number of starts that found files of an earlier run.
        total: Totals over all runs.
        clean: True if the last run ended without a crash or kill; False while it runs.
        alarms: State of the alarms, in the format of ``AlarmEvaluator.saved_state``.
        hooks: Hashes of the alarm hooks without unfinished or failed jobs at a clean end; None: unknown.
        cell_slots: Slots of the cells (``CellSlots.cell_indices``).
    """

    restarts: int
    total: Totals
    clean: bool = False
    alarms: str = ""
    hooks: list[str] | None = None
    cell_slots: list[int] = field(default_factory=list)


class SavedRun(NamedTuple):
    """Result of reading the counters of earlier runs."""

    counters: RunCounters
    """Counters including this start."""
    lost_reason: str = ""
    """Reason why raised alarms may be missing; empty if the alarms are complete."""
    is_damaged: bool = False
    """True if there is a file that cannot be used."""
    crashed: bool = False
    """True if the last run crashed or was killed."""


class RunFile:
    """Counters and alarms of one pack, ``<pack.name>.run``.

    Args:
        folder: Folder of the file.
        name: Name of the pack.
        wall_s: Wall clock [s since 1970].
        pack: Devices and cells of the pack; None: unknown.
    """

    def __init__(
        self, folder: Path, name: str, wall_s: Callable[[], float], pack: PackDescription | None = None
    ) -> None:
        self._name, self._wall_s, self._pack = name, wall_s, pack or PackDescription()
        self.path = folder / f"{name}.run"
        self._quarantined = folder / f"{name}.refused.run"

    def save(self, counters: RunCounters) -> None:
        """Write the file atomically, or overwrite it on a full disk or in a read-only folder. A missing folder is created.

        Raises:
            OSError: The file cannot be written.
        """
        values = {"format": FORMAT, "name": self._name, **vars(counters), "total": counters.total.model_dump()}
        values |= self._pack._asdict()
        content = add_checksum(json.dumps(values).encode())
        try:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            write_private(self.path, content)
        except OSError:
            # a raised alarm must not wait for free space; the next start reports a file that a power failure has damaged
            overwrite_private(self.path, content)

    def load(self) -> SavedRun:
        """Read the file. Without a usable file, read the pack's newest checkpoint of a version that stored counters there."""
        try:
            values = _read(self.path)
            if (name := values.get("name", self._name)) != self._name:
                raise ValueError(f"it belongs to the pack {name}")  # noqa: TRY301 - one handler
            crashed = values.get("clean") is not True
            return SavedRun(self._next_counters(values), self._newer_checkpoint_reason(), crashed=crashed)
        except FileNotFoundError:
            return self._load_former_version()
        except Exception as error:  # noqa: BLE001 - a damaged file may raise anything, and is reported
            former = self._load_former_version().counters
            return SavedRun(former, f"{self.path.name} is damaged ({error})", is_damaged=True)

    def quarantine(self) -> str:
        """Rename a damaged file, so that the next save does not overwrite it. Return a description for the user."""
        try:
            self.path.replace(self._quarantined)
        except OSError as error:
            return f"it cannot be set aside: {error}"
        return f"set aside as {self._quarantined.name}"

    def _load_former_version(self) -> SavedRun:
        """Return the counters of the pack's newest readable checkpoint of a former version, whatever its identity."""
        former, lost_reason = None, ""
        for path in self._checkpoints():
            try:
                values = _read_former_counters(path)
            except Exception as error:  # noqa: BLE001 - a damaged file may raise anything; an older one may be readable
                if former is None or isinstance(error, KeyError):  # a checkpoint without counters had a run file
                    lost_reason = f"{self.path.name} is missing, and {path.name} has no readable alarms"
            else:
                former = former or values
        if not lost_reason and (self._quarantined.exists() if former else self._has_other_files()):
            lost_reason = f"{self.path.name} is missing beside other files of the pack"
        if not former and not lost_reason:
            lost_reason = self._other_pack_with_alarm()
        if former:
            return SavedRun(self._next_counters(former), lost_reason)
        return SavedRun(RunCounters(int(bool(lost_reason)), new_totals(self._wall_s())), lost_reason)

    def _newer_checkpoint_reason(self) -> str:
        """Return a reason if a version without run files has saved alarms later than this file; otherwise an empty text."""
        saved_ns = self.path.stat().st_mtime_ns
        for path in self._checkpoints():
            if path.lstat().st_mtime_ns > saved_ns:
                with contextlib.suppress(Exception):  # the content of a damaged file does not count
                    _read_former_counters(path)
                    return f"{path.name} of a former version is newer than {self.path.name}"
        return ""

    def _checkpoints(self) -> list[Path]:
        """Return all checkpoints of the pack, also quarantined ones, newest first."""
        pattern = re.compile(rf"{re.escape(self._name)}(-[0-9a-f]{{8}}|\.refused|\.later-\d)\.npz")
        paths = [path for path in self._folder_content() if pattern.fullmatch(path.name)]
        return sorted(paths, key=lambda path: path.lstat().st_mtime_ns, reverse=True)

    def _has_other_files(self) -> bool:
        """Return True if an earlier run has left any other file."""
        # the name of another pack may be this pack's name with an identity; then only the suffix shows whose file it is
        suffixes = r"\.((refused|later).*|sqlite.*|board\.json|new)|-[0-9a-f]{8}\.(((history|load)\.)?npz|changes-\d)"
        pattern = re.compile(rf"{re.escape(self._name)}({suffixes})")
        return any(pattern.fullmatch(path.name) for path in self._folder_content())

    def _other_pack_with_alarm(self) -> str:
        """Return a reason if another pack, which this one may be after a renaming, has a critical alarm or a lost sensor.

        A pack that a service runs at present was not renamed. Neither was a pack whose settings describe another one
        (``PackDescription.differs``): it is only logged, because a new pack would otherwise start with an alarm. A file
        of a former version, which lacks the description, counts as renamed, so that a latched alarm is not lost.
        """
        folder = self.path.parent
        for path in self._folder_content():
            if path.suffix == ".run" and not path.name.endswith(".refused.run") and not is_locked(folder, path.stem):
                with contextlib.suppress(Exception):  # a damaged file concerns the other pack
                    values = _read(path)
                    alarms = json.loads(values["alarms"] or "{}")
                    inputs = alarms.pop("inputs", {}).values()
                    if (
                        alarms.get("pending")
                        or any(lost for _, lost in inputs)
                        or '"severity": "critical"' in json.dumps(alarms)
                    ):
                        reason = f"{path.stem} has an alarm in {path.name}, and this pack may be {path.stem}, renamed"
                        if not self._pack.differs(values.get("devices"), values.get("cells")):
                            return reason
                        log.warning("another pack in the state folder was stopped with an alarm", pack=path.stem)
        return ""

    def _folder_content(self) -> list[Path]:
        try:
            return list(self.path.parent.iterdir())
        except OSError:
            return []

    def _next_counters(self, values: Mapping[str, Any]) -> RunCounters:
        """Return saved counters, including this start. Invalid counters restart from zero; the alarms remain.

        Raises:
            LookupError, TypeError: The alarms are damaged.
        """
        alarms = values["alarms"]
        if not isinstance(alarms, str):
            raise TypeError(f"alarms = {alarms!r}")
        try:
            restarts, total = _read_counters(values)
        except (ArithmeticError, LookupError, TypeError, ValueError) as error:
            log.warning("the saved counters are invalid and restart from zero", reason=str(error))
            restarts, total = 1, new_totals(self._wall_s())
        hooks, slots = values.get("hooks"), values.get("cell_slots")
        return RunCounters(
            restarts,
            total,
            alarms=alarms,
            hooks=hooks if isinstance(hooks, list) else None,
            cell_slots=slots if _are_slots(slots) else [],
        )


def _read(path: Path) -> dict[str, Any]:
    """Read a file with counters and alarms.

    Raises:
        Exception: The file is missing (FileNotFoundError), damaged, or has another format.
    """
    values: dict[str, Any] = json.loads(verify_checksum(read_private(path, MAX_FILE_BYTES)))
    if values["format"] != FORMAT:
        raise ValueError(f"format {values['format']}, this version reads {FORMAT}")
    return values


def _are_slots(slots: Any) -> TypeGuard[list[int]]:
    """Return True for a list of increasing numbers of cell slots."""
    if not isinstance(slots, list) or not all(type(slot) is int and 0 <= slot < MAX_SLOTS for slot in slots):
        return False
    return slots == sorted(set(slots))


def _read_former_counters(path: Path) -> dict[str, Any]:
    """Return the counters and alarms in a checkpoint of a former version.

    Raises:
        Exception: The file has none (KeyError), or is damaged.
    """
    with np.load(io.BytesIO(read_private(path, MAX_CHECKPOINT_BYTES)), allow_pickle=False) as file:
        return {
            "restarts": int(file["restarts"]),
            "total": json.loads(str(file["total"])),
            "clean": bool(file["clean"]),
            "alarms": str(file["alarms"]) if "alarms" in file else "",
        }


def _read_counters(values: Mapping[str, Any]) -> tuple[int, Totals]:
    """Return the number of restarts and the totals of saved counters, including this start.

    Raises:
        ArithmeticError, LookupError, TypeError, ValueError: A counter is damaged or implausible.
    """
    stored = values["total"]
    total = Totals.model_validate({name: stored[name] for name in Totals.model_fields if name in stored})
    datetime.fromisoformat(total.since)
    restarts, crashes = int(values["restarts"]) + 1, total.crashes + (not values["clean"])
    counts = {"restarts": restarts, "crashes": crashes, "unseen_s": total.unseen_s, **total.samples}
    counts |= ChargeEnergy.from_totals(total)._asdict()
    implausible = [f"{name} = {value}" for name, value in counts.items() if not 0 <= value <= MAX_COUNT]
    if implausible:
        raise ValueError(", ".join(implausible))
    return restarts, total.model_copy(update={"crashes": crashes})
