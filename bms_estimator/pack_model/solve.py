"""Damped Gauss-Newton (Levenberg-Marquardt) minimization of the cost of the slow fit of the pack's model to its history."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from bms_estimator.kernels.least_squares import backward_substitution, eliminate_sparse, forward_substitution
from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.equations import Equations, NormalEquations, Residuals
from bms_estimator.pack_model.unknowns import Unknowns

MAX_ITERATIONS = 30
"""Maximum number of steps from one start."""
MAX_STEP_SOC = 0.15
"""Maximum change of an SOC in one step, because the curves are not linear over a longer one."""
MIN_DECREASE = 0.02
"""Decrease of the cost in one step below which the minimization ends."""
SAME_COST, SAME_SOC = 0.3, 0.01
"""Differences of cost and SOC below which two minima count as one. They exceed the differences that an unfinished minimization
leaves (``MIN_DECREASE``)."""
FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-3, 1e-9, 1e6
"""Relative damping of the diagonal at the start, and its limits."""
LESS_DAMPING, MORE_DAMPING = 0.2, 8.0
"""Factors on the damping after a step that lowers the cost, and after a step that does not."""

_ONE_FIT = threading.Lock()
"""Lock for one fit at a time. The number of BLAS threads is a setting of the process, and the first of two concurrent fits to end
would reset it during the other."""


@contextmanager
def single_threaded() -> Iterator[None]:
    """Limit BLAS to one thread, and the process to one fit at a time.

    The matrices are small: more threads need 2 to 18 times the processor time, and a fit on another number of cores could differ
    in the last bit.
    """
    with _ONE_FIT, threadpool_limits(1, user_api="blas"):
        yield


@dataclass(frozen=True)
class Minimum:
    """Local minimum of the cost."""

    x: Floats
    cost: float
    factor: Floats
    """Lower Cholesky factor of the inverse of the unknowns' covariance (Laplace approximation)."""

    def covariance_of(self, matrix: Floats) -> Floats:
        """Return the covariance of ``matrix`` @ x."""
        half = np.array([forward_substitution(self.factor, row) for row in matrix])
        return np.asarray(half @ half.T)


def minimize(equations: Equations, start: Floats, known: Sequence[Minimum] = ()) -> Minimum | None:
    """Return the local minimum that is reached from ``start``; None if it is one of the known ones."""
    now, damping = equations.residuals(start), FIRST_DAMPING
    normal = equations.normal_equations(now)
    for _ in range(MAX_ITERATIONS):
        trial = equations.residuals(now.x + step(normal, damping, equations.unknowns))
        decrease = now.cost - trial.cost
        if decrease > 0.0:
            now, damping = trial, max(LESS_DAMPING * damping, MIN_DAMPING)
            if decrease < MIN_DECREASE:
                break
            normal = equations.normal_equations(now)
        else:
            damping *= MORE_DAMPING
            if damping > MAX_DAMPING:
                break
    if any(is_same(equations, now, other) for other in known):
        return None
    # with the file's slope, because slopes of the fitted correction would count as information on the SOC
    precision = equations.normal_equations(now, use_file_slope=True).a
    return Minimum(now.x, now.cost, cholesky(precision, equations.unknowns.soc.start))


def is_same(equations: Equations, now: Residuals, other: Minimum) -> bool:
    """Return True if cost and SOCs equal those of another minimum."""
    difference = np.abs(now.x[equations.unknowns.soc] - other.x[equations.unknowns.soc]).max()
    return abs(now.cost - other.cost) < SAME_COST and bool(difference < SAME_SOC)


def step(normal: NormalEquations, damping: float, u: Unknowns) -> Floats:
    """Return the damped step, shortened so that no SOC changes by more than ``MAX_STEP_SOC``."""
    a = normal.a.copy()
    a.ravel()[:: u.size + 1] *= 1.0 + damping
    lower = cholesky(a, u.soc.start)
    full_step = backward_substitution(lower, forward_substitution(lower, normal.b))
    largest_soc = float(np.abs(full_step[u.soc]).max())
    return full_step * min(1.0, MAX_STEP_SOC / largest_soc) if largest_soc > 0.0 else full_step


def cholesky(a: Floats, sparse_count: int) -> Floats:
    """Return the lower Cholesky factor of a symmetric matrix. The upper triangle of the result is meaningless.

    Args:
        a: Matrix, of which only the lower triangle is read; overwritten.
        sparse_count: Number of first columns with few non-zero elements: those of the unknowns of single segments, before the
            SOCs.

    Raises:
        numpy.linalg.LinAlgError: The matrix is not positive definite, or not finite.
    """
    eliminate_sparse(a, sparse_count)
    a[sparse_count:, sparse_count:] = np.linalg.cholesky(a[sparse_count:, sparse_count:])
    return a
