"""Shape functions of a link: sines of the pinned link, with or without the two static shapes of end moments.

``sines``: phi_j = sin(j pi x / L). ``component_modes`` (Craig and Bampton): beside them the two shapes that moments at
the ends bend, since sines have no curvature at the ends, where the torques act. The shapes are combined to the modes of
the pinned link, so that mass and stiffness matrix of a link alone stay diagonal; a sine stays what it is.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh

from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array

STATIC = 2
"""Static shapes of a link: a moment at its root and one at its tip."""


class ShapeFunctions(NamedTuple):
    """Shapes of a pinned link of length 1, k of them: phi(0) = phi(1) = 0 and the mean of phi^2 is 1/2."""

    sines: int
    """Number of sines."""
    combination: Array
    """(k, k) shapes out of the sines and, in the last two columns, x (1 - x) and x (1 - x) (1 - 2 x)."""
    stiffness: Array
    """(k,) integral of phi''^2: times EI / L^3 the stiffness of the mode [N/m]."""

    def at(self, x: Array) -> tuple[Array, Array, Array]:
        """Return phi, phi' and phi'' at x (N,) of a link of length 1, (k, N) each."""
        turn = np.pi * np.arange(1, self.sines + 1)[:, None]
        raw = [np.sin(turn * x), turn * np.cos(turn * x), -turn ** 2 * np.sin(turn * x)]
        if len(self.combination) > self.sines:
            raw[0] = np.vstack([raw[0], x - x ** 2, x - 3.0 * x ** 2 + 2.0 * x ** 3])
            raw[1] = np.vstack([raw[1], 1.0 - 2.0 * x, 1.0 - 6.0 * x + 6.0 * x ** 2])
            raw[2] = np.vstack([raw[2], np.full_like(x, -2.0), -6.0 + 12.0 * x])
        phi, slope, curvature = (self.combination @ values for values in raw)
        return phi, slope, curvature


def count(arm: ArmParameters) -> int:
    """Return the number kappa of modal coordinates of each link."""
    return arm.modes + (STATIC if arm.shape_functions == 'component_modes' else 0)


@lru_cache(maxsize=64)
def shape_functions(sines: int, static: bool) -> ShapeFunctions:
    """Return the shapes of a pinned link, in the order of their frequencies."""
    turn: Array = np.pi * np.arange(1, sines + 1, dtype=np.float64)
    if not static:
        return ShapeFunctions(sines, np.eye(sines), np.asarray(turn ** 4 / 2.0, dtype=np.float64))
    raw = ShapeFunctions(sines, np.eye(sines + STATIC), np.zeros(0))
    x, weight = quadrature(20 + 4 * sines)
    phi, _, curvature = raw.at(x)
    square, V = eigh((curvature * weight) @ curvature.T, (phi * weight) @ phi.T)
    V *= np.sqrt(0.5) * np.sign(raw.at(np.zeros(1))[1].T @ V)
    return ShapeFunctions(sines, V.T.copy(), square / 2.0)


def quadrature(points: int) -> tuple[Array, Array]:
    """Return nodes and weights (points,) of Gauss and Legendre on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(points)
    return (nodes + 1.0) / 2.0, weights / 2.0


def slope_products(shapes: ShapeFunctions, x: Array) -> Array:
    """G(x) (N, k, k), the integral of phi' phi'^T from 0 to x (N,): the link shortens by eta' G(x) eta / 2."""
    nodes, weights = quadrature(20 + 4 * shapes.sines)
    inner = x[:, None] * nodes
    slope = shapes.at(inner.ravel())[1].reshape(-1, *inner.shape)
    products: Array = np.einsum('jxs,kxs,xs->xjk', slope, slope, x[:, None] * weights, optimize=True)
    return products
