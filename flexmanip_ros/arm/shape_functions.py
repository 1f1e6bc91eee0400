"""Shape functions of a link: sines, their slope correction, and the residual modes above them."""

from __future__ import annotations

from itertools import permutations

import numpy as np
from scipy.linalg import eigh, expm

from flexmanip_ros.arm import linearization
from flexmanip_ros.arm.outputs import Slopes
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array


def link_tables(L: float, rho: float, k: int, shortening: bool) -> tuple[Array, ...]:
    """Integrals over one link by Gauss-Legendre quadrature fine enough to be exact to rounding."""
    nodes, weights = np.polynomial.legendre.leggauss(40 + 8 * k)
    x, weights = L * (nodes + 1) / 2, rho * L * weights / 2
    j = np.arange(1, k + 1)
    sign = np.where(j % 2, -1.0, 1.0)
    phi = np.sin(np.pi * j[:, None] * x / L)
    mean = rho * L * (1 - sign) / (j * np.pi)
    rigid = -rho * L**2 * sign / (j * np.pi)
    S = _slope_products(L, k, x) if shortening else np.zeros((k, k, x.size))
    C2 = rho * L / 2 * np.eye(k) - np.einsum('jmx,x->jm', S, weights * x)
    S1 = np.einsum('jmx,x->jm', S, weights)
    W = np.einsum('jx,mpx,x->jmp', phi, S, weights)
    Q = np.einsum('jlx,mpx,x->jlmp', S, S, weights)
    return mean, rigid, C2, S1, W, Q


def _slope_products(L: float, k: int, x: Array) -> Array:
    """S_jm(x) = int_0^x phi_j' phi_m' over the arc, (k, k, x) [1/m]."""
    a = np.pi / L * np.arange(1, k + 1)
    S = np.empty((k, k, x.size))
    for j in range(k):
        for m in range(k):
            plus = np.sin((a[j] + a[m]) * x) / (a[j] + a[m])
            minus = x if j == m else np.sin((a[j] - a[m]) * x) / (a[j] - a[m])
            S[j, m] = a[j] * a[m] * (plus + minus) / 2
    return S


def quartic(L: float, k: int, shortening: bool) -> Array:
    """Curvature of an inextensible beam to third order, w'' (1 + w'^2 / 2): V4 = EI / 2 int w''^2 w'^2."""
    if not shortening:
        return np.zeros((k, k, k, k))
    nodes, weights = np.polynomial.legendre.leggauss(40 + 8 * k)
    x, weights = L * (nodes + 1) / 2, L * weights / 2
    a = np.pi / L * np.arange(1, k + 1)[:, None]
    slope, curvature = a * np.cos(a * x), -(a**2) * np.sin(a * x)
    P = np.einsum('jx,kx,lx,mx,x->jklm', curvature, curvature, slope, slope, weights, optimize=True)
    total = np.zeros_like(P)
    for order in permutations(range(4)):
        total += np.transpose(P, order)
    symmetric: Array = total / 12
    return symmetric


def rotary(arm: ArmParameters, root: Array, tip: Array) -> Array:
    """Constant mass of the bodies whose angle is a chord plus a slope."""
    k = root.shape[1]
    R = np.zeros((2 + 2 * k, 2 + 2 * k))
    bodies = ((arm.hub_inertia[0], 0, root), (arm.hub_inertia[1], 1, root),
              (arm.joint_inertia, 0, tip), (arm.tip_inertia, 1, tip))
    for J, link, slopes in bodies:
        row = np.zeros(2 + 2 * k)
        row[link] = 1.0
        row[2 + link * k:2 + (link + 1) * k] = slopes[link]
        R += J * np.outer(row, row)
    return R


def output_matrix(arm: ArmParameters, root: Array, tip: Array) -> Array:
    """Joint angles (by the arm's convention) and sensor deflections from q, (4, n)."""
    k = root.shape[1]
    C = np.zeros((4, 2 + 2 * k))
    C[0, 0] = C[1, 1] = 1.0
    if arm.angle_convention == 'encoder':
        C[1, 0] = -1.0
        C[0, 2:2 + k] = root[0]
        C[1, 2:2 + k] = -tip[0]
        C[1, 2 + k:] = root[1]
    j = np.pi * np.arange(1, k + 1)
    for i in range(2):
        C[2 + i, 2 + i * k:2 + (i + 1) * k] = np.sin(j * arm.sensor_position[i])
    return C


TERMS = 4000
"""Modes summed; the slowest sums go on with 1 / j^2 and are closed by their known total."""


def slopes(arm: ArmParameters, kappa: int) -> Slopes:
    """Precompute the correction of an arm with kappa modes; inactive when switched off."""
    return Slopes(
        active=arm.slope_correction, flexibility=flexibility(arm, kappa), moments=_moments(arm),
        hubs=np.array([arm.hub_inertia[0], arm.joint_inertia, arm.hub_inertia[1], arm.tip_inertia]),
        step=np.zeros((0, 2, 2)), start=np.zeros((0, 2)), end=np.zeros((0, 2)), load=np.zeros((0, 7)),
        output=np.zeros((4, 0)))


def flexibility(arm: ArmParameters, kappa: int) -> Array:
    """Outputs (4) by loads (7), summed over the modes beyond kappa.

    Outputs joint1, joint2 [rad], link1_bend, link2_bend [m]; loads: moments [N m] at root and tip of
    link 1, root and tip of link 2, then -theta1'', -theta2'' [rad/s^2] and -n2 . P'' [m/s^2].
    """
    L, EI = np.array(arm.link_length), np.array(arm.bending_stiffness)
    ends = np.stack([f(arm, TERMS) for f in (linearization.root_slopes, linearization.tip_slopes)])
    stiffness = linearization.stiffness(arm, TERMS)
    C = output_matrix(arm, *ends)[:, 2:]
    beyond = np.tile(np.arange(TERMS) >= kappa, 2)
    R: Array = (C / stiffness * beyond) @ load_weights(arm, TERMS)
    # slopes by end moments fall with 1 / j^2 only: the static beam (L / 3 EI, L / 6 EI) less the modes kept
    total = np.array([[1 / 3, -1 / 6], [-1 / 6, 1 / 3]])
    if arm.angle_convention == 'encoder':
        kept = stiffness.reshape(2, TERMS)[:, :kappa]
        few = ends[:, :, :kappa]
        bent = [total * L[i] / EI[i] - (few[:, i] / kept[i]) @ few[:, i].T for i in range(2)]
        R[0, :2] = bent[0][0]
        R[1, :2] = -bent[0][1]
        R[1, 2:4] = bent[1][0]
    return R


def load_weights(arm: ArmParameters, modes: int) -> Array:
    """Generalized forces of the modal coordinates by the seven loads, (2 modes, 7), see ``flexibility``."""
    root, tip = linearization.root_slopes(arm, modes), linearization.tip_slopes(arm, modes)
    mass = np.array(arm.linear_density) * np.array(arm.link_length)
    j = np.arange(1, modes + 1)
    sign = np.where(j % 2, -1.0, 1.0)
    rigid = -(mass * np.array(arm.link_length))[:, None] * sign / (j * np.pi)
    W = np.zeros((2 * modes, 7))
    W[:modes, [0, 1, 4]] = np.column_stack([root[0], tip[0], rigid[0]])
    W[modes:, [2, 3, 5, 6]] = np.column_stack([
        root[1], tip[1], rigid[1], mass[1] * (1 - sign) / (j * np.pi)])
    return W


def _moments(arm: ArmParameters) -> Array:
    """End moments (root 1, tip 1, root 2, tip 2) by the two joint torques, (4, 2)."""
    if arm.torque_convention == 'paper':
        return np.zeros((4, 2))
    return np.array([[1.0, 0.0], [0.0, -1.0], [0.0, 1.0], [0.0, 0.0]])


def slopes_with_tail(
    arm: ArmParameters, theta: tuple[float, ...], kappa: int, tail: int, dt: float,
) -> Slopes:
    """Correction of an arm with kappa modes a link whose next ``tail`` modes follow as oscillators."""
    plain = slopes(arm, kappa)
    if not (tail and arm.slope_correction):
        return plain
    total = kappa + tail
    b = linearization.blocks(arm, np.array(theta), 0.0, total)
    M = np.block([[b.Ma, b.Mb], [b.Mb.T, b.Mc]])
    chosen = np.r_[2 + kappa:2 + total, 2 + total + kappa:2 + 2 * total]
    kept = np.setdiff1d(np.arange(len(M)), chosen)
    S = M[np.ix_(chosen, chosen)] - M[np.ix_(chosen, kept)] @ np.linalg.solve(
        M[np.ix_(kept, kept)], M[np.ix_(kept, chosen)])
    K = linearization.stiffness(arm, total)[chosen - 2]
    D = linearization.damping(arm, total)[chosen - 2]
    squares, V = eigh(np.diag(K), S)
    rates = np.einsum('ja,j,ja->a', V, D, V)
    step = np.empty((len(squares), 2, 2))
    held, rising = np.empty((len(squares), 2)), np.empty((len(squares), 2))
    for a, (square, rate) in enumerate(zip(squares, rates, strict=True)):
        step[a], held[a], rising[a] = _ramp_step(float(square), float(rate), dt)
    root, tip = (f(arm, total) for f in (linearization.root_slopes, linearization.tip_slopes))
    return plain._replace(
        flexibility=flexibility(arm, total), step=step, start=held - rising, end=rising,
        load=V.T @ load_weights(arm, total)[chosen - 2],
        output=output_matrix(arm, root, tip)[:, chosen] @ V)


def _ramp_step(square: float, rate: float, dt: float) -> tuple[Array, Array, Array]:
    """Exact step of z'' + rate z' + square z = f: state matrix, gains of f held at 1 and rising to 1."""
    A = np.zeros((4, 4))
    A[0, 1] = 1.0
    A[1, :3] = -square, -rate, 1.0
    A[2, 3] = 1.0 / dt
    F = expm(A * dt)
    return F[:2, :2], F[:2, 2], F[:2, 3]
