"""The plants a simulator can step: nonlinear assumed modes, linear assumed modes, finite elements.

A model turns a state x = [q; q'] (2n,) into samples and into the next state, and knows its mass matrix
and the motion of a body at its tip. ``advance`` is one compiled loop whatever the number of samples, so
that stepping one by one and simulating at once give the same bits.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigvals

from flexmanip_ros.arm import dynamics
from flexmanip_ros.arm import manipulator as arm_dynamics
from flexmanip_ros.arm.capture import body_jacobian, free_object, joined
from flexmanip_ros.arm.outputs import end_loads, slopes, slopes_with_residual_modes
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import PlantParameters
from flexmanip_ros.simulation.finite_elements import finite_element_model
from flexmanip_ros.simulation.integration import run_nonlinear, scratch
from flexmanip_ros.simulation.linear_model import linear_model
from flexmanip_ros.types import Array

STEP_ANGLE = 0.15
"""Largest angle [rad] the fastest mode turns in one integration step: its phase is then good to 4e-6."""
STABLE_ANGLE = 2.6
"""Runge-Kutta of fourth order is stable up to 2.78."""
MOST_SUBSTEPS = 1000


class Model(Protocol):
    """What the simulator asks of a plant."""

    @property
    def held(self) -> Array:
        """Combinations (0 or 2, n) of q that locked joints keep."""

    def rest(self) -> Array:
        """State (2n,) at rest at the initial angles."""

    def memory(self) -> Array:
        """What the outputs remember beside the state, at rest."""

    def struck(self, x: Array, memory: Array, jump: Array) -> Array:
        """Memory after the rates jumped by jump (n,)."""

    def advance(
        self, x: Array, payload: Array, memory: Array, efforts: Array, position: Array, velocity: Array,
    ) -> int:
        """Record efforts.shape[0] samples and advance x and memory in place; return how many are good."""

    def mass_matrix(self, x: Array, payload: Array) -> Array:
        """M at the state, (n, n)."""

    def body_jacobian(self, x: Array, com: tuple[float, float]) -> Array:
        """Motion (3, n) of a point in the tip's frame: x, y [m], angle [rad]."""


class NonlinearModel:
    """The arm of ``manipulator.py``, any amplitude and configuration."""

    def __init__(self, config: PlantParameters) -> None:
        self.arm = arm_dynamics.manipulator(config.arm)
        self.slopes = slopes_with_residual_modes(
            config.arm, config.initial_angles, self.arm.kappa, config.tail_modes, 1.0 / config.rate)
        if config.locked:  # the joints' reactions are loads of their own; clamped roots need more modes
            self.slopes = slopes(replace(config.arm, slope_correction=False), self.arm.kappa)
        self.held = self.arm.output[:2].copy() if config.locked else np.zeros((0, 2 + 2 * self.arm.kappa))
        self._angles = config.initial_angles
        self._dt = 1.0 / config.rate
        self._steps = substeps(self.arm, config)
        self._work = arm_dynamics.workspace(self.arm.kappa)
        self._scratch = scratch(4 + 4 * self.arm.kappa)

    def rest(self) -> Array:
        """State at rest: chords at the initial angles, no bending."""
        x = np.zeros(4 + 4 * self.arm.kappa)
        x[:2] = self._angles
        return x

    def memory(self) -> Array:
        """Loads of the truncated modes, then places and rates of the tail."""
        return np.zeros(7 + 2 * len(self.slopes.step))

    def struck(self, x: Array, memory: Array, jump: Array) -> Array:
        """The tail takes its part of an impulse at once; places and quasi-static loads do not jump."""
        after = memory.copy()
        loads = np.zeros(7)
        end_loads(self.arm, np.zeros(4), self.slopes, x[:jump.size], jump, np.zeros(2), loads)
        after[7 + len(self.slopes.step):] += self.slopes.load @ loads
        return after

    def advance(
        self, x: Array, payload: Array, memory: Array, efforts: Array, position: Array, velocity: Array,
    ) -> int:
        """See Model."""
        return run_nonlinear(
            self.arm, payload, self.slopes, self.held, x, memory, efforts, self._dt, self._steps,
            position, velocity, self._scratch, self._work)

    def mass_matrix(self, x: Array, payload: Array) -> Array:
        """See Model."""
        return dynamics.mass_matrix(self.arm, payload, x[:x.size // 2])

    def body_jacobian(self, x: Array, com: tuple[float, float]) -> Array:
        """See Model."""
        return body_jacobian(self.arm, x[:x.size // 2], com)


def build(config: PlantParameters) -> Model:
    """Make the plant the parameters ask for."""
    if config.model == 'nonlinear':
        return NonlinearModel(config)
    model = (finite_element_model if config.model == 'finite_element' else linear_model)(config)
    empty = np.zeros(4)
    for payload in (empty, joined(empty, free_object(config))):  # so that a live capture is not late
        model.step_matrices(payload)
    return model


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
    M = cho_factor(dynamics.mass_matrix(arm, np.zeros(4), q))
    rows = cho_solve(M, np.hstack([-np.diag(arm.stiffness), -np.diag(arm.damping)]))
    poles = eigvals(np.block([[np.zeros((n, n)), np.eye(n)], [rows]]))
    return float(np.max(np.abs(poles)))
