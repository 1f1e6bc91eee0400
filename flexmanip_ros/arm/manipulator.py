"""The nonlinear two-link flexible arm: M(q) q'' + E(q, q') + D q' + K q = B tau (paper eq. 7).

q = [theta1, theta2, eta_11.., eta_21..], n = 2 + 2 kappa; theta are the chords' absolute angles.
Payload arrays are (4,): mass [kg], inertia about its centre of mass [kg m^2], centre of mass x, y [m]
in the tip tangent frame (x along the tangent).

What others build on (compiled functions run inside other compiled functions, without allocation):

* ``manipulator(arm, kappa)`` -> Manipulator, a NamedTuple of scalars and float64 arrays. Its
  ``stiffness`` and ``damping`` (n,) may be overwritten by whoever made it (calibration).
* ``workspace(kappa)`` -> Workspace, scratch for one thread; ``payload_array(mass, ...)``.
* ``kernels.assemble(arm, payload, q, qd, M, E, work)``: lower triangle of M and the bias E.
* ``acceleration_kernel.acceleration(arm, payload, q, qd, effort, qdd, work) -> bool``; ``factor``, ``solve``.
* ``jacobian_kernel.acceleration_jacobian(arm, payload, q, qd, effort, qdd, dq, dqd, dp, work) -> bool``:
  qdd and its derivatives by q (n, n), qd (n, n) and p = [mass, inertia, EI1, EI2] (n, 4).
* outputs are linear: positions = ``arm.output @ q``, rates = ``arm.output @ qd`` (4, n), joint1, joint2,
  link1_bend, link2_bend, so ``arm.output`` is their Jacobian too (``output_kernel`` for the slopes of
  the truncated modes).
* in Python: ``mass_matrix``, ``bias``, ``coriolis_matrix``, ``energy``, ``accelerations``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flexmanip_ros.arm import linearization
from flexmanip_ros.arm.equations_of_motion import acceleration, assemble, elastic, steepen
from flexmanip_ros.arm.jacobian import acceleration_jacobian, bias_jacobian
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
    root, tip = linearization.root_slopes(arm, k), linearization.tip_slopes(arm, k)
    tables = [link_tables(L, rho, k, arm.shortening) for L, rho in zip(length, density, strict=True)]
    j = np.pi * np.arange(1, k + 1)
    stiffness = np.concatenate([np.zeros(2), linearization.stiffness(arm, k)])
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
        rotary=rotary(arm, root, tip), stiffness=stiffness,
        damping=np.concatenate([np.zeros(2), linearization.damping(arm, k)]),
        unit_stiffness=per_stiffness, torque=linearization.torque_matrix(arm, k),
        output=output_matrix(arm, root, tip))


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


__all__ = [
    'Manipulator', 'Workspace', 'acceleration', 'acceleration_jacobian', 'accelerations', 'bias',
    'coriolis_matrix', 'elastic_forces', 'energy', 'manipulator', 'mass_matrix',
    'payload_array', 'workspace',
]
