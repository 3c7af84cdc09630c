"""A short ``make soak``: kills of service, broker and line, real processes."""

import pytest

from tests.benchmarks.soak import soak
from tests.benchmarks.soak_account import gaps, judged
from tests.mosquitto import MOSQUITTO
from tests.patience import LONG_S


@pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed (apt-get install mosquitto)")
def test_what_is_killed_comes_back_and_nothing_is_lost(tmp_path):
    one = soak(3, LONG_S, 1, tmp_path, pace=4.0)
    missed = [f"{row.what}: {row.measured}, {row.target}" for row in judged(one.account) if row.met is False]
    assert missed == []
    assert one.killed.total() == 3


def test_the_account_finds_what_is_missing():
    times_s = [0.0, 1.0, 19.0, 20.0]
    assert list(gaps(times_s, [])) == [(1.0, 19.0)]
    assert list(gaps(times_s, [(1.5, 12.0)])) == [(12.0, 19.0)]
    assert list(gaps(times_s, [(1.5, 4.0), (3.0, 15.0)])) == []
