"""Process model of the structured filter: the arm's equations carry the mean, their Jacobian the covariance.

The state is x = [q (n), qd (n), p]. p holds what is not known of payload and arm; each entry has a ``Kind`` and a link
(``ProcessModel.kind``). What is not estimated keeps the value of its parameter. The covariance is S S' with the square
root S (nx, nx). Over a step S becomes F S, with F the derivative of the new state by the old one.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.arm.equations_of_motion import STICTION_RATE, balance, inertial_forces, solve
from flexmanip_ros.arm.jacobian import (
    add_body_forces,
    add_length_forces,
    add_mass_forces,
    add_weight,
    complete_jacobian,
    force_jacobian,
    solve_columns,
)
from flexmanip_ros.arm.late_torque import late_torque
from flexmanip_ros.arm.manipulator import Manipulator, Workspace
from flexmanip_ros.numerics.compiled import inner, separate, separate_kernel
from flexmanip_ros.numerics.square_root import Bounds, dot, multiply, ordered_dot
from flexmanip_ros.types import Array

SERIES = 12
"""Terms of the exponential series where its cost does not matter: the rest is 1e-9 for a mode that turns by 1 rad."""
STEP_ANGLE = 2.0
"""Largest angle [rad] by which the fastest mode may turn in an integration step."""
MOTION_ERROR = 1e-8
"""Relative error of the fastest mode in a step, by the truncated exponential series of the motion."""
SPREAD_ERROR = 1e-4
"""The same for the square root of the covariance, which only weighs measurements and may be less exact, and for what
the remainder at Radau's points adds to the motion, which is some 1e-8 of it."""
AVERAGE_TERMS = 6
"""Terms of the series that predicts the mean state of a step; the next is 3e-4 for a mode that turns by 1.4 rad."""
MOST_TERMS = 30
"""Largest number of terms of an exponential series: more than ``STEP_ANGLE`` needs."""
STIFF_STEP = 2.0
"""Longest step over the time constant of the stiffest damper: up to there the exponential series converges quickly."""
BEGIN, MEAN, WITHIN = range(3)
"""Stages of a step, by where the accelerations are evaluated: where it begins, at its mean state, at ``RADAU``."""
RADAU = np.array([0.6 - np.sqrt(0.06), 0.6 + np.sqrt(0.06), 1.0])
"""Shares of a step: Radau's points beyond the begin (quadrature of fifth order), where the remainder is evaluated, and
the end."""
TO_POWERS = np.linalg.solve(np.vander(np.append(0.0, RADAU[:2]), increasing=True), np.eye(3))
"""Coefficients of the powers of that share, from the values at the begin and at Radau's two points."""
MOST_STEPS = 2000.0
"""Largest number of steps from a sample to the next: parameters that need more belong to no real arm."""
STIFFEST = 200.0
"""Largest rate of the stiffest damper over that of the fastest mode: beyond it the learned parameters belong to no real
arm. The friction of a joint that sticks reaches five."""


class Kind(IntEnum):
    """What an entry of p is: first the inertial parameters of the payload, then those of a link or joint."""

    MASS = 0
    """Mass of the payload [kg]."""
    FIRST_X = 1
    """Its first moment along the tangent of the tip, m c_x [kg m]."""
    FIRST_Y = 2
    """And to its left, m c_y [kg m]."""
    INERTIA = 3
    """Its inertia about the tip [kg m^2]."""
    POINT = 4
    """Angle between the links at which a linear plant stays, less that of ``freeze`` [rad]."""
    CONSTANT = 5
    """Error of the given lengths, densities and masses along a principal axis, over its deviation."""
    STIFFNESS = 6
    """Logarithm of EI over its nominal value."""
    DAMPING = 7
    """Damping ratio."""
    VISCOUS = 8
    """Viscous friction of a joint [N m s/rad]."""
    COULOMB = 9
    """Coulomb friction of a joint [N m]."""
    ROTOR = 10
    """Rotor inertia of a joint [kg m^2]."""
    TORQUE_GAIN = 11
    """Logarithm of torque over reported effort."""
    BEND_GAIN = 12
    """Logarithm of measured over true bend."""
    BEND_OFFSET = 13
    """Measured bend of a straight link [m]."""
    MODE = 14
    """Logarithm of the stiffness of a mode beyond the first over what its link's stiffness gives; number link k + j."""
    TORQUE_DELAY = 15
    """Dead time from the reported efforts to the torques of all joints [s]."""
    TORQUE_LAG = 16
    """Time constant from the effort of a joint to its torque [s]."""
    BEND_DELAY = 17
    """Age of all bends in a sample beyond that of the angles [s]."""
    TIP_INERTIA = 18
    """Rotary inertia of the tip mass beyond the given one [kg m^2]."""


# for the compiled functions, to which an enumeration is no constant
(MASS, FIRST_X, FIRST_Y, INERTIA, POINT, CONSTANT, STIFFNESS, DAMPING, VISCOUS, COULOMB, ROTOR, TORQUE_GAIN, BEND_GAIN,
 BEND_OFFSET, MODE, TORQUE_DELAY, TORQUE_LAG, BEND_DELAY, TIP_INERTIA) = (int(kind) for kind in Kind)


class ProcessModel(NamedTuple):
    """The arm that the filter integrates; ``set_parameters`` writes the state's entries p into it before each use."""

    arm: Manipulator
    work: Workspace
    kind: NDArray[np.int64]
    """(np,) what each entry of p is."""
    link: NDArray[np.int64]
    """(np,) number of the link or joint that each entry of p belongs to."""
    prior: Array
    """(np,) prior standard deviation of each entry of p."""
    given: Array
    """(np,) prior mean of each."""
    frozen: bool
    """Keep the mass matrix of the working point (a linear plant) instead of following the configuration."""
    M0: Array
    """(n, n) mass matrix of the empty arm at the working point, used when frozen."""
    Mp: Array
    """(4, n, n) its derivatives by the payload's inertial parameters."""
    Mt: Array
    """(5, n, n) the derivatives of M0 and Mp by the angle between the links."""
    point: Array
    """(1,) value of ``Kind.POINT``."""
    stiffness: Array
    """(n,) nominal K."""
    damping: Array
    """(n,) D at a damping ratio of one."""
    rotary: Array
    """(n, n) nominal ``Manipulator.rotary``."""
    scale: float
    """Mass [kg] at the tip of the empty arm: that of the tip and a third of the last link."""
    considered: float
    """Deviation [kg] of the mass that an empty arm seems to hold, by the error of its inertia (``model_error``)."""
    masses: Array
    """(L, P) nominal ``Manipulator.mass``."""
    lengths: Array
    """(L,) nominal ``Manipulator.length``."""
    gravity: Array
    """(L, 2) nominal ``Manipulator.gravity``."""
    constants: Array
    """(c, L, 4) errors of the arm, see ``structured_model.constant_errors``."""
    least: Array
    """(2,) mass m_a [kg] and inertia I_a [kg m^2], both negative. The mass matrix stays positive for every payload with
    (m - m_a) (I - I_a) >= |h|^2 and m >= m_a / 2, h its first moments."""
    least_rotor: Array
    """(L,) least rotor inertia [kg m^2] with which the mass matrix stays positive."""
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
    """(L, 2) derivatives of the torques by dead time and lag."""
    driven: Array
    """(L,) torques of the drives, without the friction of ``share``."""
    coulomb: Array
    """(L,) Coulomb friction."""
    share: Array
    """(L,) part of it that acts over the present sample, -1 to 1, by the measured rate of the joint; NaN: that of the
    model is used."""
    rate: Array
    """(L,) measured mean rate of each joint over that sample [rad/s]; NaN: it was not measured or is not used."""
    modelled: NDArray[np.bool_]
    """(L,) whether Coulomb friction follows the model's rate of the joint even where a rate was measured."""
    opened: NDArray[np.int64]
    """(1 + np,) number of the entries of p that are uncertain, then their indices."""
    bounds: Bounds
    """Scratch for the bounds of p."""
    p: Array
    """(np,) scratch."""
    a: Array
    k: Array
    dq: Array
    dqd: Array
    dp: Array
    G: Array
    """(n, 2 np) derivatives of the accelerations by the uncertain entries of p, lines over a step: first their means,
    then their slopes; see ``parameter_columns``."""
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
    payload[:], motion.gain[:] = 0.0, 1.0
    first_rotor = True
    for c in range(motion.kind.size):
        value, kind, i = x[2 * n + c], motion.kind[c], motion.link[c]
        o = links + i * k
        if kind <= INERTIA:
            payload[kind] = value
        elif kind == POINT:
            motion.point[0] = value
        elif kind == CONSTANT:
            change_constants(motion, i, value)
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
            motion.coulomb[i] = value
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
            motion.late[:, 0] = value
        elif kind == TORQUE_LAG:
            motion.late[i, 1] = value
        elif kind == TIP_INERTIA:  # as if the object had it; its own stands before
            payload[INERTIA] += value


@inner
def change_constants(motion: ProcessModel, axis: int, value: float) -> None:
    """Change masses, lengths and gravity of the arm by ``value`` deviations along a principal axis of their errors."""
    mass, length, end = motion.arm.mass, motion.arm.length, motion.masses.shape[1] - 1
    for i in range(length.size):
        error, nominal = motion.constants[axis, i], motion.masses[i]
        before = motion.lengths[i] if axis == 0 else length[i]
        length[i] = before + value * error[2] * motion.lengths[i]
        for side in range(2):
            before = motion.gravity[i, side] if axis == 0 else motion.arm.gravity[i, side]
            motion.arm.gravity[i, side] = before + value * error[3] * motion.gravity[i, side]
        for p in range(end + 1):
            before = nominal[p] if axis == 0 else mass[i, p]
            mass[i, p] = before + value * (error[0] * nominal[p] if p < end else error[1])


@inner
def mean_share(begin: float, end: float) -> float:
    """Return the mean of tanh(rate / STICTION_RATE) over a sample in which the rate goes from begin to end in a line.

    The integral of tanh is ln(cosh). begin, end: rates over STICTION_RATE; the result is NaN where one of them is.
    """
    if abs(end - begin) < 1e-3:  # the quotient would lose digits; the middle is right to 1e-7
        return float(np.tanh(0.5 * (begin + end)))
    first = abs(begin) + np.log1p(np.exp(-2.0 * abs(begin)))
    last = abs(end) + np.log1p(np.exp(-2.0 * abs(end)))
    return float((last - first) / (end - begin))


@inner
def set_torques(motion: ProcessModel, rows: Array, period: float) -> None:
    """Fill motion.effort with the torques of the last of ``rows`` (see ``predict``), and what they depend on.

    Where the rate of a joint was measured, its Coulomb friction is a known share of F. The model's own rate lacks the
    waves that a step of the torque sends through the links, which are as fast as the joint where friction reverses.
    """
    links, newest = motion.effort.size, rows.shape[0] - 1
    for i in range(links):
        late, slope = motion.late[i], motion.slope[i]
        motion.driven[i] = motion.gain[i] * late_torque(rows, 1 + i, late[0], late[1], period, slope)
        slope[0] *= motion.gain[i]
        slope[1] *= motion.gain[i]
        share, motion.rate[i] = np.nan, np.nan
        if rows.shape[1] > 1 + links and not motion.modelled[i]:
            begin, end = rows[newest, 1 + links + i], rows[newest, 1 + 2 * links + i]
            share = mean_share(begin / STICTION_RATE, end / STICTION_RATE)
            motion.rate[i] = 0.5 * (begin + end)
        motion.share[i] = share
        motion.effort[i] = motion.driven[i]
        motion.arm.coulomb[i] = motion.coulomb[i]
        if share == share:
            motion.effort[i] -= motion.coulomb[i] * share
            motion.arm.coulomb[i] = 0.0


@inner
def nonnegative(motion: ProcessModel, c: int) -> bool:
    """Whether entry c of p is at least zero: below it friction would add energy, or a torque precede its effort."""
    return motion.kind[c] in (DAMPING, VISCOUS, COULOMB, TORQUE_DELAY, TORQUE_LAG)


@inner
def lower_bound(motion: ProcessModel, c: int) -> float:
    """Return the lower bound of entry c of p: the mass matrix stays positive, ``nonnegative`` ones at least zero."""
    kind = motion.kind[c]
    low: float = -np.inf
    if kind == MASS:
        low = 0.5 * motion.least[0]
    elif kind == ROTOR:
        low = motion.least_rotor[motion.link[c]]
    elif kind == TIP_INERTIA:
        low = 0.5 * motion.least[1]
    elif nonnegative(motion, c):
        low = 0.0
    return low


@inner
def gather_bounds(motion: ProcessModel, p: Array, S: Array, chance: float) -> int:
    """Write into motion.bounds how far each bound is above p (np,), below zero where p keeps it, and its row of S.

    Return the number of bounds, 0 if p violates none. A bound of zero is lowered by ``chance`` standard deviations of
    its entry. Entries that are taken as known have no bound. S: square root of the covariance; its last np rows are
    p's.
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
def body_size(motion: ProcessModel) -> int:
    """Return the number of states that describe the object: 4 of a body, 1 of a point."""
    return 4 if motion.kind.size > INERTIA and motion.kind[INERTIA] == INERTIA else 1


@inner
def tip_inertia(motion: ProcessModel) -> int:
    """Return the entry of p that is the rotary inertia of the tip mass; -1: there is none."""
    found = motion.kind.size - 1
    while found >= 0 and motion.kind[found] != TIP_INERTIA:
        found -= 1
    return found


@inner
def keep_inertia(motion: ProcessModel, p: Array) -> float:
    """Raise the inertia in p (np,) to the least that its mass and first moments allow; return the change [kg m^2]."""
    if body_size(motion) == 1:
        return 0.0
    moment = p[FIRST_X] * p[FIRST_X] + p[FIRST_Y] * p[FIRST_Y]
    before, least = p[INERTIA], motion.least[1] + moment / (p[MASS] - motion.least[0])
    own = tip_inertia(motion)
    if own >= 0:
        least -= p[own]
    p[INERTIA] = max(before, least)
    return float(p[INERTIA] - before)


@inner
def constant_mass(motion: ProcessModel) -> None:
    """Fill work.M with the mass matrix of the working point, and work.E with zero."""
    M = motion.work.M
    for r in range(M.shape[0]):
        motion.work.E[r] = 0.0
        for c in range(r + 1):
            M[r, c] = motion.M0[r, c] + motion.arm.rotary[r, c] - motion.rotary[r, c]
            for p in range(4):
                M[r, c] += motion.payload[p] * motion.Mp[p, r, c]
            M[r, c] += motion.point[0] * turned_mass(motion, r, c)


@inner
def turned_mass(motion: ProcessModel, r: int, c: int) -> float:
    """Return the derivative of element (r, c) of the mass matrix of a linear plant by the angle between the links."""
    derivative: float = motion.Mt[0, r, c]
    for p in range(4):
        derivative += motion.payload[p] * motion.Mt[1 + p, r, c]
    return derivative


@inner
def accelerate(motion: ProcessModel, q: Array, qd: Array, qdd: Array) -> bool:
    """Fill qdd (n,) under motion.effort; leaves the factor of M in work.M."""
    if motion.frozen:
        constant_mass(motion)
    else:
        inertial_forces(motion.arm, motion.payload, q, qd, motion.work)
    return balance(motion.arm, q, qd, motion.effort, qdd, motion.work)


@inner
def linearize(motion: ProcessModel, q: Array, qd: Array, qdd: Array) -> None:
    """Fill motion.F (n, 2 n), the derivatives of the accelerations by q and q', right after ``accelerate`` there."""
    if motion.frozen:  # forces on a constant mass matrix depend on neither q nor q'
        motion.dq[:], motion.dqd[:], motion.dp[:] = 0.0, 0.0, 0.0
        add_payload_columns(motion, qdd)
    else:
        force_jacobian(motion.arm, motion.payload, q, qd, qdd, motion.dq, motion.dqd, motion.dp, motion.work)
    complete_jacobian(motion.arm, q, qd, motion.dq, motion.dqd, motion.F, motion.work)


@inner
def differentiate(motion: ProcessModel, qd: Array, qdd: Array, jerk: Array) -> None:
    """Fill jerk (n,) with the time derivative of the accelerations, by the linearization motion.F."""
    n = qd.size
    jerk[:] = 0.0
    for r in range(n):
        for j in range(n):
            jerk[r] += motion.F[r, j] * qd[j] + motion.F[r, n + j] * qdd[j]


@inner
def within_step(motion: ProcessModel, h: float) -> None:
    """Fill rows 4 to 6 of motion.k with the slopes of q, q' and q'' over a step h, by s, which runs from -1 to 1 in it.

    The lines go through the values at Gauss's two points, s^2 = 1/3. Their slope is h / 2 z' + h^3 / 144 z^(3) + ...
    Their mean is that of the step to 1e-3 for a mode that turns by 1.4 rad.
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
    """Fill motion.G with the derivatives of the accelerations by the uncertain entries of p, as lines over a step h.

    The first ``motion.opened[0]`` columns are their means, the next ones their slopes by s, which runs from -1 to 1 in
    the step. The derivatives vary within it: that by a stiffness is in proportion to a bend, and a mode of bending
    turns by a radian in a sample. Of Coulomb friction the mean alone is taken. ``linearize`` was just called at the
    mean state.
    """
    opened = motion.opened[0]
    if opened == 0:
        return
    within_step(motion, h)
    balance_columns(motion, motion.k[16], motion.k[17], motion.k[8], 0)
    motion.dp[:] = 0.0
    add_payload_columns(motion, motion.k[6])
    balance_columns(motion, motion.k[4], motion.k[5], motion.k[6], opened)
    solve_columns(motion.work.M, motion.G, 2 * opened)


@inner
def add_payload_columns(motion: ProcessModel, qdd: Array) -> None:
    """Add to motion.dp (n, 4), the derivatives of the forces by the payload's parameters, the part of qdd (n,)."""
    if not motion.frozen:
        add_body_forces(motion.arm, motion.k[16], qdd, motion.dp, motion.work)
        return
    for r in range(qdd.size):
        for p in range(4):
            for c in range(qdd.size):
                motion.dp[r, p] += motion.Mp[p, r, c] * qdd[c]


@inner
def balance_columns(motion: ProcessModel, q: Array, qd: Array, qdd: Array, first: int) -> None:
    """Fill columns of motion.G, from number ``first`` on, with derivatives of M qdd + E + D qd + dV/dq - B tau by p.

    motion.dp holds those by the payload's parameters. first: 0 for the values at the mean state q, qd, qdd (n,); beyond
    0 q, qd and qdd are slopes over the step, and so are the derivatives.
    """
    arm, net, G = motion.arm, motion.work.net, motion.G
    n, k, links = arm.stiffness.size, arm.kappa, arm.length.size
    for c in range(motion.opened[0]):
        kind, i = motion.kind[motion.opened[1 + c]], motion.link[motion.opened[1 + c]]
        o, at = links + i * k, first + c
        G[:, at] = 0.0
        if kind <= INERTIA or kind == TIP_INERTIA:
            for r in range(n):
                G[r, at] = motion.dp[r, min(kind, INERTIA)]
        elif kind == POINT:
            for r in range(n):
                for t in range(n):
                    G[r, at] += turned_mass(motion, r, t) * qdd[t]
        elif kind == CONSTANT:
            constant_column(motion, q, qd, qdd, i, at, first > 0)
        elif kind == STIFFNESS:
            for j in range(k):
                G[o + j, at] = motion.work.elastic[o + j] if first == 0 else arm.stiffness[o + j] * q[o + j]
        elif kind == DAMPING:
            for j in range(k):
                G[o + j, at] = motion.damping[o + j] * qd[o + j]
        elif kind == MODE:
            G[links + i, at] = arm.stiffness[links + i] * q[links + i]
        elif kind == ROTOR:
            turn = ordered_dot(arm.joint[i], qdd)
            for r in range(n):
                G[r, at] = arm.joint[i, r] * turn
        elif kind == VISCOUS:
            rate = ordered_dot(motion.work.B[:, i], qd)
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
                force = motion.share[i]
                if force != force:
                    force = np.tanh(net[1, i] / STICTION_RATE)
            elif kind == TORQUE_GAIN:
                force = -motion.driven[i]
            elif kind == TORQUE_LAG:
                force = -motion.slope[i, 1]
            if force != 0.0:
                for r in range(n):
                    G[r, at] = force * motion.work.B[r, i]


@inner
def constant_column(
    motion: ProcessModel, q: Array, qd: Array, qdd: Array, axis: int, at: int, is_slope: bool,
) -> None:
    """Fill column ``at`` of motion.G with the derivative of the forces by a principal axis of the constants' errors.

    is_slope: q, qd and qdd are slopes over the step; the part that qdd adds at the mean state motion.k[16] is taken.
    """
    arm, work, place, rate, A = motion.arm, motion.work, q, qd, motion.k[7]
    if is_slope:
        place, rate = motion.k[16], motion.k[9]
        rate[:] = 0.0
    for i in range(arm.length.size):
        for side in range(2):
            A[side] = ordered_dot(work.J[i, side], qdd) if is_slope else work.A[i, side]
            if is_slope and arm.floating:
                A[side] -= ordered_dot(work.P[side], qdd) / work.F[2]
        error = motion.constants[axis, i]
        add_mass_forces(arm, i, place, rate, qdd, A, error, motion.masses[i], motion.G, at, work)
        if error[2] != 0.0:
            add_length_forces(arm, i, place, rate, qdd, error[2] * motion.lengths[i], motion.payload[0], is_slope,
                              motion.G, at, work)
        if error[3] != 0.0 and not is_slope:
            add_weight(arm, i, error[3], motion.gravity[i], motion.G, at, work)


@inner
def friction_step(motion: ProcessModel, duration: float) -> float:
    """Return the longest step [s] where Coulomb friction may change its sign within ``duration`` [s], else infinity.

    A change of sign bends the motion. A joint that sticks is a stiff damper; its rate is the slope of its friction
    times b' M^-1 b, b its column of B. ``accelerate`` was just called and filled motion.k[0].
    """
    arm, work, qdd, column = motion.arm, motion.work, motion.k[0], motion.k[9]
    step: float = np.inf
    for i in range(arm.length.size):
        if arm.coulomb[i] == 0.0:
            continue
        if abs(work.net[1, i]) >= 3.0 * STICTION_RATE + duration * abs(ordered_dot(arm.joint[i], qdd)):
            continue
        for r in range(qdd.size):
            column[r] = work.B[r, i]
        solve(work.M, column)
        mobility = ordered_dot(work.B[:, i], column)
        step = min(step, 0.5 * motion.substeps, STIFF_STEP / max(work.net[2, i] * mobility, 1e-9))
    return step


@inner
def terms(angle: float, error: float) -> int:
    """Return the number k of terms of an exponential series whose rest is below an error: angle^k / k! < error."""
    k, left = 1, angle
    while left > error and k < MOST_TERMS:
        k += 1
        left *= angle / k
    return k


@inner
def note_opened(motion: ProcessModel, S: Array, used: int) -> None:
    """Write into motion.opened which entries of p are uncertain: their rows of S are not zero."""
    count, first = 0, S.shape[0] - motion.kind.size
    for p in range(motion.kind.size):
        for c in range(used):
            if S[first + p, c] != 0.0:
                count += 1
                motion.opened[count] = p
                break
    motion.opened[0] = count


@separate_kernel
def predict(
    motion: ProcessModel, x: Array, S: Array, used: int, rows: Array, period: float, duration: float,
) -> int:
    """Carry x and S over ``duration`` [s] under held torques. Return the number of steps; 0: a number was not finite.

    used: number of the first columns of S, beyond which they are zero; rows: (P, >= 1 + L) with efforts [N m] in
    columns 1 to L, those held meanwhile in the last row and, for late torques, those before it. The next 2 L columns,
    if there are more, hold the rates of the joints [rad/s] before and after (NaN: unknown). period: sample time of the
    rows [s]. Afterwards motion.k[0] is the acceleration at the end, and motion.work is of Radau's last point, 0.155
    of a step before it. A duration of zero fills motion.k[0] and motion.F at x alone.
    """
    n, taken = motion.arm.stiffness.size, 0
    set_parameters(motion, x)
    note_opened(motion, S, used)
    set_torques(motion, rows, period)
    left, stiff, h, steps, turn, stage, within = duration, 0.0, 0.0, 0.0, 0.0, BEGIN, 0
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
            within = 0
            q, qd, qdd, stage = motion.k[18], motion.k[21], motion.k[0], WITHIN
            continue
        if stage == WITHIN:
            remainder(motion, q, qd, qdd, motion.k[12 + within])
            within += 1
            if within < 2:
                q, qd = motion.k[18 + within], motion.k[21 + within]
                continue
            if not arrive(motion, x, h, turn):
                return 0
            taken += 1
            if steps <= 1.0:
                return taken
            left -= h
            q, qd, stage = x[:n], x[n:2 * n], BEGIN
            continue
        longest = min(motion.substeps, friction_step(motion, left), STIFF_STEP / max(stiff, 1e-9))
        steps = max(np.ceil(left / longest - 1e-9), 1.0)
        if not (steps < MOST_STEPS and stiff * motion.substeps < STIFFEST * STIFF_STEP):
            return 0
        h = left / steps
        average(motion, x, h)
        q, qd, qdd, stage = motion.k[16], motion.k[17], motion.k[8], MEAN


@inner
def average(motion: ProcessModel, x: Array, h: float) -> None:
    """Fill rows 16 and 17 of motion.k with a prediction of the means of q and q' over a step h from x.

    It is an exponential Euler step whose linear part is stiffness, damping and friction, as the fastest mode turns by
    1.4 rad in a sample. The Jacobian is nearly linear in q and q', so its mean over the step is its value at their
    means. With it the covariance is as exact over seconds as with two steps linearized at their midpoints.
    ``accelerate`` was just called at x.
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
                turned = ordered_dot(work.B[:, i], rate)
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
    """Fill lacks (n,) with the remainder of the linearization at q and q', where the acceleration is qdd."""
    n = motion.arm.stiffness.size
    middle, about, rate = motion.k[8], motion.k[16], motion.k[17]
    for i in range(n):
        lacks[i] = qdd[i] - middle[i]
        for j in range(n):
            lacks[i] -= motion.F[i, j] * (q[j] - about[j]) + motion.F[i, n + j] * (qd[j] - rate[j])


@inner
def lead(motion: ProcessModel, x: Array, h: float, turn: float) -> None:
    """Predict the states at ``RADAU`` in a step h: q in rows 18 to 20 of motion.k, q' in rows 21 to 23.

    turn: angle by which the fastest mode turns in the step [rad]. ``linearize`` was just called at the mean state.

    An exponential integrator (Hochbruck and Ostermann, Acta Numerica 19, 2010) about the mean state: x' = g(x) + r(u),
    g the linearization, r its remainder, u from 0 to 1 the share of the step. Here r is r0 (2 u - 1)^2, r0 its value at
    the begin, as r is of second order in the distance from the mean state. ``arrive`` takes the r evaluated at the
    states found here. A step of Runge and Kutta is not exact enough: the fastest mode turns too far in a sample, and
    the damping that such a step adds to it changed the payload by 0.3 %.
    """
    n = motion.arm.stiffness.size
    places, rates, forcing, first = motion.k[18:21], motion.k[21:24], motion.k[24:26], motion.k[3]
    for i in range(n):
        for j in range(n):  # by columns, which ``series`` reads in a row
            motion.X[j, i], motion.Y[j, i] = motion.F[i, j], motion.F[i, n + j]
    remainder(motion, x[:n], x[n:2 * n], motion.k[0], first)
    for i in range(n):
        motion.k[10, i], motion.k[11, i] = h * x[n + i], h * motion.k[0, i]
        forcing[0, i], forcing[1, i] = -4.0 * first[i], 4.0 * first[i]
        for point in range(RADAU.size):
            places[point, i], rates[point, i] = x[i], x[n + i]
    series(motion, h, terms(turn, MOTION_ERROR), 0)


@inner
def arrive(motion: ProcessModel, x: Array, h: float, turn: float) -> bool:
    """Set x to the state after the step, r the parabola through its values at the begin and at Radau's points.

    They stand in rows 3, 12 and 13 of motion.k. Fill motion.k[0] with the acceleration at the end.
    """
    n = motion.arm.stiffness.size
    forcing, first, end, ending, last = motion.k[24:26], motion.k[3], motion.k[20], motion.k[23], motion.k[15]
    for i in range(n):
        last[i] = first[i]
        motion.k[10, i], motion.k[11, i] = 0.0, 0.0
        for power in range(1, 3):
            found = TO_POWERS[power, 0] * first[i]
            for point in range(2):
                found += TO_POWERS[power, 1 + point] * motion.k[12 + point, i]
            last[i] += found
            forcing[power - 1, i] = found - forcing[power - 1, i]
    series(motion, h, terms(turn, SPREAD_ERROR), 2)
    largest = 0.0
    for i in range(n):
        x[i] = end[i]
        x[n + i] = ending[i]
        largest += abs(x[i]) + abs(x[n + i])
    for i in range(n):
        motion.k[0, i] = motion.k[8, i] + last[i]
        for j in range(n):
            motion.k[0, i] += (motion.F[i, j] * (x[j] - motion.k[16, j])
                               + motion.F[i, n + j] * (x[n + j] - motion.k[17, j]))
    return largest < 1e6


@inner
def series(motion: ProcessModel, h: float, count: int, begin: int) -> None:
    """Add the solution of x' = g + F x + r to rows 18 to 23 of motion.k, for the points of ``RADAU`` from begin on.

    It is a Taylor series of ``count`` terms from x = 0: with x = sum c_j u^j and r = sum rho_j u^j, u the share of the
    step h, c_{j + 1} = h / (j + 1) (F c_j + rho_j). c_1 = h (g + rho_0) stands in rows 10 and 11 (positions, rates) and
    is overwritten, rho_1 and rho_2 in rows 24 and 25; motion.X and Y hold the columns of motion.F as rows.
    """
    n = motion.arm.stiffness.size
    place, rate, following = motion.k[10], motion.k[11], motion.k[14]
    for j in range(1, count + 1):
        for point in range(begin, RADAU.size):
            power = RADAU[point] ** j
            for i in range(n):
                motion.k[18 + point, i] += power * place[i]
                motion.k[21 + point, i] += power * rate[i]
        if j == count:
            return
        weight = h / (j + 1)
        for i in range(n):
            following[i] = motion.k[23 + j, i] if j <= 2 else 0.0
        for c in range(n):
            by_place, by_rate, at, going = motion.X[c], motion.Y[c], place[c], rate[c]
            for i in range(n):
                following[i] += by_place[i] * at + by_rate[i] * going
        for i in range(n):
            place[i] = weight * rate[i]
            rate[i] = weight * following[i]


@separate
def spread(
    flow: Array, G: Array, opened: NDArray[np.int64], S: Array, used: int, scratch: Array, h: float, count: int,
) -> None:
    """Replace the first ``used`` columns of S by F S, F the linearized flow over h, a Taylor series of ``count`` terms.

    Evaluated by Horner's rule: a term is one product with flow (n, 2 n), the derivatives of the accelerations by q and
    q'. G (n, 2 np): those by the entries of p in ``opened``, as means and slopes over the step (``parameter_columns``);
    term j takes -j / (j + 2) of a slope. p itself stays. scratch: see ``spread_scratch``.
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
        product[:] = 0.0
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
    """Allocate for n coordinates, ``size`` entries of p, and square roots with at most ``columns`` columns."""
    return np.zeros(7 * n * columns + size * (columns + n))
