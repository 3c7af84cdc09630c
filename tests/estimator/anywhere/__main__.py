"""``python -m tests.estimator.anywhere`` writes the summary anew, after a change of the estimator that is meant."""

import sys

from tests.estimator.anywhere.summary import PATH, rows, write

write(rows())
sys.stdout.write(f"{PATH}\n")
