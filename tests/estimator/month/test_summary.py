"""Results of some weeks of use, compared with those under version control."""

from tests.estimator.month.summary import changes, read, table


def test_the_results_equal_the_checked_in_summary() -> None:
    """``make month ARGS=--summary`` rewrites the summary after an intended change of the estimator."""
    changed = changes(table(), read())
    assert not changed, "\n".join(["if this is intended, rewrite the summary by make month ARGS=--summary", *changed])
