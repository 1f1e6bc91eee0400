"""Equations of motion of the arm: mass matrix, forces, accelerations (paper eqs. 1-19; symbols in docs/notation.md).

A link is a set of point masses (``Manipulator.mass``). In the frame of its chord, point p is at
(x - eta^T G(x) eta / 2, phi(x)^T eta). With its Jacobian J and its acceleration A = J q'' + a(q, q'), the inertial
forces are the sum of m J^T A: M collects m J^T J, E collects m J^T a. The root of a link is the tip of the link before,
whose J and a in inertial axes it takes over.
"""

import numpy as np

from flexmanip_ros.arm.manipulator import Manipulator, Workspace
from flexmanip_ros.numerics.compiled import inlined, inner
from flexmanip_ros.numerics.square_root import ordered_dot
from flexmanip_ros.types import Array

STICTION_RATE = 2e-3
"""Joint rate [rad/s] at which the Coulomb friction F tanh(rate / STICTION_RATE) reaches 76 % of its value F."""


@inner
def shortening_gradient(G: Array, eta: Array, product: Array) -> None:
    """Fill product (P, k) with G eta, the gradient of the shortening up to each point; G: (k, P, k), eta: (k,)."""
    rows, found = G.reshape((eta.size, product.size)), product.reshape(product.size)
    found[:] = 0.0
    for j in range(eta.size):
        row, amplitude = rows[j], eta[j]
        for c in range(found.size):
            found[c] += row[c] * amplitude


@inner
def assemble_link(
    arm: Manipulator, i: int, q: Array, qd: Array, M: Array, E: Array, work: Workspace,
) -> None:
    """Add link i with what is mounted at its end to M, E, work.P and work.F; set station i + 1 (its tip)."""
    k = arm.kappa
    links = arm.length.size
    n = q.size
    o = links + i * k
    c, s, w = np.cos(q[i]), np.sin(q[i]), qd[i]
    J, a = work.J[i], work.a[i]
    re, rn = c * a[0] + s * a[1], c * a[1] - s * a[0]
    Je, Jn, Se, Sn, own = work.own[0], work.own[1], work.own[2], work.own[3], work.own[4]
    block = work.block
    eta, etad, G, phi, shortened = q[o:o + k], qd[o:o + k], arm.G[i], arm.phi[i], arm.tip_shortening[i]
    Se[:], Sn[:], own[:], block[:] = 0.0, 0.0, 0.0, 0.0
    mass, fe, fn = 0.0, 0.0, 0.0
    shortening_gradient(G, eta, work.gradient[0])
    shortening_gradient(G, etad, work.gradient[1])
    for p in range(arm.mass.shape[1]):
        m, by_eta, by_rate = arm.mass[i, p], work.gradient[0, p], work.gradient[1, p]
        x, y, xd, yd, xdd = arm.place[i, p], 0.0, 0.0, 0.0, 0.0
        for j in range(k):
            g, h = by_eta[j], by_rate[j]
            x -= 0.5 * g * eta[j]
            xd -= g * etad[j]
            xdd -= h * etad[j]
            y += phi[p, j] * eta[j]
            yd += phi[p, j] * etad[j]
            Je[1 + j] = -g
            Jn[1 + j] = phi[p, j]
        Je[0] = -y
        Jn[0] = x
        Ae = m * (xdd - 2.0 * yd * w - x * w * w + re)
        An = m * (2.0 * xd * w - y * w * w + rn)
        mass += m
        fe += Ae
        fn += An
        for r in range(k + 1):
            own[r] += Je[r] * Ae + Jn[r] * An
            me, mn = m * Je[r], m * Jn[r]
            Se[r] += me
            Sn[r] += mn
            for t in range(r + 1):
                block[r, t] += me * Je[t] + mn * Jn[t]
    S = work.first[i]
    S[:] = 0.0
    for r in range(k + 1):
        row = i if r == 0 else o + r - 1
        S[0, row] = c * Se[r] - s * Sn[r]
        S[1, row] = s * Se[r] + c * Sn[r]
        E[row] += own[r]
        for t in range(r + 1):
            M[row, i if t == 0 else o + t - 1] += block[r, t]
    fx, fy = c * fe - s * fn, s * fe + c * fn
    for r in range(n if i > 0 or arm.floating else 0):  # J = 0 where joint 1 is pinned
        E[r] += J[0, r] * fx + J[1, r] * fy
        for t in range(r + 1):
            M[r, t] += (mass * (J[0, r] * J[0, t] + J[1, r] * J[1, t])
                        + J[0, r] * S[0, t] + J[1, r] * S[1, t] + S[0, r] * J[0, t] + S[1, r] * J[1, t])
    for r in range(n):
        work.P[0, r] += mass * J[0, r] + S[0, r]
        work.P[1, r] += mass * J[1, r] + S[1, r]
    work.F[0] += fx
    work.F[1] += fy
    work.F[2] += mass
    x, xd, xdd = arm.length[i], 0.0, 0.0
    tip, b = work.J[i + 1], work.a[i + 1]
    for r in range(n):
        tip[0, r] = J[0, r]
        tip[1, r] = J[1, r]
    for j in range(k):
        g, h = ordered_dot(shortened[j], eta), ordered_dot(shortened[j], etad)
        x -= 0.5 * g * eta[j]
        xd -= g * etad[j]
        xdd -= h * etad[j]
        tip[0, o + j] -= c * g
        tip[1, o + j] -= s * g
    tip[0, i] -= s * x
    tip[1, i] += c * x
    b[0] = a[0] + c * (xdd - x * w * w) - s * (2.0 * xd * w)
    b[1] = a[1] + s * (xdd - x * w * w) + c * (2.0 * xd * w)
    if i + 1 < links:
        b[0] -= arm.gravity[i + 1, 0] - arm.gravity[i, 0]
        b[1] -= arm.gravity[i + 1, 1] - arm.gravity[i, 1]


@inner
def assemble_payload(arm: Manipulator, payload: Array, q: Array, qd: Array, M: Array, E: Array, work: Workspace
                     ) -> None:
    """Add the payload, a rigid body held at the tip, to M, E, work.P and work.F."""
    k = arm.kappa
    links = arm.length.size
    n = q.size
    m, hx, hy, inertia = payload[0], payload[1], payload[2], payload[3]
    last = links - 1
    o = links + last * k
    turn, spin = q[last], qd[last]
    g = work.turn
    g[:] = 0.0
    g[last] = 1.0
    for j in range(k):
        g[o + j] = arm.tip_slope[last, j]
        turn += g[o + j] * q[o + j]
        spin += g[o + j] * qd[o + j]
    c, s = np.cos(turn), np.sin(turn)
    dx, dy = -hx * s - hy * c, hx * c - hy * s
    J, a = work.J[links], work.a[links]
    fx = m * a[0] - spin * spin * dy
    fy = m * a[1] + spin * spin * dx
    moment = dx * a[0] + dy * a[1]
    for r in range(n):
        E[r] += J[0, r] * fx + J[1, r] * fy + g[r] * moment
        work.P[0, r] += m * J[0, r] + dx * g[r]
        work.P[1, r] += m * J[1, r] + dy * g[r]
        across = dx * J[0, r] + dy * J[1, r]
        for t in range(r + 1):
            M[r, t] += (m * (J[0, r] * J[0, t] + J[1, r] * J[1, t]) + across * g[t]
                        + g[r] * (dx * J[0, t] + dy * J[1, t]) + inertia * g[r] * g[t])
    work.F[0] += fx
    work.F[1] += fy
    work.F[2] += m


@inlined
def assemble(
    arm: Manipulator, payload: Array, q: Array, qd: Array, M: Array, E: Array, work: Workspace,
) -> None:
    """Fill the lower triangle of M(q) (n, n) and the bias E(q, qd) (n,): M qdd + E + D qd + dV/dq = B tau.

    payload: (4,) inertial parameters. A floating base may still translate here: see ``eliminate_translation``.
    """
    n = q.size
    E[:], work.J[0], work.P[:] = 0.0, 0.0, 0.0
    for r in range(n):
        for t in range(r + 1):
            M[r, t] = arm.rotary[r, t]
    work.F[0], work.F[1], work.F[2] = 0.0, 0.0, arm.base[0]
    work.a[0, 0], work.a[0, 1] = -arm.gravity[0, 0], -arm.gravity[0, 1]
    if arm.floating:
        c, s = np.cos(q[n - 1]), np.sin(q[n - 1])
        x, y = c * arm.base[1] - s * arm.base[2], s * arm.base[1] + c * arm.base[2]
        work.J[0, 0, n - 1] = -y
        work.J[0, 1, n - 1] = x
        work.a[0, 0] = -x * qd[n - 1] * qd[n - 1]
        work.a[0, 1] = -y * qd[n - 1] * qd[n - 1]
    for i in range(arm.length.size):
        assemble_link(arm, i, q, qd, M, E, work)
    if payload[0] != 0.0 or payload[3] != 0.0:
        assemble_payload(arm, payload, q, qd, M, E, work)


@inner
def eliminate_translation(M: Array, E: Array, work: Workspace) -> None:
    """Eliminate the translation of a floating base by conservation of momentum: Schur complement of the total mass."""
    mass = work.F[2]
    for r in range(E.size):
        x, y = work.P[0, r] / mass, work.P[1, r] / mass
        E[r] -= x * work.F[0] + y * work.F[1]
        for t in range(r + 1):
            M[r, t] -= x * work.P[0, t] + y * work.P[1, t]


@inner
def inertial_forces(arm: Manipulator, payload: Array, q: Array, qd: Array, work: Workspace) -> None:
    """Fill work.M and work.E; the translation of a floating base is eliminated."""
    assemble(arm, payload, q, qd, work.M, work.E, work)
    if arm.floating:
        eliminate_translation(work.M, work.E, work)


@inner
def curvature_and_slope(curvature: Array, slopes: Array, eta: Array) -> tuple[float, float]:
    """Return curvature w'' and slope w' of a link at a point, from phi'' and phi' (k,) at that point and eta (k,)."""
    return ordered_dot(curvature, eta), ordered_dot(slopes, eta)


@inner
def elastic(arm: Manipulator, q: Array, work: Workspace) -> None:
    """Fill work.elastic (n,) with dV/dq.

    V = q^T K q / 2 + V4, V4 the integral of EI w''^2 w'^2 / 2: the curvature of an inextensible beam is
    w'' (1 + w'^2 / 2). EI is computed from arm.stiffness, so that an estimated stiffness takes effect in V4 too.
    """
    k = arm.kappa
    links = arm.length.size
    for r in range(q.size):
        work.elastic[r] = arm.stiffness[r] * q[r]
    for i in range(links):
        o = links + i * k
        EI = arm.stiffness[o] / arm.unit_stiffness[o]
        eta, force, curvature, slopes = q[o:o + k], work.elastic[o:o + k], arm.curvature[i], arm.slope[i]
        for p in range(arm.along.shape[1]):
            weight = EI * arm.along[i, p]
            if weight == 0.0:
                continue
            bend, slope = curvature_and_slope(curvature[p], slopes[p], eta)
            for j in range(k):
                K, s = weight * curvature[p, j], weight * slopes[p, j]
                force[j] += bend * slope * (slope * K + bend * s)


@inner
def factor(M: Array) -> bool:
    """Overwrite the lower triangle of M with its Cholesky factor, diagonal inverted; False if indefinite."""
    n = M.shape[0]
    for j in range(n):
        done = M[j]
        d = done[j]
        for p in range(j):
            d -= done[p] * done[p]
        if not d > 0.0:
            return False
        inverse = 1.0 / np.sqrt(d)
        done[j] = inverse
        for r in range(j + 1, n):
            row = M[r]
            x = row[j]
            for p in range(j):
                x -= row[p] * done[p]
            row[j] = x * inverse
    return True


@inner
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


@inner
def hold(L: Array, held: Array, qdd: Array, columns: Array) -> None:
    """Change qdd (n,) by constraint forces so that held qdd = 0.

    held: (m, n) constant rows, m at most 2; L from ``factor``; columns: (2, n) scratch.
    """
    rows, n = held.shape
    b, d, y = 0.0, 1.0, 0.0
    for i in range(rows):
        for c in range(n):
            columns[i, c] = held[i, c]
        solve(L, columns[i])
    a, x = ordered_dot(held[0], columns[0]), ordered_dot(held[0], qdd)
    if rows == 2:
        b, d, y = ordered_dot(held[0], columns[1]), ordered_dot(held[1], columns[1]), ordered_dot(held[1], qdd)
    determinant = a * d - b * b
    first = (d * x - b * y) / determinant
    second = (a * y - b * x) / determinant
    for c in range(n):
        qdd[c] -= first * columns[0, c]
        if rows == 2:
            qdd[c] -= second * columns[1, c]


@inner
def net_torques(B: Array, arm: Manipulator, qd: Array, effort: Array, net: Array) -> None:
    """Fill net (3, L): joint torques less friction, joint rates, derivative of the friction by the rates; B: (n, L)."""
    for i in range(arm.length.size):
        rate = ordered_dot(B[:, i], qd)
        share = np.tanh(rate / STICTION_RATE)
        net[0, i] = effort[i] - arm.viscous[i] * rate - arm.coulomb[i] * share
        net[1, i] = rate
        net[2, i] = arm.viscous[i] + arm.coulomb[i] * (1.0 - share * share) / STICTION_RATE


@inner
def torque_matrix(arm: Manipulator, q: Array, B: Array) -> None:
    """Fill B (n, L), the generalized forces of unit joint torques at q.

    A joint turns by the angle asin(w') of the link's tangent. So the generalized force on eta is that of the slope w'
    times 1 + w'^2 / 2, a correction of the order of V4. In the paper's convention torques bend nothing, B is constant.
    """
    k = arm.kappa
    links = arm.length.size
    for r in range(q.size):
        for i in range(links):
            B[r, i] = arm.torque[r, i]
    if arm.along[0, 0] == 0.0:
        return
    for i in range(links):
        o = links + i * k
        root, tip = ordered_dot(arm.root_slope[i], q[o:o + k]), ordered_dot(arm.tip_slope[i], q[o:o + k])
        for j in range(k):
            B[o + j, i] *= 1.0 + 0.5 * root * root
            if i + 1 < links:
                B[o + j, i + 1] *= 1.0 + 0.5 * tip * tip


@inner
def balance(arm: Manipulator, q: Array, qd: Array, effort: Array, qdd: Array, work: Workspace) -> bool:
    """Fill qdd (n,) from work.M and work.E. Leaves the factor of M in work.M, and fills work.elastic, B and net."""
    elastic(arm, q, work)
    if not factor(work.M):
        return False
    torque_matrix(arm, q, work.B)
    net_torques(work.B, arm, qd, effort, work.net)
    for r in range(q.size):
        qdd[r] = -work.E[r] - work.elastic[r] - arm.damping[r] * qd[r]
        for i in range(arm.length.size):
            qdd[r] += work.B[r, i] * work.net[0, i]
    solve(work.M, qdd)
    return True


@inlined
def acceleration(
    arm: Manipulator, payload: Array, q: Array, qd: Array, effort: Array, qdd: Array, work: Workspace,
) -> bool:
    """Fill qdd (n,) for joint torques effort (L,) [N m]; payload: (4,) inertial parameters.

    Leaves the Cholesky factor of M in work.M, E in work.E, ``torque_matrix`` in work.B and ``net_torques`` in work.net.
    Returns False when M is not positive definite (numbers left the finite range).
    """
    inertial_forces(arm, payload, q, qd, work)
    return balance(arm, q, qd, effort, qdd, work)
