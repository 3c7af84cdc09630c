"""Totals of a worker over its present and former partitions."""

from collections import Counter

from bms_estimator.fleet.worker.lease_tasks import SourceSum


def test_total_does_not_fall_when_a_source_disappears_and_counts_each_source_once():
    total, first, second = SourceSum(), object(), object()
    total.update({first: Counter(blocks=2)})
    total.update({first: Counter(blocks=3), second: Counter(blocks=10)})
    total.update({second: Counter(blocks=11)})
    total.update({second: Counter(blocks=12, gaps=1)})
    assert total.total() == Counter(blocks=15, gaps=1)
