"""Products, eigenvectors and solvers of small symmetric matrices for kernels, computed in the calling thread.

BLAS and LAPACK choose their code by the processor and, for some processors, by an array's place in memory: the last
bits of results would depend on both. They start threads of their own for a few hundred unknowns, which take the cores
from the odometry and wait for each other; and numba takes 10 s to compile its interface to LAPACK.
"""

import numpy as np

from graphvio.arrays import Float
from graphvio.kernels import kernel, vector_kernel

_MAX_SWEEPS = 30  # five or six suffice for a matrix of six


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
def solve_rows(matrix: Float, right: Float) -> Float:
    """Solve ``matrix x = right`` for each row of right (M, N), with a positive definite matrix; returns (M, N)."""
    lower = cholesky(matrix)
    x = solve_lower(lower, right)
    upper = lower.T.copy()
    for m in range(len(right)):
        for r in range(len(lower) - 1, -1, -1):
            x[m, r] = (x[m, r] - _dot(upper[r, r + 1 :], x[m, r + 1 :])) / lower[r, r]
    return x


@kernel
def solve_symmetric(matrix: Float, right: Float) -> Float:
    """Solve ``matrix x = right`` (N,) with a positive definite matrix (N, N)."""
    x: Float = solve_rows(matrix, right.reshape(1, -1))[0]
    return x


@kernel
def inverse(matrix: Float) -> Float:
    """Return the inverse (N, N) of a positive definite matrix; NaN where it is not positive definite."""
    n = len(matrix)
    lower = cholesky(matrix)
    inverted = np.zeros((n, n))  # inverse of lower, transposed
    for r in range(n):
        inverted[r, r] = 1.0 / lower[r, r]
        for c in range(r + 1, n):
            inverted[r, c] = -_dot(lower[c, r:c], inverted[r, r:c]) / lower[c, c]
    out = np.empty((n, n))
    for r in range(n):
        for c in range(r, n):
            out[r, c] = out[c, r] = _dot(inverted[r, c:], inverted[c, c:])
    return out


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


@kernel
def product(a: Float, b: Float) -> Float:
    """Return ``a b`` (N, M) of matrices (N, K) and (K, M), each element summed in the order of K."""
    out = np.zeros((len(a), b.shape[1]))
    for r in range(len(a)):
        for k in range(len(b)):
            factor = a[r, k]
            for c in range(b.shape[1]):
                out[r, c] += factor * b[k, c]
    return out


@kernel
def turn_rows(by: Float, at: int, matrix: Float) -> None:
    """Multiply three rows of a matrix (N, M), from row ``at`` on, by the transpose of ``by`` (3, 3), in place."""
    for c in range(matrix.shape[1]):
        first, second, third = matrix[at, c], matrix[at + 1, c], matrix[at + 2, c]
        for r in range(3):
            matrix[at + r, c] = by[0, r] * first + by[1, r] * second + by[2, r] * third


@kernel
def squared_length(vector: Float, covariance: Float) -> float:
    """Return ``v^T C^-1 v`` of a vector (N,): its squared Mahalanobis length; NaN where C is not positive definite."""
    white = solve_lower(cholesky(covariance), vector.reshape(1, -1))
    total = 0.0
    for i in range(len(vector)):
        total += white[0, i] * white[0, i]
    return total


@kernel
def eigen(matrix: Float) -> tuple[Float, Float]:
    """Return the eigenvalues (N,), unordered, and the eigenvectors (N, N) in columns, of a symmetric matrix.

    They are computed by Jacobi's rotations (G. Golub, C. Van Loan, *Matrix Computations*, 2013, section 8.5).

    Raises:
        LinAlgError: if the matrix is not finite.
    """
    n = len(matrix)
    turned, axes = matrix.copy(), np.eye(n)
    if not np.isfinite(matrix).all():
        raise np.linalg.LinAlgError("eigenvectors are asked for of a matrix that is not finite")
    for _ in range(_MAX_SWEEPS):
        outside = on_diagonal = 0.0
        for r in range(n):
            on_diagonal += turned[r, r] * turned[r, r]
            for c in range(r):
                outside += turned[r, c] * turned[r, c]
        if outside <= 1e-32 * on_diagonal:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                if turned[p, q] == 0.0:
                    continue
                slope = 0.5 * (turned[q, q] - turned[p, p]) / turned[p, q]
                tangent = 1.0 / (abs(slope) + np.sqrt(slope * slope + 1.0))
                if slope < 0.0:
                    tangent = -tangent
                cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
                sine = tangent * cosine
                for k in range(n):
                    a, b = turned[k, p], turned[k, q]
                    turned[k, p], turned[k, q] = cosine * a - sine * b, sine * a + cosine * b
                    a, b = axes[k, p], axes[k, q]
                    axes[k, p], axes[k, q] = cosine * a - sine * b, sine * a + cosine * b
                for k in range(n):
                    a, b = turned[p, k], turned[q, k]
                    turned[p, k], turned[q, k] = cosine * a - sine * b, sine * a + cosine * b
    return np.diag(turned).copy(), axes


def times(matrix: Float, vector: Float) -> Float:
    """Return ``matrix vector``, summed in a fixed order: a library's last digits depend on arrays' place in memory."""
    return product(np.ascontiguousarray(matrix), vector.reshape(-1, 1))[:, 0]
