"""Linear plants at a working point, stepped exactly: assumed modes, and whatever gives M, D, K, B, C."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve, null_space

from flexmanip_ros.arm import dynamics
from flexmanip_ros.arm import manipulator as arm_dynamics
from flexmanip_ros.arm.capture import body_jacobian
from flexmanip_ros.arm.linearization import discretize
from flexmanip_ros.parameters import PlantParameters
from flexmanip_ros.simulation.integration import run_linear, scratch
from flexmanip_ros.types import Array


class LinearModel:
    """A linear plant M dq'' + D dq' + K dq = B tau around the initial angles, stepped exactly.

    M0: (n, n) without payload, D, K: (n, n), B: (n, 2), C: (4, n) outputs, rest_output: (4,),
    tip: function of a centre of mass giving the body Jacobian (3, n).
    """

    def __init__(
        self, M0: Array, D: Array, K: Array, B: Array, C: Array, rest_output: Array, dt: float,
        tip: BodyJacobian, locked: bool = False,
    ) -> None:
        self.held = np.zeros((0, M0.shape[0]))
        if locked:  # coordinates that leave both joint angles alone
            T = null_space(C[:2])
            M0, D, K, B, C = T.T @ M0 @ T, T.T @ D @ T, T.T @ K @ T, T.T @ B, C @ T
            free_tip = tip
            tip = lambda com: free_tip(com) @ T  # noqa: E731
        self.M0, self.D, self.K, self.B, self.C = M0, D, K, B, C
        self.rest_output = rest_output
        self._dt = dt
        self._tip = tip
        self._scratch = scratch(2 * M0.shape[0])
        self._steps: dict[bytes, tuple[Array, Array]] = {}

    def rest(self) -> Array:
        """State at rest at the working point."""
        return np.zeros(2 * self.M0.shape[0])

    def memory(self) -> Array:
        """Nothing beside the state."""
        return np.zeros(0)

    def struck(self, x: Array, memory: Array, jump: Array) -> Array:
        """See Model."""
        return memory

    def advance(
        self, x: Array, payload: Array, memory: Array, efforts: Array, position: Array, velocity: Array,
    ) -> int:
        """See Model."""
        A, B = self.step_matrices(payload)
        return run_linear(
            A, B, self.C, self.rest_output, x, efforts, position, velocity, self._scratch)

    def step_matrices(self, payload: Array) -> tuple[Array, Array]:
        """Discrete (A (2n, 2n), B (2n, 2)) with a payload, kept for the last few payloads."""
        key = payload.tobytes()
        if key not in self._steps:
            if len(self._steps) > 8:
                self._steps.clear()
            self._steps[key] = discretize(*self.continuous(payload), self._dt)
        return self._steps[key]

    def continuous(self, payload: Array) -> tuple[Array, Array]:
        """Continuous (Ac (2n, 2n), Bc (2n, 2)) of x = [dq; dq']."""
        n = self.M0.shape[0]
        rows = cho_solve(cho_factor(self.mass_matrix(self.rest(), payload)),
                         np.hstack([-self.K, -self.D, self.B]))
        Ac = np.block([[np.zeros((n, n)), np.eye(n)], [rows[:, :2 * n]]])
        return Ac, np.vstack([np.zeros((n, 2)), rows[:, 2 * n:]])

    def mass_matrix(self, x: Array, payload: Array) -> Array:
        """See Model; constant."""
        J = self._tip((float(payload[2]), float(payload[3])))
        weight = np.array([payload[0], payload[0], payload[1]])
        total: Array = self.M0 + J.T @ (weight[:, None] * J)
        return total

    def body_jacobian(self, x: Array, com: tuple[float, float]) -> Array:
        """See Model; constant."""
        return self._tip(com)


class BodyJacobian(Protocol):
    """Motion (3, n) of a point fixed in the tip's frame."""

    def __call__(self, com: tuple[float, float], /) -> Array:
        """Jacobian for a centre of mass."""


def linear_model(config: PlantParameters) -> LinearModel:
    """Linearize the assumed modes at the initial angles, at rest (paper eq. 8 with eqs. 12-14)."""
    arm = arm_dynamics.manipulator(config.arm)
    q = np.zeros(2 + 2 * arm.kappa)
    q[:2] = config.initial_angles
    return LinearModel(
        M0=dynamics.mass_matrix(arm, np.zeros(4), q), D=np.diag(arm.damping), K=np.diag(arm.stiffness),
        B=arm.torque, C=arm.output, rest_output=arm.output @ q, dt=1.0 / config.rate,
        tip=lambda com: body_jacobian(arm, q, com), locked=config.locked)
