"""The plants a simulator can step: nonlinear assumed modes, linear assumed modes, finite elements.

A model turns a state x = [q; q'] (2n,) into samples and into the next state, and knows its mass matrix
and the motion of a body at its tip. ``advance`` is one compiled loop whatever the number of samples, so
that stepping one by one and simulating at once give the same bits.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.linalg import eigvals

from flexmanip_ros.arm import linearization
from flexmanip_ros.arm.capture import body_jacobian, free_object, tip_angle, tip_jacobian
from flexmanip_ros.arm.equations_of_motion import STICTION_RATE
from flexmanip_ros.arm.manipulator import Manipulator, manipulator, workspace
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import PlantParameters
from flexmanip_ros.simulation.integration import run_nonlinear, scratch
from flexmanip_ros.simulation.linear_model import finite_element_model, linear_model
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
        """Combinations (0 or L, n) of q that locked joints keep."""

    def rest(self) -> Array:
        """State (2n,) at rest at the initial angles."""

    def advance(self, x: Array, payload: Array, efforts: Array, position: Array, velocity: Array) -> int:
        """Record efforts.shape[0] samples and advance x in place; return how many are good."""

    def mass_matrix(self, x: Array, payload: Array) -> Array:
        """M at the state, (n, n)."""

    def body_jacobian(self, x: Array, payload: Array, com: tuple[float, float]) -> Array:
        """Motion (3, n) of a point in the tip's frame: x, y [m], angle [rad]."""

    def floating_mass(self, payload: Array) -> float:
        """Mass of all that floats with the base [kg]; inf: the base is fixed."""


class NonlinearModel:
    """The arm of ``manipulator.py``, any amplitude and configuration."""

    def __init__(self, config: PlantParameters) -> None:
        self.arm = manipulator(config.arm)
        n, links = self.arm.torque.shape
        self.held = self.arm.output[:links].copy() if config.locked else np.zeros((0, n))
        self._angles = config.initial_angles
        self._dt = 1.0 / config.rate
        self._steps = substeps(self.arm, config)
        self._work = workspace(self.arm)
        self._scratch = scratch(2 * n)

    def rest(self) -> Array:
        """State at rest: chords at the initial angles, no bending."""
        x = np.zeros(2 * self.arm.stiffness.size)
        x[:len(self._angles)] = self._angles
        return x

    def advance(self, x: Array, payload: Array, efforts: Array, position: Array, velocity: Array) -> int:
        """See Model."""
        return run_nonlinear(self.arm, payload, self.held, x, efforts, self._dt, self._steps, position, velocity,
                             self._scratch, self._work)

    def mass_matrix(self, x: Array, payload: Array) -> Array:
        """See Model."""
        return linearization.mass_matrix(self.arm, payload, x[:x.size // 2])

    def body_jacobian(self, x: Array, payload: Array, com: tuple[float, float]) -> Array:
        """See Model."""
        q = x[:x.size // 2]
        return body_jacobian(tip_jacobian(self.arm, payload, q), tip_angle(self.arm, q), com)

    def floating_mass(self, payload: Array) -> float:
        """See Model."""
        return linearization.momentum(self.arm, payload, self.rest()[:self.arm.stiffness.size])[1] \
            if self.arm.floating else np.inf


def build(config: PlantParameters) -> Model:
    """Make the plant the parameters ask for. Raises ParameterError where a linear plant cannot be so."""
    if config.model == 'nonlinear':
        return NonlinearModel(config)
    arm = config.arm
    if config.model == 'finite_element' and len(arm.link_length) == 1:
        raise ParameterError("parameter 'model' is 'finite_element', but the arm has one link",
                             "choose 'model' nonlinear or linear")
    for name, value in (('gravity', any(arm.gravity)), ('base_mass', arm.base_mass),
                        ('joint_coulomb_friction', any(arm.joint_coulomb_friction))):
        if value:
            raise ParameterError(f"parameter 'arm.{name}' is set, but a {config.model} plant has none",
                                 "choose 'model' nonlinear")
    model = (finite_element_model if config.model == 'finite_element' else linear_model)(config)
    for payload in (np.zeros(4), free_object(config).payload):  # so that a live capture is not late
        model.step_matrices(payload)
    return model


def substeps(arm: Manipulator, config: PlantParameters) -> int:
    """Integration steps a sample for the fastest mode of the empty arm, in any configuration.

    Raises ParameterError naming the field when the steps asked for are unstable, or none suffice.
    """
    fastest = max(_fastest(arm, spread, 0.0) for spread in (0.0, np.pi / 2, np.pi)) / config.rate
    # where a joint sticks, its friction is a stiff damper, and stability is enough
    stiffest = max(_fastest(arm, spread, 1.0) for spread in (0.0, np.pi / 2, np.pi)) / config.rate
    if config.substeps:
        if stiffest / config.substeps > STABLE_ANGLE:
            raise ParameterError(
                f"parameter 'substeps' is {config.substeps}: the fastest mode turns "
                f'{stiffest / config.substeps:.1f} rad a step and the integration is unstable',
                f'give at least {int(np.ceil(stiffest / STABLE_ANGLE))}, or 0 for automatic')
        return config.substeps
    steps = max(int(np.ceil(fastest / STEP_ANGLE)), int(np.ceil(stiffest)), 1)
    if steps > MOST_SUBSTEPS:
        raise ParameterError(
            f"parameter 'rate' is {config.rate} Hz but the fastest mode needs {steps} steps a sample",
            "raise 'rate', lower 'arm.modes', or check length, density and stiffness")
    return steps


def _fastest(arm: Manipulator, spread: float, sticking: float) -> float:
    """Largest pole magnitude [rad/s] with chord 2 at an angle from chord 1; sticking: share of the joints' friction."""
    n, links = arm.torque.shape
    q = np.zeros(n)
    q[links - 1] = spread
    friction = arm.viscous + sticking * arm.coulomb / STICTION_RATE
    D = np.diag(arm.damping) + (arm.torque * friction) @ arm.torque.T
    M = linearization.mass_matrix(arm, np.zeros(4), q)
    A, _ = linearization.first_order(M, np.diag(arm.stiffness), D, np.zeros((n, 0)))
    return float(np.max(np.abs(eigvals(A))))
