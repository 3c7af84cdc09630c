"""The conditions of Lemma 4.1.1, under which C_ts and C_tl stay positive while the parameters adapt."""

from dataclasses import dataclass

from bms_estimator.model.cell import Bounds, CellModel


@dataclass(frozen=True)
class Condition:
    """One condition, whether it holds, and its two sides."""

    name: str
    holds: bool
    left: float
    right: float


def lemma_conditions(cell: CellModel) -> list[Condition]:
    """Check the conditions of Lemma 4.1.1 on bounds, weights and initial values of (a7, a9) and (a10, a12).

    A capacitance that is positive over the whole of SOC 0..1 at both ends of the adaptation needs no condition;
    ``failed_conditions`` leaves it out.
    """
    conditions = []
    for number, (amplitude, offset) in enumerate(((7, 9), (10, 12)), start=1):
        big, small = cell.bounds(amplitude), cell.bounds(offset)
        a, b = f"a{amplitude}", f"a{offset}"
        conditions += [
            _below(f"{number}: {b}(0) < {a}(0)", _initial(small), _initial(big)),
            _below(f"{number}: rate of {a} < rate of {b}", big.rate, small.rate),
            _below(f"{number}: P{offset}.l{offset} < P{amplitude}.l{amplitude}", _pull(small), _pull(big)),
        ]
    return conditions


def failed_conditions(cell: CellModel) -> list[Condition]:
    """Return the conditions that fail where they are needed."""
    needed = []
    for (amplitude, offset), number in zip(((7, 9), (10, 12)), "12", strict=True):
        big, small = cell.bounds(amplitude), cell.bounds(offset)
        if big.limit >= small.limit or _initial(big) >= _initial(small):
            needed.append(number)
    return [c for c in lemma_conditions(cell) if not c.holds and c.name[0] in needed]


def _below(name: str, left: float, right: float) -> Condition:
    return Condition(name, left < right, left, right)


def _initial(bounds: Bounds) -> float:
    return bounds.limit if bounds.initial is None else bounds.initial


def _pull(bounds: Bounds) -> float:
    """P_i . lambda_i = lambda_x a_u + lambda_y a_l."""
    return bounds.limit * bounds.rate
