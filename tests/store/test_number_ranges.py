"""``NumberRanges`` against a set of numbers."""

from hypothesis import given, strategies as st

from bms_estimator.store.outbox_queue import NumberRanges

NUMBERS = st.sets(st.integers(-5, 30))


def ranges_of(numbers: set[int]) -> NumberRanges:
    """Return ranges to which the numbers were added in order."""
    ranges = NumberRanges()
    for number in sorted(numbers):
        ranges.add(number)
    return ranges


def numbers_in(ranges: NumberRanges) -> set[int]:
    """Return the numbers in the ranges. Check that they are in order, without repetition."""
    listed = [number for run in ranges for number in run]
    assert listed == sorted(set(listed))
    assert len(ranges) == len(listed)
    return set(listed)


@given(NUMBERS, NUMBERS, st.integers(-6, 31))
def test_operations_agree_with_those_of_sets(some: set[int], other: set[int], end: int) -> None:
    assert numbers_in(ranges_of(some)) == some
    assert {number for number in range(-6, 32) if number in ranges_of(some)} == some
    assert numbers_in(ranges_of(some).intersection(ranges_of(other))) == some & other
    assert numbers_in(ranges_of(some).shifted(3)) == {number + 3 for number in some}
    rest = ranges_of(some)
    assert numbers_in(rest.take_before(end)) == {number for number in some if number < end}
    assert numbers_in(rest) == {number for number in some if number >= end}
    for number in some & other:
        rest = ranges_of(some)
        rest.remove(number)
        assert numbers_in(rest) == some - {number}
