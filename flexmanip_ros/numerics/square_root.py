"""Compiled square-root algebra of a Gaussian: covariance = S S', S (nx, nx) of any shape."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.numerics.compiled import inner, kernel, library, separate
from flexmanip_ros.types import Array


@library
def multiply(A: Array, B: Array, product: Array) -> None:
    """Fill product (m, n) with A (m, k) B (k, n) by BLAS, five times as fast as loops. None may overlap another."""
    np.dot(A, B, product)


@inner
def project(x: Array, S: Array, H: Array, offset: int, f: Array) -> float:
    """Return H x[offset:] and fill f = S[offset:, :f.size]' H'; f'f is the variance of H x[offset:]."""
    value = 0.0
    f[:] = 0.0
    for i in range(H.size):
        if H[i] != 0.0:
            value += H[i] * x[offset + i]
            for c in range(f.size):
                f[c] += H[i] * S[offset + i, c]
    return value


@inner
def dot(a: Array, b: Array) -> float:
    """Return a . b as four independent sums: three times as fast as one, and the same bits on every machine."""
    n = a.size - a.size % 4
    first, second, third, fourth = 0.0, 0.0, 0.0, 0.0
    for c in range(0, n, 4):
        first += a[c] * b[c]
        second += a[c + 1] * b[c + 1]
        third += a[c + 2] * b[c + 2]
        fourth += a[c + 3] * b[c + 3]
    for c in range(n, a.size):
        first += a[c] * b[c]
    return (first + second) + (third + fourth)


@inner
def ordered_dot(a: Array, b: Array) -> float:
    """Return a . b, summed in the order of the elements: for short vectors, where ``dot`` gains nothing."""
    value = 0.0
    for c in range(a.size):
        value += a[c] * b[c]
    return value


@inner
def absorb_measurement(
    x: Array, S: Array, opened: NDArray[np.int64], f: Array, e: float, r: float, variance: float,
) -> None:
    """Update x and S by Potter's algorithm: innovation e of variance f'f + r, r of the noise, f the nonzero S' H'.

    opened: (1 + np,) number of the last np states that are not taken as known, then the indices of these states.
    """
    gamma = 1.0 / (1.0 + np.sqrt(r / variance))
    first = x.size - opened.size + 1
    for k in range(first + opened[0]):
        i = k if k < first else first + opened[1 + k - first]
        gain = dot(f, S[i]) / variance
        x[i] += gain * e
        gain *= gamma
        for c in range(f.size):
            S[i, c] -= gain * f[c]


@separate
def absorb_noise(S: Array, noise: Array, W: Array) -> None:
    """Overwrite S with lower L, L L' = S S' + noise noise', by Householder reflections.

    noise: (nx, c); W: (nx, nx + c) scratch.

    A row of zeros uses no column of L, so the columns after the last one used are zero.
    """
    nx = S.shape[0]
    for i in range(nx):
        for c in range(nx):
            W[i, c] = S[i, c]
        for c in range(noise.shape[1]):
            W[i, nx + c] = noise[i, c]
    width, own = W.shape[1], 0
    for i in range(nx):
        norm = 0.0
        for c in range(own, width):
            norm += W[i, c] * W[i, c]
        norm = np.sqrt(norm)
        if norm > 0.0:
            if W[i, own] > 0.0:
                norm = -norm
            head = W[i, own] - norm
            square = -norm * head  # half the squared length of the reflection vector
            if square > 0.0:
                W[i, own] = head
                for r in range(i + 1, nx):
                    dot = 0.0
                    for c in range(own, width):
                        dot += W[i, c] * W[r, c]
                    dot /= square
                    for c in range(own, width):
                        W[r, c] -= dot * W[i, c]
            W[i, own] = norm
            own += 1
        for c in range(nx):
            S[i, c] = W[i, c] if c < own else 0.0


@separate
def factor_information(N: Array) -> bool:
    """Overwrite the lower triangle of N with the Cholesky factor of I + N; False when it is not finite."""
    nx = N.shape[0]
    for j in range(nx):
        d = 1.0 + N[j, j]
        for p in range(j):
            d -= N[j, p] * N[j, p]
        if not (d > 0.0 and d < 1e300):
            return False
        d = np.sqrt(d)
        N[j, j] = d
        for r in range(j + 1, nx):
            value = N[r, j]
            for p in range(j):
                value -= N[r, p] * N[j, p]
            N[r, j] = value / d
    return True


@separate
def forward(L: Array, b: Array) -> None:
    """Overwrite b with L^-1 b."""
    for r in range(b.size):
        value = b[r]
        for p in range(r):
            value -= L[r, p] * b[p]
        b[r] = value / L[r, r]


@separate
def backward(L: Array, b: Array) -> None:
    """Overwrite b with L'^-1 b."""
    for r in range(b.size - 1, -1, -1):
        value = b[r]
        for p in range(r + 1, b.size):
            value -= L[p, r] * b[p]
        b[r] = value / L[r, r]


class Bounds(NamedTuple):
    """At most c linear inequalities rows . u >= least of a vector u (n,), and scratch for ``least_distance``."""

    rows: Array
    """(c, n); overwritten with rows of length one."""
    least: Array
    """(c,) bounds; scaled with the rows."""
    gram: Array
    """(c, c) scratch."""
    factor: Array
    """(c, c) scratch."""
    multiplier: Array
    """(c,) scratch."""
    active: Array
    """(c,) scratch: 1 where the vector is on the bound."""
    shortest: Array
    """(n,) the shortest vector that meets the first ``count`` inequalities."""


def allocate_bounds(c: int, n: int) -> Bounds:
    """Allocate ``Bounds`` for c inequalities of a vector (n,)."""
    return Bounds(np.zeros((c, n)), np.zeros(c), np.zeros((c, c)), np.zeros((c, c)), np.zeros(c), np.zeros(c),
                  np.zeros(n))


MOST_PIVOTS = 200
"""Number of pivots after which ``least_distance`` gives up: the nine bounds of an arm take some ten."""
MET = 1e-9
"""Tolerance for rounding of an inequality whose row has length one."""


@kernel
def least_distance(bounds: Bounds, count: int) -> bool:
    """Fill bounds.shortest with the shortest u that meets the first ``count`` inequalities; False: none was found.

    Least-distance programming (Lawson and Hanson): u = rows' z with multipliers z >= 0; each multiplier is zero or its
    inequality holds with equality. This linear complementarity problem is solved by least-index principal pivoting
    (Murty 1974), which terminates where the rows are linearly independent.
    """
    rows, least, Q, L = bounds.rows, bounds.least, bounds.gram, bounds.factor
    z, active, u = bounds.multiplier, bounds.active, bounds.shortest
    for i in range(count):
        length = np.sqrt(dot(rows[i], rows[i]))
        if not length > 0.0:
            return False
        least[i] /= length
        for c in range(u.size):
            rows[i, c] /= length
        for j in range(i + 1):
            Q[i, j] = dot(rows[i], rows[j])
            Q[j, i] = Q[i, j]
        active[i] = 0.0
        z[i] = 0.0
    found = False
    for _ in range(MOST_PIVOTS):
        first = count
        for i in range(count):  # least index of a negative multiplier or a violated inequality
            short = least[i]
            for j in range(count):
                short -= Q[i, j] * z[j] * active[j]
            if z[i] < -MET if active[i] == 1.0 else short > MET:
                first = i
                break
        if first == count:
            found = True
            break
        active[first] = 1.0 - active[first]
        for i in range(count):  # solve for the active multipliers; rows of the identity for others
            z[i] = least[i] if active[i] == 1.0 else 0.0
            for j in range(i + 1):
                both = active[i] * active[j]
                L[i, j] = both * Q[i, j] - (both if i == j else 0.0)
        if not factor_information(L[:count, :count]):
            break
        forward(L[:count, :count], z[:count])
        backward(L[:count, :count], z[:count])
    u[:] = 0.0
    for c in range(u.size):
        for i in range(count if found else 0):
            u[c] += z[i] * rows[i, c]
    return found
