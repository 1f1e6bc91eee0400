"""Process model of the structured filter: the arm's equations carry the mean, their Jacobian the covariance.

The state is x = [q (n), qd (n), d (n - 4), p (6)]. d: modal stiffness deviation, the logarithm of the stiffness of each
mode beyond a link's first over what the link's stiffness factor gives, link 1 first. p = [payload, logarithm of the
stiffness factors of links 1 and 2, damping ratios 1 and 2, logarithm of the rotary inertia]. The covariance is S S'
with the square root S (nx, nx), which moves as S <- F S, F the Jacobian of the flow.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from flexmanip_ros.arm.equations_of_motion import acceleration, factor, solve
from flexmanip_ros.arm.jacobian import acceleration_jacobian
from flexmanip_ros.numerics.compiled import inlined, kernel, merged
from flexmanip_ros.types import Array

if TYPE_CHECKING:
    from flexmanip_ros.arm.manipulator import Manipulator, Workspace

PARAMETERS = 6
"""Last states: payload, two stiffness factors (logarithm), two damping ratios, rotary inertia (logarithm)."""
SERIES = 12
"""Terms of the motion's exponential: 1e-9 of the fastest mode at one radian a step."""
SPREAD_SERIES = 6
"""Terms of the spread's: it weighs, and need not be exact."""


class ProcessModel(NamedTuple):
    """The arm as the filter integrates it; stiffness and damping in ``arm`` are set from the state."""

    arm: Manipulator
    work: Workspace
    frozen: bool
    """Hold the mass matrix at the working point (a linear plant) instead of following the configuration."""
    M0: Array
    """(n, n) mass matrix of the empty arm at the working point, used when frozen."""
    Mp: Array
    """(n, n) its derivative by the payload."""
    Mi: Array
    """(n, n) its derivative by the payload's rotary inertia."""
    stiffness: Array
    """(n,) nominal K."""
    damping: Array
    """(n,) D at a damping ratio of one."""
    inertia: float
    """Rotary inertia [kg m^2] of state zero; 0: a point mass."""
    scale: float
    """Payload [kg] of state zero when something is held."""
    least: float
    """Least payload [kg] of an arm thought empty: keeps the mass matrix positive."""
    substeps: float
    """Longest integration step [s]."""
    payload: Array
    a: Array
    q: Array
    k: Array
    dq: Array
    dqd: Array
    dp: Array
    G: Array
    X: Array
    Y: Array


@inlined
def payload_mass(motion: ProcessModel, state: float, held: bool) -> float:
    """Payload [kg] from its state: scale exp(state) > 0 when something is held, else the state itself."""
    if held:
        return motion.scale * float(np.exp(min(state, 12.0)))
    return max(state, motion.least)


@merged
def set_parameters(motion: ProcessModel, x: Array, held: bool) -> None:
    """Write payload, stiffness and damping of the state into the arm."""
    n = motion.q.size
    k = (n - 2) // 2
    p = x.size - PARAMETERS
    motion.payload[0] = payload_mass(motion, x[p], held)
    motion.payload[1] = 0.0
    if held and motion.inertia > 0.0:
        motion.payload[1] = motion.inertia * np.exp(min(x[p + 5], 12.0))
    for link in range(2):
        ratio = x[p + 3 + link]
        for mode in range(k):
            j = 2 + link * k + mode
            factor_EI = x[p + 1 + link]
            if mode > 0:
                factor_EI += x[2 * n + link * (k - 1) + mode - 1]
            motion.arm.stiffness[j] = motion.stiffness[j] * np.exp(factor_EI)
            motion.arm.damping[j] = motion.damping[j] * ratio


@inlined
def accelerate(motion: ProcessModel, q: Array, qd: Array, effort: Array, qdd: Array) -> bool:
    """Fill qdd (n,); leaves the factor of M in work.M."""
    if not motion.frozen:
        return acceleration(motion.arm, motion.payload, q, qd, effort, qdd, motion.work)
    arm, M = motion.arm, motion.work.M
    n = q.size
    for r in range(n):
        for c in range(r + 1):
            M[r, c] = motion.M0[r, c]
            M[r, c] += motion.payload[0] * motion.Mp[r, c] + motion.payload[1] * motion.Mi[r, c]
    if not factor(M):
        return False
    for r in range(n):
        qdd[r] = (arm.torque[r, 0] * effort[0] + arm.torque[r, 1] * effort[1]
                  - arm.stiffness[r] * q[r] - arm.damping[r] * qd[r])
    solve(M, qdd)
    return True


@kernel
def linearize(motion: ProcessModel, q: Array, qd: Array, effort: Array, qdd: Array, held: bool) -> bool:
    """Fill qdd and its derivatives: motion.dq, motion.dqd (n, n), motion.G by d and p."""
    n = q.size
    k = (n - 2) // 2
    deviations = motion.G.shape[1] - PARAMETERS
    arm, M, a, G = motion.arm, motion.work.M, motion.a, motion.G
    if motion.frozen:
        if not accelerate(motion, q, qd, effort, qdd):
            return False
        for c in range(n + 2):
            for r in range(n):
                a[r] = 0.0
            if c >= n:
                share = motion.Mp if c == n else motion.Mi
                for r in range(n):
                    for j in range(n):
                        a[r] -= share[r, j] * qdd[j]
            else:
                a[c] = -arm.stiffness[c]
            solve(M, a)
            for r in range(n):
                if c >= n:
                    motion.dp[r, c - n] = a[r]
                else:
                    motion.dq[r, c] = a[r]
                    bends = arm.stiffness[c] > 0.0
                    motion.dqd[r, c] = a[r] * arm.damping[c] / arm.stiffness[c] if bends else 0.0
    elif not acceleration_jacobian(
            arm, motion.payload, q, qd, effort, qdd, motion.dq, motion.dqd, motion.dp, motion.work):
        return False
    rate = motion.payload[0] if held else 1.0
    for r in range(n):
        for c in range(1, 5):
            G[r, deviations + c] = 0.0
        G[r, deviations] = motion.dp[r, 0] * rate
        G[r, deviations + 5] = motion.dp[r, 1] * motion.payload[1]
    for link in range(2):
        for mode in range(k):
            j = 2 + link * k + mode
            for r in range(n):
                a[r] = 0.0
            a[j] = 1.0
            solve(M, a)
            for r in range(n):
                by_stiffness = -arm.stiffness[j] * q[j] * a[r]
                G[r, deviations + 1 + link] += by_stiffness
                G[r, deviations + 3 + link] -= motion.damping[j] * qd[j] * a[r]
                if mode > 0:
                    G[r, link * (k - 1) + mode - 1] = by_stiffness
    return True


@kernel
def predict(motion: ProcessModel, x: Array, S: Array, effort: Array, duration: float, held: bool) -> bool:
    """Carry x and S over a time [s] with the torque held; False when numbers left the finite range."""
    if duration <= 0.0:
        return True
    set_parameters(motion, x, held)
    steps = max(int(np.ceil(duration / motion.substeps)), 1)
    for _ in range(steps):
        if not exponential_step(motion, x, effort, duration / steps, held):
            return False
        spread(motion, S, duration / steps)
    return True


@merged
def exponential_step(motion: ProcessModel, x: Array, effort: Array, h: float, held: bool) -> bool:
    """Advance x by h, exactly where the motion is linear; leaves the linearisation at the start in motion.

    Exponential Rosenbrock method of third order: x1 = x + h phi_1(h F) f(x), then x1 + 2 h phi_3(h F) of what
    f(x1) - f(x) misses of F (x1 - x). The vibration turns too far in one sample for a step of Runge and
    Kutta: their damping of the fastest mode read as 0.3 % of payload.
    """
    n = motion.q.size
    q, qd = x[:n], x[n:2 * n]
    total, term = motion.k[1:3], motion.k[4:6]
    if not linearize(motion, q, qd, effort, motion.k[0], held):
        return False
    for i in range(n):
        term[0, i] = qd[i]
        term[1, i] = motion.k[0, i]
    series(motion, h, 1, h)
    for i in range(n):
        x[i] += total[0, i]
        x[n + i] += total[1, i]
    if not motion.frozen:
        if not accelerate(motion, q, qd, effort, motion.k[3]):
            return False
        for i in range(n):
            missed = motion.k[3, i] - motion.k[0, i]
            for j in range(n):
                missed -= motion.dq[i, j] * total[0, j] + motion.dqd[i, j] * total[1, j]
            term[0, i] = 0.0
            term[1, i] = missed / 6.0
        series(motion, h, 3, 2.0 * h)
        for i in range(n):
            x[i] += total[0, i]
            x[n + i] += total[1, i]
    largest = 0.0
    for i in range(2 * n):
        largest += abs(x[i])
    return largest < 1e6


@merged
def series(motion: ProcessModel, h: float, first: int, scale: float) -> None:
    """Fill total with scale x phi_first(h F) v, F the linearisation, phi_l(z) = sum of z^j / (j + l)!.

    v / first! stands in rows 4, 5 of motion.k (positions, rates) and is used up; total: rows 1, 2.
    """
    n = motion.q.size
    total, term, following = motion.k[1:3], motion.k[4:6], motion.k[6:8]
    for part in range(2):
        for i in range(n):
            total[part, i] = scale * term[part, i]
    for order in range(first + 1, first + SERIES):
        weight = h / order
        for i in range(n):
            value = 0.0
            for j in range(n):
                value += motion.dq[i, j] * term[0, j] + motion.dqd[i, j] * term[1, j]
            following[0, i] = weight * term[1, i]
            following[1, i] = weight * value
        for part in range(2):
            for i in range(n):
                term[part, i] = following[part, i]
                total[part, i] += scale * following[part, i]


@merged
def spread(motion: ProcessModel, S: Array, h: float) -> None:
    """S <- F S, F the Taylor series of the linearised flow over h."""
    n = motion.q.size
    nx = S.shape[1]
    X, Y = motion.X, motion.Y
    for i in range(2 * n):
        for c in range(nx):
            X[i, c] = S[i, c]
    weight = 1.0
    for order in range(1, SPREAD_SERIES + 1):
        for i in range(n):
            for c in range(nx):
                Y[i, c] = X[n + i, c]
                Y[n + i, c] = 0.0
            for j in range(n):
                a = motion.dq[i, j]
                b = motion.dqd[i, j]
                for c in range(nx):
                    Y[n + i, c] += a * X[j, c] + b * X[n + j, c]
        if order == 1:
            for i in range(n):
                for p in range(motion.G.shape[1]):
                    g = motion.G[i, p]
                    for c in range(nx):
                        Y[n + i, c] += g * S[2 * n + p, c]
        weight *= h / order
        for i in range(2 * n):
            for c in range(nx):
                S[i, c] += weight * Y[i, c]
                X[i, c] = Y[i, c]
