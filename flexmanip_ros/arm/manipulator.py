"""Constants of the nonlinear two-link flexible arm M(q) q'' + E(q, q') + D q' + K q = B tau (paper eq. 7).

q = [theta1, theta2, eta_11.., eta_21..], n = 2 + 2 kappa; theta are the chords' absolute angles.
Payload arrays are (4,): mass [kg], inertia about its centre of mass [kg m^2], centre of mass x, y [m]
in the tip tangent frame (x along the tangent).

The compiled functions of ``equations_of_motion`` and ``jacobian`` take a ``Manipulator`` (constants) and a
``Workspace`` (scratch for one thread), and allocate nothing. ``dynamics`` evaluates the same functions from Python.
Outputs are linear: positions = ``arm.output @ q``, rates = ``arm.output @ qd``, (4,) joint1, joint2, link1_bend,
link2_bend.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flexmanip_ros.arm.shape_functions import link_tables, output_matrix, quartic, rotary
from flexmanip_ros.errors import ModelError
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array


class Manipulator(NamedTuple):
    """Constants of the arm for the compiled functions; link index first, SI units."""

    kappa: int
    shortening: bool
    joint_mass: float
    tip_mass: float
    length: Array
    """(2,) L."""
    half_mass: Array
    """(2,) rho L / 2."""
    inertia: Array
    """(2,) int rho x^2."""
    moment: Array
    """(2,) int rho x."""
    mean_shape: Array
    """(2, k) int rho phi."""
    rigid_shape: Array
    """(2, k) int rho x phi."""
    tip_stretch: Array
    """(2, k) diagonal of S(L); zero without shortening."""
    root_slope: Array
    """(2, k) phi'(0)."""
    tip_slope: Array
    """(2, k) phi'(L)."""
    C2: Array
    """(2, k, k) int rho (phi phi' - x S)."""
    S1: Array
    """(2, k, k) int rho S."""
    W: Array
    """(2, k, k, k) int rho phi_j S_mp."""
    Q: Array
    """(2, k, k, k, k) int rho S_jl S_mp."""
    quartic: Array
    """(2, k, k, k, k) totally symmetric: fourth-order elastic energy EI quartic eta^4 / 4."""
    rotary: Array
    """(n, n) hubs and bodies that turn with a slope."""
    stiffness: Array
    """(n,) diagonal of K."""
    damping: Array
    """(n,) diagonal of D."""
    unit_stiffness: Array
    """(n,) derivative of the stiffness by its link's EI."""
    torque: Array
    """(n, 2) B."""
    output: Array
    """(4, n) joint angles and bends from q."""


class Workspace(NamedTuple):
    """Scratch memory of the compiled functions, for one thread."""

    M: Array
    E: Array
    elastic: Array
    tangent: Array
    moments: Array
    stretch: Array
    Y: Array
    Z: Array
    pairs: Array
    columns: Array
    left: Array
    right: Array
    parameters: Array
    held: Array


def workspace(kappa: int) -> Workspace:
    """Allocate scratch for arms of kappa modes a link."""
    n = 2 + 2 * kappa
    return Workspace(
        M=np.zeros((n, n)), E=np.zeros(n), elastic=np.zeros(n), tangent=np.zeros((n, kappa)),
        moments=np.zeros((2, 3 + kappa)), stretch=np.zeros((2, kappa)),
        Y=np.zeros((2, kappa, kappa)), Z=np.zeros((2, kappa, kappa, kappa)),
        pairs=np.zeros((2, kappa, kappa)), columns=np.zeros((6, kappa)),
        left=np.zeros((n, n)), right=np.zeros((n, n)), parameters=np.zeros((n, 4)), held=np.zeros((2, n)))


def payload_array(
    mass: float = 0.0, inertia: float = 0.0, com: tuple[float, float] = (0.0, 0.0),
) -> Array:
    """Pack a payload; raises ModelError when it is not a physical body."""
    packed = np.array([mass, inertia, com[0], com[1]], dtype=np.float64)
    if not np.all(np.isfinite(packed)) or mass < 0 or inertia < 0:
        raise ModelError(
            f'the payload is mass {mass}, inertia {inertia}, com {com}',
            'give finite values, mass and inertia of zero or more')
    return packed


def manipulator(arm: ArmParameters, kappa: int | None = None) -> Manipulator:
    """Precompute the constants of an arm with kappa modes a link (default arm.modes)."""
    k = arm.modes if kappa is None else kappa
    if k < 1:
        raise ModelError(f'kappa is {k}', 'use at least one mode a link')
    length = np.asarray(arm.link_length)
    density = np.asarray(arm.linear_density)
    root, tip = root_slopes(arm, k), tip_slopes(arm, k)
    tables = [link_tables(L, rho, k, arm.shortening) for L, rho in zip(length, density, strict=True)]
    j = np.pi * np.arange(1, k + 1)
    diagonal = np.concatenate([np.zeros(2), stiffness(arm, k)])
    per_stiffness = np.concatenate([np.zeros(2), *(j**4 / (2 * L**3) for L in length)])
    stretch = j**2 / (2 * length[:, None]) if arm.shortening else np.zeros((2, k))
    return Manipulator(
        kappa=k, shortening=arm.shortening, joint_mass=arm.joint_mass, tip_mass=arm.tip_mass,
        length=length.copy(), half_mass=density * length / 2, inertia=density * length**3 / 3,
        moment=density * length**2 / 2,
        mean_shape=np.stack([t[0] for t in tables]), rigid_shape=np.stack([t[1] for t in tables]),
        tip_stretch=stretch, root_slope=root, tip_slope=tip,
        C2=np.stack([t[2] for t in tables]), S1=np.stack([t[3] for t in tables]),
        W=np.stack([t[4] for t in tables]), Q=np.stack([t[5] for t in tables]),
        quartic=np.stack([quartic(L, k, arm.shortening) for L in length]),
        rotary=rotary(arm, root, tip), stiffness=diagonal,
        damping=np.concatenate([np.zeros(2), damping(arm, k)]),
        unit_stiffness=per_stiffness, torque=torque_matrix(arm, k),
        output=output_matrix(arm, root, tip))


def root_slopes(arm: ArmParameters, kappa: int) -> Array:
    """Slopes phi'(0) of each link's sine shapes, (2, kappa) [1/m]."""
    j = np.arange(1, kappa + 1)
    slopes: Array = np.pi * j / np.asarray(arm.link_length)[:, None]
    return slopes


def tip_slopes(arm: ArmParameters, kappa: int) -> Array:
    """Slopes phi'(L) of each link's sine shapes, (2, kappa) [1/m]."""
    j = np.arange(1, kappa + 1)
    return root_slopes(arm, kappa) * np.where(j % 2, -1.0, 1.0)


def stiffness(arm: ArmParameters, kappa: int) -> Array:
    """Diagonal of Kc, (2 kappa,) [N/m]."""
    j = np.pi * np.arange(1, kappa + 1)
    return np.concatenate([
        EI * j**4 / (2 * L**3) for EI, L in zip(arm.bending_stiffness, arm.link_length, strict=True)])


def damping(arm: ArmParameters, kappa: int) -> Array:
    """Diagonal of the modal damping matrix Dc, (2 kappa,) [N s/m].

    ``stiffness``: Dc = (2 zeta / omega_i1) Kc; ``modal``: 2 zeta omega_ij Mc, with the pinned link's
    omega_ij = (j pi / L_i)^2 sqrt(EI_i / rho_i).
    """
    j = np.arange(1, kappa + 1)
    growth = j**4 if arm.damping_model == 'stiffness' else j**2
    rows = []
    for L, rho, EI in zip(arm.link_length, arm.linear_density, arm.bending_stiffness, strict=True):
        first = (np.pi / L) ** 2 * np.sqrt(EI / rho)
        rows.append(2 * arm.damping_ratio * first * (rho * L / 2) * growth)
    return np.concatenate(rows)


def torque_matrix(arm: ArmParameters, kappa: int) -> Array:
    """Generalized force of the two joint torques, (2 + 2 kappa, 2): rows theta, eta_1, eta_2.

    ``paper``: torque 2 acts on link 2's chord alone. ``joint``: it reacts on link 1's tip, and both
    torques do work through the slopes of the shapes.
    """
    B = np.zeros((2 + 2 * kappa, 2))
    B[:2] = np.eye(2)
    if arm.torque_convention == 'joint':
        root, tip = root_slopes(arm, kappa), tip_slopes(arm, kappa)
        B[0, 1] = -1.0
        B[2:2 + kappa, 0] = root[0]
        B[2:2 + kappa, 1] = -tip[0]
        B[2 + kappa:, 1] = root[1]
    return B
