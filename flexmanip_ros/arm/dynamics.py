"""The equations of motion evaluated once, for checks and linearizations: mass matrix, forces, energy, accelerations."""

from __future__ import annotations

import numpy as np

from flexmanip_ros.arm.equations_of_motion import acceleration, assemble, elastic, steepen
from flexmanip_ros.arm.jacobian import bias_jacobian
from flexmanip_ros.arm.manipulator import Manipulator, workspace
from flexmanip_ros.errors import ModelError
from flexmanip_ros.types import Array


def mass_matrix(arm: Manipulator, payload: Array, q: Array) -> Array:
    """Return M(q), (n, n)."""
    M, _ = _assembled(arm, payload, q, np.zeros_like(q))
    return M


def bias(arm: Manipulator, payload: Array, q: Array, qd: Array) -> Array:
    """Return E(q, qd), the centripetal and Coriolis forces, (n,)."""
    return _assembled(arm, payload, q, qd)[1]


def coriolis_matrix(arm: Manipulator, payload: Array, q: Array, qd: Array) -> Array:
    """Return C(q, qd) of the Christoffel symbols, (n, n): E = C qd and dM/dt - 2 C is skew.

    E is quadratic in the rates with the symmetric Christoffel symbols, hence C = dE/dqd / 2.
    """
    work = workspace(arm.kappa)
    bias_jacobian(arm, payload, q, qd, np.zeros_like(q), work.left, work.right, work)
    return work.right / 2


def torque_at(arm: Manipulator, q: Array) -> Array:
    """Return the generalized forces of unit joint torques at q, (n, 2)."""
    B = arm.torque.copy()
    if arm.shortening:
        for i, unit in enumerate(np.eye(2)):
            column = B[:, i].copy()
            steepen(arm.root_slope, arm.tip_slope, arm.torque, np.asarray(q, float), unit, column)
            B[:, i] = column
    return B


def energy(arm: Manipulator, payload: Array, q: Array, qd: Array) -> float:
    """Kinetic plus elastic energy [J]."""
    M = mass_matrix(arm, payload, q)
    fourth = 0.0
    for i in range(2):
        part = slice(2 + i * arm.kappa, 2 + (i + 1) * arm.kappa)
        EI = arm.stiffness[part][0] / arm.unit_stiffness[part][0]
        eta = q[part]
        fourth += EI / 2 * np.einsum('jklm,j,k,l,m', arm.quartic[i], eta, eta, eta, eta)
    return float(qd @ M @ qd + q @ (arm.stiffness * q) + fourth) / 2


def elastic_forces(arm: Manipulator, q: Array) -> Array:
    """Return the elastic forces dV/dq (n,): K q, and of third order when shortening is kept."""
    work = workspace(arm.kappa)
    elastic(arm, np.asarray(q, float), work)
    return work.elastic


def elastic_tangent(arm: Manipulator, q: Array) -> Array:
    """Return the derivative (n, n) of the elastic forces by q."""
    work = workspace(arm.kappa)
    elastic(arm, np.asarray(q, float), work)
    K = np.diag(arm.stiffness)
    for i in range(2):
        part = slice(2 + i * arm.kappa, 2 + (i + 1) * arm.kappa)
        K[part, part] += work.tangent[part]
    return K


def accelerations(arm: Manipulator, payload: Array, q: Array, qd: Array, effort: Array) -> Array:
    """Return q'' (n,) for joint torques (2,) [N m]; ModelError when the mass matrix is not positive."""
    qdd = np.empty_like(q)
    if not acceleration(arm, payload, q, qd, effort, qdd, workspace(arm.kappa)):
        raise ModelError('the mass matrix is not positive definite', 'check the state for non-finite numbers')
    return qdd


def _assembled(arm: Manipulator, payload: Array, q: Array, qd: Array) -> tuple[Array, Array]:
    work = workspace(arm.kappa)
    assemble(arm, payload, np.asarray(q, float), np.asarray(qd, float), work.M, work.E, work)
    lower = np.tril(work.M)
    return lower + np.tril(lower, -1).T, work.E
