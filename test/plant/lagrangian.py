"""The arm's Lagrangian written down once more, from positions alone, and derived by CasADi.

Shares nothing with the package but the parameters: points of the links are placed in the inertial frame,
everything (shortening included) is integrated by Gauss-Legendre quadrature, and the equations of motion
come from automatic differentiation.
"""

from __future__ import annotations

import numpy as np
import pytest

from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array

ca = pytest.importorskip('casadi')
POINTS = 30


def forces(arm: ArmParameters, kappa: int, body: tuple[float, float, float, float]) -> ca.Function:
    """Return (q, qd, qdd) -> d/dt(dT/dqd) - dT/dq + dV/dq; body: mass, inertia, centre of mass x, y."""
    n = 2 + 2 * kappa
    q, qd, qdd = (ca.SX.sym(name, n) for name in ('q', 'qd', 'qdd'))
    kinetic, potential = energies(arm, kappa, body, q, qd)
    momentum = ca.gradient(kinetic, qd)
    inertia = ca.jtimes(momentum, q, qd) + ca.jtimes(momentum, qd, qdd)
    return ca.Function('forces', [q, qd, qdd], [
        inertia - ca.gradient(kinetic, q) + ca.gradient(potential, q)])


def energies(
    arm: ArmParameters, kappa: int, body: tuple[float, float, float, float], q: ca.SX, qd: ca.SX,
) -> tuple[ca.SX, ca.SX]:
    """Kinetic and elastic energy [J]."""
    nodes, weights = np.polynomial.legendre.leggauss(POINTS)
    kinetic, potential = ca.SX(0), ca.SX(0)
    origin = ca.SX.zeros(2)
    for i in range(2):
        L, rho, EI = arm.link_length[i], arm.linear_density[i], arm.bending_stiffness[i]
        eta = q[2 + i * kappa:2 + (i + 1) * kappa]
        e = ca.vertcat(ca.cos(q[i]), ca.sin(q[i]))
        normal = ca.vertcat(-e[1], e[0])
        for x, weight in zip(L * (nodes + 1) / 2, L * weights / 2, strict=True):
            r = point(arm, i, x, eta, origin, e, normal)
            kinetic += rho * weight / 2 * speed2(r, q, qd)
            curvature = sum(-(j * np.pi / L) ** 2 * np.sin(j * np.pi * x / L) * eta[j - 1]
                            for j in range(1, kappa + 1))
            steeper = 1 + slope(x, L, eta) ** 2 if arm.shortening else 1  # inextensible, to fourth order
            potential += EI * weight / 2 * curvature**2 * steeper
        kinetic += arm.hub_inertia[i] / 2 * ca.jtimes(q[i] + slope(0.0, L, eta), q, qd) ** 2
        origin = point(arm, i, L, eta, origin, e, normal)
        heading = q[i] + slope(L, L, eta)
        end_mass, end_inertia = ((arm.joint_mass, arm.joint_inertia), (arm.tip_mass, arm.tip_inertia))[i]
        kinetic += end_mass / 2 * speed2(origin, q, qd)
        kinetic += end_inertia / 2 * ca.jtimes(heading, q, qd) ** 2
    mass, inertia, cx, cy = body
    com = origin + ca.vertcat(cx * ca.cos(heading) - cy * ca.sin(heading),
                              cx * ca.sin(heading) + cy * ca.cos(heading))
    kinetic += mass / 2 * speed2(com, q, qd) + inertia / 2 * ca.jtimes(heading, q, qd) ** 2
    return kinetic, potential


def point(arm: ArmParameters, i: int, x: float, eta: ca.SX, origin: ca.SX, e: ca.SX, normal: ca.SX) -> ca.SX:
    """Inertial position of the material point x of link i."""
    L = arm.link_length[i]
    w = sum(np.sin(j * np.pi * x / L) * eta[j - 1] for j in range(1, eta.numel() + 1))
    along = ca.SX(x)
    if arm.shortening:
        nodes, weights = np.polynomial.legendre.leggauss(POINTS)
        for s, weight in zip(x * (nodes + 1) / 2, x * weights / 2, strict=True):
            along -= weight / 2 * slope(s, L, eta) ** 2
    return origin + along * e + w * normal


def slope(x: float, L: float, eta: ca.SX) -> ca.SX:
    """Slope w'(x)."""
    return sum(j * np.pi / L * np.cos(j * np.pi * x / L) * eta[j - 1] for j in range(1, eta.numel() + 1))


def speed2(r: ca.SX, q: ca.SX, qd: ca.SX) -> ca.SX:
    """Squared speed [m^2/s^2]."""
    v = ca.jtimes(r, q, qd)
    return ca.dot(v, v)


def evaluate(function: ca.Function, *arguments: Array) -> Array:
    """Call a CasADi function with arrays, one result, flat."""
    return np.array(function(*arguments)).ravel()
