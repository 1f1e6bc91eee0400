"""Constants of the nonlinear flexible arm M(q) q'' + E(q, q') + D q' + dV/dq = B tau (paper eq. 7).

q = [theta_1.., eta_11.., eta_21.., phi], n = L (1 + kappa), and one more where the base floats. theta: absolute angles
of the chords, eta: modal coordinates [m], phi: angle of the base. A payload is a rigid body held at the tip, given by
its inertial parameters (4,): mass m [kg], first moments m c_x, m c_y [kg m] and inertia about the tip [kg m^2], in the
frame of the tip's cross-section (x along the tangent). The mass matrix is linear in them.

The compiled functions of ``equations_of_motion`` and ``jacobian`` take a ``Manipulator`` (constants) and a
``Workspace`` (scratch for one thread), and allocate nothing. ``linearization`` evaluates the same functions from
Python. Outputs are linear: positions = ``arm.output @ q``, rates = ``arm.output @ qd``, (2 L,) joint angles, then
bends.

The shape functions of a link are those of a pinned link. ``sines``: phi_j = sin(j pi x / L). ``component_modes``
(Craig and Bampton): the sines and the static shapes of moments at the two ends, since sines have no curvature there,
where the torques act. The shapes are combined into the modes of the pinned link, so that mass and stiffness matrix of a
single link are diagonal; each sine remains a mode. The last mode stands for all faster ones. It is slowed by additional
inertia (mass scaling, Olovsson et al. 2005), see ``SLOWED``.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import scipy

from flexmanip_ros.errors import ModelError
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array

STATIC = 2
"""Number of static shapes of a link: those of a moment at either end."""
SLOWED = 0.9
"""Frequency of the last mode of a link over that of its shape. A truncated basis makes the modes of the whole arm too
fast. Of 0.72 to 1 this has the least error of the fifth mode (docs/lab/plant.md). Over a minute of four undamped arms
95 % of the payload's intervals hold the truth, 75 % with 1 (docs/lab/payload.md)."""


class ShapeFunctions(NamedTuple):
    """Shapes of a pinned link of length 1, k of them: phi(0) = phi(1) = 0 and the mean of phi^2 is 1/2."""

    sines: int
    """Number of sines."""
    combination: Array
    """(k, k) coefficients of each shape (row) on the sines, then x (1 - x) and x (1 - x) (1 - 2 x)."""
    stiffness: Array
    """(k,) integral of phi''^2; the stiffness of a mode is EI / L^3 times this [N/m]."""
    inertia: Array
    """(k,) mean of phi^2, the last one with mass scaling; the inertia of a mode is rho L times this [kg]."""

    def at(self, x: Array) -> tuple[Array, Array, Array]:
        """Return phi, phi' and phi'' at x (N,) of a link of length 1, (k, N) each."""
        turn = np.pi * np.arange(1, self.sines + 1)[:, None]
        u, v = x - x ** 2, 1.0 - 2.0 * x
        static = len(self.combination) - self.sines
        phi, slope, curvature = (
            self.combination @ np.vstack([sines, *shapes[:static]]) for sines, shapes in (
                (np.sin(turn * x), (u, u * v)),
                (turn * np.cos(turn * x), (v, 1.0 - 6.0 * u)),
                (-turn ** 2 * np.sin(turn * x), (np.full_like(x, -2.0), -6.0 * v))))
        return phi, slope, curvature


def count(arm: ArmParameters) -> int:
    """Return the number kappa of modal coordinates of each link."""
    return arm.modes + (STATIC if arm.shape_functions == 'component_modes' else 0)


def fastest_mode(arm: ArmParameters) -> float:
    """Return the highest modal frequency of the links, each pinned at both ends [rad/s]."""
    shapes = shape_functions(arm.modes, arm.shape_functions == 'component_modes')
    square = np.max(shapes.stiffness / shapes.inertia)
    return max(float(np.sqrt(square * EI / rho)) / L ** 2 for EI, rho, L in zip(
        arm.bending_stiffness, arm.linear_density, arm.link_length, strict=True))


def pinned_frequencies(arm: ArmParameters) -> tuple[float, ...]:
    """First frequency of each link alone, pinned at both ends [Hz]."""
    return tuple(
        float(np.pi / (2 * L ** 2) * np.sqrt(EI / rho))
        for L, EI, rho in zip(arm.link_length, arm.bending_stiffness, arm.linear_density, strict=True))


@lru_cache(maxsize=64)
def shape_functions(sines: int, static: bool) -> ShapeFunctions:
    """Return the shapes of a pinned link, in the order of their frequencies."""
    if not static:
        turn: Array = np.pi * np.arange(1, sines + 1, dtype=np.float64)
        return ShapeFunctions(sines, np.eye(sines), np.asarray(turn ** 4 / 2.0, dtype=np.float64), np.full(sines, 0.5))
    raw = ShapeFunctions(sines, np.eye(sines + STATIC), np.zeros(0), np.zeros(0))
    x, weight = quadrature(20 + 4 * sines)
    phi, _, curvature = raw.at(x)
    square, V = scipy.linalg.eigh((curvature * weight) @ curvature.T, (phi * weight) @ phi.T)
    V *= np.sqrt(0.5) * np.sign(raw.at(np.zeros(1))[1].T @ V)
    inertia = np.full(sines + STATIC, 0.5)
    inertia[-1] /= SLOWED ** 2
    return ShapeFunctions(sines, V.T.copy(), square / 2.0, inertia)


def quadrature(points: int) -> tuple[Array, Array]:
    """Return nodes and weights (points,) of the Gauss-Legendre quadrature on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(points)
    return (nodes + 1.0) / 2.0, weights / 2.0


def slope_products(shapes: ShapeFunctions, x: Array) -> Array:
    """Return G(x) (N, k, k), the integral of phi' phi'^T from 0 to x (N,): the link shortens by eta^T G(x) eta / 2."""
    nodes, weights = quadrature(20 + 4 * shapes.sines)
    inner = x[:, None] * nodes
    slope = shapes.at(inner.ravel())[1].reshape(-1, *inner.shape)
    products: Array = np.einsum('jxs,kxs,xs->xjk', slope, slope, x[:, None] * weights, optimize=True)
    return products


POINTS = 5
"""Quadrature points of a link, plus two for each sine: frequencies are accurate to 1e-9, accelerations to 1e-5."""


class Manipulator(NamedTuple):
    """Constants of the arm for the compiled functions: link index first, P point masses on a link, SI units."""

    kappa: int
    floating: bool
    """The base floats: phi is the last coordinate, and the translation is eliminated (momentum is constant)."""
    length: Array
    """(L,) length of each link."""
    mass: Array
    """(L, P) point masses: those of the link by Gauss-Legendre quadrature, and last the mass mounted at its end."""
    place: Array
    """(L, P) coordinate x of each point mass along the undeformed link."""
    phi: Array
    """(L, P, k) shape functions at these points."""
    G: Array
    """(L, k, P, k) integral of phi' phi'^T from 0 to x, indexed by link, row, point and column; zero without
    shortening."""
    slope: Array
    """(L, P, k) phi' at the points."""
    curvature: Array
    """(L, P, k) phi'' at the points."""
    along: Array
    """(L, P) quadrature weights [m]; 0 at the end of the link, and 0 at every point without shortening."""
    tip_shortening: Array
    """(L, k, k) G at the end of the link."""
    root_slope: Array
    """(L, k) phi'(0)."""
    tip_slope: Array
    """(L, k) phi'(L)."""
    rotary: Array
    """(n, n) constant part of M: hubs, rotors, bodies that turn with a slope, base, mass scaling of the last modes."""
    stiffness: Array
    """(n,) diagonal of K."""
    damping: Array
    """(n,) diagonal of D."""
    unit_stiffness: Array
    """(n,) derivative of ``stiffness`` with respect to the EI of its link."""
    torque: Array
    """(n, L) torque matrix B of straight links. Convention ``paper``: each torque acts on its link's chord alone;
    ``joint``: it also reacts on the end of the link before (or on the base), and does work through the slopes."""
    joint: Array
    """(L, n) joint angles from q, between the slopes of adjacent links (or the base); rotors turn with them."""
    output: Array
    """(2 L, n) joint angles and bends from q."""
    viscous: Array
    """(L,) viscous friction of the joints [N m s/rad]."""
    coulomb: Array
    """(L,) Coulomb friction of the joints [N m]."""
    base: Array
    """(3,) mass of a floating base [kg]; x and y of joint 1, seen from the centre of mass of the base [m]."""
    gravity: Array
    """(L, 2) gravity along x and y, as each link feels it [m/s^2]."""


class Workspace(NamedTuple):
    """Scratch memory of the compiled functions, for one thread; stations are joint 1 and the tip of each link."""

    M: Array
    E: Array
    J: Array
    """(L + 1, 2, n) Jacobians of the stations."""
    a: Array
    """(L + 1, 2) accelerations of the stations at qdd = 0."""
    P: Array
    """(2, n) linear momentum of all that moves with the base, per rate: the momentum is P q'."""
    F: Array
    """(3,) sum of mass times acceleration of all that moves with the base at qdd = 0, and the mass of all."""
    first: Array
    """(L, 2, n) sum of mass times Jacobian over a link's points, by the link's own coordinates, inertial axes."""
    own: Array
    """(12, k + 1) scratch of one link."""
    block: Array
    """(k + 1, k + 1) scratch of one link."""
    gradient: Array
    """(3, P, k) scratch of one link: G eta at each point, and the same with eta' and eta''."""
    elastic: Array
    tangent: Array
    """(k, k) scratch: derivative of a link's elastic forces from V4, see ``equations_of_motion.elastic``."""
    A: Array
    """(L + 1, 2) accelerations of the stations."""
    Aq: Array
    """(L + 1, 2, n) derivatives of A with respect to q."""
    Av: Array
    """(L + 1, 2, n) derivatives of A with respect to q'."""
    Fq: Array
    """(2, n) derivative with respect to q of the force that a link passes on to the link before."""
    Fv: Array
    load: Array
    """(2,) force on the tip of link 1 by what it carries."""
    turn: Array
    """(n,) gradient of the angle of the tip's cross-section."""
    B: Array
    """(n, L) torque matrix."""
    net: Array
    """(3, L) joint torques less friction, joint rates, and derivative of the friction by the rates."""
    held: Array
    """(2, n) scratch of the constraints."""


def workspace(arm: Manipulator) -> Workspace:
    """Allocate scratch for an arm."""
    n, k, links = arm.stiffness.size, arm.kappa, arm.length.size
    return Workspace(
        M=np.zeros((n, n)), E=np.zeros(n), J=np.zeros((links + 1, 2, n)), a=np.zeros((links + 1, 2)),
        P=np.zeros((2, n)), F=np.zeros(3), first=np.zeros((links, 2, n)), own=np.zeros((12, k + 1)),
        block=np.zeros((k + 1, k + 1)), gradient=np.zeros((3, arm.mass.shape[1], k)), elastic=np.zeros(n),
        tangent=np.zeros((k, k)),
        A=np.zeros((links + 1, 2)), Aq=np.zeros((links + 1, 2, n)), Av=np.zeros((links + 1, 2, n)),
        Fq=np.zeros((2, n)), Fv=np.zeros((2, n)), load=np.zeros(2), turn=np.zeros(n), B=np.zeros((n, links)),
        net=np.zeros((3, links)), held=np.zeros((2, n)))


def payload_array(mass: float = 0.0, inertia: float = 0.0, com: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Return inertial parameters (4,) from mass [kg], inertia about the centre of mass [kg m^2] and its place com [m].

    Raises ModelError when it is not a physical body.
    """
    given = np.array([mass, inertia, com[0], com[1]], dtype=np.float64)
    if not np.all(np.isfinite(given)) or mass < 0 or inertia < 0:
        raise ModelError(
            f'the payload is mass {mass}, inertia {inertia}, com {com}',
            'give finite values, mass and inertia of zero or more')
    return np.array([mass, mass * com[0], mass * com[1], inertia + mass * (com[0] ** 2 + com[1] ** 2)])


@lru_cache(maxsize=64)
def manipulator(arm: ArmParameters, kappa: int | None = None, points: int | None = None) -> Manipulator:
    """Return the constants of an arm with its own shape functions, or with kappa sines a link. Do not write to them.

    points: number of quadrature points over a link, by default ``POINTS`` plus two for each sine.
    Raises ModelError for kappa below 1.
    """
    if kappa is not None and kappa < 1:
        raise ModelError(f'kappa is {kappa}', 'use at least one mode a link')
    static = kappa is None and arm.shape_functions == 'component_modes'
    shapes = shape_functions(arm.modes if kappa is None else kappa, static)
    k = count(arm) if kappa is None else kappa
    length, density = np.asarray(arm.link_length), np.asarray(arm.linear_density)
    links = length.size
    n = links * (1 + k) + bool(arm.base_mass)
    x, weight = quadrature(points or POINTS + 2 * shapes.sines)
    x, weight = np.append(x, 1.0), np.append(weight, 0.0)
    phi, slope, curvature = (np.broadcast_to(values.T, (links, x.size, k)) for values in shapes.at(x))
    G = slope_products(shapes, x) * arm.shortening
    root, tip = (shapes.at(np.array([end]))[1].T / length[:, None] for end in (0.0, 1.0))
    ends = np.array([*[arm.joint_mass] * (links - 1), arm.tip_mass])
    mass = density[:, None] * length[:, None] * weight
    mass[:, -1] = ends
    unit = np.zeros(n)
    unit[links:links * (1 + k)] = (shapes.stiffness / length[:, None] ** 3).ravel()
    stiffness = unit.copy()
    stiffness[links:links * (1 + k)] *= np.repeat(arm.bending_stiffness, k)
    joint = joint_rows(arm, root, tip, n)
    scale = length[:, None, None]
    made = Manipulator(
        kappa=k, floating=bool(arm.base_mass), length=length.copy(), mass=mass, place=x * length[:, None],
        phi=phi, G=np.moveaxis(G / scale[..., None], 2, 1), slope=slope / scale,
        curvature=curvature / scale ** 2, along=weight * length[:, None] * arm.shortening,
        tip_shortening=G[-1] / scale, root_slope=root, tip_slope=tip,
        rotary=_rotary(arm, shapes, root, tip, joint), stiffness=stiffness, damping=_damping(arm, shapes, stiffness),
        unit_stiffness=unit, joint=joint,
        torque=joint.T.copy() if arm.torque_convention == 'joint' else np.eye(n, links),
        output=_output_matrix(arm, shapes, joint),
        viscous=np.array(arm.joint_viscous_friction), coulomb=np.array(arm.joint_coulomb_friction),
        base=np.array([arm.base_mass, *arm.base_joint_offset]), gravity=np.tile(arm.gravity, (links, 1)))
    # kernels are compiled for one memory layout, C-contiguous arrays, which a checkpoint preserves
    contiguous: dict[str, Any] = {
        name: np.ascontiguousarray(part) for name, part in made._asdict().items() if isinstance(part, np.ndarray)}
    return made._replace(**contiguous)


def chords(arm: ArmParameters, angles: Array) -> Array:
    """Return absolute chord angles (L,) [rad] of a straight arm whose measured angles are ``angles`` (L,).

    An encoder reads root slopes on top: some milliradians that swing about zero with the vibration, so
    they are left out at a working point (give averaged angles where that matters). ``structured`` keeps them.
    """
    if arm.angle_convention == 'chord':
        return np.asarray(angles, dtype=np.float64)
    return np.cumsum(angles, dtype=np.float64)


def modal(links: int, kappa: int, link: int) -> slice:
    """Return where the modal coordinates of a link stand in q."""
    return slice(links + link * kappa, links + (link + 1) * kappa)


def joint_rows(arm: ArmParameters, root: Array, tip: Array, n: int) -> Array:
    """Return (L, n) joint angles from q, slopes of the shapes included: what an encoder reads and a motor turns."""
    links, k = root.shape
    rows = np.zeros((links, n))
    for i in range(links):
        rows[i, i] = 1.0
        rows[i, modal(links, k, i)] = root[i]
        if i:
            rows[i, i - 1] = -1.0
            rows[i, modal(links, k, i - 1)] = -tip[i - 1]
    if arm.base_mass:
        rows[0, -1] = -1.0
    return rows


def _rotary(arm: ArmParameters, shapes: ShapeFunctions, root: Array, tip: Array, joint: Array) -> Array:
    """Constant part (n, n) of M: bodies whose angle is a chord plus a slope, rotors, base, mass scaling of a mode."""
    links, k = root.shape
    R = np.zeros((joint.shape[1], joint.shape[1]))
    for i in range(links):
        end = arm.tip_inertia if i == links - 1 else arm.joint_inertia
        for J, slopes in ((arm.hub_inertia[i], root), (end, tip)):
            row = np.zeros(len(R))
            row[i], row[modal(links, k, i)] = 1.0, slopes[i]
            R += J * np.outer(row, row)
        R += arm.rotor_inertia[i] * np.outer(joint[i], joint[i])
        at = modal(links, k, i)
        R[at, at] += arm.linear_density[i] * arm.link_length[i] * np.diag(shapes.inertia - 0.5)
    if arm.base_mass:
        R[-1, -1] += arm.base_inertia
    return R


def _damping(arm: ArmParameters, shapes: ShapeFunctions, stiffness: Array) -> Array:
    """Diagonal of the modal damping matrix, (n,) [N s/m].

    ``stiffness``: D = (2 zeta / omega_i1) K; ``modal``: 2 zeta omega_ij M, omega_ij of the pinned link.
    """
    D = np.zeros(stiffness.size)
    for i, (L, rho) in enumerate(zip(arm.link_length, arm.linear_density, strict=True)):
        at = modal(len(arm.link_length), len(shapes.inertia), i)
        M, K = rho * L * shapes.inertia, stiffness[at]
        omega = np.sqrt(K / M)
        D[at] = 2 * arm.damping_ratio * (K / omega[0] if arm.damping_model == 'stiffness' else M * omega)
    return D


def _output_matrix(arm: ArmParameters, shapes: ShapeFunctions, joint: Array) -> Array:
    """Matrix (2 L, n) from q to joint angles (by the arm's convention) and sensor deflections."""
    links, n = joint.shape
    k = len(shapes.combination)
    C = np.zeros((2 * links, n))
    C[:links] = joint if arm.angle_convention == 'encoder' else np.eye(links, n)
    for i in range(links):
        C[links + i, modal(links, k, i)] = shapes.at(np.array([arm.sensor_position[i]]))[0][:, 0]
    return C
