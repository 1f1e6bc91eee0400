"""The plants a simulator can step: nonlinear assumed modes, linear assumed modes, finite elements.

A model turns a state x = [q; q'] (2n,) into samples and into the next state, and gives its mass matrix
and the Jacobian of a body at its tip. ``advance`` is one compiled loop whatever the number of samples, so
that stepping one by one and simulating at once give the same bits.

The linear plants are linearized at a working point and stepped exactly. The finite element plant (paper section 4.3)
is independent of the assumed modes: each link is a chain of Euler-Bernoulli elements (cubic Hermite), whose transverse
displacement y_i(x) from the posture at rest includes the link's rigid motion. Joint 2 moves the root of link 2 both
transversely and axially. The geometry stays that of the working point.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh, eigvals, null_space

from flexmanip_ros.arm import linearization
from flexmanip_ros.arm.capture import body_jacobian, free_object, tip_angle, tip_jacobian
from flexmanip_ros.arm.equations_of_motion import STICTION_RATE
from flexmanip_ros.arm.linearization import discretize
from flexmanip_ros.arm.manipulator import Manipulator, manipulator, workspace
from flexmanip_ros.errors import ModelError, ParameterError
from flexmanip_ros.parameters import ArmParameters, PlantParameters
from flexmanip_ros.simulation.integration import ROUGH, SMOOTH, Method, run_linear, run_nonlinear
from flexmanip_ros.types import Array

MOST_SUBSTEPS = 1000


class NonlinearModel:
    """Nonlinear plant: the arm of ``manipulator.py`` at any amplitude and configuration.

    held: (0 or L, n) rows; locked joints keep the product of each row with q constant.
    """

    def __init__(self, config: PlantParameters) -> None:
        self.arm = manipulator(config.arm)
        n, links = self.arm.torque.shape
        self.held = self.arm.output[:links].copy() if config.locked else np.zeros((0, n))
        self._angles = config.initial_angles
        self._dt = 1.0 / config.rate
        self._steps = substeps(self.arm, config)
        self._method = method(self.arm)
        self._work = workspace(self.arm)
        self._scratch = np.zeros((len(self._method.weights) + 1, 2 * n))

    def rest(self) -> Array:
        """State at rest: chords at the initial angles, no bending."""
        x = np.zeros(2 * self.arm.stiffness.size)
        x[:len(self._angles)] = self._angles
        return x

    def advance(self, x: Array, payload: Array, efforts: Array, position: Array, velocity: Array) -> int:
        """Record efforts.shape[0] samples and advance x in place; return how many it completes without diverging."""
        return run_nonlinear(self.arm, payload, self.held, x, efforts, self._dt, self._steps, self._method.stages,
                             self._method.weights, position, velocity, self._scratch, self._work)

    def mass_matrix(self, x: Array, payload: Array) -> Array:
        """M at the state, (n, n)."""
        return linearization.mass_matrix(self.arm, payload, x[:x.size // 2])

    def body_jacobian(self, x: Array, payload: Array, com: tuple[float, float]) -> Array:
        """Jacobian (3, n) of a point that is fixed in the tip's frame at com: x, y [m], angle [rad]."""
        q = x[:x.size // 2]
        return body_jacobian(tip_jacobian(self.arm, payload, q), tip_angle(self.arm, q), com)

    def floating_mass(self, payload: Array) -> float:
        """Total mass of a floating base and all that moves with it [kg]; inf where the base is fixed."""
        return linearization.momentum(self.arm, payload, self.rest()[:self.arm.stiffness.size])[1] \
            if self.arm.floating else np.inf


class LinearModel:
    """A linear plant M dq'' + D dq' + K dq = B tau around the initial angles, stepped exactly.

    M0: (n, n) mass matrix without payload; D, K: (n, n); B: (n, L); C: (2 L, n) outputs; rest_output: (2 L,) outputs at
    rest; tip: (3, n) Jacobian of tip position and angle of its cross-section; turn: that angle at rest [rad].
    """

    def __init__(
        self, M0: Array, D: Array, K: Array, B: Array, C: Array, rest_output: Array, dt: float,
        tip: Array, turn: float, locked: bool = False,
    ) -> None:
        self.held = np.zeros((0, M0.shape[0]))
        if locked:  # reduce to the motions T that leave the joint angles unchanged
            T = null_space(C[:len(C) // 2])
            M0, D, K, B, C = T.T @ M0 @ T, T.T @ D @ T, T.T @ K @ T, T.T @ B, C @ T
            tip = tip @ T
        self.M0, self.D, self.K, self.B, self.C = M0, D, K, B, C
        self.rest_output = rest_output
        self._dt = dt
        self._tip, self._turn = tip, turn
        self._scratch = np.zeros((1, 2 * M0.shape[0]))
        self._steps: dict[bytes, tuple[Array, Array]] = {}

    def rest(self) -> Array:
        """State at rest at the working point."""
        return np.zeros(2 * self.M0.shape[0])

    def advance(self, x: Array, payload: Array, efforts: Array, position: Array, velocity: Array) -> int:
        """See ``NonlinearModel``."""
        A, B = self.step_matrices(payload)
        return run_linear(A, B, self.C, self.rest_output, x, efforts, position, velocity, self._scratch)

    def step_matrices(self, payload: Array) -> tuple[Array, Array]:
        """Discrete (A (2n, 2n), B (2n, L)) with a payload, kept for the last few payloads.

        Raises ModelError for a payload so far from the arm's own masses that its mass matrix is singular to rounding.
        """
        key = payload.tobytes()
        if key not in self._steps:
            if len(self._steps) > 8:
                self._steps.clear()
            M = self.mass_matrix(self.rest(), payload)
            try:
                self._steps[key] = discretize(*linearization.first_order(M, self.K, self.D, self.B), self._dt)
            except np.linalg.LinAlgError as error:
                raise ModelError(
                    f'the arm with a payload of {payload[0]:g} kg and {payload[3]:g} kg m^2 cannot be linearized',
                    'lower payload_mass, payload_inertia or payload_com, or use the nonlinear model') from error
        return self._steps[key]

    def mass_matrix(self, x: Array, payload: Array) -> Array:
        """See ``NonlinearModel``; constant."""
        m, hx, hy, inertia = payload
        J = self._tip
        # d: body_jacobian at (hx, hy) less that of the tip is linear in hx, hy: the first moments give d^T J + J^T d
        d = body_jacobian(J, self._turn, (hx, hy))[:2] - J[:2]
        total: Array = self.M0 + m * J[:2].T @ J[:2] + J[:2].T @ d + d.T @ J[:2] + inertia * np.outer(J[2], J[2])
        return total

    def body_jacobian(self, x: Array, payload: Array, com: tuple[float, float]) -> Array:
        """See ``NonlinearModel``; constant."""
        return body_jacobian(self._tip, self._turn, com)

    def floating_mass(self, payload: Array) -> float:
        """See ``NonlinearModel``."""
        return np.inf


Model = NonlinearModel | LinearModel


def build(config: PlantParameters) -> Model:
    """Return the plant the parameters ask for. Raises ParameterError where a linear plant lacks what they set."""
    if config.model == 'nonlinear':
        return NonlinearModel(config)
    arm = config.arm
    if config.model == 'finite_element' and len(arm.link_length) == 1:
        raise ParameterError("parameter 'model' is 'finite_element', but the arm has one link",
                             "choose 'model' nonlinear or linear")
    for name, value in (('gravity', any(arm.gravity)), ('base_mass', arm.base_mass),
                        ('joint_coulomb_friction', any(arm.joint_coulomb_friction))):
        if value:
            raise ParameterError(f"parameter 'arm.{name}' is set, but a {config.model} plant has none",
                                 "choose 'model' nonlinear")
    model = (finite_element_model if config.model == 'finite_element' else linear_model)(config)
    for payload in (np.zeros(4), free_object(config).payload):  # now, so that a live capture is not delayed
        model.step_matrices(payload)
    return model


def method(arm: Manipulator) -> Method:
    """Return the integration method: ``ROUGH`` for an arm with Coulomb friction, else ``SMOOTH``."""
    return ROUGH if arm.coulomb.any() else SMOOTH


def substeps(arm: Manipulator, config: PlantParameters) -> int:
    """Return how many integration steps a sample needs for the fastest mode of the empty arm, in any configuration.

    Raises ParameterError naming the field when the steps asked for are unstable, or the fastest mode needs more than
    ``MOST_SUBSTEPS``.
    """
    if config.substeps:
        least = fewest_substeps(arm, config)
        if config.substeps < least:
            raise ParameterError(
                f"parameter 'substeps' is {config.substeps}, and the integration is unstable",
                f'give at least {least}, or 0 for automatic')
        return config.substeps
    by = method(arm)
    turning, decaying = (int(np.ceil(_fastest(arm, friction) / config.rate / most))
                         for friction, most in ((0.0, by.angle), (1.0, by.decay)))
    steps = max(turning, decaying, 1)
    if steps > MOST_SUBSTEPS:
        what, remedy = ('the fastest mode needs', "lower 'arm.modes', or check length, density and stiffness")
        if decaying > turning and arm.coulomb.any():
            what, remedy = ('a joint that sticks needs', "or lower 'arm.joint_coulomb_friction'")
        raise ParameterError(f"parameter 'rate' is {config.rate} Hz but {what} {steps} steps a sample",
                             f"raise 'rate', {remedy}")
    return steps


def fewest_substeps(arm: Manipulator, config: PlantParameters) -> int:
    """Return the fewest stable integration steps a sample; the friction of a sticking joint acts as a stiff damper."""
    return int(np.ceil(_fastest(arm, 1.0) / config.rate / method(arm).stable))


def _fastest(arm: Manipulator, sticking: float) -> float:
    """Largest pole magnitude [rad/s] in any configuration; sticking: share (0 to 1) of the damping of stuck joints."""
    n, links = arm.torque.shape
    friction = arm.viscous + sticking * arm.coulomb / STICTION_RATE
    D = np.diag(arm.damping) + (arm.torque * friction) @ arm.torque.T
    largest = 0.0
    for spread in (0.0, np.pi / 2, np.pi):
        q = np.zeros(n)
        q[links - 1] = spread
        M = linearization.mass_matrix(arm, np.zeros(4), q)
        A, _ = linearization.first_order(M, np.diag(arm.stiffness), D, np.zeros((n, 0)))
        largest = max(largest, float(np.max(np.abs(eigvals(A)))))
    return largest


def linear_model(config: PlantParameters) -> LinearModel:
    """Linearize the assumed modes at the initial angles, at rest (paper eq. 8 with eqs. 12-14)."""
    arm = manipulator(config.arm)
    q = np.zeros(arm.stiffness.size)
    q[:len(config.initial_angles)] = config.initial_angles
    return LinearModel(
        M0=linearization.mass_matrix(arm, np.zeros(4), q),
        D=np.diag(arm.damping) + (arm.torque * arm.viscous) @ arm.torque.T,
        K=np.diag(arm.stiffness), B=arm.torque, C=arm.output, rest_output=arm.output @ q, dt=1.0 / config.rate,
        tip=tip_jacobian(arm, np.zeros(4), q), turn=tip_angle(arm, q), locked=config.locked)


class Beam(NamedTuple):
    """Free-free matrices of one link; coordinates [y, y'] node by node, (2 elements + 2) of them."""

    length: float
    M: Array
    K: Array

    def at(self, x: float) -> Array:
        """Row that gives the deflection y(x)."""
        elements = self.M.shape[0] // 2 - 1
        h = self.length / elements
        e = min(int(x / h), elements - 1)
        t = x / h - e
        row = np.zeros(self.M.shape[0])
        row[2 * e:2 * e + 4] = [1 - 3 * t**2 + 2 * t**3, h * (t - 2 * t**2 + t**3),
                                3 * t**2 - 2 * t**3, h * (t**3 - t**2)]
        return row


def beam(length: float, density: float, stiffness: float, elements: int) -> Beam:
    """Assemble a link of ``length`` [m], ``density`` [kg/m] and ``stiffness`` EI [N m^2] with scikit-fem."""
    try:
        from skfem import Basis, BilinearForm, ElementLineHermite, MeshLine
        from skfem.helpers import dd
    except ImportError as error:
        raise ModelError(
            'the finite element plant needs scikit-fem, which is not installed',
            'run: pip install scikit-fem, or use another model') from error
    basis = Basis(MeshLine(np.linspace(0.0, length, elements + 1)), ElementLineHermite(), intorder=6)
    M = BilinearForm(lambda u, v, _: density * u * v).assemble(basis).toarray()
    K = BilinearForm(lambda u, v, _: stiffness * dd(u)[0, 0] * dd(v)[0, 0]).assemble(basis).toarray()
    order = basis.nodal_dofs[:, np.argsort(basis.mesh.p[0])].T.ravel()
    return Beam(length, M[np.ix_(order, order)], K[np.ix_(order, order)])


def bending_damping(arm: ArmParameters, element_beam: Beam) -> Array:
    """Damping matrix of a link in the coordinates of its beam; its rigid motion is not damped."""
    size = element_beam.M.shape[0]
    chord = np.tile([0.0, 1.0], size // 2)  # the chord's slope at every node; its height at the nodes follows
    chord_rows = np.zeros((size, size))
    ends = np.zeros(size)
    ends[0], ends[-2] = -1 / element_beam.length, 1 / element_beam.length
    x = np.linspace(0, element_beam.length, size // 2)
    chord_rows += np.outer(chord, ends)
    chord_rows[::2] += np.outer(x, ends)
    chord_rows[::2, 0] += 1.0
    bending = np.eye(size) - chord_rows
    inner = np.r_[1:size - 2, size - 1]  # pinned: both ends without deflection
    M, K = (matrix[np.ix_(inner, inner)] for matrix in (element_beam.M, element_beam.K))
    squares, shapes = eigh(K, M)
    omega = np.sqrt(squares)
    rate = omega**2 / omega[0] if arm.damping_model == 'stiffness' else omega
    loaded = M @ shapes
    pinned = loaded @ np.diag(2 * arm.damping_ratio * rate) @ loaded.T
    damping: Array = bending[inner].T @ pinned @ bending[inner]
    return damping


class Chain(NamedTuple):
    """The two-link arm in free coordinates z: M z'' + D z' + K z = B tau; C z and tip z are its outputs."""

    M: Array
    D: Array
    K: Array
    B: Array
    C: Array
    """(4, n) joint angles by the arm's convention and bends."""
    tip: Array
    """(3, n) displacement of the tip along and across link 2 (e2, n2) [m], and its angle [rad]."""


def chain(arm: ArmParameters, theta: tuple[float, ...], elements: int) -> Chain:
    """Assemble the arm at chord angles theta [rad], without payload."""
    beams = [beam(*values, elements) for values in zip(
        arm.link_length, arm.linear_density, arm.bending_stiffness, strict=True)]
    size = 2 * elements + 2
    n = 2 * size - 2
    c, s = np.cos(theta[1] - theta[0]), np.sin(theta[1] - theta[0])
    # beam coordinates from the free ones: y1(0) = 0, y2(0) = c y1(L1)
    T1, T2 = np.zeros((size, n)), np.zeros((size, n))
    T1[1:, :size - 1] = np.eye(size - 1)
    T2[1:, size - 1:] = np.eye(size - 1)
    elbow = T1[-2]
    T2[0] = c * elbow
    along = s * elbow  # link 2 moves rigidly along its axis e2
    slopes = {'root1': T1[1], 'tip1': T1[-1], 'root2': T2[1], 'tip2': T2[-1]}
    M, K, D = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    for T, link in zip((T1, T2), beams, strict=True):
        M += T.T @ link.M @ T
        K += T.T @ link.K @ T
        D += T.T @ bending_damping(arm, link) @ T
    for mass, row in (
        (arm.joint_mass, elbow), (arm.tip_mass, T2[-2]),
        (arm.linear_density[1] * arm.link_length[1] + arm.tip_mass, along),
        (arm.hub_inertia[0], slopes['root1']), (arm.hub_inertia[1], slopes['root2']),
        (arm.joint_inertia, slopes['tip1']), (arm.tip_inertia, slopes['tip2']),
    ):
        M += mass * np.outer(row, row)
    chords = np.stack([T[-2] - T[0] for T in (T1, T2)]) / np.array(arm.link_length)[:, None]
    encoders = np.stack([slopes['root1'], slopes['root2'] - slopes['tip1']])
    bends = []
    for i, (T, link) in enumerate(zip((T1, T2), beams, strict=True)):
        x = arm.sensor_position[i] * link.length
        bends.append(link.at(x) @ T - T[0] - x * chords[i])
    B = (encoders if arm.torque_convention == 'joint' else chords).T
    for rotor, viscous, row, torque in zip(
            arm.rotor_inertia, arm.joint_viscous_friction, encoders, B.T, strict=True):
        M += rotor * np.outer(row, row)
        D += viscous * np.outer(torque, torque)
    return Chain(
        M=M, D=D, K=K, B=B,
        C=np.vstack([encoders if arm.angle_convention == 'encoder' else chords, *bends]),
        tip=np.stack([along, T2[-2], slopes['tip2']]))


def finite_element_model(config: PlantParameters) -> LinearModel:
    """Return the finite element plant: the chain at the initial angles."""
    arm, theta = config.arm, config.initial_angles
    parts = chain(arm, theta, config.elements)
    rest = np.zeros(4)
    rest[:2] = theta
    if arm.angle_convention == 'encoder':
        rest[1] -= theta[0]
    e2 = np.array([np.cos(theta[1]), np.sin(theta[1])])
    turn = np.array([e2, [-e2[1], e2[0]]]).T  # e2, n2 as columns

    return LinearModel(
        M0=parts.M, D=parts.D, K=parts.K, B=parts.B, C=parts.C, rest_output=rest, dt=1.0 / config.rate,
        tip=np.vstack([turn @ parts.tip[:2], parts.tip[2]]), turn=theta[1], locked=config.locked)
