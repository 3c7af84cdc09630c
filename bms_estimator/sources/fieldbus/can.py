"""Line producer that listens to a CAN bus with any interface of python-can. It never sends."""

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import AsyncGenerator, Callable, Mapping
from typing import Any

import can

from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.reading import CONNECTED, sample_json_line
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sources.fieldbus import CanSource
from bms_estimator.sources.fieldbus.can_signals import CanDecoder
from bms_estimator.sources.source import LineProducer, SourceUnavailableError

RECEIVE_TIMEOUT_S = 0.2
"""Timeout of a receive call [s]. After each call the thread checks if it must stop."""
SHUTDOWN_TIMEOUT_S = 5.0
"""Timeout of the thread at its end [s]. A thread whose adapter hangs is abandoned."""
BUS_OFF_BIT = 0x40
"""Bit in the identifier of an error frame: CAN_ERR_BUSOFF of linux/can/error.h."""

Deliver = Callable[[bytes | Exception], None]
"""Passes a line, or the error that ended the thread, to the event loop."""


class CanProducer(LineProducer):
    """Line producer that listens to a bus in its own thread, because most adapters have only blocking calls.

    Args:
        settings: Settings of the bus.

    Raises:
        UserError: The interface is unknown, or the DBC file does not define the signals.
    """

    def __init__(self, settings: CanSource) -> None:
        if settings.interface not in can.VALID_INTERFACES:
            known = ", ".join(sorted(can.VALID_INTERFACES))
            raise UserError(f"source.interface = {settings.interface!r}: python-can has {known}")
        logging.getLogger("can").setLevel(logging.CRITICAL)  # its log lines are replaced by one of this module
        self._settings = settings
        self._decoder = CanDecoder(settings)
        self._invalid_frames = self._error_frames = 0
        self._is_bus_off = False

    @property
    def name(self) -> str:
        """Name of the bus."""
        return self._settings.short_description

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters of the decoder, number of ``error_frames``, and number of invalid frames of an adapter (``junk``)."""
        return {**self._decoder.counters, "error_frames": self._error_frames, "junk": self._invalid_frames}

    @property
    def fault(self) -> str | None:
        """Reason why no reading arrives."""
        if self._is_bus_off:
            return "the controller is bus off: are bitrate, wiring and termination right?"
        missing = self._decoder.missing
        return missing and f"connected, but without {missing}: are identifiers, bitrate and wiring right?"

    async def iter_lines(self) -> AsyncGenerator[bytes, None]:
        """Yield one line for each pair of voltage and current."""
        loop, stop = asyncio.get_running_loop(), threading.Event()
        items: asyncio.Queue[bytes | Exception] = asyncio.Queue()

        def deliver(item: bytes | Exception) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(items.put_nowait, item)

        thread = threading.Thread(target=self._listen, args=(deliver, stop), name=self.name, daemon=True)
        thread.start()
        try:
            while not isinstance(item := await items.get(), Exception):
                yield item
            raise item
        finally:
            stop.set()
            await asyncio.to_thread(thread.join, SHUTDOWN_TIMEOUT_S)

    def _listen(self, deliver: Deliver, stop: threading.Event) -> None:
        """Deliver lines until the bus is lost, and then the error. Runs in the thread."""
        try:
            bus = self._open()
            try:
                deliver(CONNECTED)
                while not stop.is_set():
                    self._handle_message(self._receive(bus), deliver)
            finally:
                with contextlib.suppress(Exception):  # the adapter may have been removed
                    bus.shutdown()
        except Exception as error:  # noqa: BLE001 - ``iter_lines`` raises it
            deliver(error)

    def _open(self) -> can.BusABC:
        """Open the bus.

        Raises:
            SourceUnavailableError: The bus cannot be opened.
        """
        settings = self._settings
        options: dict[str, Any] = {**settings.options}
        if settings.bitrate is not None:
            options["bitrate"] = settings.bitrate
        filters = [  # identifiers have 29 or 11 bits
            {"can_id": frame.id, "can_mask": 0x1FFF_FFFF if frame.extended else 0x7FF, "extended": frame.extended}
            for frame in self._decoder.frame_ids
        ]
        try:
            return can.Bus(
                interface=settings.interface,
                channel=settings.channel,
                can_filters=filters,
                ignore_config=True,
                **options,
            )
        except Exception as error:  # each interface raises the errors of its library
            raise SourceUnavailableError(f"cannot be opened: {error}") from error

    def _receive(self, bus: can.BusABC) -> can.Message | None:
        """Return the next frame if it arrives soon.

        Raises:
            SourceUnavailableError: The bus is lost.
        """
        try:
            return bus.recv(RECEIVE_TIMEOUT_S)
        except ValueError:  # slcan received a line that is not a frame
            self._invalid_frames += 1
            return None
        except Exception as error:  # each interface raises the errors of its library
            raise SourceUnavailableError(f"lost: {error}") from error

    def _handle_message(self, message: can.Message | None, deliver: Deliver) -> None:
        if message is None or message.is_remote_frame:
            return
        self._is_bus_off = message.is_error_frame and bool(message.arbitration_id & BUS_OFF_BIT)
        if message.is_error_frame:
            self._error_frames += 1
        elif message.dlc != len(message.data):  # slcan received a frame with lost characters
            self._invalid_frames += 1
        elif (line := self._line(message)) is not None:
            deliver(line)

    def _line(self, message: can.Message) -> bytes | None:
        """Return the line of a sample that this frame completes."""
        data = bytes(message.data)
        reading = self._decoder.feed(time.monotonic(), message.arbitration_id, message.is_extended_id, data)
        return reading and sample_json_line(
            reading.voltage_v,
            reading.current_a,
            temperatures_c=reading.temperatures_c,
            cells_v=reading.cells_v,
            soc=reading.soc,
            capacity_ah=reading.capacity_ah,
        )


def producer(settings: Settings) -> CanProducer:
    """Make the line producer of ``[source]``.

    Raises:
        UserError: The interface is unknown, or the DBC file does not define the signals.
    """
    assert isinstance(settings.source, CanSource)  # noqa: S101 - KINDS maps kind = "can" to CanSource
    return CanProducer(settings.source)
