"""State from measurements, and the linear quadratic regulator at a configuration with a payload.

x = [theta, eta, theta', eta'] (2n,), n = L (1 + kappa): chord angles theta [rad] and modal coordinates eta [m]
of the arm's shape functions (with one mode alone the second and third of a real link are driven unstable).
A link at rest under no torque is straight, so the regulator needs no integrator: the plane has no gravity.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve, solve_discrete_are

from flexmanip_ros.arm.linearization import blocks, discretize
from flexmanip_ros.arm.manipulator import manipulator
from flexmanip_ros.errors import ModelError
from flexmanip_ros.parameters import ControllerParameters
from flexmanip_ros.types import Array

RATE_SCALE = 8.0
"""A rate [1/s] costs as much as the deviation that is RATE_SCALE times smaller."""
FLOOR = 1e-6
"""Process noise on every state, so that the filter never stops to listen."""


def observation(config: ControllerParameters) -> Array:
    """Return T (2 L, n): [encoder angles, bends] = T [theta, eta], and the same for their rates."""
    arm = config.arm
    output = manipulator(replace(arm, base_mass=0.0) if arm.base_mass else arm).output
    return np.asarray(np.append(np.ones(len(arm.bend_gain)), arm.bend_gain)[:, None] * output)


def reference(config: ControllerParameters, angles: Array) -> Array:
    """Return the chord angles (L,) of a straight arm whose encoders read ``angles`` (L,)."""
    return np.cumsum(angles) if config.arm.angle_convention == 'encoder' else np.array(angles, dtype=np.float64)


def model(config: ControllerParameters, between: float, payload: float) -> tuple[Array, Array]:
    """Return (A (2n, 2n), B (2n, L)) of one sample at theta2 - theta1 = ``between`` [rad], payload [kg]."""
    b = blocks(config.arm, turned(config, between), payload)
    links = len(b.Ma)
    n = links + len(b.Mc)
    M = np.block([[b.Ma, b.Mb], [b.Mb.T, b.Mc]])
    B = np.vstack([b.B_theta, b.B_eta])
    K, D = np.zeros((n, n)), (B * np.array(config.arm.joint_viscous_friction)) @ B.T
    K[links:, links:] = b.Kc
    D[links:, links:] += b.Dc
    rows = cho_solve(cho_factor(M), np.hstack([-K, -D, B * np.array(config.arm.torque_gain)]))
    A = np.zeros((2 * n, 2 * n))
    A[:n, n:], A[n:] = np.eye(n), rows[:, :2 * n]
    B = np.vstack([np.zeros_like(B), rows[:, 2 * n:]])
    return discretize(A, B, 1.0 / config.rate)


def turned(config: ControllerParameters, between: float) -> Array:
    """Return chord angles (L,) [rad] with that angle between the links: the blocks depend on it alone."""
    return np.array([0.0, between])[:len(config.arm.link_length)]


def feedforward(config: ControllerParameters, between: float, payload: float) -> tuple[Array, Array]:
    """Return (F (L, L), E (L kappa, L)): torques and modal coordinates per acceleration of the chords.

    The quasi-static solution of M q'' + K q = B u with eta'' = 0.
    """
    b = blocks(config.arm, turned(config, between), payload)
    F = solve(b.B_theta, b.Ma)
    E = solve(b.Kc, b.B_eta @ F - b.Mb.T, assume_a='pos')
    return F / np.array(config.arm.torque_gain)[:, None], E


class Design(NamedTuple):
    """Everything made for one configuration and payload.

    A (2n, 2n), B (2n, L): one sample; G (L, 2n): torque = -G (x - x_ref); L (2n, 4 L): weight of the innovation
    of [positions, rates]; the stationary linear quadratic regulator and Kalman filter. F (L, L): torque that
    accelerates the chords (L,) without vibration, E (L kappa, L): modal coordinates that go with it.
    """

    A: Array
    B: Array
    G: Array
    L: Array
    F: Array
    E: Array


def design(config: ControllerParameters, between: float, payload: float) -> Design:
    """Return the regulator and the filter. Raises ModelError when there is no stabilizing one."""
    A, B = model(config, between, payload)
    T = observation(config)
    C = np.kron(np.eye(2), T)
    links = len(T) // 2
    scale = np.array([config.angle_scale] * links + [config.bend_scale] * (T.shape[1] - links))
    Q = np.diag(np.concatenate([1.0 / scale, 1.0 / (RATE_SCALE * scale)]) ** 2)
    R = np.diag(1.0 / np.asarray(config.effort_scale) ** 2)
    W = B @ np.diag(np.asarray(config.disturbance_std) ** 2) @ B.T
    V = np.diag(np.asarray(config.noise_std) ** 2)
    try:
        P = solve_discrete_are(A, B, Q, R)
        G: Array = solve(R + B.T @ P @ B, B.T @ P @ A, assume_a='pos')
        S = solve_discrete_are(A.T, C.T, W + FLOOR * np.trace(W) * np.eye(len(A)), V)
        L: Array = solve(C @ S @ C.T + V, C @ S, assume_a='pos').T
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ModelError(
            f'there is no regulator at {between:.3f} rad with {payload:.3f} kg',
            'change angle_scale, bend_scale or effort_scale') from error
    return Design(A, B, G, L, *feedforward(config, between, payload))
