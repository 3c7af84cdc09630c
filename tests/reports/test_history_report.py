"""Report on a pack's history: data quality."""

import numpy as np

from bms_estimator.reports.history_report import PackHistory, history_report
from bms_estimator.store.minute import Minute


def test_minutes_that_passed_twice_are_counted():
    time_s = np.array([0.0, 60.0, 61.0, 120.0])
    columns = dict.fromkeys(Minute._fields, np.full(time_s.size, 60.0))
    history = PackHistory("shed", time_s, columns, events=(), learned=(), not_learned="no checkpoint")
    groups = history_report(history, "2026-01-01").sections[0].groups
    rows = dict(next(group.rows for group in groups if group.title == "Data quality"))
    assert rows["clock"] == "1 minutes passed twice, because the clock was set back"
    assert rows["gaps"] == "0, the longest 0 min"
