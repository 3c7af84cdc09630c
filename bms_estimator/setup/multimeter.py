"""Comparison of measured voltages and currents with a multimeter. It does no I/O."""

from collections.abc import Sequence
from dataclasses import dataclass

from bms_estimator.setup.answers import InvalidAnswerError

DISCHARGING, CHARGING = "discharging", "charging"
"""Directions of a current."""
MAX_DEVIATION = 0.2
"""Maximum relative deviation of a device from the multimeter. A larger one indicates a wrong connection or unit."""
MAX_DISAGREEMENT = 0.01
"""Maximum relative deviation of two comparisons from their common gain."""
MIN_LOAD_STEPS = 20.0
"""Minimum current of a comparison relative to the device's resolution, so that the rounding error is at most 2.5 %."""
MIN_LOAD_A = 0.2
"""Minimum current of a comparison with a device of negligible resolution [A]."""
MAX_ZERO_A = 2.0
"""Maximum reading of a current sensor without a current [A]. A Hall sensor for 200 A may show 1 % of its range."""


@dataclass(frozen=True)
class VoltagePoint:
    """Voltage that the device reports, and voltage that the multimeter shows, at one state of charge [V]."""

    device_v: float
    multimeter_v: float


def voltage_gain(points: Sequence[VoltagePoint]) -> float:
    """Return the factor from the device's voltage to the multimeter's, by least squares through 0 V.

    Raises:
        InvalidAnswerError: The device deviates too far from the multimeter, or two comparisons disagree.
    """
    for point in points:
        _require_similar(point.device_v, point.multimeter_v, "V", "is the multimeter at the terminals of this pack?")
    gain = sum(p.device_v * p.multimeter_v for p in points) / sum(p.device_v**2 for p in points)
    for point in points:
        error = gain * point.device_v / point.multimeter_v - 1.0
        if abs(error) > MAX_DISAGREEMENT:
            raise InvalidAnswerError(
                f"{point.multimeter_v:g} V: the comparisons disagree by {2 * abs(error):.1%}; did the voltage change "
                "while you read the multimeter?"
            )
    return gain


@dataclass(frozen=True)
class CurrentCorrection:
    """Result of a comparison of currents."""

    gain: float
    is_sign_wrong: bool
    """True if the device reports the opposite direction."""


def current_correction(device_a: float, multimeter_a: float, *, resolution_a: float = 0.0) -> CurrentCorrection:
    """Return the correction from a comparison at a load.

    Args:
        device_a: Current that the device reports minus its zero, positive on discharge [A].
        multimeter_a: Current that the multimeter shows, positive on discharge [A].
        resolution_a: Resolution of the device [A].

    Raises:
        InvalidAnswerError: The current is too small for a comparison, or the device deviates too far.
    """
    _require_load(min(abs(device_a), abs(multimeter_a)), resolution_a)
    _require_similar(abs(device_a), abs(multimeter_a), "A", "does all current flow through both?")
    return CurrentCorrection(abs(multimeter_a / device_a), device_a * multimeter_a < 0.0)


def direction_correction(device_a: float, direction: str, *, resolution_a: float = 0.0) -> CurrentCorrection:
    """Return the correction of the sign, from a load whose direction is known.

    Args:
        device_a: Current that the device reports, positive on discharge [A].
        direction: ``DISCHARGING`` or ``CHARGING``, the true direction.
        resolution_a: Resolution of the device [A].

    Raises:
        InvalidAnswerError: The direction is unknown, or the current is too small.
    """
    if direction not in (DISCHARGING, CHARGING):
        raise InvalidAnswerError(f"{direction}: must be {DISCHARGING} or {CHARGING}")
    _require_load(abs(device_a), resolution_a)
    return CurrentCorrection(1.0, (device_a > 0.0) != (direction == DISCHARGING))


def _require_load(current_a: float, resolution_a: float) -> None:
    """Reject a current that is too small for a comparison.

    Raises:
        InvalidAnswerError: The current is too small.
    """
    min_load_a = max(MIN_LOAD_A, MIN_LOAD_STEPS * resolution_a)
    if current_a < min_load_a:
        raise InvalidAnswerError(
            f"{current_a:.2f} A: a comparison needs at least {min_load_a:g} A; switch on a larger load"
        )


def require_zero(device_a: float) -> float:
    """Return the current that the device reports without a load [A], if it is a plausible zero.

    Raises:
        InvalidAnswerError: The current is above ``MAX_ZERO_A``.
    """
    if abs(device_a) > MAX_ZERO_A:
        raise InvalidAnswerError(
            f"the device measures {device_a:.2f} A, but a zero is at most {MAX_ZERO_A:g} A; is everything switched off?"
        )
    return device_a


def _require_similar(device: float, multimeter: float, unit: str, question: str) -> None:
    """Reject a deviation that is too large for an error of the gain.

    Raises:
        InvalidAnswerError: The deviation is above ``MAX_DEVIATION``.
    """
    if multimeter <= 0.0 or abs(device / multimeter - 1.0) > MAX_DEVIATION:
        raise InvalidAnswerError(
            f"{multimeter:g} {unit}: the device measures {device:.2f} {unit}, which differs by more than "
            f"{MAX_DEVIATION:.0%}; {question}"
        )
