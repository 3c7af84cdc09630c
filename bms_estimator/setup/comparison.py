"""Comparison of a device with a multimeter. The board stores the corrections, or they are settings of ``[sensor]``."""

import asyncio

from bms_estimator.model.errors import UserError
from bms_estimator.protocols.firmware.messages import (
    MAX_DIVIDER,
    MAX_VOLTS_PER_AMPERE,
    MIN_DIVIDER,
    MIN_VOLTS_PER_AMPERE,
    set_current_slope_command,
    set_divider_command,
)
from bms_estimator.protocols.registry import BOARD
from bms_estimator.setup.found_device import FoundDevice
from bms_estimator.setup.measurement import Measurement, measure
from bms_estimator.setup.multimeter import (
    CurrentCorrection,
    VoltagePoint,
    current_correction,
    direction_correction,
    require_zero,
    voltage_gain,
)
from bms_estimator.sources.serial.device_detection import BoardClient
from bms_estimator.sources.serial.port_list import NoPortError

GAIN_DIGITS = 6
"""Number of decimals of a gain. Its rounding error is far below the error of a multimeter."""
ZERO_DIGITS = 4
"""Number of decimals of the current zero [A]."""
OPPOSITE_SIGNS = {"discharge_positive": "charge_positive", "charge_positive": "discharge_positive"}
"""Opposite of each value of ``sensor.current_sign``."""


class Comparison:
    """Comparison of one device with a multimeter.

    A board with this project's firmware stores its gains and its zero itself. The corrections of any other device are
    settings of ``[sensor]``.

    Args:
        device: Device to compare.
    """

    def __init__(self, device: FoundDevice) -> None:
        self._device, self._sensor = device, device.settings.sensor
        self._is_board = self._sensor.protocol == BOARD
        self._resolution_a = self._sensor.current_resolution_a or 0.0
        self._points: list[VoltagePoint] = []
        self._zero_a = 0.0
        self._current: CurrentCorrection | None = None

    async def measure(self) -> Measurement:
        """Return the present values of the device, without the corrections of this comparison.

        Raises:
            UserError: No sample arrives.
        """
        return await measure(self._device.settings)

    async def compare_voltage(self, multimeter_v: float) -> str:
        """Compare the present voltage [V]; return the result as text.

        Raises:
            InvalidAnswerError: The voltage is implausible, or contradicts an earlier comparison.
            UserError: No sample arrives.
        """
        measured = await self.measure()
        points = [*self._points, VoltagePoint(measured.voltage_v, multimeter_v)]
        gain = voltage_gain(points)
        self._points = points
        return f"voltage: device {measured.voltage_v:.3f} V, multimeter {multimeter_v:g} V: gain {gain:.4f}"

    async def set_zero(self) -> str:
        """Use the present current as the zero of the sensor; return the result as text.

        Raises:
            InvalidAnswerError: A current flows.
            UserError: No sample arrives, or the board rejects the command.
        """
        measured = await self.measure()
        zero_a = require_zero(measured.current_a)
        if self._is_board:
            await asyncio.to_thread(self._zero_board)
            return f"current: zero was {zero_a:.3f} A; the board has stored the new zero"
        self._zero_a = zero_a
        return f"current: zero {zero_a:.3f} A"

    async def compare_current(self, multimeter_a: float) -> str:
        """Compare the present current [A], positive on discharge; return the result as text.

        Raises:
            InvalidAnswerError: The current is too small, or deviates too far.
            UserError: No sample arrives.
        """
        device_a = (await self.measure()).current_a - self._zero_a
        self._current = current_correction(device_a, multimeter_a, resolution_a=self._resolution_a)
        sign = ", and the sign of the current is reversed" if self._current.is_sign_wrong else ""
        return f"current: device {device_a:.3f} A, multimeter {multimeter_a:g} A: gain {self._current.gain:.4f}{sign}"

    async def compare_direction(self, direction: str) -> str:
        """Compare the direction of the present current with the true one; return the result as text.

        Raises:
            InvalidAnswerError: The direction is unknown, or the current is too small.
            UserError: No sample arrives.
        """
        device_a = (await self.measure()).current_a - self._zero_a
        self._current = direction_correction(device_a, direction, resolution_a=self._resolution_a)
        return f"current: the sign is {'reversed' if self._current.is_sign_wrong else 'right'}"

    async def finish(self) -> tuple[tuple[str, object], ...]:
        """Store the gains on a board; return the corrections that it does not store, as key and value of settings of ``[sensor]``.

        Raises:
            UserError: The board rejects a gain, or does not answer.
        """
        if self._is_board:
            await asyncio.to_thread(self._set_board_gains)
        return tuple(self._settings())

    def _settings(self) -> list[tuple[str, object]]:
        settings: list[tuple[str, object]] = []
        if self._current and self._current.is_sign_wrong:
            settings.append(("current_sign", OPPOSITE_SIGNS[self._sensor.current_sign]))
        if self._is_board:
            return settings
        if self._points:
            settings.append(("voltage_gain", round(voltage_gain(self._points), GAIN_DIGITS)))
        if self._current and self._current.gain != 1.0:
            settings.append(("current_gain", round(self._current.gain, GAIN_DIGITS)))
        if self._zero_a:
            # the setting has the sign of the device; measured currents are positive on discharge
            sign = 1.0 if self._sensor.current_sign == "discharge_positive" else -1.0
            settings.append(("current_zero_a", round(sign * self._zero_a, ZERO_DIGITS)))
        return settings

    def _client(self) -> BoardClient:
        try:
            return BoardClient(self._sensor.port, self._sensor.baud)
        except NoPortError as error:
            raise UserError(str(error)) from None

    def _zero_board(self) -> None:
        with self._client() as client:
            client.zero_current()

    def _set_board_gains(self) -> None:
        """Multiply the board's divider and slope by the gains."""
        with self._client() as client:
            hello = client.hello()
            if self._points:
                divider = hello.divider_ppm * 1e-6 * voltage_gain(self._points)
                _require_within("divider", divider, MIN_DIVIDER, MAX_DIVIDER)
                client.send(set_divider_command(divider))
            if self._current and self._current.gain != 1.0:
                slope = hello.current_uv_per_a * 1e-6 / self._current.gain
                _require_within("slope of the current [V/A]", slope, MIN_VOLTS_PER_AMPERE, MAX_VOLTS_PER_AMPERE)
                client.send(set_current_slope_command(slope))


def _require_within(name: str, value: float, minimum: float, maximum: float) -> None:
    if not minimum <= value <= maximum:
        raise UserError(f"the {name} of the board would be {value:g}, but must be {minimum:g} to {maximum:g}")
