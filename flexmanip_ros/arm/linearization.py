"""The arm at a working point: where it is, and its linear vibration model (paper eqs. 20-23)."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, expm

from flexmanip_ros.arm import dynamics
from flexmanip_ros.arm.jacobian import bias_jacobian
from flexmanip_ros.arm.manipulator import Manipulator, manipulator, payload_array, workspace
from flexmanip_ros.errors import ModelError
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array


class Linearization(NamedTuple):
    """Matrices of eq. (8), each (n, n), B (n, L), and the acceleration (n,) of the working point."""

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
    """Damping, and the derivative of the friction by the rates."""
    B: Array
    acceleration: Array

    def state_space(self) -> tuple[Array, Array]:
        """Continuous (A (2n, 2n), B (2n, L)) of x = [dq; dq']."""
        n = len(self.M)
        rows = cho_solve(cho_factor(self.M), np.hstack([
            -(self.K + self.K_M + self.K_E), -(self.C_E + self.D), self.B]))
        A = np.block([[np.zeros((n, n)), np.eye(n)], [rows[:, :2 * n]]])
        return A, np.vstack([np.zeros_like(self.B), rows[:, 2 * n:]])


def linearize(
    arm: Manipulator, payload: Array, q: Array, qd: Array, effort: Array, simplified: bool = False,
) -> Linearization:
    """Linearize at coordinates q (n,), rates qd (n,) and joint torques effort (L,) [N m].

    simplified: as in the paper, bending in M and all of C_E, K_M and K_E are dropped.
    Raises ModelError when a number is not finite or a size is wrong.
    """
    n, links = arm.torque.shape
    q, qd, effort = (np.asarray(value, dtype=np.float64) for value in (q, qd, effort))
    if q.shape != (n,) or qd.shape != (n,) or effort.shape != (links,):
        raise ModelError(f'the working point has shapes {q.shape}, {qd.shape}, {effort.shape}',
                         f'give {n} coordinates, {n} rates and {links} torques')
    qdd = dynamics.accelerations(arm, payload, q, qd, effort)
    work = workspace(arm)
    K, D = dynamics.stiffness_at(arm, q, qd, effort)
    if simplified:
        straight = q.copy()
        straight[links:links * (1 + arm.kappa)] = 0.0
        zero = np.zeros((n, n))
        return Linearization(
            M=dynamics.mass_matrix(arm, payload, straight), C_E=zero, K_M=zero, K_E=zero,
            K=np.diag(arm.stiffness), D=D, B=arm.torque.copy(), acceleration=qdd)
    both, at_rest, rates = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    bias_jacobian(arm, payload, q, qd, qdd, both, rates, work)
    bias_jacobian(arm, payload, q, qd, np.zeros(n), at_rest, rates, work)
    return Linearization(
        M=dynamics.mass_matrix(arm, payload, q), C_E=rates, K_M=both - at_rest, K_E=at_rest,
        K=K, D=D, B=dynamics.torque_at(arm, q), acceleration=qdd)


class Blocks(NamedTuple):
    """Mass, stiffness, damping and input matrices with q = [theta; eta], k modes a link (paper eqs. 12-14).

    Ma: (L, L), Mb: (L, L k), Mc, Kc, Dc: (L k, L k), B_theta: (L, L), B_eta: (L k, L), in SI units.
    """

    Ma: Array
    Mb: Array
    Mc: Array
    Kc: Array
    Dc: Array
    B_theta: Array
    B_eta: Array


def blocks(arm: ArmParameters, theta: Array, payload_mass: float = 0.0, kappa: int | None = None) -> Blocks:
    """Return the block matrices at chord angles theta (L,) [rad], eta = 0, for a point-mass payload [kg].

    With the arm's own shape functions, or kappa sines a link. A floating base counts as fixed.
    Raises ModelError when theta or the payload is not finite or kappa is below 1.
    """
    theta = _checked(arm, theta, payload_mass)
    fixed = manipulator(replace(arm, base_mass=0.0) if arm.base_mass else arm, kappa)
    L = len(theta)
    M = dynamics.mass_matrix(fixed, payload_array(payload_mass), np.append(theta, np.zeros(L * fixed.kappa)))
    return Blocks(M[:L, :L], M[:L, L:], M[L:, L:], np.diag(fixed.stiffness[L:]), np.diag(fixed.damping[L:]),
                  fixed.torque[:L], fixed.torque[L:])


def vibration_model(
    arm: ArmParameters, theta: Array, payload_mass: float = 0.0, kappa: int | None = None,
) -> tuple[Array, Array]:
    """Return (Ac (2 L k, 2 L k), Bc (2 L k, L)), x = [eta; eta'], chords free, damped (paper eqs. 19-21)."""
    b = blocks(arm, theta, payload_mass, kappa)
    h = len(b.Mc)
    solved = cho_solve(cho_factor(b.Ma), np.hstack([b.Mb, b.B_theta]))
    Mt = cho_factor(b.Mc - b.Mb.T @ solved[:, :h])
    rows = cho_solve(Mt, np.hstack([-b.Kc, -b.Dc, b.B_eta - b.Mb.T @ solved[:, h:]]))
    Ac = np.block([[np.zeros((h, h)), np.eye(h)], [rows[:, :2 * h]]])
    return Ac, np.vstack([np.zeros((h, b.B_eta.shape[1])), rows[:, 2 * h:]])


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


def _checked(arm: ArmParameters, theta: Array, payload_mass: float) -> Array:
    theta, links = np.asarray(theta, dtype=np.float64), len(arm.link_length)
    if theta.shape != (links,) or not np.all(np.isfinite(theta)):
        raise ModelError(f'the chord angles are {theta!r}', f'give {links} finite angles in rad')
    if not (np.isfinite(payload_mass) and payload_mass >= 0):
        raise ModelError(f'the payload mass is {payload_mass}', 'give a mass of zero or more in kg')
    return theta
