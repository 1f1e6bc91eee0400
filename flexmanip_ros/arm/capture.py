"""Capture of an object: a body is joined to the tip, and momentum is conserved.

An impulse at the tip leaves the momentum of arm and object together unchanged: (M + J^T W J) v+ = M v- + J^T W v_o,
W = diag(m, m, I_c), v_o the object's velocity and spin, J (3, n) the Jacobian of its centre of mass and angle. The
impact is inelastic: afterwards the object moves with the tip. The translation of a floating base is two more
coordinates here. Velocities are then relative to the centre of mass of the arm and its base.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from flexmanip_ros.arm.equations_of_motion import assemble
from flexmanip_ros.arm.manipulator import Manipulator, modal, payload_array, workspace
from flexmanip_ros.parameters import PlantParameters
from flexmanip_ros.types import Array


class Body(NamedTuple):
    """A free object: mass [kg], inertia about its centre of mass [kg m^2], centre [m] in the tip's frame."""

    mass: float
    inertia: float
    com: tuple[float, float]
    velocity: tuple[float, float]
    """Inertial velocity of its centre of mass [m/s]."""
    spin: float
    """Angular rate [rad/s]."""

    def part(self, fraction: float) -> Body:
        """A fraction of the object, as a soft gripper takes it."""
        return self._replace(mass=self.mass * fraction, inertia=self.inertia * fraction)

    @property
    def payload(self) -> Array:
        """Inertial parameters (4,), see ``manipulator.payload_array``; those of two bodies held together add."""
        return payload_array(self.mass, self.inertia, self.com)


def free_object(config: PlantParameters) -> Body:
    """Return the object the parameters describe."""
    (x, y), (vx, vy) = config.payload_com, config.object_velocity
    return Body(config.payload_mass, config.payload_inertia, (x, y), (vx, vy), config.object_spin)


def tip_jacobian(arm: Manipulator, payload: Array, q: Array) -> Array:
    """Jacobian (3, n) of the tip: inertial x, y [m] and angle of its cross-section [rad].

    With a floating base, x and y are relative to the centre of mass of base, arm and payload.
    """
    work = workspace(arm)
    assemble(arm, payload, np.asarray(q, float), np.zeros_like(q), work.M, work.E, work)
    links = arm.length.size
    J = np.zeros((3, q.size))
    J[:2] = work.J[links]
    if arm.floating:
        J[:2] -= work.P / work.F[2]
    J[2, links - 1] = 1.0
    J[2, modal(links, arm.kappa, links - 1)] = arm.tip_slope[-1]
    return J


def rates_after(M: Array, J: Array, qd: Array, body: Body, mass: float = np.inf, held: Array | None = None) -> Array:
    """Rates (n,) just after the body is caught; M (n, n) is the mass matrix before.

    J: (3, n) Jacobian of the body's centre of mass and angle; mass: total mass of all that floats before the capture
    [kg], inf where the base is fixed. With a floating base, M and J are relative to the centre of mass of all that
    floats. held: (m, n) rows of locked joints, whose reaction takes part of the impulse.
    """
    slip = np.array([*body.velocity, body.spin]) - J @ qd
    # mobility at the body's centre: J M^-1 J^T of the arm, plus 1 / mass for the translation of a floating base
    free = np.eye(qd.size) if held is None or not len(held) else scipy.linalg.null_space(held)
    response = free @ scipy.linalg.cho_solve(scipy.linalg.cho_factor(free.T @ M @ free), (J @ free).T)
    yielding = J @ response + np.diag([1.0 / mass, 1.0 / mass, 0.0])
    weight = np.diag([body.mass, body.mass, body.inertia])
    # impulse p: weight (slip - yielding p) = p
    impulse = np.linalg.solve(np.eye(3) + weight @ yielding, weight @ slip)
    jumped: Array = qd + response @ impulse
    return jumped


def body_jacobian(tip: Array, turn: float, com: tuple[float, float]) -> Array:
    """Jacobian (3, n) of a point of the tip's frame, from the tip's own and the angle of its cross-section [rad]."""
    c, s = np.cos(turn), np.sin(turn)
    J = tip.copy()
    J[0] -= (s * com[0] + c * com[1]) * tip[2]
    J[1] += (c * com[0] - s * com[1]) * tip[2]
    return J


def tip_angle(arm: Manipulator, q: Array) -> float:
    """Angle of the tip's cross-section [rad]."""
    last = arm.length.size - 1
    return float(q[last] + arm.tip_slope[last] @ q[modal(last + 1, arm.kappa, last)])
