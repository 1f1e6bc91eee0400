"""The compiled equations of motion called once from Python: forces, energy, accelerations."""

from __future__ import annotations

import numpy as np

from flexmanip_ros.arm.equations_of_motion import acceleration, assemble, elastic, eliminate_translation, torque_matrix
from flexmanip_ros.arm.jacobian import force_jacobian
from flexmanip_ros.arm.linearization import mass_matrix
from flexmanip_ros.arm.manipulator import Manipulator, workspace
from flexmanip_ros.types import Array


def bias(arm: Manipulator, payload: Array, q: Array, qd: Array) -> Array:
    """Return E(q, qd), the centripetal, Coriolis and gravity forces, (n,)."""
    work = workspace(arm)
    assemble(arm, payload, np.asarray(q, float), np.asarray(qd, float), work.M, work.E, work)
    if arm.floating:
        eliminate_translation(work.M, work.E, work)
    return work.E


def coriolis_matrix(arm: Manipulator, payload: Array, q: Array, qd: Array) -> Array:
    """Return C(q, qd) of the Christoffel symbols, (n, n): E = C qd and dM/dt - 2 C is skew; C = dE/dqd / 2."""
    work = workspace(arm)
    assemble(arm, payload, q, qd, work.M, work.E, work)
    left, right = np.zeros((2, q.size, q.size))
    force_jacobian(arm, payload, q, qd, np.zeros_like(q), left, right, np.zeros((q.size, 4)), work)
    return right / 2


def torque_at(arm: Manipulator, q: Array) -> Array:
    """Return the generalized forces of unit joint torques at q, (n, L)."""
    B = np.empty_like(arm.torque)
    torque_matrix(arm, np.asarray(q, float), B)
    return B


def elastic_forces(arm: Manipulator, q: Array) -> Array:
    """Return the elastic forces dV/dq (n,): K q, and of third order when shortening is kept."""
    work = workspace(arm)
    elastic(arm, np.asarray(q, float), work)
    return work.elastic


def energy(arm: Manipulator, payload: Array, q: Array, qd: Array) -> float:
    """Kinetic plus elastic energy [J]; of a floating base in the frame of the centre of mass of all."""
    k, links = arm.kappa, arm.length.size
    potential = float(q @ (arm.stiffness * q)) / 2
    for i in range(links):
        part = slice(links + i * k, links + (i + 1) * k)
        EI = arm.stiffness[part][0] / arm.unit_stiffness[part][0]
        potential += EI / 2 * float(arm.along[i] @ ((arm.curvature[i] @ q[part]) * (arm.slope[i] @ q[part])) ** 2)
    return float(qd @ mass_matrix(arm, payload, q) @ qd) / 2 + potential


def accelerations(arm: Manipulator, payload: Array, q: Array, qd: Array, effort: Array) -> Array:
    """Return q'' (n,) for joint torques (L,) [N m]; NaN where the mass matrix is not positive."""
    qdd = np.empty_like(q)
    good = acceleration(arm, payload, q, qd, effort, qdd, workspace(arm))
    return qdd if good else np.full_like(q, np.nan)
