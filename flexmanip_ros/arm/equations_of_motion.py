"""Equations of motion of the arm: forces, mass matrix, accelerations (paper eqs. 1-19)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from flexmanip_ros.numerics.compiled import inlined, kernel

if TYPE_CHECKING:
    from flexmanip_ros.arm.manipulator import Manipulator, Workspace
    from flexmanip_ros.types import Array

@inlined
def add_point(
    m: float, cx: float, cy: float, arm: Manipulator, i: int, q: Array, qd: Array,
    M: Array, E: Array, moments: Array,
) -> None:
    """Add a point mass m [kg] at (cx, cy) [m] in the tip tangent frame of link i, base at rest.

    Adds its mass to M, its bias to E and, for link 2, its first moments to moments (see assemble).
    """
    k = arm.kappa
    o = 2 + i * k
    w = qd[i]
    length = arm.length[i]
    alpha = 0.0
    alpha_d = 0.0
    for j in range(k):
        length -= 0.5 * arm.tip_stretch[i, j] * q[o + j] * q[o + j]
        alpha += arm.tip_slope[i, j] * q[o + j]
        alpha_d += arm.tip_slope[i, j] * qd[o + j]
    px = 0.0
    py = 0.0
    if cx != 0.0 or cy != 0.0:
        px = cx * np.cos(alpha) - cy * np.sin(alpha)
        py = cx * np.sin(alpha) + cy * np.cos(alpha)
    a = length + px
    b = py
    ad = 0.0
    bd = px * alpha_d
    add = -px * alpha_d * alpha_d
    bdd = -py * alpha_d * alpha_d
    for j in range(k):
        ad -= (arm.tip_stretch[i, j] * q[o + j] + py * arm.tip_slope[i, j]) * qd[o + j]
        add -= arm.tip_stretch[i, j] * qd[o + j] * qd[o + j]
    X = add - 2.0 * bd * w - a * w * w
    Y = bdd + 2.0 * ad * w - b * w * w
    M[i, i] += m * (a * a + b * b)
    E[i] += m * (a * Y - b * X)
    for j in range(k):
        aj = -arm.tip_stretch[i, j] * q[o + j] - py * arm.tip_slope[i, j]
        bj = px * arm.tip_slope[i, j]
        M[o + j, i] += m * (a * bj - b * aj)
        E[o + j] += m * (aj * X + bj * Y)
        for t in range(j + 1):
            al = -arm.tip_stretch[i, t] * q[o + t] - py * arm.tip_slope[i, t]
            bl = px * arm.tip_slope[i, t]
            M[o + j, o + t] += m * (aj * al + bj * bl)
        if i == 1:
            moments[0, 3 + j] += m * aj
            moments[1, 3 + j] += m * bj
    if i == 1:
        moments[0, 0] += m * a
        moments[1, 0] += m * b
        moments[0, 1] += m * ad
        moments[1, 1] += m * bd
        moments[0, 2] += m * add
        moments[1, 2] += m * bdd


@inlined
def add_link(
    arm: Manipulator, i: int, q: Array, qd: Array, M: Array, E: Array, work: Workspace,
) -> None:
    """Add link i's distributed mass, its base at rest; for link 2 also its first moments."""
    k = arm.kappa
    o = 2 + i * k
    w = qd[i]
    n0 = arm.half_mass[i]
    inertia = arm.inertia[i]
    e_theta = 0.0
    if not arm.shortening:
        for j in range(k):
            inertia += n0 * q[o + j] * q[o + j]
            e_theta += 2.0 * n0 * q[o + j] * qd[o + j]
            M[o + j, i] += arm.rigid_shape[i, j]
            M[o + j, o + j] += n0
            E[o + j] -= w * w * n0 * q[o + j]
        M[i, i] += inertia
        E[i] += w * e_theta
    else:
        Z, Y = work.Z, work.Y
        gyro = 0.0
        for j in range(k):
            # Y_jm = (W_j eta)_m, Z_jmp = sum_t Q_jtmp eta_t, and Q_jtmp = Q_mpjt lies in order
            c2 = 0.0
            for m in range(k):
                y = 0.0
                for p in range(k):
                    y += arm.W[i, j, m, p] * q[o + p]
                    z = 0.0
                    for t in range(k):
                        z += arm.Q[i, m, p, j, t] * q[o + t]
                    Z[i, j, m, p] = z
                Y[i, j, m] = y
                c2 += arm.C2[i, j, m] * q[o + m]
            work.stretch[i, j] = c2
        for j in range(k):
            quad = 0.0
            h = arm.rigid_shape[i, j]
            n_eta = 0.0
            r = 0.0
            coriolis = 0.0
            for m in range(k):
                quad += Y[i, j, m] * q[o + m]
                h += q[o + m] * Y[i, m, j]
                coriolis += (Y[i, m, j] - Y[i, j, m]) * qd[o + m]
                n2 = 0.0
                k3 = 0.0
                wd = 0.0
                for p in range(k):
                    n2 += Z[i, j, m, p] * q[o + p]
                    k3 += Z[i, j, m, p] * qd[o + p]
                    wd += arm.W[i, j, m, p] * qd[o + p]
                if m <= j:
                    M[o + j, o + m] += n2
                n_eta += n2 * q[o + m]
                r += k3 * qd[o + m]
                gyro += q[o + j] * qd[o + m] * wd
            M[o + j, o + j] += n0
            M[o + j, i] += h - 0.5 * quad
            c2 = work.stretch[i, j]
            inertia += q[o + j] * (c2 + 0.25 * n_eta)
            slope = 2.0 * c2 + n_eta
            work.stretch[i, j] = slope
            e_theta += slope * qd[o + j]
            E[o + j] += r + 2.0 * w * coriolis - 0.5 * w * w * slope
        M[i, i] += inertia
        E[i] += w * e_theta + gyro
    if i == 1:
        moments = work.moments
        moments[0, 0] += arm.moment[i]
        for j in range(k):
            moments[1, 0] += arm.mean_shape[i, j] * q[o + j]
            moments[1, 1] += arm.mean_shape[i, j] * qd[o + j]
            moments[1, 3 + j] += arm.mean_shape[i, j]
            if arm.shortening:
                s = 0.0
                sd = 0.0
                for m in range(k):
                    s += arm.S1[i, j, m] * q[o + m]
                    sd += arm.S1[i, j, m] * qd[o + m]
                moments[0, 0] -= 0.5 * s * q[o + j]
                moments[0, 1] -= s * qd[o + j]
                moments[0, 2] -= sd * qd[o + j]
                moments[0, 3 + j] -= s


@inlined
def assemble(
    arm: Manipulator, payload: Array, q: Array, qd: Array, M: Array, E: Array, work: Workspace,
) -> None:
    """Fill the lower triangle of M(q) (n, n) and the bias E(q, qd) (n,): M qdd + E + D qd + K q = B tau.

    payload: (4,) mass [kg], inertia about its centre of mass [kg m^2], centre of mass x, y [m] in the
    tip tangent frame. work.moments afterwards holds rows [A, A', A'' at qdd = 0, dA/deta2] and the
    same of B.
    """
    k = arm.kappa
    n = 2 + 2 * k
    for r in range(n):
        E[r] = 0.0
        for c in range(r + 1):
            M[r, c] = arm.rotary[r, c]
    moments = work.moments
    for r in range(2):
        for c in range(3 + k):
            moments[r, c] = 0.0
    if payload[1] != 0.0:
        M[1, 1] += payload[1]
        for j in range(k):
            slope = payload[1] * arm.tip_slope[1, j]
            M[2 + k + j, 1] += slope
            for t in range(j + 1):
                M[2 + k + j, 2 + k + t] += slope * arm.tip_slope[1, t]
    for i in range(2):  # with a constant in place of i, numba compiles a version for each
        add_link(arm, i, q, qd, M, E, work)
    at_tip = payload[2] == 0.0 and payload[3] == 0.0
    for i in range(2):
        mass = arm.tip_mass + payload[0] if at_tip else arm.tip_mass
        if i == 0:
            mass = arm.joint_mass + arm.tip_mass + 2.0 * arm.half_mass[1] + payload[0]
        add_point(mass, 0.0, 0.0, arm, i, q, qd, M, E, moments)
        if i == 1 and not at_tip:
            add_point(payload[0], payload[2], payload[3], arm, i, q, qd, M, E, moments)

    c = np.cos(q[1] - q[0])
    s = np.sin(q[1] - q[0])
    A, Ad, Add = moments[0, 0], moments[0, 1], moments[0, 2]
    B, Bd, Bdd = moments[1, 0], moments[1, 1], moments[1, 2]
    w1, w2 = qd[0], qd[1]
    length = arm.length[0]
    rate = 0.0
    drift = 0.0
    for j in range(k):
        stretch = arm.tip_stretch[0, j]
        length -= 0.5 * stretch * q[2 + j] * q[2 + j]
        rate -= stretch * q[2 + j] * qd[2 + j]
        drift -= stretch * qd[2 + j] * qd[2 + j]
    fe = Add - 2.0 * Bd * w2 - A * w2 * w2
    fn = Bdd + 2.0 * Ad * w2 - B * w2 * w2
    pe = drift - length * w1 * w1
    pn = 2.0 * rate * w1
    base_e = c * pe + s * pn
    base_n = c * pn - s * pe
    E[0] += length * (s * fe + c * fn)
    E[1] += A * base_n - B * base_e
    M[1, 0] += length * (A * c - B * s)
    for j in range(k):
        v = arm.tip_stretch[0, j] * q[2 + j]
        aj, bj = moments[0, 3 + j], moments[1, 3 + j]
        E[2 + j] -= v * (c * fe - s * fn)
        E[2 + k + j] += aj * base_e + bj * base_n
        M[2 + j, 1] += v * (A * s + B * c)
        M[2 + k + j, 0] += length * (aj * s + bj * c)
        if arm.shortening:
            for t in range(k):
                M[2 + k + j, 2 + t] -= arm.tip_stretch[0, t] * q[2 + t] * (aj * c - bj * s)


@inlined
def elastic(arm: Manipulator, q: Array, work: Workspace) -> None:
    """Fill work.elastic (n,) with dV/dq and, link by link, work.tangent (n, k) with its part from V4.

    V4 (``shape_integrals.quartic``) is of the same order as the kinetic energy of the shortening. The
    stiffness EI is read back from arm.stiffness, so that a calibrated one counts.
    """
    k = arm.kappa
    for r in range(q.size):
        work.elastic[r] = arm.stiffness[r] * q[r]
    if arm.shortening:
        for i in range(2):
            o = 2 + i * k
            EI = arm.stiffness[o] / arm.unit_stiffness[o]
            for j in range(k):
                for m in range(j + 1):
                    bend = 0.0
                    for p in range(k):
                        row = 0.5 * arm.quartic[i, j, m, p, p] * q[o + p]
                        for t in range(p):
                            row += arm.quartic[i, j, m, p, t] * q[o + t]
                        bend += row * q[o + p]
                    bend *= 2.0 * EI
                    work.tangent[o + j, m] = 3.0 * bend
                    work.tangent[o + m, j] = 3.0 * bend
                    work.elastic[o + j] += bend * q[o + m]
                    if m != j:
                        work.elastic[o + m] += bend * q[o + j]


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
