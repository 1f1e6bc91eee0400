"""The plants a simulator can step: nonlinear assumed modes, linear assumed modes, finite elements.

A model turns a state x = [q; q'] (2n,) into samples and into the next state, and knows its mass matrix
and the motion of a body at its tip. ``advance`` is one compiled loop whatever the number of samples, so
that stepping one by one and simulating at once give the same bits.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigvals

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters.plant import PlantParameters
from flexmanip_ros.plant import manipulator as arm_dynamics
from flexmanip_ros.plant.capture import body_jacobian
from flexmanip_ros.plant.integration_kernel import run_linear, run_nonlinear, scratch
from flexmanip_ros.plant.linearization import discretize
from flexmanip_ros.plant.slope_correction import slopes
from flexmanip_ros.types import Array

STEP_ANGLE = 0.1
"""Largest angle [rad] the fastest mode turns in one integration step: its phase is then good to 1e-6."""
STABLE_ANGLE = 2.6
"""Runge-Kutta of fourth order is stable up to 2.78."""
MOST_SUBSTEPS = 1000


class Model(Protocol):
    """What the simulator asks of a plant."""

    def rest(self) -> Array:
        """State (2n,) at rest at the initial angles."""

    def advance(
        self, x: Array, payload: Array, previous: Array, efforts: Array, position: Array, velocity: Array,
    ) -> int:
        """Record efforts.shape[0] samples and advance x and previous in place; return how many are good."""

    def mass_matrix(self, x: Array, payload: Array) -> Array:
        """M at the state, (n, n)."""

    def body_jacobian(self, x: Array, com: tuple[float, float]) -> Array:
        """Motion (3, n) of a point in the tip's frame: x, y [m], angle [rad]."""


class NonlinearModel:
    """The arm of ``manipulator.py``, any amplitude and configuration."""

    def __init__(self, config: PlantParameters) -> None:
        self.arm = arm_dynamics.manipulator(config.arm)
        self.slopes = slopes(config.arm, self.arm.kappa)
        self._angles = config.initial_angles
        self._dt = 1.0 / config.rate
        self._steps = substeps(self.arm, config)
        self._work = arm_dynamics.workspace(self.arm.kappa)
        self._scratch = scratch(4 + 4 * self.arm.kappa)
        self._loads = np.zeros(7)

    def rest(self) -> Array:
        """State at rest: chords at the initial angles, no bending."""
        x = np.zeros(4 + 4 * self.arm.kappa)
        x[:2] = self._angles
        return x

    def advance(
        self, x: Array, payload: Array, previous: Array, efforts: Array, position: Array, velocity: Array,
    ) -> int:
        """See Model."""
        return run_nonlinear(
            self.arm, payload, self.slopes, x, previous, efforts, self._dt, self._steps, position, velocity,
            self._scratch, self._loads, self._work)

    def mass_matrix(self, x: Array, payload: Array) -> Array:
        """See Model."""
        return arm_dynamics.mass_matrix(self.arm, payload, x[:x.size // 2])

    def body_jacobian(self, x: Array, com: tuple[float, float]) -> Array:
        """See Model."""
        return body_jacobian(self.arm, x[:x.size // 2], com)


class LinearModel:
    """A linear plant M dq'' + D dq' + K dq = B tau around the initial angles, stepped exactly.

    M0: (n, n) without payload, D, K: (n, n), B: (n, 2), C: (4, n) outputs, rest_output: (4,),
    tip: function of a centre of mass giving the body Jacobian (3, n).
    """

    def __init__(
        self, M0: Array, D: Array, K: Array, B: Array, C: Array, rest_output: Array, dt: float,
        tip: BodyJacobian,
    ) -> None:
        self.M0, self.D, self.K, self.B, self.C = M0, D, K, B, C
        self.rest_output = rest_output
        self._dt = dt
        self._tip = tip
        self._scratch = scratch(2 * M0.shape[0])
        self._steps: dict[bytes, tuple[Array, Array]] = {}

    def rest(self) -> Array:
        """State at rest at the working point."""
        return np.zeros(2 * self.M0.shape[0])

    def advance(
        self, x: Array, payload: Array, previous: Array, efforts: Array, position: Array, velocity: Array,
    ) -> int:
        """See Model."""
        A, B = self.step_matrices(payload)
        good = run_linear(
            A, B, self.C, self.rest_output, x, efforts, position, velocity, self._scratch)
        if good:
            previous[:] = efforts[good - 1]
        return good

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
        M0=arm_dynamics.mass_matrix(arm, np.zeros(4), q), D=np.diag(arm.damping), K=np.diag(arm.stiffness),
        B=arm.torque, C=arm.output, rest_output=arm.output @ q, dt=1.0 / config.rate,
        tip=lambda com: body_jacobian(arm, q, com))


def build(config: PlantParameters) -> Model:
    """Make the plant the parameters ask for."""
    if config.model == 'linear':
        return linear_model(config)
    return NonlinearModel(config)


def substeps(arm: arm_dynamics.Manipulator, config: PlantParameters) -> int:
    """Integration steps a sample for the fastest mode of the empty arm, in any configuration.

    Raises ParameterError naming the field when the steps asked for are unstable, or none suffice.
    """
    fastest = max(_fastest(arm, spread) for spread in (0.0, np.pi / 2, np.pi))
    angle = fastest / config.rate
    if config.substeps:
        if angle / config.substeps > STABLE_ANGLE:
            raise ParameterError(
                f"parameter 'substeps' is {config.substeps}: the fastest mode turns "
                f'{angle / config.substeps:.1f} rad a step and the integration is unstable',
                f'give at least {int(np.ceil(angle / STABLE_ANGLE))}, or 0 for automatic')
        return config.substeps
    steps = max(int(np.ceil(angle / STEP_ANGLE)), 1)
    if steps > MOST_SUBSTEPS:
        raise ParameterError(
            f"parameter 'rate' is {config.rate} Hz but the fastest mode needs {steps} steps a sample",
            "raise 'rate', lower 'arm.modes', or check length, density and stiffness")
    return steps


def _fastest(arm: arm_dynamics.Manipulator, spread: float) -> float:
    """Largest pole magnitude [rad/s] with chord 2 at an angle from chord 1."""
    n = 2 + 2 * arm.kappa
    q = np.zeros(n)
    q[1] = spread
    M = cho_factor(arm_dynamics.mass_matrix(arm, np.zeros(4), q))
    rows = cho_solve(M, np.hstack([-np.diag(arm.stiffness), -np.diag(arm.damping)]))
    poles = eigvals(np.block([[np.zeros((n, n)), np.eye(n)], [rows]]))
    return float(np.max(np.abs(poles)))
