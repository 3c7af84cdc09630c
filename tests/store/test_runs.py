"""Runs of numbers against a set of them."""

from hypothesis import given
from hypothesis import strategies as st

from bms_estimator.store.number_ranges import NumberRanges

NUMBERS = st.sets(st.integers(-5, 30))


def runs(numbers: set[int]) -> NumberRanges:
    made = NumberRanges()
    for number in sorted(numbers):
        made.add(number)
    return made


def numbers(of: NumberRanges) -> set[int]:
    found = [number for run in of for number in run]
    assert found == sorted(set(found))
    assert len(of) == len(found)
    return set(found)


@given(NUMBERS, NUMBERS, st.integers(-6, 31))
def test_they_hold_what_a_set_holds(some: set[int], other: set[int], end: int) -> None:
    assert numbers(runs(some)) == some
    assert {number for number in range(-6, 32) if number in runs(some)} == some
    assert numbers(runs(some).both(runs(other))) == some & other
    assert numbers(runs(some).moved(3)) == {number + 3 for number in some}
    rest = runs(some)
    assert numbers(rest.take_before(end)) == {number for number in some if number < end}
    assert numbers(rest) == {number for number in some if number >= end}


def test_the_lowest_comes_first() -> None:
    made = runs({1, 2, 5})
    assert (made.first, made.end, [made.pop() for _ in range(3)]) == (1, 6, [1, 2, 5])
    assert not made
