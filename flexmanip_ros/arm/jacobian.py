"""Derivatives of the equations of motion by q, q' and the payload's inertial parameters (see ``equations_of_motion``).

The inertial forces are the sum of m J^T A over all points, A = J q'' + a(q, q'). Their derivative at fixed q'' is the
sum of m (dJ^T A + J^T dA). It is gathered link by link from the tip to the base: each link passes the force F at its
root, and the derivatives Fq (by q) and Fv (by q') of F, to the tip of the link before.
"""

import numpy as np

from flexmanip_ros.arm.equations_of_motion import curvature_and_slope, shortening_gradient
from flexmanip_ros.arm.manipulator import Manipulator, Workspace
from flexmanip_ros.numerics.compiled import inner
from flexmanip_ros.numerics.square_root import ordered_dot
from flexmanip_ros.types import Array


@inner
def move_station(arm: Manipulator, i: int, q: Array, qd: Array, qdd: Array, work: Workspace) -> None:
    """Set acceleration A of the tip of link i and its derivatives Aq, Av, from those of its root."""
    k = arm.kappa
    o = arm.length.size + i * k
    c, s, w, wd = np.cos(q[i]), np.sin(q[i]), qd[i], qdd[i]
    A, Aq, Av = work.A[i + 1], work.Aq[i + 1], work.Av[i + 1]
    for side in range(2):
        for r in range(q.size):
            Aq[side, r] = work.Aq[i, side, r]
            Av[side, r] = work.Av[i, side, r]
    x, xd, xdd = arm.length[i], 0.0, 0.0
    eta, etad, etadd = q[o:o + k], qd[o:o + k], qdd[o:o + k]
    for j in range(k):
        shortened = arm.tip_shortening[i, j]
        g, h, gdd = ordered_dot(shortened, eta), ordered_dot(shortened, etad), ordered_dot(shortened, etadd)
        x -= 0.5 * g * eta[j]
        xd -= g * etad[j]
        xdd -= h * etad[j] + g * etadd[j]
        e, f = -gdd + g * w * w, -2.0 * h * w - g * wd
        Aq[0, o + j] += c * e - s * f
        Aq[1, o + j] += s * e + c * f
        e, f = -2.0 * h, -2.0 * g * w
        Av[0, o + j] += c * e - s * f
        Av[1, o + j] += s * e + c * f
    e, f = xdd - x * w * w, 2.0 * xd * w + x * wd
    A[0] = work.A[i, 0] + c * e - s * f
    A[1] = work.A[i, 1] + s * e + c * f
    if i + 1 < arm.length.size:
        A[0] -= arm.gravity[i + 1, 0] - arm.gravity[i, 0]
        A[1] -= arm.gravity[i + 1, 1] - arm.gravity[i, 1]
    Aq[0, i] += -s * e - c * f
    Aq[1, i] += c * e - s * f
    e, f = -2.0 * x * w, 2.0 * xd
    Av[0, i] += c * e - s * f
    Av[1, i] += s * e + c * f


@inner
def payload_jacobian(
    arm: Manipulator, payload: Array, q: Array, qd: Array, qdd: Array, left: Array, right: Array, dp: Array,
    work: Workspace,
) -> None:
    """Add the payload to left and right; set F, Fq, Fv to its force at the tip, dp (n, 4) to d(forces)/d(payload)."""
    k = arm.kappa
    links = arm.length.size
    n = q.size
    last = links - 1
    o = links + last * k
    m, hx, hy = payload[0], payload[1], payload[2]
    turn, spin, accelerated = q[last], qd[last], qdd[last]
    g = work.turn
    g[:] = 0.0
    g[last] = 1.0
    for j in range(k):
        g[o + j] = arm.tip_slope[last, j]
        turn += g[o + j] * q[o + j]
        spin += g[o + j] * qd[o + j]
        accelerated += g[o + j] * qdd[o + j]
    tx, ty = np.cos(turn), np.sin(turn)
    J, A, Aq, Av = work.J[links], work.A[links], work.Aq[links], work.Av[links]
    # force per m c_x: n psi'' - t psi'^2, per m c_y: -(t psi'' + n psi'^2); psi: tip angle, n = (-ty, tx)
    xx, xy = -ty * accelerated - tx * spin * spin, tx * accelerated - ty * spin * spin
    yx, yy = -tx * accelerated + ty * spin * spin, -ty * accelerated - tx * spin * spin
    along, across = tx * A[0] + ty * A[1], tx * A[1] - ty * A[0]
    for r in range(n):
        dp[r, 0] = J[0, r] * A[0] + J[1, r] * A[1]
        dp[r, 1] = J[0, r] * xx + J[1, r] * xy + g[r] * across
        dp[r, 2] = J[0, r] * yx + J[1, r] * yy - g[r] * along
        dp[r, 3] = g[r] * accelerated
    if arm.floating:
        mass = work.F[2]
        for r in range(n):
            x, y = work.P[0, r] / mass, work.P[1, r] / mass
            dp[r, 0] -= x * A[0] + y * A[1]
            dp[r, 1] -= x * xx + y * xy
            dp[r, 2] -= x * yx + y * yy
    F = work.F
    F[0] = m * A[0] + hx * xx + hy * yx
    F[1] = m * A[1] + hx * xy + hy * yy
    dx, dy = -hx * ty - hy * tx, hx * tx - hy * ty
    # derivative of d = hx n - hy t by psi: -(hx t + hy n); of the force by psi': -2 psi' (hx t + hy n)
    qx, qy = hx * -xy + hy * -yy, hx * xx + hy * yx
    vx, vy = -2.0 * spin * dy, 2.0 * spin * dx
    moment = -(hx * along + hy * across)
    for r in range(n):
        work.Fq[0, r] = m * Aq[0, r] + qx * g[r]
        work.Fq[1, r] = m * Aq[1, r] + qy * g[r]
        work.Fv[0, r] = m * Av[0, r] + vx * g[r]
        work.Fv[1, r] = m * Av[1, r] + vy * g[r]
    for t in range(n):
        by_q = dx * Aq[0, t] + dy * Aq[1, t] + moment * g[t]
        by_v = dx * Av[0, t] + dy * Av[1, t]
        for r in range(n):
            if g[r] != 0.0:
                left[r, t] += g[r] * by_q
                right[r, t] += g[r] * by_v


@inner
def add_body_forces(arm: Manipulator, q: Array, qdd: Array, dp: Array, work: Workspace) -> None:
    """Add to dp (n, 4), the derivative of the forces by the payload's parameters, the part of additional qdd (n,).

    Call it right after ``force_jacobian``: it reads work.turn, work.J and work.P of that call.
    """
    n = q.size
    g, J, mass = work.turn, work.J[arm.length.size], work.F[2]
    turn, accelerated, x, y = 0.0, 0.0, 0.0, 0.0
    for r in range(n):
        accelerated += g[r] * qdd[r]
        x += J[0, r] * qdd[r]
        y += J[1, r] * qdd[r]
        turn += g[r] * q[r]
        if arm.floating:  # the translation of the base, from conservation of momentum
            x -= work.P[0, r] / mass * qdd[r]
            y -= work.P[1, r] / mass * qdd[r]
    tx, ty = np.cos(turn), np.sin(turn)
    along, across = tx * x + ty * y, tx * y - ty * x
    for r in range(n):
        a, b = J[0, r], J[1, r]
        if arm.floating:
            a -= work.P[0, r] / mass
            b -= work.P[1, r] / mass
        dp[r, 0] += a * x + b * y
        dp[r, 1] += (b * tx - a * ty) * accelerated + g[r] * across
        dp[r, 2] -= (a * tx + b * ty) * accelerated + g[r] * along
        dp[r, 3] += g[r] * accelerated


@inner
def add_mass_forces(
    arm: Manipulator, i: int, q: Array, qd: Array, qdd: Array, A: Array, change: Array, nominal: Array, G: Array,
    at: int, work: Workspace,
) -> None:
    """Add to column ``at`` of G (n, c) the inertial forces of a change of link i's masses.

    change: relative change of its density, and change of the mass at its end [kg]; nominal: (P,) its masses; A: (2,)
    acceleration of its root. Call it right after ``force_jacobian``: it reads work.J, work.P and the mass in work.F.
    """
    n, k = q.size, arm.kappa
    o = arm.length.size + i * k
    c, s, w, wd = np.cos(q[i]), np.sin(q[i]), qd[i], qdd[i]
    re, rn = c * A[0] + s * A[1], c * A[1] - s * A[0]
    eta, etad, etadd, shortening, phi = q[o:o + k], qd[o:o + k], qdd[o:o + k], arm.G[i], arm.phi[i]
    shortening_gradient(shortening, eta, work.gradient[0])
    shortening_gradient(shortening, etad, work.gradient[1])
    shortening_gradient(shortening, etadd, work.gradient[2])
    fe, fn, end = 0.0, 0.0, nominal.size - 1
    for p in range(end + 1):
        by_eta, by_rate, by_acceleration = work.gradient[0, p], work.gradient[1, p], work.gradient[2, p]
        x, y, xd, yd, xdd, ydd = arm.place[i, p], 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(k):
            x -= 0.5 * by_eta[j] * eta[j]
            xd -= by_eta[j] * etad[j]
            xdd -= by_rate[j] * etad[j] + by_acceleration[j] * eta[j]
            y += phi[p, j] * eta[j]
            yd += phi[p, j] * etad[j]
            ydd += phi[p, j] * etadd[j]
        m = change[0] * nominal[p] if p < end else change[1]
        Ae = m * (xdd - 2.0 * yd * w - y * wd - x * w * w + re)
        An = m * (ydd + 2.0 * xd * w + x * wd - y * w * w + rn)
        fe += Ae
        fn += An
        G[i, at] += x * An - y * Ae
        for j in range(k):
            G[o + j, at] += phi[p, j] * An - by_eta[j] * Ae
    fx, fy = c * fe - s * fn, s * fe + c * fn
    for r in range(n):
        G[r, at] += work.J[i, 0, r] * fx + work.J[i, 1, r] * fy
        if arm.floating:  # the translation of the base, from conservation of momentum
            G[r, at] -= (work.P[0, r] * fx + work.P[1, r] * fy) / work.F[2]


@inner
def add_length_forces(
    arm: Manipulator, i: int, q: Array, qd: Array, qdd: Array, change: float, payload: float, is_part: bool, G: Array,
    at: int, work: Workspace,
) -> None:
    """Add to column ``at`` of G (n, c) the inertial forces of a change [m] of where link i + 1 is mounted on link i.

    The next link and what it carries then have another Jacobian and another acceleration. payload: its mass [kg];
    is_part: of the forces, the part of an additional qdd (qd is zero). Call it right after ``force_jacobian``.
    """
    n, c, s, w, wd = q.size, np.cos(q[i]), np.sin(q[i]), qd[i], qdd[i]
    x, y = -s * wd - c * w * w, c * wd - s * w * w
    own, carried = 0.0, payload
    for p in range(arm.mass.shape[1]):
        own += arm.mass[i, p]
        carried += arm.mass[i + 1, p]
    fx, fy = work.load[0], work.load[1]
    if is_part:
        fx, fy = 0.0, 0.0
    for r in range(n):
        px = work.P[0, r] - work.first[i, 0, r] - own * work.J[i, 0, r]
        py = work.P[1, r] - work.first[i, 1, r] - own * work.J[i, 1, r]
        if arm.floating:
            px -= carried / work.F[2] * work.P[0, r]
            py -= carried / work.F[2] * work.P[1, r]
        if is_part:
            fx += px * qdd[r]
            fy += py * qdd[r]
        G[r, at] += change * (px * x + py * y)
    G[i, at] += change * (c * fy - s * fx)


@inner
def add_weight(arm: Manipulator, i: int, change: float, nominal: Array, G: Array, at: int, work: Workspace) -> None:
    """Add to column ``at`` of G (n, c) the forces of a relative change of the gravity that link i of a fixed arm feels.

    nominal: (2,) that gravity [m/s^2]. The last link carries the payload. Call it right after ``force_jacobian``.
    """
    last = arm.length.size - 1
    for r in range(G.shape[0]):
        for side in range(2):
            momentum = work.first[0, side, r] if i < last else work.P[side, r]
            if i > 0:
                momentum -= work.first[0, side, r]
            G[r, at] -= change * nominal[side] * momentum


@inner
def tip_load_jacobian(arm: Manipulator, i: int, q: Array, left: Array, right: Array, work: Workspace) -> None:
    """Add the force work.F at the tip of link i, with its derivatives Fq and Fv, to its rows of left and right."""
    k = arm.kappa
    o = arm.length.size + i * k
    c, s = np.cos(q[i]), np.sin(q[i])
    Fe, Fn = c * work.F[0] + s * work.F[1], c * work.F[1] - s * work.F[0]
    x = arm.length[i]
    G = work.own[0]
    for j in range(k):
        g = ordered_dot(arm.tip_shortening[i, j], q[o:o + k])
        x -= 0.5 * g * q[o + j]
        G[j] = g
    for r in range(q.size):
        e = c * work.Fq[0, r] + s * work.Fq[1, r]
        f = c * work.Fq[1, r] - s * work.Fq[0, r]
        if r == i:
            e += Fn
            f -= Fe
        left[i, r] += x * f
        for j in range(k):
            left[o + j, r] -= G[j] * e
        e = c * work.Fv[0, r] + s * work.Fv[1, r]
        f = c * work.Fv[1, r] - s * work.Fv[0, r]
        right[i, r] += x * f
        for j in range(k):
            right[o + j, r] -= G[j] * e
    for t in range(k):
        left[i, o + t] -= G[t] * Fn
        for j in range(k):
            left[o + j, o + t] -= arm.tip_shortening[i, j, t] * Fe


@inner
def link_jacobian(
    arm: Manipulator, i: int, q: Array, qd: Array, qdd: Array, left: Array, right: Array, work: Workspace,
) -> None:
    """Add the inertial forces of link i's points to left and right, and their sum to work.F, Fq and Fv."""
    k = arm.kappa
    n = q.size
    o = arm.length.size + i * k
    c, s, w, wd = np.cos(q[i]), np.sin(q[i]), qd[i], qdd[i]
    A, Aq, Av = work.A[i], work.Aq[i], work.Av[i]
    re, rn = c * A[0] + s * A[1], c * A[1] - s * A[0]
    g, Se, Sn = work.own[0], work.own[2], work.own[3]
    eq, nq, ev, nv = work.own[4], work.own[5], work.own[6], work.own[7]
    feq, fnq, fev, fnv = work.own[8], work.own[9], work.own[10], work.own[11]
    eta, etad, etadd = q[o:o + k], qd[o:o + k], qdd[o:o + k]
    shortening, phi, turned, turning = arm.G[i], arm.phi[i], left[i, o:o + k], right[i, o:o + k]
    Se[:], Sn[:] = 0.0, 0.0
    work.own[8:] = 0.0
    mass, fe, fn = 0.0, 0.0, 0.0
    shortening_gradient(shortening, eta, work.gradient[0])
    shortening_gradient(shortening, etad, work.gradient[1])
    shortening_gradient(shortening, etadd, work.gradient[2])
    for p in range(arm.mass.shape[1]):
        m = arm.mass[i, p]
        by_eta, by_rate, by_acceleration = work.gradient[0, p], work.gradient[1, p], work.gradient[2, p]
        x, y, xd, yd, xdd, ydd = arm.place[i, p], 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(k):
            G, h, gdd = by_eta[j], by_rate[j], by_acceleration[j]
            shape = phi[p, j]
            x -= 0.5 * G * eta[j]
            xd -= G * etad[j]
            xdd -= h * etad[j] + G * etadd[j]
            y += shape * eta[j]
            yd += shape * etad[j]
            ydd += shape * etadd[j]
            g[1 + j] = G
            eq[1 + j] = m * (-gdd - shape * wd + G * w * w)
            nq[1 + j] = m * (-2.0 * h * w - G * wd - shape * w * w)
            ev[1 + j] = m * (-2.0 * h - 2.0 * shape * w)
            nv[1 + j] = m * (-2.0 * G * w)
        ev[0] = m * (-2.0 * yd - 2.0 * x * w)
        nv[0] = m * (2.0 * xd - 2.0 * y * w)
        Ae = m * (xdd - 2.0 * yd * w - y * wd - x * w * w)
        An = m * (ydd + 2.0 * xd * w + x * wd - y * w * w)
        mass += m
        fe += Ae
        fn += An
        Ae += m * re
        An += m * rn
        Se[0] -= m * y
        Sn[0] += m * x
        for t in range(k):
            Se[1 + t] -= m * g[1 + t]
            Sn[1 + t] += m * phi[p, t]
        right[i, i] += x * nv[0] - y * ev[0]
        fev[0] += ev[0]
        fnv[0] += nv[0]
        for t in range(k):
            feq[1 + t] += eq[1 + t]
            fnq[1 + t] += nq[1 + t]
            fev[1 + t] += ev[1 + t]
            fnv[1 + t] += nv[1 + t]
            turned[t] += x * nq[1 + t] - y * eq[1 + t] - phi[p, t] * Ae - g[1 + t] * An
            turning[t] += x * nv[1 + t] - y * ev[1 + t]
            right[o + t, i] += phi[p, t] * nv[0] - g[1 + t] * ev[0]
        for j in range(k):
            shape, G = phi[p, j], g[1 + j]
            by_q, by_v = left[o + j, o:o + k], right[o + j, o:o + k]
            for t in range(k):
                by_q[t] += shape * nq[1 + t] - G * eq[1 + t] - shortening[j, p, t] * Ae
                by_v[t] += shape * nv[1 + t] - G * ev[1 + t]
    # the root's acceleration, in the link's frame, is the same at all points
    for r in range(n):
        if i == 0 and r != i and not arm.floating:
            continue  # a pinned root is not accelerated
        e = c * Aq[0, r] + s * Aq[1, r]
        f = c * Aq[1, r] - s * Aq[0, r]
        if r == i:
            e += rn
            f -= re
        left[i, r] += Se[0] * e + Sn[0] * f
        for j in range(k):
            left[o + j, r] += Se[1 + j] * e + Sn[1 + j] * f
        e = c * Av[0, r] + s * Av[1, r]
        f = c * Av[1, r] - s * Av[0, r]
        right[i, r] += Se[0] * e + Sn[0] * f
        for j in range(k):
            right[o + j, r] += Se[1 + j] * e + Sn[1 + j] * f
        for side in range(2):
            work.Fq[side, r] += mass * Aq[side, r]
            work.Fv[side, r] += mass * Av[side, r]
    feq[0], fnq[0] = -fn, fe  # the link's frame turns with q[i]
    for r in range(k + 1):
        row = i if r == 0 else o + r - 1
        work.Fq[0, row] += c * feq[r] - s * fnq[r]
        work.Fq[1, row] += s * feq[r] + c * fnq[r]
        work.Fv[0, row] += c * fev[r] - s * fnv[r]
        work.Fv[1, row] += s * fev[r] + c * fnv[r]
    fe += mass * re
    fn += mass * rn
    work.F[0] += c * fe - s * fn
    work.F[1] += s * fe + c * fn


@inner
def force_jacobian(
    arm: Manipulator, payload: Array, q: Array, qd: Array, qdd: Array, left: Array, right: Array, dp: Array,
    work: Workspace,
) -> None:
    """Fill left = d(M qdd + E)/dq, right = dE/dqd (n, n) and dp = d(M qdd + E)/d(payload) (n, 4), at fixed qdd.

    payload: (4,) inertial parameters. Call it right after ``assemble``: it reads work.J, work.P and work.F.
    """
    n = q.size
    links = arm.length.size
    mass = work.F[2]
    left[:], right[:], work.Aq[0], work.Av[0] = 0.0, 0.0, 0.0, 0.0
    work.A[0, 0], work.A[0, 1] = work.a[0, 0], work.a[0, 1]
    x, y, along, across = 0.0, 0.0, 0.0, 0.0
    if arm.floating:
        x, y = work.J[0, 1, n - 1], -work.J[0, 0, n - 1]
        spin, turn = qd[n - 1], qdd[n - 1]
        along, across = -y * turn - x * spin * spin, x * turn - y * spin * spin
        work.Aq[0, 0, n - 1], work.Aq[0, 1, n - 1] = -across, along
        work.Av[0, 0, n - 1], work.Av[0, 1, n - 1] = -2.0 * x * spin, -2.0 * y * spin
        # the translation of the base, from conservation of momentum
        tx, ty = -work.F[0] / mass, -work.F[1] / mass
        for r in range(n):
            tx -= work.P[0, r] * qdd[r] / mass
            ty -= work.P[1, r] * qdd[r] / mass
        work.A[0, 0], work.A[0, 1] = along + tx, across + ty
    for i in range(links):
        move_station(arm, i, q, qd, qdd, work)
    payload_jacobian(arm, payload, q, qd, qdd, left, right, dp, work)
    for back in range(links):
        i = links - 1 - back
        if i == 0:
            work.load[0], work.load[1] = work.F[0], work.F[1]
        tip_load_jacobian(arm, i, q, left, right, work)
        link_jacobian(arm, i, q, qd, qdd, left, right, work)
    if arm.floating:
        left[n - 1, n - 1] -= x * work.F[0] + y * work.F[1]
        for r in range(n):
            left[n - 1, r] += x * work.Fq[1, r] - y * work.Fq[0, r]
            right[n - 1, r] += x * work.Fv[1, r] - y * work.Fv[0, r]
        for r in range(n):
            a, b = work.P[0, r] / mass, work.P[1, r] / mass
            for t in range(n):
                left[r, t] -= a * work.Fq[0, t] + b * work.Fq[1, t]
                right[r, t] -= a * work.Fv[0, t] + b * work.Fv[1, t]


@inner
def solve_columns(L: Array, X: Array, m: int) -> None:
    """Overwrite the first m columns of X (n, >= m) with -M^-1 X, L from ``equations_of_motion.factor``."""
    n = X.shape[0]
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


@inner
def torque_jacobian(arm: Manipulator, q: Array, qd: Array, work: Workspace, dq: Array) -> None:
    """Subtract the derivative of B(q) tau by q from dq (n, n), tau the torques less friction."""
    k = arm.kappa
    links = arm.length.size
    if arm.along[0, 0] == 0.0:
        return
    net = work.net
    for i in range(links):
        o = links + i * k
        for end in range(2):
            joint = i + end
            if joint == links:
                continue
            slopes = arm.root_slope[i] if end == 0 else arm.tip_slope[i]
            slope, rate = ordered_dot(slopes, q[o:o + k]), ordered_dot(arm.torque[o:o + k, joint], qd[o:o + k])
            for t in range(k):
                # B depends on the slope: so do the generalized force and, through B^T q', the joint rate and friction
                turned = slope * slopes[t]
                for j in range(k):
                    dq[o + j, o + t] -= arm.torque[o + j, joint] * turned * net[0, joint]
                for r in range(q.size):
                    dq[r, o + t] += work.B[r, joint] * net[2, joint] * turned * rate


@inner
def elastic_jacobian(arm: Manipulator, q: Array, dq: Array, work: Workspace) -> None:
    """Add the derivative of ``equations_of_motion.elastic`` by q to dq (n, n)."""
    k = arm.kappa
    links = arm.length.size
    for r in range(q.size):
        dq[r, r] += arm.stiffness[r]
    for i in range(links):
        o = links + i * k
        EI = arm.stiffness[o] / arm.unit_stiffness[o]
        eta, tangent, curvature, slopes = q[o:o + k], work.tangent, arm.curvature[i], arm.slope[i]
        tangent[:] = 0.0
        for p in range(arm.along.shape[1]):
            weight = EI * arm.along[i, p]
            if weight == 0.0:
                continue
            bend, slope = curvature_and_slope(curvature[p], slopes[p], eta)
            for j in range(k):
                K, s = weight * curvature[p, j], weight * slopes[p, j]
                first = slope * slope * K + 2.0 * bend * slope * s
                second = 2.0 * bend * slope * K + bend * bend * s
                for t in range(j + 1):
                    tangent[j, t] += first * curvature[p, t] + second * slopes[p, t]
        for j in range(k):
            for t in range(k):
                dq[o + j, o + t] += tangent[max(j, t), min(j, t)]


@inner
def damping_jacobian(arm: Manipulator, work: Workspace, dqd: Array) -> None:
    """Add damping and the derivative of the friction to dqd (n, n); call it right after ``acceleration``."""
    for r in range(dqd.shape[0]):
        dqd[r, r] += arm.damping[r]
    for i in range(arm.length.size):
        if work.net[2, i] != 0.0:
            for r in range(dqd.shape[0]):
                force = work.net[2, i] * work.B[r, i]
                if force != 0.0:
                    for t in range(dqd.shape[0]):
                        dqd[r, t] += force * work.B[t, i]


@inner
def complete_jacobian(arm: Manipulator, q: Array, qd: Array, dq: Array, dqd: Array, flow: Array, work: Workspace
                      ) -> None:
    """Fill flow (n, 2 n), the derivatives of the accelerations by q and q', from the result of ``force_jacobian``.

    dq, dqd: (n, n) left and right of ``force_jacobian``; they are completed to derivatives of f. For any parameter on
    which f = M q'' + E + D q' + dV/dq - B tau depends, dqdd = -M^-1 df. Call it right after ``acceleration``: it reads
    the factor of M in work.M.
    """
    n = q.size
    elastic_jacobian(arm, q, dq, work)
    torque_jacobian(arm, q, qd, work, dq)
    damping_jacobian(arm, work, dqd)
    for r in range(n):
        for t in range(n):
            flow[r, t], flow[r, n + t] = dq[r, t], dqd[r, t]
    solve_columns(work.M, flow, 2 * n)
