"""Plausibility of a block's number of samples."""

import numpy as np

from bms_estimator.edge.batching import MAX_SAMPLES as EDGE_MAX_SAMPLES
from bms_estimator.model.sample import SampleBlock

MAX_RATE_HZ = 1000.0
"""Maximum sample rate of a source [Hz]."""
MAX_SAMPLES = 20_000
"""Maximum number of samples in a block: the limit of earlier edge versions. Present edges use ``EDGE_MAX_SAMPLES``."""
MAX_TIMESTAMP_S = 2.0**33
"""Latest plausible timestamp [s since the creation of the store]. The limit allows for a store that was created in 1970
by a machine whose clock was not set."""


def density_fault(samples: SampleBlock) -> str:
    """Return the reason for which a block has too many samples; empty if the number is plausible.

    ``EDGE_MAX_SAMPLES`` are allowed beyond the rate, because an edge's clock may stand still while a source's is
    corrected.
    """
    if samples.size <= EDGE_MAX_SAMPLES:
        return ""
    if samples.size > MAX_SAMPLES:
        return f"{samples.size} samples: at most {MAX_SAMPLES}"
    times = samples["time_s"]
    plausible = times[(times >= 0.0) & (times <= MAX_TIMESTAMP_S)]
    elapsed_s = float(np.ptp(plausible)) if plausible.size else 0.0
    if samples.size <= EDGE_MAX_SAMPLES + MAX_RATE_HZ * elapsed_s:
        return ""
    return f"{samples.size} samples in {elapsed_s:.3g} s: at most {MAX_RATE_HZ:g} a second, and {EDGE_MAX_SAMPLES} more"
