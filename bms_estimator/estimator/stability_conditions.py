"""Conditions of Lemma 4.1.1 of the thesis, under which C_ts and C_tl stay positive, and warnings if settings violate them.

Numbers in parentheses are equations of the thesis.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from bms_estimator.model.cell import CellModel
from bms_estimator.model.cell_sections import Bounds
from bms_estimator.model.pack_model import PackModel
from bms_estimator.settings.observer import ObserverSettings

CAPACITANCE_INDICES = (7, 9), (10, 12)
"""Indices of the parameters amplitude and offset of C_ts and of C_tl."""


@dataclass(frozen=True)
class Condition:
    """Condition of Lemma 4.1.1: the inequality ``left`` < ``right``. ``holds`` is True if it is satisfied."""

    name: str
    holds: bool
    left: float
    right: float


def lemma_conditions(cell: CellModel) -> list[Condition]:
    """Check the conditions of Lemma 4.1.1 on bounds, weights and initial values of amplitude and offset of C_ts and C_tl.

    The name of each condition begins with 1 for C_ts (a7, a9), and with 2 for C_tl (a10, a12).

    The list also contains conditions that are not required. A condition is not required if the capacitance is positive
    over SOC 0..1 both at the beginning and at the end of the adaptation. ``failed_conditions`` omits such conditions.
    """
    conditions = []
    for number, (amplitude, offset) in enumerate(CAPACITANCE_INDICES, start=1):
        amplitude_bounds, offset_bounds = cell.bounds(amplitude), cell.bounds(offset)
        a, b = f"a{amplitude}", f"a{offset}"
        products = _weighted_bounds(offset_bounds), _weighted_bounds(amplitude_bounds)
        conditions += [
            _below(f"{number}: {b}(0) < {a}(0)", _initial(offset_bounds), _initial(amplitude_bounds)),
            _below(f"{number}: rate of {a} < rate of {b}", amplitude_bounds.rate, offset_bounds.rate),
            _below(f"{number}: P{offset}.l{offset} < P{amplitude}.l{amplitude}", *products),
        ]
    return conditions


def failed_conditions(cell: CellModel) -> list[Condition]:
    """Return the required conditions that fail."""
    required_numbers = []
    for (amplitude, offset), number in zip(CAPACITANCE_INDICES, "12", strict=True):
        amplitude_bounds, offset_bounds = cell.bounds(amplitude), cell.bounds(offset)
        if amplitude_bounds.limit >= offset_bounds.limit or _initial(amplitude_bounds) >= _initial(offset_bounds):
            required_numbers.append(number)
    return [c for c in lemma_conditions(cell) if not c.holds and c.name[0] in required_numbers]


def _below(name: str, left: float, right: float) -> Condition:
    return Condition(name, left < right, left, right)


def _initial(bounds: Bounds) -> float:
    return bounds.limit if bounds.initial is None else bounds.initial


def _weighted_bounds(bounds: Bounds) -> float:
    """Return the sum of both bounds, each times its weight: P_i . lambda_i = lambda_x a_u + lambda_y a_l of the thesis."""
    return bounds.limit * bounds.rate


LAWS_WITH_BOUNDS = ("improved", "scheme-3")
"""Laws that adapt the parameters by (3.18). Lemma 4.1.1 applies to the bounds of (3.18) only."""
MAX_K_WITHOUT_GAIN = {"k2-cos": 0.0, "k-cos-sqrt": 0.0, "ln-cos-sqrt-ln": 1.0}
"""Adaptive gain k up to which a Nussbaum function N(k) is 0 [V^2 s]."""


def observer_warnings(observer: ObserverSettings, cell: PackModel) -> Iterator[str]:
    """Yield a warning for each condition of Lemma 4.1.1 that fails with (3.18), and one if N(k0) is 0.

    A fuel cell and the law ``learning`` use neither (3.18) nor N(k), so that they give no warning.
    """
    if observer.law != "learning":
        yield from cell.by_kind(lambda battery: _battery_warnings(observer, battery), lambda _: ())


def _battery_warnings(observer: ObserverSettings, cell: CellModel) -> Iterator[str]:
    """Yield the warnings of a battery."""
    if observer.law in LAWS_WITH_BOUNDS:
        for condition in failed_conditions(cell):
            yield (
                f"{cell.cell.name}: condition {condition.name} of Lemma 4.1.1 fails: {condition.left:g} is not below "
                f"{condition.right:g}; a capacitance of the observer may become negative although the SOC is above its limit"
            )
    limit = MAX_K_WITHOUT_GAIN.get(observer.nussbaum)
    if limit is not None and observer.k0 <= limit:
        yield (
            f"observer.k0 = {observer.k0:g}: N(k) of {observer.nussbaum!r} is 0 up to k = {limit:g}, so that the observer does "
            f"not correct its voltage until k is larger; set observer.k0 above {limit:g}"
        )
