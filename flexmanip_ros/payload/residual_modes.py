"""The modes of the arm that the structured estimator leaves out, as its compiled functions take them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from flexmanip_ros.arm import linearization
from flexmanip_ros.arm.shape_functions import output_matrix
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.payload.tail_kernel import Tail
from flexmanip_ros.types import Array

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
    K = linearization.stiffness(arm, total)[chosen - 2]
    D = linearization.damping(arm, total)[chosen - 2]
    # what the kept coordinates leave them of inertia: they give way at once
    square, V = eigh(np.diag(K), M[np.ix_(chosen, chosen)] - M[np.ix_(chosen, kept)] @ coupled)
    omega = np.sqrt(square)
    damping = np.clip(np.einsum('ja,j,ja->a', V, D, V), 2.0 * LEAST_DAMPING * omega, 1.9 * omega)
    B = linearization.torque_matrix(arm, total)
    C = output_matrix(arm, linearization.root_slopes(arm, total), linearization.tip_slopes(arm, total))
    output = (C[:, chosen] - C[:, kept] @ coupled) @ V
    return Tail(square=square, damping=damping, load=V.T @ (B[chosen] - coupled.T @ B[kept]),
                output=np.ascontiguousarray(output[rows]), row=rate.astype(np.int64), push=_push(arm, kappa))


def _push(arm: ArmParameters, kappa: int) -> Array:
    """Momentum M_rt K_t^-1 B_t, as ``Tail.push``."""
    total = kappa + HELD_MODES
    chosen, kept = _split(kappa, HELD_MODES)
    held = linearization.torque_matrix(arm, total)[chosen]
    held /= linearization.stiffness(arm, total)[chosen - 2, None]
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
