"""``python -m tests.estimator.anywhere`` writes the summaries, after an intended change of the estimator."""

import sys

from tests.estimator.anywhere import cycles
from tests.estimator.anywhere.summary import SUMMARY_PATH, rows, write

write(rows())
cycles.write(row for chemistry in cycles.CHEMISTRIES for row in cycles.rows(chemistry))
sys.stdout.write(f"{SUMMARY_PATH}\n{cycles.SUMMARY_PATH}\n")
