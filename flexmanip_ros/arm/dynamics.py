"""The equations of motion evaluated once, for checks and linearizations: mass matrix, forces, energy, accelerations."""

from __future__ import annotations

import numpy as np

from flexmanip_ros.arm.equations_of_motion import (
    acceleration,
    assemble,
    elastic,
    eliminate_translation,
    net_torques,
    torque_matrix,
)
from flexmanip_ros.arm.jacobian import bias_jacobian, damping_jacobian, elastic_jacobian, torque_jacobian
from flexmanip_ros.arm.manipulator import Manipulator, Workspace, workspace
from flexmanip_ros.errors import ModelError
from flexmanip_ros.types import Array


def mass_matrix(arm: Manipulator, payload: Array, q: Array) -> Array:
    """Return M(q), (n, n); of a floating base without its translation, which keeps the momentum."""
    return _assembled(arm, payload, q, np.zeros_like(q))[0]


def bias(arm: Manipulator, payload: Array, q: Array, qd: Array) -> Array:
    """Return E(q, qd), the centripetal, Coriolis and gravity forces, (n,)."""
    return _assembled(arm, payload, q, qd)[1]


def momentum(arm: Manipulator, payload: Array, q: Array) -> tuple[Array, float]:
    """Return P (2, n), linear momentum by the rates where the base does not translate, and the mass of all [kg]."""
    work = workspace(arm)
    assemble(arm, payload, np.asarray(q, float), np.zeros_like(q), work.M, work.E, work)
    return work.P, float(work.F[2])


def coriolis_matrix(arm: Manipulator, payload: Array, q: Array, qd: Array) -> Array:
    """Return C(q, qd) of the Christoffel symbols, (n, n): E = C qd and dM/dt - 2 C is skew.

    E is quadratic in the rates with the symmetric Christoffel symbols, hence C = dE/dqd / 2.
    """
    work = workspace(arm)
    bias_jacobian(arm, payload, q, qd, np.zeros_like(q), work.left, work.right, work)
    return work.right / 2


def torque_at(arm: Manipulator, q: Array) -> Array:
    """Return the generalized forces of unit joint torques at q, (n, L)."""
    B = np.empty_like(arm.torque)
    torque_matrix(arm, np.asarray(q, float), B)
    return B


def energy(arm: Manipulator, payload: Array, q: Array, qd: Array) -> float:
    """Kinetic plus elastic energy [J]; of a floating base in the frame of the centre of mass of all."""
    k, links = arm.kappa, arm.length.size
    potential = float(q @ (arm.stiffness * q)) / 2
    for i in range(links):
        part = slice(links + i * k, links + (i + 1) * k)
        EI = arm.stiffness[part][0] / arm.unit_stiffness[part][0]
        potential += EI / 2 * float(arm.along[i] @ ((arm.curvature[i] @ q[part]) * (arm.slope[i] @ q[part])) ** 2)
    return float(qd @ mass_matrix(arm, payload, q) @ qd) / 2 + potential


def elastic_forces(arm: Manipulator, q: Array) -> Array:
    """Return the elastic forces dV/dq (n,): K q, and of third order when shortening is kept."""
    return _elastic(arm, q).elastic


def stiffness_at(arm: Manipulator, q: Array, qd: Array, effort: Array) -> tuple[Array, Array]:
    """Derivatives (n, n) by q and by the rates of elastic forces, damping and friction less the torques' forces."""
    q, qd = np.asarray(q, float), np.asarray(qd, float)
    work = _elastic(arm, q)
    torque_matrix(arm, q, work.B)
    net_torques(work.B, arm, qd, np.asarray(effort, float), work.net)
    K, D = np.zeros((q.size, q.size)), np.zeros((q.size, q.size))
    elastic_jacobian(arm, q, K, work)
    torque_jacobian(arm, q, qd, work, K)
    damping_jacobian(arm, work, D)
    return K, D


def accelerations(arm: Manipulator, payload: Array, q: Array, qd: Array, effort: Array) -> Array:
    """Return q'' (n,) for joint torques (L,) [N m]; ModelError when the mass matrix is not positive."""
    qdd = np.empty_like(q)
    if not acceleration(arm, payload, q, qd, effort, qdd, workspace(arm)):
        raise ModelError('the mass matrix is not positive definite', 'check the state for non-finite numbers')
    return qdd


def _elastic(arm: Manipulator, q: Array) -> Workspace:
    work = workspace(arm)
    elastic(arm, np.asarray(q, float), work)
    return work


def _assembled(arm: Manipulator, payload: Array, q: Array, qd: Array) -> tuple[Array, Array]:
    work = workspace(arm)
    assemble(arm, payload, np.asarray(q, float), np.asarray(qd, float), work.M, work.E, work)
    if arm.floating:
        eliminate_translation(work.M, work.E, work)
    lower = np.tril(work.M)
    return lower + np.tril(lower, -1).T, work.E
