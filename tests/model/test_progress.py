"""Progress of a calculation that consists of parts."""

import pytest

from bms_estimator.model.progress import WorkCounter


def test_parts_of_different_sizes_count_by_their_sizes() -> None:
    reported = list[float]()
    work = WorkCounter(reported.append, total=4.0)
    small, large = work.part(1.0), work.part(3.0)
    small(0.5)
    small(1.0)
    large(0.5)
    large(1.0)
    assert reported == pytest.approx([0.125, 0.25, 0.625, 1.0])


def test_the_fraction_never_exceeds_1() -> None:
    reported = list[float]()
    work = WorkCounter(reported.append, total=1.0)
    work.part(1.5)(1.0)
    assert reported == [1.0]
