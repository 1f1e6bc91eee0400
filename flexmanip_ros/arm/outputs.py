"""What the sensors measure: joint angles and bends, with the static slopes of the modes beyond kappa."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import eigh, expm

from flexmanip_ros.arm import manipulator as constants
from flexmanip_ros.arm.linearization import blocks
from flexmanip_ros.arm.shape_functions import output_matrix
from flexmanip_ros.numerics.compiled import kernel
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array

if TYPE_CHECKING:
    from flexmanip_ros.arm.manipulator import Manipulator


class Slopes(NamedTuple):
    """What the modes beyond kappa add to the outputs (``slope_correction.py``, ``tail.py``)."""

    active: bool
    flexibility: Array
    """(4, 7) outputs by loads."""
    moments: Array
    """(4, 2) end moments by joint torques."""
    hubs: Array
    """(4,) rotary inertias at root and tip of link 1, root and tip of link 2."""
    step: Array
    """(T, 2, 2) free motion of each oscillator of the tail over a sample."""
    start: Array
    """(T, 2) its motion by a unit force that falls to zero over the sample."""
    end: Array
    """(T, 2) the same for a force that rises from zero."""
    load: Array
    """(T, 7) forces on the oscillators by loads."""
    output: Array
    """(4, T) outputs by oscillators."""


@kernel
def measure(
    arm: Manipulator, slopes: Slopes, q: Array, qd: Array, memory: Array, position: Array, velocity: Array,
) -> None:
    """Fill position and velocity (4,): joint1, joint2, link1_bend, link2_bend.

    memory (7 + 2 T,): loads of the truncated modes at the end of the last interval, under its torque (at a
    jump of the torque they still show the one before), then places and rates of the tail's oscillators.
    """
    T = slopes.step.shape[0]
    for r in range(4):
        place, rate = 0.0, 0.0
        for c in range(q.size):
            place += arm.output[r, c] * q[c]
            rate += arm.output[r, c] * qd[c]
        for c in range(7):
            place += slopes.flexibility[r, c] * memory[c]
        for c in range(T):
            place += slopes.output[r, c] * memory[7 + c]
            rate += slopes.output[r, c] * memory[7 + T + c]
        position[r] = place
        velocity[r] = rate


@kernel
def shake(slopes: Slopes, before: Array, memory: Array) -> None:
    """Move the tail over a sample while the loads go from before (7,) to memory[:7]."""
    T = slopes.step.shape[0]
    for a in range(T):
        first, last = 0.0, 0.0
        for c in range(7):
            first += slopes.load[a, c] * before[c]
            last += slopes.load[a, c] * memory[c]
        z, rate = memory[7 + a], memory[7 + T + a]
        step = slopes.step[a]
        memory[7 + a] = (step[0, 0] * z + step[0, 1] * rate
                         + slopes.start[a, 0] * first + slopes.end[a, 0] * last)
        memory[7 + T + a] = (step[1, 0] * z + step[1, 1] * rate
                             + slopes.start[a, 1] * first + slopes.end[a, 1] * last)


@kernel
def end_loads(
    arm: Manipulator, payload: Array, slopes: Slopes, q: Array, qdd: Array, effort: Array, loads: Array,
) -> None:
    """Fill loads[:7] of the truncated modes, see ``slope_correction.flexibility``."""
    k = arm.kappa
    base = arm.length[0] * np.cos(q[1] - q[0]) * qdd[0]
    turn1, turn2 = qdd[0], qdd[1]
    loads[4] = -turn1
    loads[5] = -turn2
    loads[6] = -base
    root1, tip1, root2, tip2 = turn1, turn1, turn2, turn2
    for j in range(k):
        root1 += arm.root_slope[0, j] * qdd[2 + j]
        tip1 += arm.tip_slope[0, j] * qdd[2 + j]
        root2 += arm.root_slope[1, j] * qdd[2 + k + j]
        tip2 += arm.tip_slope[1, j] * qdd[2 + k + j]
    loads[0] = -slopes.hubs[0] * root1
    loads[1] = -slopes.hubs[1] * tip1
    loads[2] = -slopes.hubs[2] * root2
    across = payload[0] * payload[2]
    loads[3] = (-(slopes.hubs[3] + payload[1] + across * payload[2] + payload[0] * payload[3] ** 2) * tip2
                - across * (base + arm.length[1] * turn2))
    for r in range(4):
        loads[r] += slopes.moments[r, 0] * effort[0] + slopes.moments[r, 1] * effort[1]


TERMS = 4000
"""Modes summed; the slowest sums go on with 1 / j^2 and are closed by their known total."""


def slopes(arm: ArmParameters, kappa: int) -> Slopes:
    """Precompute the correction of an arm with kappa modes; inactive when switched off."""
    return Slopes(
        active=arm.slope_correction, flexibility=flexibility(arm, kappa), moments=_moments(arm),
        hubs=np.array([arm.hub_inertia[0], arm.joint_inertia, arm.hub_inertia[1], arm.tip_inertia]),
        step=np.zeros((0, 2, 2)), start=np.zeros((0, 2)), end=np.zeros((0, 2)), load=np.zeros((0, 7)),
        output=np.zeros((4, 0)))


def flexibility(arm: ArmParameters, kappa: int) -> Array:
    """Outputs (4) by loads (7), summed over the modes beyond kappa.

    Outputs joint1, joint2 [rad], link1_bend, link2_bend [m]; loads: moments [N m] at root and tip of
    link 1, root and tip of link 2, then -theta1'', -theta2'' [rad/s^2] and -n2 . P'' [m/s^2].
    """
    L, EI = np.array(arm.link_length), np.array(arm.bending_stiffness)
    ends = np.stack([f(arm, TERMS) for f in (constants.root_slopes, constants.tip_slopes)])
    stiffness = constants.stiffness(arm, TERMS)
    C = output_matrix(arm, *ends)[:, 2:]
    beyond = np.tile(np.arange(TERMS) >= kappa, 2)
    R: Array = (C / stiffness * beyond) @ load_weights(arm, TERMS)
    # slopes by end moments fall with 1 / j^2 only: the static beam (L / 3 EI, L / 6 EI) less the modes kept
    total = np.array([[1 / 3, -1 / 6], [-1 / 6, 1 / 3]])
    if arm.angle_convention == 'encoder':
        kept = stiffness.reshape(2, TERMS)[:, :kappa]
        few = ends[:, :, :kappa]
        bent = [total * L[i] / EI[i] - (few[:, i] / kept[i]) @ few[:, i].T for i in range(2)]
        R[0, :2] = bent[0][0]
        R[1, :2] = -bent[0][1]
        R[1, 2:4] = bent[1][0]
    return R


def load_weights(arm: ArmParameters, modes: int) -> Array:
    """Generalized forces of the modal coordinates by the seven loads, (2 modes, 7), see ``flexibility``."""
    root, tip = constants.root_slopes(arm, modes), constants.tip_slopes(arm, modes)
    mass = np.array(arm.linear_density) * np.array(arm.link_length)
    j = np.arange(1, modes + 1)
    sign = np.where(j % 2, -1.0, 1.0)
    rigid = -(mass * np.array(arm.link_length))[:, None] * sign / (j * np.pi)
    W = np.zeros((2 * modes, 7))
    W[:modes, [0, 1, 4]] = np.column_stack([root[0], tip[0], rigid[0]])
    W[modes:, [2, 3, 5, 6]] = np.column_stack([
        root[1], tip[1], rigid[1], mass[1] * (1 - sign) / (j * np.pi)])
    return W


def _moments(arm: ArmParameters) -> Array:
    """End moments (root 1, tip 1, root 2, tip 2) by the two joint torques, (4, 2)."""
    if arm.torque_convention == 'paper':
        return np.zeros((4, 2))
    return np.array([[1.0, 0.0], [0.0, -1.0], [0.0, 1.0], [0.0, 0.0]])


def slopes_with_residual_modes(
    arm: ArmParameters, theta: tuple[float, ...], kappa: int, tail: int, dt: float,
) -> Slopes:
    """Correction of an arm with kappa modes a link whose next ``tail`` modes follow as oscillators."""
    plain = slopes(arm, kappa)
    if not (tail and arm.slope_correction):
        return plain
    total = kappa + tail
    b = blocks(arm, np.array(theta), 0.0, total)
    M = np.block([[b.Ma, b.Mb], [b.Mb.T, b.Mc]])
    chosen = np.r_[2 + kappa:2 + total, 2 + total + kappa:2 + 2 * total]
    kept = np.setdiff1d(np.arange(len(M)), chosen)
    S = M[np.ix_(chosen, chosen)] - M[np.ix_(chosen, kept)] @ np.linalg.solve(
        M[np.ix_(kept, kept)], M[np.ix_(kept, chosen)])
    K = constants.stiffness(arm, total)[chosen - 2]
    D = constants.damping(arm, total)[chosen - 2]
    squares, V = eigh(np.diag(K), S)
    rates = np.einsum('ja,j,ja->a', V, D, V)
    step = np.empty((len(squares), 2, 2))
    held, rising = np.empty((len(squares), 2)), np.empty((len(squares), 2))
    for a, (square, rate) in enumerate(zip(squares, rates, strict=True)):
        step[a], held[a], rising[a] = _ramp_step(float(square), float(rate), dt)
    root, tip = (f(arm, total) for f in (constants.root_slopes, constants.tip_slopes))
    return plain._replace(
        flexibility=flexibility(arm, total), step=step, start=held - rising, end=rising,
        load=V.T @ load_weights(arm, total)[chosen - 2],
        output=output_matrix(arm, root, tip)[:, chosen] @ V)


def _ramp_step(square: float, rate: float, dt: float) -> tuple[Array, Array, Array]:
    """Exact step of z'' + rate z' + square z = f: state matrix, gains of f held at 1 and rising to 1."""
    A = np.zeros((4, 4))
    A[0, 1] = 1.0
    A[1, :3] = -square, -rate, 1.0
    A[2, 3] = 1.0 / dt
    F = expm(A * dt)
    return F[:2, :2], F[:2, 2], F[:2, 3]
