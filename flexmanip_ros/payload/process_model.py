"""Process model of the structured filter: the arm's equations carry the mean, their Jacobian the covariance.

The state is x = [q (n), qd (n), p]. p: what is not known of payload and arm, each entry of a ``Kind`` and a link (see
``ProcessModel.kind``); kinds that are not estimated stay at the value of the parameters. The covariance is S S' with
the square root S (nx, nx), which moves as S <- F S, F the Jacobian of the flow.
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.arm.equations_of_motion import STICTION_RATE, balance, inertial_forces, solve
from flexmanip_ros.arm.jacobian import add_body_forces, complete_jacobian, force_jacobian, solve_columns
from flexmanip_ros.arm.late_torque import late_torque
from flexmanip_ros.numerics.compiled import inner, kernel
from flexmanip_ros.numerics.square_root import dot, multiply
from flexmanip_ros.types import Array

if TYPE_CHECKING:
    from flexmanip_ros.arm.manipulator import Manipulator, Workspace
    from flexmanip_ros.numerics.square_root import Bounds

SERIES = 12
"""Terms of an exponential whose error does not matter: 1e-9 of what turns by one radian."""
STEP_ANGLE = 2.0
"""Largest angle [rad] the fastest mode may turn in an integration step."""
MOTION_ERROR = 1e-8
"""Share of the fastest mode that the motion's exponential leaves out in a step."""
MISS_ERROR = 1e-2
"""Of what the difference of the remainders adds, some 1e-8 of link 1 in a sample."""
SPREAD_ERROR = 1e-4
"""Of the spread's: it weighs, and need not be exact."""
AVERAGE_TERMS = 6
"""Terms of what foretells the mean over a step: the next is 3e-4 of what turns by 1.4 rad."""
MOST_TERMS = 30
"""Terms of an exponential at most: more than ``STEP_ANGLE`` needs."""
STIFF_STEP = 2.0
"""Longest step over the time constant of the stiffest damper: the series of the exponential converges quickly there."""
BEGIN, MEAN, END = range(3)
"""Stages of a step, by where the accelerations are evaluated: where it begins, at its mean state, where it ends."""
MOST_STEPS = 2000.0
"""Steps from a sample to the next: an arm that needs more is none."""
STIFFEST = 200.0
"""Rate of the stiffest damper over that of the fastest mode: an arm of which more is learned is none. A joint that
sticks in an arm as it is has five."""


class Kind(IntEnum):
    """What an entry of p is. The body's come first, then those of a link or joint."""

    MASS = 0
    """Mass of the payload [kg]."""
    FIRST_X = 1
    """Its first moment along the tangent of the tip, m c_x [kg m]."""
    FIRST_Y = 2
    """And to its left, m c_y [kg m]."""
    INERTIA = 3
    """Its inertia about the tip [kg m^2]."""
    STIFFNESS = 4
    """Logarithm of EI over its nominal value."""
    DAMPING = 5
    """Damping ratio."""
    VISCOUS = 6
    """Viscous friction of a joint [N m s/rad]."""
    COULOMB = 7
    """Coulomb friction of a joint [N m]."""
    ROTOR = 8
    """Rotor inertia of a joint [kg m^2]."""
    TORQUE_GAIN = 9
    """Logarithm of torque over reported effort."""
    BEND_GAIN = 10
    """Logarithm of measured over true bend."""
    BEND_OFFSET = 11
    """Measured bend of a straight link [m]."""
    MODE = 12
    """Logarithm of the stiffness of a mode beyond the first over what its link's stiffness gives; number link k + j."""
    TORQUE_DELAY = 13
    """Dead time from the reported efforts to the torques of all joints [s]."""
    TORQUE_LAG = 14
    """Time constant from the effort of a joint to its torque [s]."""
    BEND_DELAY = 15
    """Age of all bends in a sample beyond that of the angles [s]."""


# for the compiled functions, to which an enumeration is no constant
(MASS, FIRST_X, FIRST_Y, INERTIA, STIFFNESS, DAMPING, VISCOUS, COULOMB, ROTOR, TORQUE_GAIN, BEND_GAIN, BEND_OFFSET,
 MODE, TORQUE_DELAY, TORQUE_LAG, BEND_DELAY) = (int(kind) for kind in Kind)


class ProcessModel(NamedTuple):
    """The arm as the filter integrates it; what the state holds is written into ``arm`` before each use."""

    arm: Manipulator
    work: Workspace
    kind: NDArray[np.int64]
    """(np,) what each entry of p is."""
    link: NDArray[np.int64]
    """(np,) of which link or joint."""
    frozen: bool
    """Keep the mass matrix of the working point (a linear plant) instead of following the configuration."""
    M0: Array
    """(n, n) mass matrix of the empty arm at the working point, used when frozen."""
    Mp: Array
    """(4, n, n) its derivatives by the payload's inertial parameters."""
    stiffness: Array
    """(n,) nominal K."""
    damping: Array
    """(n,) D at a damping ratio of one."""
    rotary: Array
    """(n, n) nominal ``Manipulator.rotary``."""
    scale: float
    """Mass [kg] that the empty arm has at its tip."""
    least: Array
    """(2,) mass m_a [kg] and inertia I_a [kg m^2] below zero: a payload with (m - m_a) (I - I_a) >= |h|^2,
    m >= m_a / 2, keeps the mass matrix positive; h: its first moments."""
    least_rotor: Array
    """(L,) least rotor inertia [kg m^2], for the same reason."""
    substeps: float
    """Longest integration step [s]."""
    payload: Array
    """(4,) inertial parameters of the payload."""
    effort: Array
    """(L,) torques."""
    gain: Array
    """(L,) torque over reported effort."""
    late: Array
    """(L, 2) dead time and lag of the torques [s]."""
    slope: Array
    """(L, 2) derivatives of the torques by these."""
    opened: NDArray[np.int64]
    """(1 + np,) how many entries of p are not taken as known, then which these are."""
    bounds: Bounds
    """Scratch for what p can be."""
    p: Array
    """(np,) scratch."""
    a: Array
    k: Array
    dq: Array
    dqd: Array
    dp: Array
    G: Array
    """(n, 2 np) derivatives of the accelerations by the entries of p that are not taken as known, in this order: means
    over a step, then slopes; see ``parameter_columns``."""
    F: Array
    """(n, 2 n) derivative of the accelerations by q and q'."""
    X: Array
    """(2 n, 2 n) scratch."""
    Y: Array
    """(n, n) scratch."""
    scratch: Array
    """See ``spread_scratch``."""


@inner
def set_parameters(motion: ProcessModel, x: Array) -> None:
    """Write what the state holds of payload and arm into motion."""
    arm, payload = motion.arm, motion.payload
    n = arm.stiffness.size
    k, links = arm.kappa, arm.length.size
    for c in range(4):
        payload[c] = 0.0
    for i in range(links):
        motion.gain[i] = 1.0
    first_rotor = True
    for c in range(motion.kind.size):
        value, kind, i = x[2 * n + c], motion.kind[c], motion.link[c]
        o = links + i * k
        if kind <= INERTIA:
            payload[kind] = value
        elif kind == STIFFNESS:
            factor_EI = np.exp(value)
            for j in range(k):
                arm.stiffness[o + j] = motion.stiffness[o + j] * factor_EI
        elif kind == DAMPING:
            for j in range(k):
                arm.damping[o + j] = motion.damping[o + j] * value
        elif kind == VISCOUS:
            arm.viscous[i] = value
        elif kind == COULOMB:
            arm.coulomb[i] = value
        elif kind == ROTOR:
            for r in range(n):
                for t in range(n):
                    before = motion.rotary[r, t] if first_rotor else arm.rotary[r, t]
                    arm.rotary[r, t] = before + value * arm.joint[i, r] * arm.joint[i, t]
            first_rotor = False
        elif kind == TORQUE_GAIN:
            motion.gain[i] = np.exp(value)
        elif kind == MODE:
            arm.stiffness[links + i] *= np.exp(value)
        elif kind == TORQUE_DELAY:
            for joint in range(links):
                motion.late[joint, 0] = value
        elif kind == TORQUE_LAG:
            motion.late[i, 1] = value


@inner
def nonnegative(motion: ProcessModel, c: int) -> bool:
    """Whether entry c of p cannot be below zero: it takes energy away, or a torque would come before its effort."""
    return motion.kind[c] in (DAMPING, VISCOUS, COULOMB, TORQUE_DELAY, TORQUE_LAG)


@inner
def lower_bound(motion: ProcessModel, c: int) -> float:
    """Return the least that entry c of p can be: the mass matrix is positive, no damping or friction below zero."""
    kind = motion.kind[c]
    low: float = -np.inf
    if kind == MASS:
        low = 0.5 * motion.least[0]
    elif kind == ROTOR:
        low = motion.least_rotor[motion.link[c]]
    elif nonnegative(motion, c):
        low = 0.0
    return low


@inner
def gather_bounds(motion: ProcessModel, p: Array, S: Array, chance: float) -> int:
    """Write into motion.bounds by how much each bound is above p (np,), and the row of S that moves it.

    Returns the number of bounds; 0: p keeps them all. Those of zero are lower by ``chance`` standard deviations. What
    is taken as known has none. S: square root of the covariance, its last np rows are those of p.
    """
    first, count, violated = S.shape[0] - p.size, 0, False
    for c in range(p.size):
        violated |= p[c] < lower_bound(motion, c)
    if not violated:
        return 0
    rows, least, violated = motion.bounds.rows, motion.bounds.least, False
    for c in range(p.size):
        square = dot(S[first + c], S[first + c])
        low = lower_bound(motion, c)
        if low == -np.inf or square == 0.0:
            continue
        least[count] = low - p[c]
        if nonnegative(motion, c):
            least[count] -= chance * np.sqrt(square)
        violated |= least[count] > 0.0
        for r in range(S.shape[1]):
            rows[count, r] = S[first + c, r]
        count += 1
    return count if violated else 0


@inner
def keep_inertia(motion: ProcessModel, p: Array) -> float:
    """Raise the inertia in p (np,) to the least that mass and first moments leave; return by how much [kg m^2]."""
    if p.size <= INERTIA or motion.kind[INERTIA] != INERTIA:
        return 0.0
    moment = p[FIRST_X] * p[FIRST_X] + p[FIRST_Y] * p[FIRST_Y]
    before, least = p[INERTIA], motion.least[1] + moment / (p[MASS] - motion.least[0])
    p[INERTIA] = max(before, least)
    return float(p[INERTIA] - before)


@inner
def constant_mass(motion: ProcessModel) -> None:
    """Fill work.M with a mass matrix that stays, and work.E with zero."""
    M = motion.work.M
    for r in range(M.shape[0]):
        motion.work.E[r] = 0.0
        for c in range(r + 1):
            M[r, c] = motion.M0[r, c] + motion.arm.rotary[r, c] - motion.rotary[r, c]
            for p in range(4):
                M[r, c] += motion.payload[p] * motion.Mp[p, r, c]


@inner
def accelerate(motion: ProcessModel, q: Array, qd: Array, qdd: Array) -> bool:
    """Fill qdd (n,) under motion.effort; leaves the factor of M in work.M."""
    if motion.frozen:
        constant_mass(motion)
    else:
        inertial_forces(motion.arm, motion.payload, q, qd, motion.work)
    return balance(motion.arm, q, qd, motion.effort, qdd, motion.work)


@inner
def constant_mass_jacobian(motion: ProcessModel, qdd: Array) -> None:
    """The same as ``force_jacobian`` for a mass matrix that stays."""
    for r in range(qdd.size):
        for c in range(qdd.size):
            motion.dq[r, c] = 0.0
            motion.dqd[r, c] = 0.0
        for p in range(4):
            motion.dp[r, p] = 0.0
            for c in range(qdd.size):
                motion.dp[r, p] += motion.Mp[p, r, c] * qdd[c]


@inner
def linearize(motion: ProcessModel, q: Array, qd: Array, qdd: Array) -> None:
    """Fill motion.F (n, 2 n), the derivatives of the accelerations by q and q'; right after ``accelerate`` there."""
    if motion.frozen:
        constant_mass_jacobian(motion, qdd)
    else:
        force_jacobian(motion.arm, motion.payload, q, qd, qdd, motion.dq, motion.dqd, motion.dp, motion.work)
    complete_jacobian(motion.arm, q, qd, motion.dq, motion.dqd, motion.F, motion.work)


@inner
def differentiate(motion: ProcessModel, qd: Array, qdd: Array, jerk: Array) -> None:
    """Fill jerk (n,) with the rate of the accelerations, by the linearization."""
    n = qd.size
    for r in range(n):
        jerk[r] = 0.0
        for j in range(n):
            jerk[r] += motion.F[r, j] * qd[j] + motion.F[r, n + j] * qdd[j]


@inner
def within_step(motion: ProcessModel, h: float) -> None:
    """Fill rows 4 to 6 of motion.k with the slopes of q, q' and q'' over a step h, by s from -1 to 1 in it.

    Those of the lines through their values at Gauss's two points, s^2 = 1/3, whose mean is that over the step but for
    1e-3 of what turns by 1.4 rad: h / 2 z' + h^3 / 144 z^(3) + ...
    """
    n = motion.arm.stiffness.size
    qd, qdd, slope = motion.k[17], motion.k[8], motion.k[4:7]
    jerk, fourth, fifth = motion.k[9], motion.k[10], motion.k[11]
    differentiate(motion, qd, qdd, jerk)
    differentiate(motion, qdd, jerk, fourth)
    differentiate(motion, jerk, fourth, fifth)
    first, third = h / 2.0, h ** 3 / 144.0
    for r in range(n):
        slope[0, r] = first * qd[r] + third * jerk[r]
        slope[1, r] = first * qdd[r] + third * fourth[r]
        slope[2, r] = first * jerk[r] + third * fifth[r]


@inner
def parameter_columns(motion: ProcessModel, h: float) -> None:
    """Fill motion.G with the derivatives of the accelerations by what is not known of p, as lines over a step h.

    Their means come first, in ``motion.opened`` columns, then their slopes, by s from -1 to 1 in the step. A parameter
    acts through what vibrates: a stiffness through the bend, which turns by a radian within a sample. Right after
    ``linearize`` at the mean state. Of Coulomb friction the mean alone is taken.
    """
    n, opened = motion.arm.stiffness.size, motion.opened[0]
    if opened == 0:
        return
    within_step(motion, h)
    balance_columns(motion, motion.k[16], motion.k[17], motion.k[8], 0)
    for r in range(n):
        for p in range(4):
            motion.dp[r, p] = 0.0
    add_payload_columns(motion, motion.k[6])
    balance_columns(motion, motion.k[4], motion.k[5], motion.k[6], opened)
    solve_columns(motion.work.M, motion.G, 2 * opened)


@inner
def add_payload_columns(motion: ProcessModel, qdd: Array) -> None:
    """Add to motion.dp (n, 4), the derivative of the forces by the payload's parameters, that of accelerations qdd."""
    if not motion.frozen:
        add_body_forces(motion.arm, motion.k[16], qdd, motion.dp, motion.work)
        return
    for r in range(qdd.size):
        for p in range(4):
            for c in range(qdd.size):
                motion.dp[r, p] += motion.Mp[p, r, c] * qdd[c]


@inner
def balance_columns(motion: ProcessModel, q: Array, qd: Array, qdd: Array, first: int) -> None:
    """Fill columns ``first``... of motion.G with derivatives of M qdd + E + D qd + dV/dq - B tau by p, motion.dp known.

    first: 0 for the values at q (n,), the mean, otherwise for their slopes, where q, qd and qdd are slopes.
    """
    arm, net, G = motion.arm, motion.work.net, motion.G
    n, k, links = arm.stiffness.size, arm.kappa, arm.length.size
    for c in range(motion.opened[0]):
        kind, i = motion.kind[motion.opened[1 + c]], motion.link[motion.opened[1 + c]]
        o, at = links + i * k, first + c
        for r in range(n):
            G[r, at] = 0.0
        if kind <= INERTIA:
            for r in range(n):
                G[r, at] = motion.dp[r, kind]
        elif kind == STIFFNESS:
            for j in range(k):
                G[o + j, at] = motion.work.elastic[o + j] if first == 0 else arm.stiffness[o + j] * q[o + j]
        elif kind == DAMPING:
            for j in range(k):
                G[o + j, at] = motion.damping[o + j] * qd[o + j]
        elif kind == MODE:
            G[links + i, at] = arm.stiffness[links + i] * q[links + i]
        elif kind == ROTOR:
            turn = 0.0
            for r in range(n):
                turn += arm.joint[i, r] * qdd[r]
            for r in range(n):
                G[r, at] = arm.joint[i, r] * turn
        elif kind == VISCOUS:
            rate = 0.0
            for r in range(n):
                rate += motion.work.B[r, i] * qd[r]
            for r in range(n):
                G[r, at] = rate * motion.work.B[r, i]
        elif first > 0:
            continue
        elif kind == TORQUE_DELAY:
            for joint in range(links):
                for r in range(n):
                    G[r, at] -= motion.slope[joint, 0] * motion.work.B[r, joint]
        else:
            force = 0.0
            if kind == COULOMB:
                force = np.tanh(net[1, i] / STICTION_RATE)
            elif kind == TORQUE_GAIN:
                force = -motion.effort[i]
            elif kind == TORQUE_LAG:
                force = -motion.slope[i, 1]
            if force != 0.0:
                for r in range(n):
                    G[r, at] = force * motion.work.B[r, i]


@inner
def friction_step(motion: ProcessModel, duration: float) -> float:
    """Return the longest step [s] if Coulomb friction may change its sign within a time [s]: it bends the motion.

    Right after ``accelerate``, to motion.k[0]. Infinite: it will not. A joint that sticks is a stiff damper, of which
    the rate is the slope of its friction times b' M^-1 b, b its column of B.
    """
    arm, work, qdd, column = motion.arm, motion.work, motion.k[0], motion.k[9]
    step: float = np.inf
    for i in range(arm.length.size):
        if arm.coulomb[i] == 0.0:
            continue
        change = 0.0
        for r in range(qdd.size):
            change += arm.joint[i, r] * qdd[r]
        if abs(work.net[1, i]) >= 3.0 * STICTION_RATE + duration * abs(change):
            continue
        for r in range(qdd.size):
            column[r] = work.B[r, i]
        solve(work.M, column)
        mobility = 0.0
        for r in range(qdd.size):
            mobility += work.B[r, i] * column[r]
        step = min(step, 0.5 * motion.substeps, STIFF_STEP / max(work.net[2, i] * mobility, 1e-9))
    return step


@inner
def terms(angle: float, error: float) -> int:
    """Return how many terms of an exponential leave out less than an error: angle^k / k! < error."""
    k, left = 1, angle
    while left > error and k < MOST_TERMS:
        k += 1
        left *= angle / k
    return k


@inner
def note_opened(motion: ProcessModel, S: Array, used: int) -> None:
    """Write into motion which entries of p are not taken as known: their rows of S are not zero."""
    count, first = 0, S.shape[0] - motion.kind.size
    for p in range(motion.kind.size):
        for c in range(used):
            if S[first + p, c] != 0.0:
                count += 1
                motion.opened[count] = p
                break
    motion.opened[0] = count


@kernel
def predict(
    motion: ProcessModel, x: Array, S: Array, used: int, rows: Array, period: float, duration: float,
) -> int:
    """Carry x and S over a time [s] with the torque held. Return in how many steps; 0: numbers left the finite range.

    used: number of columns of S, the first ones, that are not zero; rows: (P, >= 1 + L) columns 1 to L of the last one
    are the efforts held meanwhile [N m], those before it are what the torque depends on too; period: their sample time
    [s]. motion.k[0] is then the acceleration at the end. A time of zero only linearizes at x: motion.k[0] and F.
    """
    n, taken = motion.arm.stiffness.size, 0
    set_parameters(motion, x)
    note_opened(motion, S, used)
    for i in range(motion.effort.size):
        late, slope = motion.late[i], motion.slope[i]
        motion.effort[i] = motion.gain[i] * late_torque(rows, 1 + i, late[0], late[1], period, slope)
        slope[0] *= motion.gain[i]
        slope[1] *= motion.gain[i]
    left, stiff, h, steps, turn, stage = duration, 0.0, 0.0, 0.0, 0.0, BEGIN
    q, qd, qdd = x[:n], x[n:2 * n], motion.k[0]
    while True:
        # the only call: the equations of motion are compiled into this loop
        if not accelerate(motion, q, qd, qdd):
            return 0
        if stage == MEAN:
            linearize(motion, q, qd, qdd)
            if duration <= 0.0:
                return 1
            stiff = 0.0
            for r in range(n):
                stiff -= motion.F[r, n + r]
            if stiff * h > 1.1 * STIFF_STEP:
                q, qd, qdd, stage = x[:n], x[n:2 * n], motion.k[0], BEGIN
                continue
            turn = max(STEP_ANGLE / motion.substeps, stiff) * h
            if used > 0:
                parameter_columns(motion, h)
                spread(motion.F, motion.G, motion.opened, S, used, motion.scratch, h, terms(turn, SPREAD_ERROR))
            lead(motion, x, h, turn)
            q, qd, qdd, stage = motion.k[18], motion.k[19], motion.k[0], END
            continue
        if stage == END:
            if not arrive(motion, x, h, turn):
                return 0
            taken += 1
            if steps <= 1.0:
                return taken
            left -= h  # the next step begins with the acceleration at the end of this one
        longest = min(motion.substeps, friction_step(motion, left), STIFF_STEP / max(stiff, 1e-9))
        steps = max(np.ceil(left / longest - 1e-9), 1.0)
        if not (steps < MOST_STEPS and stiff * motion.substeps < STIFFEST * STIFF_STEP):
            return 0
        h = left / steps
        average(motion, x, h)
        q, qd, qdd, stage = motion.k[16], motion.k[17], motion.k[8], MEAN


@inner
def average(motion: ProcessModel, x: Array, h: float) -> None:
    """Foretell the means of q and q' over a step, rows 16 and 17 of motion.k; right after ``accelerate`` at x.

    By an exponential Euler step of which the linear part is stiffness, damping and friction: what vibrates fast turns
    by 1.4 rad in a sample. The Jacobian is nearly linear in q and q', so that its mean is that at their means: with it
    the spread is as exact over seconds as with two steps linearized at their midpoints.
    """
    n, arm, work = motion.arm.stiffness.size, motion.arm, motion.work
    qdd, place, rate, q, qd = motion.k[0], motion.k[9], motion.k[10], motion.k[16], motion.k[17]
    for r in range(n):
        place[r], rate[r] = h * x[n + r], h * qdd[r]
        q[r], qd[r] = x[r] + 0.5 * place[r], x[n + r] + 0.5 * rate[r]
    force = motion.k[11]
    for order in range(2, AVERAGE_TERMS + 1):
        for r in range(n):
            force[r] = -arm.stiffness[r] * place[r] - arm.damping[r] * rate[r]
        for i in range(arm.length.size):
            if work.net[2, i] != 0.0:
                turned = 0.0
                for r in range(n):
                    turned += work.B[r, i] * rate[r]
                for r in range(n):
                    force[r] -= work.net[2, i] * turned * work.B[r, i]
        solve(work.M, force)
        for r in range(n):
            place[r] = h / order * rate[r]
            rate[r] = h / order * force[r]
            q[r] += place[r] / (order + 1)
            qd[r] += rate[r] / (order + 1)


@inner
def remainder(motion: ProcessModel, q: Array, qd: Array, qdd: Array, lacks: Array) -> None:
    """Fill lacks (n,) with what the linearization misses of the acceleration qdd at q and q'."""
    n = motion.arm.stiffness.size
    middle, about, rate = motion.k[8], motion.k[16], motion.k[17]
    for i in range(n):
        lacks[i] = qdd[i] - middle[i]
        for j in range(n):
            lacks[i] -= motion.F[i, j] * (q[j] - about[j]) + motion.F[i, n + j] * (qd[j] - rate[j])


@inner
def lead(motion: ProcessModel, x: Array, h: float, turn: float) -> None:
    """Fill rows 18 and 19 of motion.k with where r0 alone leads in a step h; right after ``linearize`` at its mean.

    turn: of the fastest mode in the step [rad].

    An exponential integrator (Hochbruck and Ostermann, Acta Numerica 19, 2010) about the mean state: x' = g(x) + r, g
    the linearization, r its remainder. With s from -1 to 1 in the step, x is its mean and a s + b (s^2 - 1/3) + ...;
    r, of second order in that, is even in s^2 and odd in s^3 - s / 3. Its values r0 and r1 at both ends tell how much:
    r = s^2 (r0 + r1) / 2 + (3 s^3 - s) / 2 (r1 - r0) / 2, and the step is of fourth order. It is symmetric in time but
    for r1, taken where r0 alone leads. The vibration turns too far in one sample for a step of Runge and Kutta: their
    damping of the fastest mode read as 0.3 % of the payload.
    """
    n = motion.arm.stiffness.size
    qdd, first, difference = motion.k[0], motion.k[3], motion.k[15]
    place, rate, moved = motion.k[10], motion.k[11], motion.k[12:14]
    for i in range(n):
        for j in range(n):  # by columns, which ``series`` reads in a row
            motion.X[j, i], motion.Y[j, i] = motion.F[i, j], motion.F[i, n + j]
    remainder(motion, x[:n], x[n:2 * n], qdd, first)
    for i in range(n):
        place[i], rate[i] = x[n + i], qdd[i] - first[i]
        difference[i] = 0.0
    series(motion, h, terms(turn, MOTION_ERROR))
    end, ending = motion.k[18], motion.k[19]
    for i in range(n):
        end[i] = x[i] + moved[0, i]
        ending[i] = x[n + i] + moved[1, i]


@inner
def arrive(motion: ProcessModel, x: Array, h: float, turn: float) -> bool:
    """Put x where r0 and r1 lead; right after ``accelerate`` where ``lead`` led."""
    n = motion.arm.stiffness.size
    first, difference, end, ending = motion.k[3], motion.k[15], motion.k[18], motion.k[19]
    place, rate, moved = motion.k[10], motion.k[11], motion.k[12:14]
    remainder(motion, end, ending, motion.k[0], difference)
    for i in range(n):
        difference[i] -= first[i]
        place[i], rate[i], first[i] = 0.0, 0.0, 0.0
    series(motion, h, terms(turn, MISS_ERROR))
    largest = 0.0
    for i in range(n):
        x[i] = end[i] + moved[0, i]
        x[n + i] = ending[i] + moved[1, i]
        largest += abs(x[i]) + abs(x[n + i])
    return largest < 1e6


@inner
def series(motion: ProcessModel, h: float, count: int) -> None:
    """Fill rows 12 and 13 of motion.k with what a step h of x' = g + F x + r adds to x = 0, in ``count`` terms.

    g stands in rows 10 and 11 (positions, rates), of r the factors of s^2 and s^2 / 2 + (3 s^3 - s) / 4 =
    6 u^3 - 7 u^2 + 2 u, u = (1 + s) / 2 the share of the step, in rows 3 and 15. u^k adds h k! phi_{k + 1}(h F),
    phi_l(z) the sum of z^j / (j + l)!. By Horner's rule; the columns of motion.F are the rows of motion.X and Y.
    """
    n = motion.arm.stiffness.size
    even, odd, place, rate, following = motion.k[3], motion.k[15], motion.k[10], motion.k[11], motion.k[14]
    moved, moving = motion.k[12], motion.k[13]
    weight = h
    for j in range(1, count):
        weight /= j + 1
    for i in range(n):
        moved[i], moving[i] = 0.0, 0.0
    for j in range(count - 1, -1, -1):
        for i in range(n):
            following[i] = 0.0
        if j < count - 1:
            for c in range(n):
                by_place, by_rate, at, going = motion.X[c], motion.Y[c], moved[c], moving[c]
                for i in range(n):
                    following[i] += by_place[i] * at + by_rate[i] * going
        of_even = weight * (j * j + j + 2) / ((j + 2) * (j + 3))
        of_odd = weight * (2 * j * j + 4) / ((j + 2) * (j + 3) * (j + 4))
        for i in range(n):
            moved[i] = h * moving[i] + weight * place[i]
            moving[i] = h * following[i] + weight * rate[i] + of_even * even[i] + of_odd * odd[i]
        weight *= j + 1


@kernel
def spread(
    flow: Array, G: Array, opened: NDArray[np.int64], S: Array, used: int, scratch: Array, h: float, count: int,
) -> None:
    """S <- F S in its first ``used`` columns, F the Taylor series of the linearised flow over h, ``count`` terms.

    By Horner's rule, each term one product with the derivatives of the accelerations by q and q', flow (n, 2 n). G:
    those by the entries of p in ``opened``, which stay, see ``parameter_columns``; of s = 2 u - 1, u the share of the
    step, term j takes -j / (j + 2). scratch: see ``spread_scratch``.
    """
    n, known, count_p = flow.shape[0], 2 * flow.shape[0], opened[0]
    size = n * used
    start, now, rates = scratch[:2 * size], scratch[2 * size:4 * size], scratch[4 * size:5 * size]
    mean, slope, rest = scratch[5 * size:6 * size], scratch[6 * size:7 * size], scratch[7 * size:]
    parameters = rest[:count_p * used].reshape((count_p, used))
    columns = rest[count_p * used:count_p * (used + n)].reshape((n, count_p))
    for r in range(known):
        for c in range(used):
            start[r * used + c] = S[r, c]
            now[r * used + c] = S[r, c]
    for p in range(count_p):
        for c in range(used):
            parameters[p, c] = S[known + opened[1 + p], c]
    for part in range(2):
        product = mean if part == 0 else slope
        for r in range(n):
            for p in range(count_p):
                columns[r, p] = G[r, part * count_p + p]
        for c in range(size):
            product[c] = 0.0
        if count_p > 0:
            multiply(columns, parameters, product.reshape((n, used)))
    place, rate, moved, moving = start[:size], start[size:], now[:size], now[size:]
    for order in range(count, 0, -1):
        multiply(flow, now.reshape((known, used)), rates.reshape((n, used)))
        weight, moment = h / order, (1.0 - order) / (order + 1.0)
        for c in range(size):
            moved[c] = place[c] + weight * moving[c]
        for c in range(size):
            moving[c] = rate[c] + weight * (rates[c] + mean[c] + moment * slope[c])
    for r in range(known):
        for c in range(used):
            S[r, c] = now[r * used + c]


def spread_scratch(n: int, size: int, columns: int) -> Array:
    """Allocate for n coordinates, ``size`` entries of p, and square roots of at most so many columns."""
    return np.zeros(7 * n * columns + size * (columns + n))
