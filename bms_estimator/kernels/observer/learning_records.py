"""Records of the learning law, fields of the estimator's records.

Erratum 14 is described in docs/theory/thesis.md.
"""

import numpy as np

LEARNABLE = 8
"""Maximum number of identified parameters of a model."""
CONSTANTS = 16
"""Maximum number of constants from a model's file; Chen & Mora: a1..a15 at their index."""

LEARNING_SETTINGS = np.dtype(
    [
        ("enabled", "i8"),  # 0: an adaptive law of the thesis is used instead
        ("model", "i8"),  # kernels.observer.learning_model.Model
        ("count", "i8"),  # number of identified parameters
        ("file", "f8", CONSTANTS),  # parameters of the cell file, which theta = 0 denotes
        ("lower", "f8", LEARNABLE),  # bounds of theta
        ("upper", "f8", LEARNABLE),
        ("middle", "f8", LEARNABLE),  # theta that the leakage approaches
        ("leak_v2s", "f8", LEARNABLE),  # weight of the leakage, as information [V^2 s]
        ("memory_s", "f8"),  # time constant with which data are discounted under load [s]
        ("offset_s", "f8"),  # time constant with which the output error is added to the offset [s]; infinite: never
        ("settle_s", "f8"),  # time after which effects of unknown initial states have decayed [s]
        ("rate", "f8"),  # gamma: rate at which theta follows the data, at k = 1 [1/s]
        ("cells", "f8"),  # cells in series; k grows with the error of one cell
        ("told_v", "f8"),  # norm of psi above which the data count as informative [V]
        ("reach", "f8"),  # trust region of theta: maximum step for which the sensitivities are valid
        ("soc_floor", "f8"),  # SOC below which learning is disabled (erratum 14)
    ],
    align=True,
)
"""Settings of the learning law."""

LEARNING_STATE = np.dtype(
    [
        ("theta", "f8", LEARNABLE),  # logarithm of each parameter over the file's value
        ("x", "f8", 2),  # states of the model [V]
        ("dx", "f8", (2, LEARNABLE)),  # derivatives of the states by theta [V]
        ("offset_v", "f8"),  # injected offset of the output [V]
        ("d_offset", "f8", LEARNABLE),  # derivative of offset_v by theta [V]
        ("psi", "f8", LEARNABLE),  # dy^/dtheta [V]
        ("temperature_c", "f8"),  # last reported value; NaN without one [C]
        ("given", "f8", LEARNABLE),  # constants of the model at the last sample
        ("information", "f8", (LEARNABLE, LEARNABLE)),  # discounted integral of psi psi' [V^2 s]
        ("pull", "f8", LEARNABLE),  # discounted integral of psi (e + psi' theta) [V^2 s]
        ("settle_s", "f8"),  # remaining time without learning, while the states depend on an unmeasured load [s]
        ("waited_s", "f8"),  # time since the last step of theta [s]
        ("step", "f8", LEARNABLE),  # last change of theta
        ("factor", "f8", (LEARNABLE, LEARNABLE)),  # Cholesky factor of information plus leakage
    ],
    align=True,
)
"""State of the learning law."""
