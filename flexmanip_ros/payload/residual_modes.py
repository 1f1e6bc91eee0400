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
from flexmanip_ros.payload.filter_state import INFORMATION, ODDS, SHOWN
from flexmanip_ros.types import Array

if TYPE_CHECKING:
    from flexmanip_ros.payload.filter_state import FilterState
    from flexmanip_ros.payload.process_model import ProcessModel

Integers = NDArray[np.int64]

MODES = 3
"""Modes of each link beyond kappa that ring; more are above what sensors follow."""
HELD_MODES = 40
"""Modes of each link beyond kappa that push; their sum falls with the third power of their number."""
UNBENT_ODDS = -3.0
"""Odds (logarithm) of modes that matter where torques bend no link: little rings, little is pushed."""
LEAST_DAMPING = 0.02
"""Damping ratio at least: after that many turns their phase is not known."""


def residual_modes(arm: ArmParameters, theta: Array, kappa: int, rows: Integers, rate: NDArray[np.bool_]
                   ) -> ResidualModes:
    """Return the residual modes of an arm with kappa modes at chords theta (2,), nothing held.

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
    return ResidualModes(square=square, damping=damping, load=V.T @ (B[chosen] - coupled.T @ B[kept]),
                output=np.ascontiguousarray(output[rows]), row=rate.astype(np.int64), push=_push(arm, kappa))


def _push(arm: ArmParameters, kappa: int) -> Array:
    """Momentum M_rt K_t^-1 B_t, as ``ResidualModes.push``."""
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


class ResidualModes(NamedTuple):
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
def propagate_residual(modes: ResidualModes, m: FilterState, duration: float, effort: Array) -> None:
    """Advance the departure of each oscillator from its static deflection over a time, exactly."""
    first, second = effort[0] - m.torque[0], effort[1] - m.torque[1]
    for i in range(modes.square.size):
        z = m.residual[0, i] - (modes.load[i, 0] * first + modes.load[i, 1] * second) / modes.square[i]
        v = m.residual[1, i]
        half = modes.damping[i] / 2.0
        omega = np.sqrt(modes.square[i] - half * half)
        shrink = np.exp(-half * duration)
        c = shrink * np.cos(omega * duration)
        s = shrink * np.sin(omega * duration) / omega
        m.residual[0, i] = z * c + (v + half * z) * s
        m.residual[1, i] = v * c - (half * v + modes.square[i] * z) * s


@inlined
def residual_output(modes: ResidualModes, m: FilterState, i: int) -> float:
    """What the vibration of the residual modes adds to sensor i; their static deflection is in the feedthrough."""
    value = 0.0
    for a in range(modes.square.size):
        value += modes.output[i, a] * m.residual[modes.row[i], a]
    return value


@inlined
def residual_probability(score: Array) -> float:
    """Probability that the arm has modes beyond the kappa integrated ones that the sensors see.

    Bayes factor of two hypotheses: their amplitude a is 0, or it has the prior N(0, 1). SHOWN has the distribution
    N(a INFORMATION, INFORMATION).
    """
    information = score[INFORMATION]
    shown = max(score[SHOWN], 0.0)
    evidence = score[ODDS] + 0.5 * (shown * shown / (1.0 + information) - np.log(1.0 + information))
    return float(1.0 / (1.0 + np.exp(-min(max(evidence, -50.0), 50.0))))


@inlined
def residual_amplitude(score: Array) -> float:
    """Expected amplitude of the residual modes, from 0 (none) to 1 (as in the equations of the arm)."""
    shown: float = max(score[SHOWN], 0.0) / (1.0 + score[INFORMATION])
    return residual_probability(score) * min(shown, 1.0)


@inlined
def excite_residual(
    motion: ProcessModel, modes: ResidualModes, x: Array, before: Array, effort: Array, share: float,
) -> None:
    """Move the integrated coordinates at a torque step from ``before``, by a share of the residual modes' reaction.

    On the time scale of the integrated modes, the residual modes follow the torque at once. The momentum is conserved:
    M_rr dq_r = -M_rt deta_t. Right after ``predict``, which leaves the factor of M_rr.
    """
    first, second = share * (effort[0] - before[0]), share * (effort[1] - before[1])
    if first == 0.0 and second == 0.0:
        return
    c = np.cos(x[1] - x[0])
    moved = motion.a
    for i in range(moved.size):
        moved[i] = -((modes.push[0, i, 0] + c * modes.push[1, i, 0]) * first
                     + (modes.push[0, i, 1] + c * modes.push[1, i, 1]) * second)
    solve(motion.work.M, moved)
    for i in range(moved.size):
        x[i] += moved[i]
