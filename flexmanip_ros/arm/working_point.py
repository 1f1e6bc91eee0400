"""The nonlinear arm linearized at any working point, moving and accelerating ones included (paper eq. 8).

M dq'' + (C_E + D) dq' + (K + K_M + K_E) dq = B dtau around a motion (q, q', q'') that satisfies the
equations of motion. The paper keeps K alone beside M, at rest and without bending; ``simplified`` does
the same.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from flexmanip_ros.arm import manipulator as dynamics
from flexmanip_ros.arm.jacobian import bias_jacobian, steep_jacobian
from flexmanip_ros.errors import ModelError
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
    arm: dynamics.Manipulator, payload: Array, q: Array, qd: Array, effort: Array, simplified: bool = False,
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
    work = dynamics.workspace(arm.kappa)
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
