"""Compiled derivatives of one link's inertia forces, in its own chord frame (see ``kernels.py``).

base_e, base_n: acceleration of the link's root in its frame [m/s^2]. Beside left = df/dq and
right = df/dqd, link 2 adds to work.columns: rows [dA''/deta, dB''/deta, dA'/deta, dB'/deta,
dA''/detad, dB''/detad] of its first moments.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from flexmanip_ros.numerics.compiled import inlined

if TYPE_CHECKING:
    from flexmanip_ros.arm.manipulator import Manipulator, Workspace
    from flexmanip_ros.types import Array


@inlined
def point_jacobian(
    m: float, cx: float, cy: float, arm: Manipulator, i: int, base_e: float, base_n: float,
    q: Array, qd: Array, qdd: Array, left: Array, right: Array, work: Workspace,
) -> None:
    """Add a point mass m [kg] at (cx, cy) [m] in the tip tangent frame of link i."""
    k = arm.kappa
    o = 2 + i * k
    w = qd[i]
    turn = qdd[i]
    alpha, alpha_d, alpha_dd = 0.0, 0.0, 0.0
    a = arm.length[i]
    for j in range(k):
        a -= 0.5 * arm.tip_stretch[i, j] * q[o + j] * q[o + j]
        alpha += arm.tip_slope[i, j] * q[o + j]
        alpha_d += arm.tip_slope[i, j] * qd[o + j]
        alpha_dd += arm.tip_slope[i, j] * qdd[o + j]
    px, py = 0.0, 0.0
    if cx != 0.0 or cy != 0.0:
        px = cx * np.cos(alpha) - cy * np.sin(alpha)
        py = cx * np.sin(alpha) + cy * np.cos(alpha)
    a += px
    b = py
    ad, bd = -py * alpha_d, px * alpha_d
    add = -px * alpha_d * alpha_d - py * alpha_dd
    bdd = -py * alpha_d * alpha_d + px * alpha_dd
    for j in range(k):
        stretch = arm.tip_stretch[i, j]
        ad -= stretch * q[o + j] * qd[o + j]
        add -= stretch * (qd[o + j] * qd[o + j] + q[o + j] * qdd[o + j])
    X = add - 2.0 * bd * w - b * turn - a * w * w + base_e
    Y = bdd + 2.0 * ad * w + a * turn - b * w * w + base_n
    Xw = -2.0 * bd - 2.0 * a * w
    Yw = 2.0 * ad - 2.0 * b * w
    right[i, i] += m * (a * Yw - b * Xw)
    for c in range(k):
        stretch, slope = arm.tip_stretch[i, c], arm.tip_slope[i, c]
        ac, bc = -stretch * q[o + c] - py * slope, px * slope
        adc, bdc = -stretch * qd[o + c] - px * slope * alpha_d, -py * slope * alpha_d
        addc = -stretch * qdd[o + c] - px * slope * alpha_dd + py * slope * alpha_d * alpha_d
        bddc = -py * slope * alpha_dd - px * slope * alpha_d * alpha_d
        Xc = addc - 2.0 * bdc * w - bc * turn - ac * w * w
        Yc = bddc + 2.0 * adc * w + ac * turn - bc * w * w
        Xr = 2.0 * adc - 2.0 * bc * w
        Yr = 2.0 * bdc + 2.0 * ac * w
        left[i, o + c] += m * (ac * Y + a * Yc - bc * X - b * Xc)
        right[i, o + c] += m * (a * Yr - b * Xr)
        right[o + c, i] += m * (ac * Xw + bc * Yw)
        for j in range(k):
            aj = -arm.tip_stretch[i, j] * q[o + j] - py * arm.tip_slope[i, j]
            bj = px * arm.tip_slope[i, j]
            ajc = -px * arm.tip_slope[i, j] * slope
            bjc = -py * arm.tip_slope[i, j] * slope
            if j == c:
                ajc -= stretch
            left[o + j, o + c] += m * (ajc * X + aj * Xc + bjc * Y + bj * Yc)
            right[o + j, o + c] += m * (aj * Xr + bj * Yr)
        if i == 1:
            columns = work.columns
            columns[0, c] += m * addc
            columns[1, c] += m * bddc
            columns[2, c] += m * adc
            columns[3, c] += m * bdc
            columns[4, c] += 2.0 * m * adc
            columns[5, c] += 2.0 * m * bdc


@inlined
def link_jacobian(
    arm: Manipulator, i: int, base_e: float, base_n: float, q: Array, qd: Array, qdd: Array,
    left: Array, right: Array, work: Workspace,
) -> None:
    """Add link i's distributed mass; work.Y, work.Z, work.stretch as ``kernels.add_link`` left them."""
    k = arm.kappa
    o = 2 + i * k
    w = qd[i]
    turn = qdd[i]
    if not arm.shortening:
        n0 = arm.half_mass[i]
        for j in range(k):
            left[i, o + j] += 2.0 * n0 * (q[o + j] * turn + w * qd[o + j])
            left[o + j, o + j] -= w * w * n0
            right[i, i] += 2.0 * n0 * q[o + j] * qd[o + j]
            right[i, o + j] += 2.0 * w * n0 * q[o + j]
            right[o + j, i] -= 2.0 * w * n0 * q[o + j]
    else:
        _bending_jacobian(arm, i, q, qd, qdd, left, right, work)
    if i == 1:
        columns = work.columns
        for c in range(k):
            slope_e = 0.0
            if arm.shortening:
                drift, rate = 0.0, 0.0
                for j in range(k):
                    S1 = arm.S1[i, c, j]
                    slope_e -= S1 * q[o + j]
                    drift -= S1 * qdd[o + j]
                    rate -= S1 * qd[o + j]
                    left[o + j, o + c] -= S1 * base_e
                columns[0, c] += drift
                columns[2, c] += rate
                columns[4, c] += 2.0 * rate
            left[i, o + c] += slope_e * base_n - arm.mean_shape[i, c] * base_e


@inlined
def _bending_jacobian(
    arm: Manipulator, i: int, q: Array, qd: Array, qdd: Array, left: Array, right: Array, work: Workspace,
) -> None:
    k = arm.kappa
    o = 2 + i * k
    w = qd[i]
    turn = qdd[i]
    Z, Y, pairs = work.Z, work.Y, work.pairs
    for p in range(k):
        for t in range(k):
            pairs[1, p, t] = q[o + p] * q[o + t]
            pairs[0, p, t] = (qd[o + p] * qd[o + t] + q[o + p] * qdd[o + t]
                              - 0.5 * w * w * pairs[1, p, t])
    for j in range(k):
        for m in range(j + 1):
            force, stretch = 0.0, 0.0
            for p in range(k):
                for t in range(k):
                    S = arm.Q[i, j, m, p, t]
                    force += S * pairs[0, p, t]
                    stretch += S * pairs[1, p, t]
            left[o + j, o + m] += force
            left[i, o + j] += w * stretch * qd[o + m]
            if m != j:
                left[o + m, o + j] += force
                left[i, o + m] += w * stretch * qd[o + j]
    for j in range(k):
        g = work.stretch[i, j]
        theta, rate, coriolis = turn * g, w * g, 0.0
        for m in range(k):
            v, wd, gyro, n2, k2, k3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for p in range(k):
                W = arm.W[i, p, j, m]
                v += W * q[o + p]
                gyro += (W - arm.W[i, j, p, m]) * qd[o + p]
                wd += arm.W[i, j, m, p] * qd[o + p]
                n2 += Z[i, j, m, p] * q[o + p]
                k2 += Z[i, j, m, p] * qdd[o + p]
                k3 += Z[i, j, m, p] * qd[o + p]
            skew = Y[i, m, j] - Y[i, j, m]
            dh = v + skew
            left[o + j, o + m] += turn * dh + k2 + 2.0 * w * gyro - w * w * (arm.C2[i, j, m] + n2)
            left[i, o + m] += qdd[o + j] * dh
            theta += (2.0 * w * (arm.C2[i, j, m] + n2) + wd) * qd[o + m]
            rate += 2.0 * v * qd[o + m]
            coriolis += skew * qd[o + m]
            right[o + j, o + m] += 2.0 * (w * skew + k3)
        left[i, o + j] += theta
        right[i, i] += g * qd[o + j]
        right[i, o + j] += rate
        right[o + j, i] += 2.0 * coriolis - w * g
