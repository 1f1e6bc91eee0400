"""Modes beyond the retained ones as linear oscillators that follow them: cheap, and without back-effect.

A step of a joint torque makes the truncated modes ring; at kappa = 3 that is what is left in the encoder
angles after the quasi-static correction, and most of the error of their rates. The tail is driven by the
loads of ``slope_correction`` and shakes with the inertia that the retained coordinates leave it,
S = M_tt - M_tr M_rr^-1 M_rt, at the initial angles; beyond the tail the correction stays quasi-static.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh, expm

from flexmanip_ros.arm import linearization
from flexmanip_ros.arm.outputs import Slopes
from flexmanip_ros.arm.shape_functions import output_matrix
from flexmanip_ros.arm.slope_correction import flexibility, load_weights, slopes
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array


def slopes_with_tail(
    arm: ArmParameters, theta: tuple[float, ...], kappa: int, tail: int, dt: float,
) -> Slopes:
    """Correction of an arm with kappa modes a link whose next ``tail`` modes follow as oscillators."""
    plain = slopes(arm, kappa)
    if not (tail and arm.slope_correction):
        return plain
    total = kappa + tail
    b = linearization.blocks(arm, np.array(theta), 0.0, total)
    M = np.block([[b.Ma, b.Mb], [b.Mb.T, b.Mc]])
    chosen = np.r_[2 + kappa:2 + total, 2 + total + kappa:2 + 2 * total]
    kept = np.setdiff1d(np.arange(len(M)), chosen)
    S = M[np.ix_(chosen, chosen)] - M[np.ix_(chosen, kept)] @ np.linalg.solve(
        M[np.ix_(kept, kept)], M[np.ix_(kept, chosen)])
    K = linearization.stiffness(arm, total)[chosen - 2]
    D = linearization.damping(arm, total)[chosen - 2]
    squares, V = eigh(np.diag(K), S)
    rates = np.einsum('ja,j,ja->a', V, D, V)
    step = np.empty((len(squares), 2, 2))
    held, rising = np.empty((len(squares), 2)), np.empty((len(squares), 2))
    for a, (square, rate) in enumerate(zip(squares, rates, strict=True)):
        step[a], held[a], rising[a] = _ramp_step(float(square), float(rate), dt)
    root, tip = (f(arm, total) for f in (linearization.root_slopes, linearization.tip_slopes))
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
