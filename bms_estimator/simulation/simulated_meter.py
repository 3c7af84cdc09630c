"""Simulated battery monitors and batteries, with their makers' protocols on a pseudo-terminal.

Values are rounded to the resolution of the device. ``virtual_board`` simulates the firmware's board.
"""

import asyncio
import math
import os
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Self

from bms_estimator.protocols.devices import junctek
from bms_estimator.simulation.virtual_adc import Reading

Signal = Callable[[float], Reading]
"""Readings as a function of time [s]. It is called with times that never decrease."""


class SimulatedMeter(ABC):
    """Simulated device on a pseudo-terminal. Open it as a context manager, then ``run`` it.

    Args:
        signal: Readings of the simulated pack as a function of time [s].
        speed: Speed relative to real time.
    """

    period_s = math.inf
    """Interval of unsolicited messages [s]."""

    def __init__(self, signal: Signal, *, speed: float = 1.0) -> None:
        self._signal, self._speed = signal, speed
        self._master = self._slave = -1
        self.path = ""
        """Path of the pseudo-terminal."""
        self.time_s = 0.0
        """Time of the last reading [s]."""
        self.samples = 0
        """Number of readings sent."""
        self.last = Reading(math.nan, math.nan)
        """Last reading sent."""

    def __enter__(self) -> Self:
        """Open the pseudo-terminal."""
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        return self

    def __exit__(self, *_: object) -> None:
        """Close the pseudo-terminal, as if the device were unplugged."""
        for descriptor in (self._master, self._slave):
            os.close(descriptor)

    @abstractmethod
    def message(self, reading: Reading) -> bytes:
        """Encode a reading. A device with a finite ``period_s`` sends the message without a request."""

    def respond(self, received: bytes, reading: Reading) -> tuple[bytes, int]:  # noqa: ARG002 - for polled devices
        """Return the response to ``received``, and the number of consumed bytes."""
        return b"", len(received)

    def send(self, data: bytes) -> None:
        """Write arbitrary bytes to the line. They are lost if the host does not read."""
        try:
            os.write(self._master, data)
        except BlockingIOError:
            return

    async def run(self, seconds: float = math.inf) -> None:
        """Send messages and responses for ``seconds`` of simulated time."""
        loop, inbox = asyncio.get_running_loop(), bytearray()
        start_s, has_input = loop.time(), asyncio.Event()

        def read_input() -> None:
            inbox.extend(os.read(self._master, 4096))
            has_input.set()

        loop.add_reader(self._master, read_input)
        try:
            due_s = 0.0
            while (now_s := (loop.time() - start_s) * self._speed) < seconds:
                if now_s >= due_s:
                    due_s += self.period_s
                    self._send_message(now_s)
                if inbox:
                    response, consumed = self.respond(bytes(inbox), self._read_sensors(now_s))
                    del inbox[:consumed]
                    self.send(response)
                has_input.clear()
                wait_s = (min(due_s, seconds) - now_s) / self._speed
                try:
                    async with asyncio.timeout(wait_s if math.isfinite(wait_s) else None):
                        await has_input.wait()
                except TimeoutError:
                    continue
        finally:
            loop.remove_reader(self._master)

    def _send_message(self, now_s: float) -> None:
        if math.isfinite(self.period_s):
            self.send(self.message(self._read_sensors(now_s)))

    def _read_sensors(self, now_s: float) -> Reading:
        """Return the present values at the sensors; update time, number and last reading."""
        self.time_s = now_s
        self.samples += 1
        self.last = self._signal(now_s)
        return self.last


class SimulatedVeDirect(SimulatedMeter):
    """Simulated Victron SmartShunt, which sends a block of values and a block of history each second."""

    period_s = 1.0

    def message(self, reading: Reading) -> bytes:
        """Return both blocks."""
        temperature = "---" if math.isnan(reading.temperature_c) else f"{reading.temperature_c:.0f}"
        fields = {
            "PID": "0xA389",
            "V": f"{1e3 * reading.voltage_v:.0f}",
            "T": temperature,
            "I": f"{-1e3 * reading.current_a:.0f}",
            "P": f"{-reading.voltage_v * reading.current_a:.0f}",
            "CE": "---",
            "SOC": "---",
            "TTG": "-1",
            "Alarm": "OFF",
            "AR": "0",
            "BMV": "SmartShunt 500A/50mV",
            "FW": "0416",
            "MON": "0",
        }
        return _vedirect_block(fields) + _vedirect_block({"H1": "0", "H2": "0", "H3": "0", "H4": "0"})


def _vedirect_block(fields: Mapping[str, str]) -> bytes:
    body = "".join(f"\r\n{label}\t{value}" for label, value in fields.items()).encode() + b"\r\nChecksum\t"
    return body + bytes((-sum(body) & 0xFF,))  # the sum of all bytes of a block is 0 modulo 256


class SimulatedJunctek(SimulatedMeter):
    """Simulated Junctek monitor at address 1."""

    def message(self, reading: Reading) -> bytes:
        """Return the response with all measured values."""
        temperature_c = 25.0 if math.isnan(reading.temperature_c) else reading.temperature_c
        values = [
            round(100 * reading.voltage_v),
            round(100 * abs(reading.current_a)),
            *(50_000, 1_000, 10_000, round(self.time_s)),  # four values that the decoder does not use
            round(temperature_c) + junctek.ZERO_C,
            *(0, 0),
            int(reading.current_a < 0.0),  # direction: 1 on charge
            *(0, 0),
        ]
        return b":r50=1,%d,%s,\r\n" % (sum(values) % 255 + 1, ",".join(map(str, values)).encode())

    def respond(self, received: bytes, reading: Reading) -> tuple[bytes, int]:
        """Respond to each line that begins with ``:R50=1,``."""
        *lines, rest = received.split(b"\n")
        requests = sum(line.startswith(b":R50=1,") for line in lines)
        return requests * self.message(reading), len(received) - len(rest)


class SimulatedPylontech(SimulatedMeter):
    """Simulated Pylontech console with one battery.

    Args:
        signal: Readings of the simulated pack as a function of time [s].
        speed: Speed relative to real time.
        cells: Number of cells in series.
    """

    def __init__(self, signal: Signal, *, speed: float = 1.0, cells: int = 15) -> None:
        super().__init__(signal, speed=speed)
        self._cells = cells

    def message(self, reading: Reading) -> bytes:
        """Return the table of all batteries."""
        cell_mv, temperature_mc = round(1e3 * reading.voltage_v / self._cells), self._millidegrees(reading)
        header = (
            "Power Volt   Curr   Tempr  Tlow   Thigh  Vlow   Vhigh  Base.St  Volt.St  Curr.St  Temp.St  Coulomb  Time"
        )
        pack_mv, pack_ma = round(1e3 * reading.voltage_v), -round(1e3 * reading.current_a)
        row = f"1     {pack_mv:<6} {pack_ma:<6} {temperature_mc:<6} {temperature_mc:<6} {temperature_mc:<6} {cell_mv:<6} {cell_mv:<6} {_base_state(pack_ma):<8} Normal"
        absent = ["2     -      -      -      -      -      -      -      Absent   -"]
        return _response("pwr", [header, row + "   Normal   Normal   50%      2026-01-01 00:00:00", *absent])

    def respond(self, received: bytes, reading: Reading) -> tuple[bytes, int]:
        """Respond to ``pwr`` and ``bat 1``."""
        *lines, rest = received.replace(b"\r", b"\n").split(b"\n")
        response = b"".join(self._command(line.decode("ascii", "replace").strip(), reading) for line in lines)
        return response, len(received) - len(rest)

    def _command(self, line: str, reading: Reading) -> bytes:
        match line.split():
            case ["pwr"]:
                return self.message(reading)
            case ["bat", "1"]:
                cell_mv, temperature_mc = round(1e3 * reading.voltage_v / self._cells), self._millidegrees(reading)
                pack_ma = -round(1e3 * reading.current_a)
                header = (
                    "Battery  Volt     Curr     Tempr    Base State   Volt. State  Curr. State  Temp. State  Coulomb"
                )
                tail = f"{pack_ma:<8} {temperature_mc:<8} {_base_state(pack_ma):<12} Normal       Normal       Normal       50%"
                return _response(line, [header, *(f"{n:<8} {cell_mv:<8} {tail}" for n in range(self._cells))])
            case []:
                return b"\n\rpylon>"
        return f"{line}\n\r@\r\r\nUnknown command '{line}' - try 'help'\r\n\r$$\r\n\rpylon>".encode()

    @staticmethod
    def _millidegrees(reading: Reading) -> int:
        return 25_000 if math.isnan(reading.temperature_c) else round(reading.temperature_c) * 1000


def _base_state(pack_ma: int) -> str:
    return "Idle" if pack_ma == 0 else "Charge" if pack_ma > 0 else "Dischg"


def _response(command: str, lines: list[str]) -> bytes:
    text = f"{command}\n\r@\r\r\n" + "\r\r\n".join(lines) + "\r\n\rCommand completed successfully\r\n\r$$\r\n\rpylon>"
    return text.encode()


METERS: Mapping[str, Callable[[Signal, float], SimulatedMeter]] = {
    "vedirect": lambda signal, speed: SimulatedVeDirect(signal, speed=speed),
    "junctek": lambda signal, speed: SimulatedJunctek(signal, speed=speed),
    "pylontech": lambda signal, speed: SimulatedPylontech(signal, speed=speed),
}
"""Simulated meters by ``sensor.protocol``."""
