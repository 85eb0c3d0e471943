"""Solvers of positive definite systems for kernels, in the thread that calls them.

LAPACK's start threads of their own for a few hundred unknowns, which take the cores from the odometry and wait for each
other; and numba compiles its interface to LAPACK for 10 s.
"""

import numpy as np

from graphvio.arrays import Float
from graphvio.kernels import kernel, vector_kernel


@vector_kernel
def _dot(a: Float, b: Float) -> float:
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@kernel
def cholesky(matrix: Float) -> Float:
    """Return the lower Cholesky factor (N, N) of a matrix; NaN where it is not positive definite."""
    n = len(matrix)
    lower = np.zeros((n, n))
    for r in range(n):
        for c in range(r):
            lower[r, c] = (matrix[r, c] - _dot(lower[r, :c], lower[c, :c])) / lower[c, c]
        lower[r, r] = np.sqrt(matrix[r, r] - _dot(lower[r, :r], lower[r, :r]))
    return lower


@kernel
def solve_lower(lower: Float, right: Float) -> Float:
    """Solve ``lower x = right`` for each row of right (M, N), with a lower triangle (N, N); returns (M, N)."""
    solved = right.copy()
    for m in range(len(right)):
        for r in range(len(lower)):
            solved[m, r] = (solved[m, r] - _dot(lower[r, :r], solved[m, :r])) / lower[r, r]
    return solved


@kernel
def solve_symmetric(matrix: Float, right: Float) -> Float:
    """Solve ``matrix x = right`` (N,) with a positive definite matrix (N, N)."""
    lower = cholesky(matrix)
    x: Float = solve_lower(lower, right.reshape(1, -1))[0]
    upper = lower.T.copy()
    for r in range(len(lower) - 1, -1, -1):
        x[r] = (x[r] - _dot(upper[r, r + 1 :], x[r + 1 :])) / lower[r, r]
    return x


@kernel
def eliminated(matrix: Float, n_kept: int) -> Float:
    """Return the Schur complement (K, K) of all but the last K unknowns of a positive definite matrix (N, N)."""
    n_left = len(matrix) - n_kept
    lower = cholesky(matrix[:n_left, :n_left].copy())
    coupling = solve_lower(lower, matrix[n_left:, :n_left].copy())
    kept = matrix[n_left:, n_left:].copy()
    for r in range(n_kept):
        for c in range(r + 1):
            kept[r, c] -= _dot(coupling[r], coupling[c])
            kept[c, r] = kept[r, c]
    return kept
