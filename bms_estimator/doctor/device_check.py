"""Check of the device: does it send samples, and is it the calibrated board of the pack?

The device is opened as the service opens it, but only if no service runs and the port is free.
"""

import asyncio
import contextlib
import math
import os
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from bms_estimator.doctor.finding import ExaminedPack, Finding, fault, ok, warning
from bms_estimator.estimator.settings_plausibility import implausible_measurement
from bms_estimator.installation.machine import root_command
from bms_estimator.model.cell_slots import is_live
from bms_estimator.protocols.registry import make_protocol
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sources.mqtt import MqttSource
from bms_estimator.sources.factory import open_source
from bms_estimator.sources.serial.port_list import STORED_FIELDS, KnownBoardFile, NoPortError, holder, resolve_port

NAME = "device"
MIN_FIRST_SAMPLE_TIMEOUT_S = 8.0
"""Minimum time within which a device must send a sample [s]. Opening the port may reset a board, whose boot loader takes 2 s."""
CELLS_TIMEOUT_S = 2.0
"""Time after the first sample within which a device sends all cell voltages [s]. Some report them in several responses."""
PSEUDO_TERMINALS = "/dev/pts/"
"""Folder of pseudo-terminals, which simulated devices use."""
UNCALIBRATED_BANDGAP_V = "1.1"
"""Bandgap voltage that a board reports before it is calibrated."""
SERIAL_REMEDY = "check cable, sensor.protocol and sensor.baud; see which device answers: bms-estimator ports --probe"
"""Remedy for a silent device on a serial port."""
SOURCE_REMEDY = "check the device and the section [source]"
"""Remedy for a silent device that is not on a serial port."""
NOT_EXAMINED = warning(
    NAME,
    "in use by the running service; not examined",
    "see on the page or in the log of the service whether samples arrive, or stop it first",
)
"""Finding on the device of a running service whose health cannot be read."""
CALIBRATION_FIELDS = STORED_FIELDS[1:]
"""Fields of a board's hello that its calibration changes: all stored fields but the serial number."""


class NoSampleError(Exception):
    """A device sends no sample."""


@dataclass(frozen=True)
class FirstSample:
    """First sample of a device, and the number of cells in the samples that follow."""

    voltage_v: float
    current_a: float
    board: Mapping[str, str]
    """Properties that the device reported; empty without any."""
    cells: int
    """Number of cell voltages; 0 without any."""
    capacity_ah: float = math.nan
    """Capacity that the device reported [Ah]; NaN without one."""

    def __str__(self) -> str:
        """Describe the sample and the device."""
        current = "no current" if math.isnan(self.current_a) else f"{self.current_a:.3f} A"
        names = ", ".join(f"{name} {self.board[name]}" for name in ("firmware", "serial") if self.board.get(name))
        return f"{self.voltage_v:.3f} V, {current}{f'; {names}' if names else ''}"


def first_sample_timeout_s(settings: Settings) -> float:
    """Return the time within which the device must send a sample [s]: two sample periods, or longer if a setting permits silence."""
    silent_s = settings.source.max_silent_s if isinstance(settings.source, MqttSource) else None
    return max(MIN_FIRST_SAMPLE_TIMEOUT_S, 2.0 * settings.sensor.sample_period_s, silent_s or 0.0)


def load_decoder(subject: ExaminedPack) -> None:
    """Load the kernel that decodes a board's frames. Without a cache it is compiled, which takes longer than a check's timeout."""
    if subject.settings.source is None and not subject.is_running:
        make_protocol(subject.settings.sensor).feed(0.0, b"\0\n")  # ends a frame, or a line of text


def check_device(subject: ExaminedPack) -> Iterator[Finding]:
    """Yield findings on the samples of the device, and on the calibration and identity of a board."""
    source = subject.settings.source
    name = source.short_description if source else subject.settings.sensor.port
    if subject.is_running:
        if subject.settings.mqtt is None:  # otherwise ``check_broker`` reads the service's health
            yield NOT_EXAMINED
        return
    if source is None:
        try:
            other = _port_holder(name)
        except NoPortError:  # ``check_port`` reports it
            return
        if other:
            remedy = "end that process, then run the command again"
            yield warning(NAME, f"{name}: in use by {other}; not opened", remedy)
            return
    try:
        sample = asyncio.run(_first_sample(subject))
    except NoSampleError as error:
        yield fault(NAME, str(error), silence_remedy(subject))
        return
    series = subject.model.cell.series_count
    others = [
        str(n)
        for n in (series - 1, series + 1)
        if n
        and not sample.cells
        and not implausible_measurement(subject.model, sample.voltage_v * series / n, sample.current_a, math.nan)
    ]
    doubt = f"; without cell voltages, {' or '.join(others)} in series cannot be excluded" if others else ""
    yield ok(NAME, f"{name}: {sample}{doubt}")
    for text in implausible_measurement(subject.model, sample.voltage_v, sample.current_a, sample.capacity_ah):
        yield warning(NAME, text, f"edit {subject.path}, then: bms-estimator config check {subject.path}")
    if sample.cells != series and (sample.cells or subject.settings.bms):
        text = f"{sample.cells} cells are measured, but the pack has {series} in series"
        yield warning(NAME, text, "correct pack.series, or measure the other cells")
    if sample.board.get("bandgap_v"):
        yield from check_board(subject, sample.board)


def silence_remedy(subject: ExaminedPack) -> str:
    """Return the remedy for a silent device."""
    return SERIAL_REMEDY if subject.settings.source is None else SOURCE_REMEDY


def _port_holder(port: str) -> str | None:
    """Return the process that has the port open; None without one.

    A pseudo-terminal counts as free, because the program that simulates its device has it open, too.

    Raises:
        NoPortError: The port does not exist.
    """
    path = resolve_port(port)
    return None if os.path.realpath(path).startswith(PSEUDO_TERMINALS) else holder(path)


async def _first_sample(subject: ExaminedPack) -> FirstSample:
    """Return the first sample of the pack's source.

    Raises:
        NoSampleError: No sample arrives. The message is the reason.
    """
    source = open_source(subject.settings)
    series, sample, timeout_s = subject.model.cell.series_count, None, first_sample_timeout_s(subject.settings)
    async with source:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s) as limit:
                async for received in source:
                    last = received.samples[-1]
                    cells = max(is_live(received.cells_v).sum(axis=1), default=0)
                    if sample is None:
                        sample = FirstSample(float(last["voltage_v"]), float(last["current_a"]), dict(source.board), 0)
                        limit.reschedule(asyncio.get_running_loop().time() + CELLS_TIMEOUT_S)
                    sample = replace(
                        sample, cells=max(sample.cells, int(cells)), capacity_ah=received.device_capacity_ah
                    )
                    if sample.cells == series or sample.board.get("bandgap_v"):  # a board measures no cells
                        break
        if sample is None:
            raise NoSampleError(source.silence_reason or f"no sample within {timeout_s:g} s")
        return sample


def check_board(subject: ExaminedPack, board: Mapping[str, str]) -> Iterator[Finding]:
    """Yield findings on the calibration of a board, and on its identity.

    Args:
        subject: The pack.
        board: Properties from the board's hello.
    """
    if board["bandgap_v"] == UNCALIBRATED_BANDGAP_V:
        text = "the bandgap is not calibrated, so that the voltage may be 10 % wrong"
        remedy = "measure between AREF and GND with a multimeter, then: bms-estimator board --aref-v VOLTS"
        yield warning("board", text, remedy)
    else:
        gains = ", ".join(f"{name} {board[name]}" for name in CALIBRATION_FIELDS if board.get(name))
        yield ok("board", f"calibrated: {gains}")
    file = KnownBoardFile(subject.state_folder, subject.settings.pack.name)
    try:
        known = {} if file.is_missing() else file.load()
    except PermissionError:
        yield warning("board", f"{file.path}: cannot be read by this user; not compared", subject.command_as_root)
        return
    accept = shlex.join(root_command("board", "--folder", file.path.parent, "--accept", subject.path))
    if known.get("serial") and known["serial"] != board.get("serial"):
        yield fault("board", f"board {board.get('serial')} is connected, but the pack's is {known['serial']}", accept)
    elif changes := [name for name in CALIBRATION_FIELDS if known.get(name) and known[name] != board.get(name)]:
        changed = ", ".join(f"{name} {known[name]} to {board.get(name)}" for name in changes)
        text = f"calibrated differently since the service last ran: {changed}"
        yield warning("board", text, "nothing, if you have calibrated it; otherwise calibrate it again")
