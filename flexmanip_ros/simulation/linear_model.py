"""Linear plants at a working point, stepped exactly: assumed modes, and whatever gives M, D, K, B, C."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve, null_space

from flexmanip_ros.arm import dynamics
from flexmanip_ros.arm.capture import body_jacobian, tip_angle, tip_jacobian
from flexmanip_ros.arm.linearization import discretize
from flexmanip_ros.arm.manipulator import manipulator
from flexmanip_ros.parameters import PlantParameters
from flexmanip_ros.simulation.integration import run_linear, scratch
from flexmanip_ros.types import Array


class LinearModel:
    """A linear plant M dq'' + D dq' + K dq = B tau around the initial angles, stepped exactly.

    M0: (n, n) without payload, D, K: (n, n), B: (n, L), C: (2 L, n) outputs, rest_output: (2 L,), tip: Jacobian (3, n)
    of the tip and the angle of its cross-section, turn: that angle [rad].
    """

    def __init__(
        self, M0: Array, D: Array, K: Array, B: Array, C: Array, rest_output: Array, dt: float,
        tip: Array, turn: float, locked: bool = False,
    ) -> None:
        self.held = np.zeros((0, M0.shape[0]))
        if locked:  # coordinates that leave both joint angles alone
            T = null_space(C[:len(C) // 2])
            M0, D, K, B, C = T.T @ M0 @ T, T.T @ D @ T, T.T @ K @ T, T.T @ B, C @ T
            tip = tip @ T
        self.M0, self.D, self.K, self.B, self.C = M0, D, K, B, C
        self.rest_output = rest_output
        self._dt = dt
        self._tip, self._turn = tip, turn
        self._scratch = scratch(2 * M0.shape[0])
        self._steps: dict[bytes, tuple[Array, Array]] = {}

    def rest(self) -> Array:
        """State at rest at the working point."""
        return np.zeros(2 * self.M0.shape[0])

    def advance(self, x: Array, payload: Array, efforts: Array, position: Array, velocity: Array) -> int:
        """See Model."""
        A, B = self.step_matrices(payload)
        return run_linear(A, B, self.C, self.rest_output, x, efforts, position, velocity, self._scratch)

    def step_matrices(self, payload: Array) -> tuple[Array, Array]:
        """Discrete (A (2n, 2n), B (2n, L)) with a payload, kept for the last few payloads."""
        key = payload.tobytes()
        if key not in self._steps:
            if len(self._steps) > 8:
                self._steps.clear()
            self._steps[key] = discretize(*self.continuous(payload), self._dt)
        return self._steps[key]

    def continuous(self, payload: Array) -> tuple[Array, Array]:
        """Continuous (Ac (2n, 2n), Bc (2n, L)) of x = [dq; dq']."""
        n = self.M0.shape[0]
        rows = cho_solve(cho_factor(self.mass_matrix(self.rest(), payload)),
                         np.hstack([-self.K, -self.D, self.B]))
        Ac = np.block([[np.zeros((n, n)), np.eye(n)], [rows[:, :2 * n]]])
        return Ac, np.vstack([np.zeros_like(self.B), rows[:, 2 * n:]])

    def mass_matrix(self, x: Array, payload: Array) -> Array:
        """See Model; constant."""
        m, hx, hy, inertia = payload
        J = self._tip
        # the body's first moments act across J: body_jacobian of a unit mass, less the tip's own, is linear in them
        d = body_jacobian(J, self._turn, (hx, hy))[:2] - J[:2]
        total: Array = self.M0 + m * J[:2].T @ J[:2] + J[:2].T @ d + d.T @ J[:2] + inertia * np.outer(J[2], J[2])
        return total

    def body_jacobian(self, x: Array, payload: Array, com: tuple[float, float]) -> Array:
        """See Model; constant."""
        return body_jacobian(self._tip, self._turn, com)

    def floating_mass(self, payload: Array) -> float:
        """See Model."""
        return np.inf


def linear_model(config: PlantParameters) -> LinearModel:
    """Linearize the assumed modes at the initial angles, at rest (paper eq. 8 with eqs. 12-14)."""
    arm = manipulator(config.arm)
    q = np.zeros(arm.stiffness.size)
    q[:len(config.initial_angles)] = config.initial_angles
    return LinearModel(
        M0=dynamics.mass_matrix(arm, np.zeros(4), q),
        D=np.diag(arm.damping) + (arm.torque * arm.viscous) @ arm.torque.T,
        K=np.diag(arm.stiffness), B=arm.torque, C=arm.output, rest_output=arm.output @ q, dt=1.0 / config.rate,
        tip=tip_jacobian(arm, np.zeros(4), q), turn=tip_angle(arm, q), locked=config.locked)
