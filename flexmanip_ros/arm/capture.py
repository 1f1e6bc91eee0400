"""What taking an object does: bodies joined at the tip, momentum conserved.

With p the momentum conjugate to q, an impulse at the tip leaves p of arm and object together unchanged:
(M + J' W J) qd+ = M qd- + J' W v, W = diag(m, m, J_c), v the object's velocity and spin, J (3, n) the
Jacobian of its centre of mass and angle. Inelastic: afterwards the object moves with the tip.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, null_space

from flexmanip_ros.arm.manipulator import Manipulator
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


def free_object(config: PlantParameters) -> Body:
    """Return the object the parameters describe."""
    (x, y), (vx, vy) = config.payload_com, config.object_velocity
    return Body(config.payload_mass, config.payload_inertia, (x, y), (vx, vy), config.object_spin)


def joined(payload: Array, body: Body) -> Array:
    """Payload (4,) after body is fixed to it: masses add, inertias by the parallel-axis theorem."""
    mass = payload[0] + body.mass
    if mass == 0.0:
        return np.array([0.0, payload[1] + body.inertia, body.com[0], body.com[1]])
    com = (payload[0] * payload[2:] + body.mass * np.asarray(body.com)) / mass
    spread = (payload[0] * np.sum((payload[2:] - com) ** 2)
              + body.mass * np.sum((np.asarray(body.com) - com) ** 2))
    return np.array([mass, payload[1] + body.inertia + spread, com[0], com[1]])


def body_jacobian(arm: Manipulator, q: Array, com: tuple[float, float]) -> Array:
    """Jacobian (3, n) of a point fixed in the tip's frame: inertial x, y [m] and angle [rad]."""
    k = arm.kappa
    eta1, eta2 = q[2:2 + k], q[2 + k:]
    e1, e2 = (np.array([np.cos(a), np.sin(a)]) for a in q[:2])
    n1, n2 = (np.array([-e[1], e[0]]) for e in (e1, e2))
    slope = arm.tip_slope[1]
    alpha = slope @ eta2
    px = com[0] * np.cos(alpha) - com[1] * np.sin(alpha)
    py = com[0] * np.sin(alpha) + com[1] * np.cos(alpha)
    reach1, reach2 = (
        arm.length[i] - arm.tip_stretch[i] @ eta**2 / 2 for i, eta in enumerate((eta1, eta2)))
    J = np.zeros((3, q.size))
    J[:2, 0] = reach1 * n1
    J[:2, 1] = (reach2 + px) * n2 - py * e2
    J[:2, 2:2 + k] = -np.outer(e1, arm.tip_stretch[0] * eta1)
    J[:2, 2 + k:] = np.outer(e2, -arm.tip_stretch[1] * eta2 - py * slope) + np.outer(n2, px * slope)
    J[2, 1] = 1.0
    J[2, 2 + k:] = slope
    return J


def rates_after(M: Array, J: Array, qd: Array, body: Body, held: Array | None = None) -> Array:
    """Rates (n,) just after the body is caught; M (n, n) is the mass matrix before.

    held: (m, n) rows of locked joints, whose reaction takes part of the impulse.
    """
    weight = np.array([body.mass, body.mass, body.inertia])
    slip = np.array([*body.velocity, body.spin]) - J @ qd
    after = M + J.T @ (weight[:, None] * J)
    free = np.eye(qd.size) if held is None or not len(held) else null_space(held)
    jump: Array = free @ cho_solve(cho_factor(free.T @ after @ free), free.T @ (J.T @ (weight * slip)))
    return qd + jump
