"""Damped Gauss-Newton (Levenberg-Marquardt) minimization of the slow fit's cost."""

from dataclasses import dataclass

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.equations import Equations, NormalEquations

MAX_ITERATIONS = 30
"""Maximum number of steps from one start."""
MAX_STEP_SOC = 0.15
"""Maximum change of an SOC in one step, because the curves are not linear over a longer one."""
CONVERGED = 0.02
"""Decrease of the cost at which the minimization ends."""
FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-3, 1e-9, 1e6
"""Relative damping of the diagonal at the start, and its limits."""
LESS_DAMPING, MORE_DAMPING = 0.2, 8.0
"""Factors on the damping after a step that lowers the cost, and after a step that does not."""


@dataclass(frozen=True)
class Minimum:
    """Local minimum of the cost, with the covariance of the unknowns (Laplace approximation)."""

    x: Floats
    cost: float
    covariance: Floats


def minimize(equations: Equations, start: Floats) -> Minimum:
    """Return the local minimum that is reached from ``start``."""
    now, damping = equations.residuals(start), FIRST_DAMPING
    normal = equations.normal_equations(now)
    for _ in range(MAX_ITERATIONS):
        trial = equations.residuals(now.x + step(normal, damping, equations.u.soc))
        decrease = now.cost - trial.cost
        if decrease > 0.0:
            now, damping = trial, max(LESS_DAMPING * damping, MIN_DAMPING)
            if decrease < CONVERGED:
                break
            normal = equations.normal_equations(now)
        else:
            damping *= MORE_DAMPING
            if damping > MAX_DAMPING:
                break
    precision = equations.normal_equations(now, use_file_slope=True).a
    return Minimum(now.x, now.cost, solve(precision, np.eye(now.x.size)))


def step(normal: NormalEquations, damping: float, soc: slice) -> Floats:
    """Return the damped step, shortened so that no SOC changes by more than ``MAX_STEP_SOC``."""
    damped = normal.a + damping * np.diag(np.diag(normal.a))
    full = solve(damped, normal.b)
    largest = float(np.abs(full[soc]).max())
    return full * min(1.0, MAX_STEP_SOC / largest) if largest > 0.0 else full


def solve(a: Floats, b: Floats) -> Floats:
    """Return the solution of a x = b for a positive definite a.

    Raises:
        numpy.linalg.LinAlgError: a is not positive definite, or not finite.
    """
    np.linalg.cholesky(a)  # raises the error
    return np.asarray(np.linalg.solve(a, b))
