"""Trace of the estimator: one row of values for each accepted sample.

A column with the name of a field of ``Estimate`` is published (``telemetry.state.COPIED``).

Numbers in parentheses are equations of the thesis.
"""

import numpy as np

TRACE = np.dtype(
    [
        ("time_s", "f8"),
        ("voltage_v", "f8"),
        ("current_a", "f8"),  # positive on discharge
        ("temperature_c", "f8"),
        ("soc", "f8"),
        # predicted by the identifier for its last update; without the identifier, the observer's y^ [V]
        ("voltage_estimate_v", "f8"),
        # measured minus predicted voltage of the identifier; without the identifier, the observer's e [V]
        ("innovation_v", "f8"),
        ("tracking_error_v", "f8"),  # the observer's e (3.15)
        ("nussbaum_gain", "f8"),  # N(k) (3.12) of a law of the thesis, or NaN
        ("adaptation_gain_hz", "f8"),  # gamma k of the learning law, or NaN [1/s]
        ("k", "f8"),  # adaptive gain state (3.13)
        ("delta_1", "f8"),  # SOC below which C_ts of the model is negative (2.11)
        ("delta_2", "f8"),  # SOC below which C_tl of the model is negative (2.12)
        ("delta_configured", "i8"),  # 1: no data have changed delta_1 and delta_2
        ("stability_margin", "f8"),  # soc - max(delta_1, delta_2), or NaN (``kernels/identifier.py``)
        ("stability_margin_std", "f8"),
        ("lock", "i8"),  # 1 while the observer tracks the voltage
        ("converged", "i8"),  # 1: |e| < eps2 of Algorithm 1
        ("soc_coulomb", "f8"),  # by coulomb counting alone
        # from the inverted OCV (7.1); this column and all later ones belong to the identifier and are NaN without it
        ("soc_ocv", "f8"),
        ("soc_std", "f8"),
        ("r_s_ohm", "f8"),
        ("r_s_std_ohm", "f8"),
        ("r_ts_ohm", "f8"),
        ("r_ts_std_ohm", "f8"),
        ("tau_ts_s", "f8"),
        ("tau_ts_std_s", "f8"),
        ("r_tl_ohm", "f8"),
        ("r_tl_std_ohm", "f8"),
        ("tau_tl_s", "f8"),
        ("tau_tl_std_s", "f8"),
    ],
    align=True,
)
