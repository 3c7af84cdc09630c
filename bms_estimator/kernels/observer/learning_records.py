"""The records of the learning law, parts of the whole estimator's."""

import numpy as np

LEARNABLE = 8
"""Maximum number of identified parameters of a model."""
CONSTANTS = 16
"""Maximum number of constants from a model's file; Chen & Mora: a1..a15 at their index."""

LEARNING_SETTINGS = np.dtype(
    [
        ("enabled", "i8"),  # 0: a printed law
        ("model", "i8"),  # kernels.observer.learning_model.Model
        ("count", "i8"),  # parameters that are learned
        ("file", "f8", CONSTANTS),  # values at theta = 0
        ("lower", "f8", LEARNABLE),  # bounds of theta
        ("upper", "f8", LEARNABLE),
        ("middle", "f8", LEARNABLE),  # where the leakage leads
        ("leak_v2s", "f8", LEARNABLE),  # information that the middle counts as [V^2 s]
        ("memory_s", "f8"),  # time constant of forgetting, under load [s]
        ("offset_s", "f8"),  # time constant of the injection; infinite: nothing is injected [s]
        ("settle_s", "f8"),  # time after which the states have forgotten unknown initial values [s]
        ("rate", "f8"),  # gamma: rate at which theta follows the data, at k = 1 [1/s]
        ("cells", "f8"),  # cells in series: k is that of one cell
        ("told_v", "f8"),  # a sensitivity of this size gives information on the parameters [V]
        ("reach", "f8"),  # trust region of theta: sensitivities hold for shorter steps
        ("soc_floor", "f8"),  # below it nothing is learned (E14)
    ],
    align=True,
)

LEARNING_STATE = np.dtype(
    [
        ("theta", "f8", LEARNABLE),  # ln of each parameter over the file's
        ("x", "f8", 2),  # states of the model [V]
        ("dx", "f8", (2, LEARNABLE)),  # their derivatives by theta [V]
        ("offset_v", "f8"),  # what the injection has added to the output [V]
        ("d_offset", "f8", LEARNABLE),  # its derivative by theta [V]
        ("psi", "f8", LEARNABLE),  # dy^/dtheta [V]
        ("temperature_c", "f8"),  # last reported value; NaN without one [C]
        ("given", "f8", LEARNABLE),  # values that are not learned, at the last sample
        ("information", "f8", (LEARNABLE, LEARNABLE)),  # of psi psi', remembered [V^2 s]
        ("pull", "f8", LEARNABLE),  # of psi (e + psi' theta), remembered [V^2 s]
        ("settle_s", "f8"),  # time without learning: the states hold unmeasured history [s]
        ("waited_s", "f8"),  # since theta moved [s]
        ("step", "f8", LEARNABLE),  # the last change of theta
        ("factor", "f8", (LEARNABLE, LEARNABLE)),  # Cholesky's, of information and leakage
    ],
    align=True,
)
