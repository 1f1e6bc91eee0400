"""The arm at a working point: where it is, and its linear vibration model (paper eqs. 20-23)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, expm

from flexmanip_ros.arm import dynamics
from flexmanip_ros.arm.jacobian import bias_jacobian, steep_jacobian
from flexmanip_ros.arm.manipulator import (
    Manipulator,
    damping,
    root_slopes,
    stiffness,
    tip_slopes,
    torque_matrix,
    workspace,
)
from flexmanip_ros.errors import ModelError
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array


class Linearization(NamedTuple):
    """Matrices of eq. (8), each (n, n), B (n, 2), and the acceleration (n,) of the working point."""

    M: Array
    C_E: Array
    """Derivative of the bias E(q, q') by the rates."""
    K_M: Array
    """Derivative of M(q) q'' by q at the working point's acceleration."""
    K_E: Array
    """Derivative of the bias by q."""
    K: Array
    """Derivative of the elastic forces less the torques' by q."""
    D: Array
    B: Array
    acceleration: Array

    def state_space(self) -> tuple[Array, Array]:
        """Continuous (A (2n, 2n), B (2n, 2)) of x = [dq; dq']."""
        n = len(self.M)
        rows = cho_solve(cho_factor(self.M), np.hstack([
            -(self.K + self.K_M + self.K_E), -(self.C_E + self.D), self.B]))
        A = np.block([[np.zeros((n, n)), np.eye(n)], [rows[:, :2 * n]]])
        return A, np.vstack([np.zeros((n, 2)), rows[:, 2 * n:]])


def linearize(
    arm: Manipulator, payload: Array, q: Array, qd: Array, effort: Array, simplified: bool = False,
) -> Linearization:
    """Linearize at coordinates q (n,), rates qd (n,) and joint torques effort (2,) [N m].

    simplified: as in the paper, bending in M and all of C_E, K_M and K_E are dropped.
    Raises ModelError when a number is not finite or a size is wrong.
    """
    n = 2 + 2 * arm.kappa
    q, qd, effort = (np.asarray(value, dtype=np.float64) for value in (q, qd, effort))
    if q.shape != (n,) or qd.shape != (n,) or effort.shape != (2,):
        raise ModelError(f'the working point has shapes {q.shape}, {qd.shape}, {effort.shape}',
                         f'give {n} coordinates, {n} rates and 2 torques')
    qdd = dynamics.accelerations(arm, payload, q, qd, effort)
    if simplified:
        straight = np.concatenate([q[:2], np.zeros(n - 2)])
        zero = np.zeros((n, n))
        return Linearization(
            M=dynamics.mass_matrix(arm, payload, straight), C_E=zero, K_M=zero, K_E=zero,
            K=np.diag(arm.stiffness), D=np.diag(arm.damping), B=arm.torque.copy(), acceleration=qdd)
    work = workspace(arm.kappa)
    both, rates = np.empty((n, n)), np.empty((n, n))
    bias_jacobian(arm, payload, q, qd, qdd, both, rates, work)
    K = dynamics.elastic_tangent(arm, q)
    if arm.shortening:
        steep_jacobian(arm.root_slope, arm.tip_slope, arm.torque, q, effort, K)
    at_rest = np.empty((n, n))
    bias_jacobian(arm, payload, q, qd, np.zeros(n), at_rest, rates, work)
    return Linearization(
        M=dynamics.mass_matrix(arm, payload, q), C_E=rates, K_M=both - at_rest, K_E=at_rest,
        K=K, D=np.diag(arm.damping), B=dynamics.torque_at(arm, q), acceleration=qdd)


class Blocks(NamedTuple):
    """Mass, stiffness and input matrices with q = [theta; eta], k modes a link (paper eqs. 12-14).

    Ma: (2, 2), Mb: (2, 2k), Mc: (2k, 2k), Kc: (2k, 2k), B_theta: (2, 2), B_eta: (2k, 2), in SI units.
    """

    Ma: Array
    Mb: Array
    Mc: Array
    Kc: Array
    B_theta: Array
    B_eta: Array


def blocks(arm: ArmParameters, theta: Array, payload_mass: float = 0.0, kappa: int | None = None) -> Blocks:
    """Return the block matrices at chord angles theta (2,) [rad], eta = 0, for a point-mass payload [kg].

    Raises ModelError when theta or the payload is not finite or kappa is below 1.
    """
    k = arm.modes if kappa is None else kappa
    theta = _checked(theta, payload_mass, k)
    (L1, L2), (rho1, rho2) = arm.link_length, arm.linear_density
    m_o = arm.tip_mass + payload_mass
    c = float(np.cos(theta[1] - theta[0]))
    j = np.arange(1, k + 1)
    sign = np.where(j % 2, -1.0, 1.0)  # cos(j pi)
    J_hub1, J_hub2 = arm.hub_inertia
    root, tip = root_slopes(arm, k), tip_slopes(arm, k)

    Ma = np.empty((2, 2))
    Ma[0, 0] = rho1 * L1**3 / 3 + (arm.joint_mass + rho2 * L2 + m_o) * L1**2 + J_hub1 + arm.joint_inertia
    Ma[0, 1] = Ma[1, 0] = (rho2 * L2 / 2 + m_o) * L1 * L2 * c
    Ma[1, 1] = rho2 * L2**3 / 3 + m_o * L2**2 + J_hub2 + arm.tip_inertia

    Mb = np.zeros((2, 2 * k))
    Mb[0, :k] = -rho1 * L1**2 * sign / (j * np.pi) + J_hub1 * root[0] + arm.joint_inertia * tip[0]
    Mb[0, k:] = rho2 * L1 * L2 * c * (1 - sign) / (j * np.pi)
    Mb[1, k:] = -rho2 * L2**2 * sign / (j * np.pi) + J_hub2 * root[1] + arm.tip_inertia * tip[1]

    Mc = np.diag(np.repeat([rho1 * L1 / 2, rho2 * L2 / 2], k))
    Mc[:k, :k] += J_hub1 * np.outer(root[0], root[0]) + arm.joint_inertia * np.outer(tip[0], tip[0])
    Mc[k:, k:] += J_hub2 * np.outer(root[1], root[1]) + arm.tip_inertia * np.outer(tip[1], tip[1])

    B = torque_matrix(arm, k)
    return Blocks(Ma, Mb, Mc, np.diag(stiffness(arm, k)), B[:2], B[2:])


def vibration_model(
    arm: ArmParameters, theta: Array, payload_mass: float = 0.0, kappa: int | None = None,
) -> tuple[Array, Array]:
    """Return (Ac (4k, 4k), Bc (4k, 2)), x = [eta; eta'], chords free, damped (paper eqs. 19-21)."""
    k = arm.modes if kappa is None else kappa
    b = blocks(arm, theta, payload_mass, k)
    solved = cho_solve(cho_factor(b.Ma), np.hstack([b.Mb, b.B_theta]))
    Mt = cho_factor(b.Mc - b.Mb.T @ solved[:, :2 * k])
    D = np.diag(damping(arm, k))
    rows = cho_solve(Mt, np.hstack([-b.Kc, -D, b.B_eta - b.Mb.T @ solved[:, 2 * k:]]))
    Ac = np.block([[np.zeros((2 * k, 2 * k)), np.eye(2 * k)], [rows[:, :4 * k]]])
    return Ac, np.vstack([np.zeros((2 * k, 2)), rows[:, 4 * k:]])


def discretize(Ac: Array, Bc: Array, dt: float) -> tuple[Array, Array]:
    """Exact step of dt seconds with the input held: exp([[Ac, Bc], [0, 0]] dt) gives (A, B)."""
    n, r = Bc.shape
    if not (np.isfinite(dt) and dt > 0):
        raise ModelError(f'the sample time is {dt}', 'give a positive number of seconds')
    stacked = np.zeros((n + r, n + r))
    stacked[:n, :n], stacked[:n, n:] = Ac, Bc
    step = expm(stacked * dt)
    return step[:n, :n], step[:n, n:]


def frequencies(Ac: Array) -> Array:
    """Damped frequencies [Hz] of a continuous model, rising, one for each oscillating pair."""
    poles = np.linalg.eigvals(Ac)
    return np.sort(poles.imag[poles.imag > 0]) / (2 * np.pi)


def _checked(theta: Array, payload_mass: float, kappa: int) -> Array:
    theta = np.asarray(theta, dtype=np.float64)
    if theta.shape != (2,) or not np.all(np.isfinite(theta)):
        raise ModelError(f'the chord angles are {theta!r}', 'give two finite angles in rad')
    if not (np.isfinite(payload_mass) and payload_mass >= 0):
        raise ModelError(f'the payload mass is {payload_mass}', 'give a mass of zero or more in kg')
    if kappa < 1:
        raise ModelError(f'kappa is {kappa}', 'use at least one mode a link')
    return theta
