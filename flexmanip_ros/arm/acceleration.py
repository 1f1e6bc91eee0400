"""Compiled forward dynamics: Cholesky factor of the mass matrix and the accelerations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from flexmanip_ros.arm.equations_of_motion import assemble, elastic
from flexmanip_ros.numerics.compiled import inlined, kernel

if TYPE_CHECKING:
    from flexmanip_ros.arm.manipulator import Manipulator, Workspace
    from flexmanip_ros.types import Array


@inlined
def factor(M: Array) -> bool:
    """Overwrite the lower triangle of M with its Cholesky factor, diagonal inverted; False if indefinite."""
    n = M.shape[0]
    for j in range(n):
        d = M[j, j]
        for p in range(j):
            d -= M[j, p] * M[j, p]
        if not d > 0.0:
            return False
        inverse = 1.0 / np.sqrt(d)
        M[j, j] = inverse
        for r in range(j + 1, n):
            x = M[r, j]
            for p in range(j):
                x -= M[r, p] * M[j, p]
            M[r, j] = x * inverse
    return True


@inlined
def solve(L: Array, x: Array) -> None:
    """Overwrite x (n,) with M^-1 x, L from ``factor``."""
    n = x.size
    for r in range(n):
        y = x[r]
        for p in range(r):
            y -= L[r, p] * x[p]
        x[r] = y * L[r, r]
    for r in range(n - 1, -1, -1):
        y = x[r]
        for p in range(r + 1, n):
            y -= L[p, r] * x[p]
        x[r] = y * L[r, r]


@kernel
def hold(L: Array, held: Array, qdd: Array, columns: Array) -> None:
    """Change qdd (n,) by constraint forces so that held qdd = 0.

    held: (m, n) constant rows, m at most 2; L from ``factor``; columns: (2, n) scratch.
    """
    rows, n = held.shape
    a, b, d = 0.0, 0.0, 1.0
    x, y = 0.0, 0.0
    for i in range(rows):
        for c in range(n):
            columns[i, c] = held[i, c]
        solve(L, columns[i])
    for c in range(n):
        a += held[0, c] * columns[0, c]
        x += held[0, c] * qdd[c]
        if rows == 2:
            b += held[0, c] * columns[1, c]
            y += held[1, c] * qdd[c]
    if rows == 2:
        d = 0.0
        for c in range(n):
            d += held[1, c] * columns[1, c]
    determinant = a * d - b * b
    first = (d * x - b * y) / determinant
    second = (a * y - b * x) / determinant
    for c in range(n):
        qdd[c] -= first * columns[0, c]
        if rows == 2:
            qdd[c] -= second * columns[1, c]


@inlined
def steepen(
    root_slope: Array, tip_slope: Array, torque: Array, q: Array, effort: Array, force: Array,
) -> None:
    """Add to force (n,) what torques gain where a link is steep, of the order of V4.

    A joint turns by the angle asin(w') of the tangent, so that its torque works on eta through
    w' (1 + w'^2 / 2). Nothing in the paper's convention, whose torques bend nothing. The arrays are the
    Manipulator's; passing it whole would cost more than the arithmetic.
    """
    k = root_slope.shape[1]
    root1, tip1, root2 = 0.0, 0.0, 0.0
    for j in range(k):
        root1 += root_slope[0, j] * q[2 + j]
        tip1 += tip_slope[0, j] * q[2 + j]
        root2 += root_slope[1, j] * q[2 + k + j]
    first = 0.5 * root1 * root1 * effort[0]
    second = 0.5 * tip1 * tip1 * effort[1]
    third = 0.5 * root2 * root2 * effort[1]
    for j in range(k):
        force[2 + j] += torque[2 + j, 0] * first + torque[2 + j, 1] * second
        force[2 + k + j] += torque[2 + k + j, 1] * third


@inlined
def acceleration(
    arm: Manipulator, payload: Array, q: Array, qd: Array, effort: Array, qdd: Array, work: Workspace,
) -> bool:
    """Fill qdd (n,) for joint torques effort (2,) [N m]; payload as in ``kernels.assemble``.

    Leaves the Cholesky factor of M in work.M and E in work.E. False when M is not positive definite
    (numbers left the finite range).
    """
    assemble(arm, payload, q, qd, work.M, work.E, work)
    elastic(arm, q, work)
    if not factor(work.M):
        return False
    for r in range(q.size):
        qdd[r] = (arm.torque[r, 0] * effort[0] + arm.torque[r, 1] * effort[1]
                  - work.E[r] - work.elastic[r] - arm.damping[r] * qd[r])
    if arm.shortening:
        steepen(arm.root_slope, arm.tip_slope, arm.torque, q, effort, qdd)
    solve(work.M, qdd)
    return True
