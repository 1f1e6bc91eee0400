"""Shape functions of a link (sines): their integrals, rotary inertia and what the sensors see of them."""

from __future__ import annotations

from itertools import permutations

import numpy as np

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
