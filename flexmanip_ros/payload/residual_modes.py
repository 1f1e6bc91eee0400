"""Residual modes: the modes of the arm above those that the estimator integrates, as a quasi-static correction."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from flexmanip_ros.arm import linearization, manipulator
from flexmanip_ros.arm.equations_of_motion import solve
from flexmanip_ros.arm.shape_functions import output_matrix
from flexmanip_ros.numerics.compiled import inlined
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.payload.filter_state import ODDS, SHOWN, TOLD
from flexmanip_ros.types import Array

if TYPE_CHECKING:
    from flexmanip_ros.payload.filter_state import Memory
    from flexmanip_ros.payload.process_model import Motion

Integers = NDArray[np.int64]

MODES = 3
"""Modes of each link beyond kappa that ring; more are above what sensors follow."""
HELD_MODES = 40
"""Modes of each link beyond kappa that push; their sum falls with the third power of their number."""
UNBENT_ODDS = -3.0
"""Odds (logarithm) of modes that matter where torques bend no link: little rings, little is pushed."""
LEAST_DAMPING = 0.02
"""Damping ratio at least: after that many turns their phase is not known."""


def tail(arm: ArmParameters, theta: Array, kappa: int, rows: Integers, rate: NDArray[np.bool_]) -> Tail:
    """Return the tail of an arm with kappa modes at chords theta (2,), nothing held.

    rows: (m,) which of joint1, joint2, link1_bend, link2_bend each sensor reads; rate: (m,) or its rate.
    """
    total = kappa + MODES
    chosen, kept = _split(kappa, MODES)
    M = _mass(arm, theta, total)
    coupled = np.linalg.solve(M[np.ix_(kept, kept)], M[np.ix_(kept, chosen)])
    K = manipulator.stiffness(arm, total)[chosen - 2]
    D = manipulator.damping(arm, total)[chosen - 2]
    # what the kept coordinates leave them of inertia: they give way at once
    square, V = eigh(np.diag(K), M[np.ix_(chosen, chosen)] - M[np.ix_(chosen, kept)] @ coupled)
    omega = np.sqrt(square)
    damping = np.clip(np.einsum('ja,j,ja->a', V, D, V), 2.0 * LEAST_DAMPING * omega, 1.9 * omega)
    B = manipulator.torque_matrix(arm, total)
    C = output_matrix(arm, manipulator.root_slopes(arm, total), manipulator.tip_slopes(arm, total))
    output = (C[:, chosen] - C[:, kept] @ coupled) @ V
    return Tail(square=square, damping=damping, load=V.T @ (B[chosen] - coupled.T @ B[kept]),
                output=np.ascontiguousarray(output[rows]), row=rate.astype(np.int64), push=_push(arm, kappa))


def _push(arm: ArmParameters, kappa: int) -> Array:
    """Momentum M_rt K_t^-1 B_t, as ``Tail.push``."""
    total = kappa + HELD_MODES
    chosen, kept = _split(kappa, HELD_MODES)
    held = manipulator.torque_matrix(arm, total)[chosen]
    held /= manipulator.stiffness(arm, total)[chosen - 2, None]
    across, along = (_mass(arm, np.array([0.0, angle]), total)[np.ix_(kept, chosen)] @ held
                     for angle in (np.pi / 2, 0.0))
    return np.array([across, along - across])


def _split(kappa: int, more: int) -> tuple[Integers, Integers]:
    """Indices of the modes beyond kappa and of all other coordinates, kappa + more modes a link."""
    total = kappa + more
    chosen = np.r_[2 + kappa:2 + total, 2 + total + kappa:2 + 2 * total]
    return chosen, np.setdiff1d(np.arange(2 + 2 * total), chosen)


def _mass(arm: ArmParameters, theta: Array, modes: int) -> Array:
    b = linearization.blocks(arm, theta, 0.0, modes)
    return np.block([[b.Ma, b.Mb], [b.Mb.T, b.Mc]])


class Tail(NamedTuple):
    """a oscillators z'' + damping z' + square z = load . torque, read by m sensors; n kept coordinates."""

    square: Array
    """(a,) squared frequency."""
    damping: Array
    """(a,) below critical."""
    load: Array
    """(a, 2)."""
    output: Array
    """(m, a) of z, or of z' where the sensor reads rates."""
    row: NDArray[np.int64]
    """(m,) 0: z, 1: z'."""
    push: Array
    """(2, n, 2) momentum of the kept coordinates by the torques held, M_rt K_t^-1 B_t: with joint 2 at a
    right angle, and what the cosine of its angle adds."""


@inlined
def ring(tail: Tail, m: Memory, duration: float, effort: Array) -> None:
    """Carry the departure of each oscillator from where the torque holds it over a time, exactly."""
    first, second = effort[0] - m.torque[0], effort[1] - m.torque[1]
    for i in range(tail.square.size):
        z = m.tail[0, i] - (tail.load[i, 0] * first + tail.load[i, 1] * second) / tail.square[i]
        v = m.tail[1, i]
        half = tail.damping[i] / 2.0
        omega = np.sqrt(tail.square[i] - half * half)
        shrink = np.exp(-half * duration)
        c = shrink * np.cos(omega * duration)
        s = shrink * np.sin(omega * duration) / omega
        m.tail[0, i] = z * c + (v + half * z) * s
        m.tail[1, i] = v * c - (half * v + tail.square[i] * z) * s


@inlined
def ringing(tail: Tail, m: Memory, i: int) -> float:
    """What sensor i would read more if the arm had these modes; where the torque holds them is known."""
    value = 0.0
    for a in range(tail.square.size):
        value += tail.output[i, a] * m.tail[tail.row[i], a]
    return value


@inlined
def believed(score: Array) -> float:
    """Probability that the arm has modes beyond kappa that matter.

    Either their amplitude a is 0, or it is of the prior N(0, 1); SHOWN ~ N(a TOLD, TOLD): the Bayes factor.
    """
    told = score[TOLD]
    shown = max(score[SHOWN], 0.0)
    evidence = score[ODDS] + 0.5 * (shown * shown / (1.0 + told) - np.log(1.0 + told))
    return float(1.0 / (1.0 + np.exp(-min(max(evidence, -50.0), 50.0))))


@inlined
def amplitude(score: Array) -> float:
    """How much of the ringing to expect: 0 of none, 1 of all. Frequencies a little off show less of it."""
    shown: float = max(score[SHOWN], 0.0) / (1.0 + score[TOLD])
    return believed(score) * min(shown, 1.0)


@inlined
def push(motion: Motion, tail: Tail, x: Array, before: Array, effort: Array, share: float) -> None:
    """Set the kept coordinates aside at a step of the torque from ``before``, by a share of what a tail does.

    Seen from the slow motion, the tail goes at once where the torque holds it, and no momentum comes from
    outside: M_rr dq_r = -M_rt deta_t. Right after ``predict``, which leaves the factor of M_rr.
    """
    first, second = share * (effort[0] - before[0]), share * (effort[1] - before[1])
    if first == 0.0 and second == 0.0:
        return
    c = np.cos(x[1] - x[0])
    moved = motion.a
    for i in range(moved.size):
        moved[i] = -((tail.push[0, i, 0] + c * tail.push[1, i, 0]) * first
                     + (tail.push[0, i, 1] + c * tail.push[1, i, 1]) * second)
    solve(motion.work.M, moved)
    for i in range(moved.size):
        x[i] += moved[i]
