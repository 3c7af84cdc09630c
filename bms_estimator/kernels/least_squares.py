"""Sparse sums and triangular solutions of a least-squares problem. They call no BLAS, whose threads would slow them down."""

import math

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import Floats
from bms_estimator.numba_cache import njit


@njit(cache=True)
def add_residuals(a: Floats, b: Floats, columns: NDArray[np.intp], values: Floats, error: Floats) -> None:
    """Add residuals to normal equations A x = b: J^T J to the lower triangle of A, and J^T e to b.

    Args:
        a: A, shape (unknowns, unknowns); written.
        b: Shape (unknowns,); written.
        columns: Indices of the non-zero derivatives of each residual, increasing within a row, shape (n, k).
        values: These derivatives, shape (n, k).
        error: Residuals e, shape (n,).
    """
    for i in range(error.size):
        for j in range(columns.shape[1]):
            c, v = columns[i, j], values[i, j]
            b[c] += v * error[i]
            for k in range(j + 1):
                a[c, columns[i, k]] += v * values[i, k]


@njit(cache=True)
def eliminate_sparse(a: Floats, count: int) -> None:
    """Compute the first columns of the lower Cholesky factor of a matrix in place, for columns with few non-zero elements.

    Args:
        a: Symmetric matrix, of which only the lower triangle is read. The first ``count`` columns of its factor and the lower
            triangle of the remaining Schur complement are written.
        count: Number of columns.
    """
    for i in range(count):
        at = i + 1 + np.flatnonzero(a[i + 1 :, i])
        root = math.sqrt(a[i, i])
        a[i, i] = root
        for j in range(at.size):
            a[at[j], i] /= root
            for k in range(j + 1):
                a[at[j], at[k]] -= a[at[j], i] * a[at[k], i]


@njit(cache=True)
def forward_substitution(lower: Floats, b: Floats) -> Floats:
    """Return the solution y of L y = b, shape (n,)."""
    y = b.copy()
    for i in range(y.size):
        y[i] = (y[i] - np.sum(lower[i, :i] * y[:i])) / lower[i, i]
    return y


@njit(cache=True)
def backward_substitution(lower: Floats, y: Floats) -> Floats:
    """Return the solution x of L^T x = y, shape (n,)."""
    x = y.copy()
    for i in range(x.size - 1, -1, -1):
        x[i] /= lower[i, i]
        x[:i] -= x[i] * lower[i, :i]
    return x
