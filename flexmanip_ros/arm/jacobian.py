"""Compiled derivatives of the equations of motion, analytic, no allocation.

With f = M(q) qdd + E(q, qd) (inverse dynamics at fixed qdd), implicit differentiation gives
dqdd/dq = -M^-1 (df/dq + K), dqdd/dqd = -M^-1 (df/dqd + D), dqdd/dp = -M^-1 df/dp.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from flexmanip_ros.arm.equations_of_motion import acceleration, assemble
from flexmanip_ros.arm.link_jacobian import link_jacobian, point_jacobian
from flexmanip_ros.numerics.compiled import inlined, kernel

if TYPE_CHECKING:
    from flexmanip_ros.arm.manipulator import Manipulator, Workspace
    from flexmanip_ros.types import Array


@inlined
def force_jacobian(
    arm: Manipulator, payload: Array, q: Array, qd: Array, qdd: Array,
    left: Array, right: Array, dp: Array, work: Workspace,
) -> None:
    """Fill df/dq and df/dqd (n, n) and df/dp (n, 4), p = [payload mass, inertia, EI1, EI2].

    Needs work as ``kernels.assemble`` left it for the same q, qd and payload.
    """
    k = arm.kappa
    n = 2 + 2 * k
    for r in range(n):
        for c in range(n):
            left[r, c] = 0.0
            right[r, c] = 0.0
        for c in range(4):
            dp[r, c] = 0.0
    columns = work.columns
    for r in range(6):
        for j in range(k):
            columns[r, j] = 0.0
    c = np.cos(q[1] - q[0])
    s = np.sin(q[1] - q[0])
    w1, w2 = qd[0], qd[1]
    length = arm.length[0]
    rate = 0.0
    second = 0.0
    for j in range(k):
        stretch = arm.tip_stretch[0, j]
        length -= 0.5 * stretch * q[2 + j] * q[2 + j]
        rate -= stretch * q[2 + j] * qd[2 + j]
        second -= stretch * (qd[2 + j] * qd[2 + j] + q[2 + j] * qdd[2 + j])
    pe = second - length * w1 * w1
    pn = length * qdd[0] + 2.0 * rate * w1
    base_e = c * pe + s * pn
    base_n = c * pn - s * pe

    mass = arm.tip_mass + payload[0]
    for i in range(2):  # with a constant in place of i, numba compiles a version for each
        e = base_e if i == 1 else 0.0
        f = base_n if i == 1 else 0.0
        link_jacobian(arm, i, e, f, q, qd, qdd, left, right, work)
    at_tip = payload[2] == 0.0 and payload[3] == 0.0
    for i in range(2):
        e = base_e if i == 1 else 0.0
        f = base_n if i == 1 else 0.0
        lumped = mass if at_tip else arm.tip_mass
        if i == 0:
            lumped = mass + arm.joint_mass + 2.0 * arm.half_mass[1]
        point_jacobian(lumped, 0.0, 0.0, arm, i, e, f, q, qd, qdd, left, right, work)
        if i == 1 and not at_tip:
            point_jacobian(payload[0], payload[2], payload[3], arm, i, e, f, q, qd, qdd, left, right, work)

    # Coupling: rows of link 1 see P_q . F'', rows of link 2 see F_q . P''.
    moments = work.moments
    A, Ad, Add = moments[0, 0], moments[0, 1], moments[0, 2]
    B, Bd, Bdd = moments[1, 0], moments[1, 1], moments[1, 2]
    for j in range(k):
        Add += moments[0, 3 + j] * qdd[2 + k + j]
        Bdd += moments[1, 3 + j] * qdd[2 + k + j]
    fe = Add - 2.0 * Bd * w2 - B * qdd[1] - A * w2 * w2
    fn = Bdd + 2.0 * Ad * w2 + A * qdd[1] - B * w2 * w2
    reach_e = s * fe + c * fn  # n1 . F''
    reach_n = c * fe - s * fn  # e1 . F'' = d(n1 . F'')/d(theta2 - theta1)
    spin_e = -2.0 * Bd - 2.0 * A * w2
    spin_n = 2.0 * Ad - 2.0 * B * w2

    turn = length * reach_n
    left[0, 0] -= turn
    left[0, 1] += turn
    turn = -A * base_e - B * base_n
    left[1, 0] -= turn
    left[1, 1] += turn
    right[0, 1] += length * (s * spin_e + c * spin_n)
    dpe, dpn = -2.0 * length * w1, 2.0 * rate
    de, dn = c * dpe + s * dpn, c * dpn - s * dpe
    right[1, 0] += A * dn - B * de
    for j in range(k):
        r1 = 2 + j
        r2 = 2 + k + j
        v = arm.tip_stretch[0, j] * q[r1]
        aj, bj = moments[0, 3 + j], moments[1, 3 + j]
        left[r1, 0] -= v * reach_e
        left[r1, 1] += v * reach_e
        turn = aj * base_n - bj * base_e
        left[r2, 0] -= turn
        left[r2, 1] += turn
        right[r1, 1] -= v * (c * spin_e - s * spin_n)
        right[r2, 0] += aj * de + bj * dn
        left[0, r1] -= v * reach_e
        left[r1, r1] -= arm.tip_stretch[0, j] * reach_n
        # by eta2_j and its rate: F'' changes
        ge = columns[0, j] - 2.0 * columns[3, j] * w2 - bj * qdd[1] - aj * w2 * w2
        gn = columns[1, j] + 2.0 * columns[2, j] * w2 + aj * qdd[1] - bj * w2 * w2
        he = columns[4, j] - 2.0 * bj * w2
        hn = columns[5, j] + 2.0 * aj * w2
        left[0, r2] += length * (s * ge + c * gn)
        right[0, r2] += length * (s * he + c * hn)
        for t in range(k):
            vl = arm.tip_stretch[0, t] * q[2 + t]
            left[2 + t, r2] -= vl * (c * ge - s * gn)
            right[2 + t, r2] -= vl * (c * he - s * hn)
        # by eta1_j and its rate: P'' changes
        stretch = arm.tip_stretch[0, j]
        if stretch != 0.0:
            dpe = -stretch * qdd[r1] + v * w1 * w1
            dpn = -v * qdd[0] - 2.0 * stretch * qd[r1] * w1
            ge, gn = c * dpe + s * dpn, c * dpn - s * dpe
            dpe = -2.0 * stretch * qd[r1]
            dpn = -2.0 * v * w1
            he, hn = c * dpe + s * dpn, c * dpn - s * dpe
            left[1, r1] += A * gn - B * ge
            right[1, r1] += A * hn - B * he
            for t in range(k):
                al, bl = moments[0, 3 + t], moments[1, 3 + t]
                left[2 + k + t, r1] += al * ge + bl * gn
                right[2 + k + t, r1] += al * he + bl * hn
    _parameter_columns(arm, payload, q, qd, qdd, base_e, base_n, c, s, length, dp)


@inlined
def _parameter_columns(
    arm: Manipulator, payload: Array, q: Array, qd: Array, qdd: Array,
    base_e: float, base_n: float, c: float, s: float, length: float, dp: Array,
) -> None:
    k = arm.kappa
    w2 = qd[1]
    a = arm.length[1]
    alpha, alpha_d, alpha_dd = 0.0, 0.0, 0.0
    for j in range(k):
        r2 = 2 + k + j
        a -= 0.5 * arm.tip_stretch[1, j] * q[r2] * q[r2]
        alpha += arm.tip_slope[1, j] * q[r2]
        alpha_d += arm.tip_slope[1, j] * qd[r2]
        alpha_dd += arm.tip_slope[1, j] * qdd[r2]
    px = payload[2] * np.cos(alpha) - payload[3] * np.sin(alpha)
    py = payload[2] * np.sin(alpha) + payload[3] * np.cos(alpha)
    a += px
    ad, bd = -py * alpha_d, px * alpha_d
    add = -px * alpha_d * alpha_d - py * alpha_dd
    bdd = -py * alpha_d * alpha_d + px * alpha_dd
    for j in range(k):
        r2 = 2 + k + j
        stretch = arm.tip_stretch[1, j]
        ad -= stretch * q[r2] * qd[r2]
        add -= stretch * (qd[r2] * qd[r2] + q[r2] * qdd[r2])
    X = add - 2.0 * bd * w2 - py * qdd[1] - a * w2 * w2 + base_e
    Y = bdd + 2.0 * ad * w2 + a * qdd[1] - py * w2 * w2 + base_n
    turn = qdd[1] + alpha_dd
    dp[0, 0] = length * (s * X + c * Y)
    dp[1, 0] = a * Y - py * X
    dp[1, 1] = turn
    for j in range(k):
        r1, r2 = 2 + j, 2 + k + j
        dp[r1, 0] = -arm.tip_stretch[0, j] * q[r1] * (c * X - s * Y)
        slope = arm.tip_slope[1, j]
        dp[r2, 0] = (-arm.tip_stretch[1, j] * q[r2] - py * slope) * X + px * slope * Y
        dp[r2, 1] = slope * turn
        dp[r1, 2] = arm.unit_stiffness[r1] * q[r1]
        dp[r2, 3] = arm.unit_stiffness[r2] * q[r2]


@kernel
def bias_jacobian(
    arm: Manipulator, payload: Array, q: Array, qd: Array, qdd: Array,
    left: Array, right: Array, work: Workspace,
) -> None:
    """Fill d(M qdd + E)/dq and dE/dqd, each (n, n), qdd held."""
    assemble(arm, payload, q, qd, work.M, work.E, work)
    force_jacobian(arm, payload, q, qd, qdd, left, right, work.parameters, work)


@inlined
def solve_columns(L: Array, X: Array) -> None:
    """Overwrite X (n, m) with -M^-1 X, L from ``acceleration_kernel.factor``."""
    n, m = X.shape
    for r in range(n):
        for p in range(r):
            x = L[r, p]
            for c in range(m):
                X[r, c] -= x * X[p, c]
        x = L[r, r]
        for c in range(m):
            X[r, c] *= x
    for r in range(n - 1, -1, -1):
        for p in range(r + 1, n):
            x = L[p, r]
            for c in range(m):
                X[r, c] -= x * X[p, c]
        x = L[r, r]
        for c in range(m):
            X[r, c] *= x
    for r in range(n):
        for c in range(m):
            X[r, c] = -X[r, c]


@inlined
def steep_jacobian(
    root_slope: Array, tip_slope: Array, torque: Array, q: Array, effort: Array, dq: Array,
) -> None:
    """Subtract the derivative of ``acceleration_kernel.steepen`` by q from dq (n, n)."""
    k = root_slope.shape[1]
    root1, tip1, root2 = 0.0, 0.0, 0.0
    for j in range(k):
        root1 += root_slope[0, j] * q[2 + j]
        tip1 += tip_slope[0, j] * q[2 + j]
        root2 += root_slope[1, j] * q[2 + k + j]
    for j in range(k):
        r1, r2 = 2 + j, 2 + k + j
        first = torque[r1, 0] * root1 * effort[0]
        second = torque[r1, 1] * tip1 * effort[1]
        third = torque[r2, 1] * root2 * effort[1]
        for m in range(k):
            dq[r1, 2 + m] -= first * root_slope[0, m] + second * tip_slope[0, m]
            dq[r2, 2 + k + m] -= third * root_slope[1, m]


@inlined
def acceleration_jacobian(
    arm: Manipulator, payload: Array, q: Array, qd: Array, effort: Array,
    qdd: Array, dq: Array, dqd: Array, dp: Array, work: Workspace,
) -> bool:
    """Fill qdd (n,) and dqdd/dq, dqdd/dqd (n, n), dqdd/dp (n, 4), p = [mass, inertia, EI1, EI2].

    The damping counts as independent of EI. False when M is not positive definite. M's Cholesky
    factor stays in work.M, so dqdd/dtau is its solution for the columns of ``manipulator.torque_at(arm, q)``.
    """
    if not acceleration(arm, payload, q, qd, effort, qdd, work):
        return False
    force_jacobian(arm, payload, q, qd, qdd, dq, dqd, dp, work)
    for r in range(q.size):
        dq[r, r] += arm.stiffness[r]
        dqd[r, r] += arm.damping[r]
    if arm.shortening:
        k = arm.kappa
        for i in range(2):
            o = 2 + i * k
            for j in range(k):
                r = o + j
                dp[r, 2 + i] = work.elastic[r] * arm.unit_stiffness[r] / arm.stiffness[r]
                for m in range(k):
                    dq[r, o + m] += work.tangent[r, m]
        steep_jacobian(arm.root_slope, arm.tip_slope, arm.torque, q, effort, dq)
    solve_columns(work.M, dq)
    solve_columns(work.M, dqd)
    solve_columns(work.M, dp)
    return True
