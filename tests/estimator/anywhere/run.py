"""Run of the estimator over a capture, which also returns the innovations."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.kalman_filter.hypotheses import weakest_cell_soc_std
from bms_estimator.kernels.step import SampleOutcome
from bms_estimator.model.arrays import Floats, SampleBlock

BLOCK_S = 600.0
"""Duration over which innovations are summed [s]. Errors of the model that last for minutes disturb the SOC."""
MIN_UPDATES_OF_BLOCK = 0.5
"""Minimum number of updates of a block, as a fraction of the fullest block."""


@dataclass(frozen=True)
class Run:
    """Results at each sample, arrays of shape (n,).

    ``innovation_v`` and its variance S in ``variance_v2`` come from the last update of the filter. ``updated`` is
    True at the samples that complete an update.
    """

    time_s: Floats
    soc: Floats
    soc_std: Floats
    innovation_v: Floats
    variance_v2: Floats
    updated: NDArray[np.bool_]

    def nis(self, after_s: float) -> float:
        """Return the normalized innovation squared of blocks of ten minutes, from ``after_s`` on.

        It is the mean over the blocks of (sum of innovations)^2 / (sum of their variances S).
        """
        elapsed_s = self.time_s - self.time_s[0] - after_s
        scored = self.updated & (elapsed_s >= 0.0)
        block = (elapsed_s[scored] / BLOCK_S).astype(int)
        sum_v, sum_v2 = (np.bincount(block, x[scored]) for x in (self.innovation_v, self.variance_v2))
        count = np.bincount(block)
        is_whole = count >= MIN_UPDATES_OF_BLOCK * count.max()
        return float(np.mean(sum_v[is_whole] ** 2 / sum_v2[is_whole]))


def run_of(estimator: Estimator, samples: SampleBlock) -> Run:
    """Run the estimator over all samples, one by one."""
    f, p = estimator.record["filter"], estimator.settings_record[0]["filter"]
    soc, innovation_v, variance_v2 = (f[n] for n in ("soc", "innovation_v", "innovation_variance"))
    samples_of_window = f["window"]["samples"]
    rows = np.zeros((samples.size, 5))
    for n, (time_s, current_a, voltage_v, temperature_c, *_, status) in enumerate(samples.tolist()):
        outcome = estimator.step(time_s, current_a, voltage_v, status, temperature_c)
        # An update of the filter empties the window of samples.
        updated = outcome is SampleOutcome.ACCEPTED and samples_of_window[0] == 0
        rows[n] = soc[0], weakest_cell_soc_std(f[0], p), innovation_v[0], variance_v2[0], updated
    return Run(samples["time_s"], *rows[:, :4].T, updated=rows[:, 4] == 1.0)
