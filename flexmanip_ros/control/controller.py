"""The regulator: its design at a configuration with a payload, its path to a setpoint, and its work over time.

``step`` takes a sample and gives the torques, ``estimate`` takes a payload estimate, ``goto`` a new setpoint. The gains
are scheduled on the configuration and on the trusted payload, a body with mass, centre of mass and inertia. The torque
does not jump when they change.

x = [theta, eta, theta', eta'] (2n,), n = L (1 + kappa): chord angles theta [rad], relative to the base where it floats,
and modal coordinates eta [m] of the arm's shape functions. (A regulator with one mode a link makes the second and third
mode of a real link unstable.) Under gravity, x counts from the static equilibrium that the torques of ``hold``
maintain. The regulator has no integrator: the arm comes to rest where the model predicts it.

The path is a polynomial of fifth degree (minimum jerk: Flash and Hogan, J. Neuroscience 5, 1985). Its duration follows
from the limits on rate, torque and bend, hence from the payload: a heavier arm is moved more slowly.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve, solve_discrete_are

from flexmanip_ros.arm.linearization import discretize, first_order, floating_blocks, gravity_forces
from flexmanip_ros.arm.manipulator import chords, manipulator, payload_array
from flexmanip_ros.control.handover import PayloadEstimate, Verdict, judge
from flexmanip_ros.errors import ModelError
from flexmanip_ros.parameters import ControllerParameters
from flexmanip_ros.types import Array

RATE_SCALE = 8.0
"""Rate over deviation of equal cost [1/s]: a rate costs as much as a deviation that is RATE_SCALE times smaller."""
FLOOR = 1e-6
"""Process noise on every state, over the trace of the disturbance covariance: no measurement is ever ignored."""
BODY_SIZE = 0.1
"""Least size of a body in ``_weight``, over the length of the last link. First moments divided by the size, and the
inertia divided by its square, change the arm's motion about as much as that many kg do."""


def observation(config: ControllerParameters) -> Array:
    """Return T (2 L, n): [encoder angles, bends] = T [theta, eta], and the same for their rates."""
    arm = config.arm
    output = manipulator(arm).output
    if arm.base_mass:  # angles are relative to the base
        output = output[:, :-1]
    return np.asarray(np.append(np.ones(len(arm.bend_gain)), arm.bend_gain)[:, None] * output)


def model(config: ControllerParameters, theta: Array, payload: float | Array) -> tuple[Array, Array]:
    """Return the discrete model (A (2n, 2n), B (2n, L)) of one sample at chord angles theta (L,) [rad].

    payload: a mass [kg], or inertial parameters (4,).
    """
    b = floating_blocks(config.arm, theta, payload)
    links = len(b.Ma)
    n = links + len(b.Mc)
    M = np.block([[b.Ma, b.Mb], [b.Mb.T, b.Mc]])
    B = np.vstack([b.B_theta, b.B_eta])
    K, D = np.zeros((n, n)), (B * np.array(config.arm.joint_viscous_friction)) @ B.T
    K[links:, links:] = b.Kc
    D[links:, links:] += b.Dc
    return discretize(*first_order(M, K, D, B * np.array(config.arm.torque_gain)), 1.0 / config.rate)


def configuration(config: ControllerParameters, theta: Array) -> Array:
    """Return one representative (L,) [rad] of all the chord angles at which the arm has the same dynamics as at theta.

    These differ by a turn of the whole arm, unless joint 1 is beside the centre of mass of a floating base: then there
    is theta alone.
    """
    beside = config.arm.base_mass and any(config.arm.base_joint_offset)
    return np.array(theta) if beside else np.asarray(theta) - theta[0]


def feedforward(config: ControllerParameters, theta: Array, payload: float | Array) -> tuple[Array, Array]:
    """Return (F (L, L), E (L kappa, L)): torques and modal coordinates per acceleration of the chords.

    The quasi-static solution of M q'' + K q = B u with eta'' = 0.
    """
    b = floating_blocks(config.arm, theta, payload)
    F = solve(b.B_theta, b.Ma)
    E = solve(b.Kc, b.B_eta @ F - b.Mb.T, assume_a='pos')
    return F / np.array(config.arm.torque_gain)[:, None], E


def hold(config: ControllerParameters, theta: Array, payload: Array) -> tuple[Array, Array]:
    """Return torques (L,) that hold chords theta (L,) against gravity, and what the bending adds to sensors (2 L,).

    payload: inertial parameters (4,). Two iterations, because the bending changes the gravity forces.
    """
    links = len(theta)
    if not any(config.arm.gravity) or config.arm.base_mass:
        return np.zeros(links), np.zeros(2 * links)
    arm = manipulator(config.arm)
    eta = np.zeros(arm.stiffness.size - links)
    for _ in range(2):
        force = gravity_forces(arm, payload, np.concatenate([theta, eta]))
        torque = solve(arm.torque[:links], force[:links])
        eta = (arm.torque[links:] @ torque - force[links:]) / arm.stiffness[links:]
    return torque / np.array(config.arm.torque_gain), observation(config)[:, links:] @ eta


def hold_goal(config: ControllerParameters, state: ControllerState) -> Array:
    """Return the torques (L,) [N m] that hold the arm at the end of its path."""
    assert state.way is not None, 'there is no path before the first sample'
    return hold(config, chords(config.arm, state.way.goal), state.payload)[0]


class Design(NamedTuple):
    """Model, regulator, filter and feedforward for one configuration and payload.

    A (2n, 2n), B (2n, L): discrete model of one sample; G (L, 2n): gain of the stationary linear quadratic regulator,
    torque = -G (x - x_ref); L (2n, 4 L): gain of the stationary Kalman filter on the innovation of [positions, rates];
    F (L, L), E (L kappa, L): torques, modal coordinates per acceleration of the chords (L,) without vibration.
    """

    A: Array
    B: Array
    G: Array
    L: Array
    F: Array
    E: Array


def design(config: ControllerParameters, theta: Array, payload: float | Array) -> Design:
    """Return the regulator and the filter. Raises ModelError when there is no stabilizing one."""
    A, B = model(config, theta, payload)
    T = observation(config)
    C = np.kron(np.eye(2), T)
    links = len(T) // 2
    scale = np.array([config.angle_scale] * links + [config.bend_scale] * (T.shape[1] - links))
    Q = np.diag(np.concatenate([1.0 / scale, 1.0 / (RATE_SCALE * scale)]) ** 2)
    R = np.diag(1.0 / np.asarray(config.effort_scale) ** 2)
    W = B @ np.diag(np.asarray(config.disturbance_std) ** 2) @ B.T
    V = np.diag(np.asarray(config.noise_std) ** 2)
    try:
        P = solve_discrete_are(A, B, Q, R)
        G: Array = solve(R + B.T @ P @ B, B.T @ P @ A, assume_a='pos')
        S = solve_discrete_are(A.T, C.T, W + FLOOR * np.trace(W) * np.eye(len(A)), V)
        L: Array = solve(C @ S @ C.T + V, C @ S, assume_a='pos').T
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ModelError(
            f'there is no regulator at {np.round(theta, 3)} rad with a payload of {np.round(payload, 3)}',
            'change angle_scale, bend_scale or effort_scale') from error
    return Design(A, B, G, L, *feedforward(config, theta, payload))


PEAK_RATE, PEAK_ACCELERATION = 15.0 / 8.0, 10.0 / math.sqrt(3.0)
"""Peak rate and peak acceleration of a path by 1 in 1 s from rest to rest."""
BRAKING = 4.0
"""Peak acceleration of a path that starts at a rate of 1 and comes to rest at its starting point after 1 s."""
SHORTEST = 1e-3
"""Duration of the shortest move [s]."""
NO_TORQUE = 1e-9
"""Limit [N m] below which a joint counts as passive; waiting for so small a torque would take a move for ever."""


class Path(NamedTuple):
    """Polynomial path: coefficients (6, L) of the powers of age / duration; both [s], age: time since the start."""

    coefficients: Array
    duration: float
    age: float = 0.0

    @property
    def goal(self) -> Array:
        """Position (L,) at the end of the path."""
        end: Array = self.coefficients.sum(axis=0)
        return end

    def after(self, seconds: float) -> Path:
        """Return the path some time later."""
        return self._replace(age=min(self.age + seconds, self.duration))

    @property
    def ended(self) -> bool:
        """Whether the goal is reached."""
        return self.age >= self.duration

    def now(self) -> Array:
        """Return position, rate, acceleration and jerk (4, L) now."""
        s = self.age / self.duration
        powers = np.array([s**k for k in range(6)])
        rows, c, scale = np.zeros((4, self.coefficients.shape[1])), self.coefficients, 1.0
        for row in range(4):
            rows[row] = (powers[:len(c)] @ c) * scale
            c = c[1:] * np.arange(1, len(c))[:, None]
            scale /= self.duration
        if self.ended:
            rows[1:] = 0.0
        return rows


def rest(position: Array) -> Path:
    """Return the path that stays at a position (L,)."""
    coefficients = np.zeros((6, len(position)))
    coefficients[0] = position
    return Path(coefficients, SHORTEST, SHORTEST)


def plan(before: Path, goal: Array, duration: float) -> Path:
    """Return a path from the present position, rate and acceleration of ``before`` to rest at the goal (L,)."""
    position, rate, acceleration, _ = before.now()
    a0, a1, a2 = position, rate * duration, acceleration * duration**2 / 2.0
    d = np.asarray(goal) - a0 - a1 - a2
    v, a = -a1 - 2.0 * a2, -2.0 * a2
    return Path(np.stack([a0, a1, a2, 10.0 * d - 4.0 * v + a / 2.0, -15.0 * d + 7.0 * v - a,
                          6.0 * d - 3.0 * v + a / 2.0]), duration)


def duration(distance: Array, rate: Array, fastest: float, loads: Array, limits: Array) -> float:
    """Return the duration [s] of a move by ``distance`` (L,) that begins with ``rate`` (L,).

    fastest: the largest rate; loads (r, L): torques and bends per acceleration of each chord; limits (r,): largest
    torques and bends. From rest it is the shortest duration within all limits. A passive joint (a limit of zero) does
    not limit a move.
    """
    loads, limits = loads[limits > NO_TORQUE], limits[limits > NO_TORQUE]
    by_rate = PEAK_RATE * float(np.abs(distance).max()) / fastest
    by_load = PEAK_ACCELERATION * float((np.abs(loads @ distance) / limits).max())
    braking = BRAKING * float((np.abs(loads @ rate) / limits).max())
    return max(by_rate, math.sqrt(by_load), braking, SHORTEST)


SPARE = 0.1
"""Least share of the torque limits that a move may use, however large the torques against gravity are."""


class Measured(NamedTuple):
    """Encoder angles and bends (2 L,) [rad, m], their rates (2 L,), and torques (L,) to add [N m]."""

    position: Array
    velocity: Array
    added: Array


class ControllerState(NamedTuple):
    """Estimated state, path, gains in use, and the configuration and payload they were designed for."""

    C: Array
    now: Design
    old: Design
    """The design that ``now`` takes over from."""
    payload: Array
    """Inertial parameters (4,) that the gains are scheduled on, see ``payload_array``; they follow ``trusted``."""
    trusted: Array
    designed_payload: Array
    designed_at: Array
    """Chord angles (L,) of the latest design, see ``configuration``."""
    x: Array | None = None
    """Predicted state (2n,) at the next sample; None before the first."""
    way: Path | None = None
    """Encoder angles to hold [rad], on the way to ``goal``."""
    goal: Array | None = None
    """The setpoint that ``way`` was planned for."""
    setpoint: Array | None = None
    blend: float = 1.0
    """0: the old gains, 1: the new ones."""
    limit: Array | None = None
    """Limits (L,) of the torques in use [N m], which follow ``effort_limit``; None before the first sample."""
    verdict: Verdict | None = None
    """Verdict on the latest payload estimate."""
    designs: int = 0
    failed_designs: int = 0
    """How often there was no regulator for a configuration and payload."""

    @property
    def gain(self) -> Array:
        """Gains (L, 2n) in use."""
        return self.between(self.old.G, self.now.G)

    def between(self, old: Array, now: Array) -> Array:
        """Return the blend of an old and a new matrix that is in use while one design takes over from another."""
        return old + self.blend * (now - old)


def init(config: ControllerParameters) -> ControllerState:
    """Start with the gains of the straight arm and the initial payload."""
    straight, payload = np.zeros(len(config.arm.link_length)), payload_array(config.initial_payload)
    first = design(config, straight, payload)
    C: Array = np.kron(np.eye(2), observation(config)).astype(np.float64)
    return ControllerState(
        C=C, now=first, old=first,
        payload=payload, trusted=payload, designed_payload=payload, designed_at=straight,
        setpoint=None if config.hold_present else np.asarray(config.setpoint, dtype=np.float64))


def goto(state: ControllerState, angles: Array) -> ControllerState:
    """Set new encoder angles (L,) [rad] to move to, as fast as the limits on rate, torque and bend allow."""
    if state.setpoint is not None and np.array_equal(state.setpoint, angles):
        return state
    return state._replace(setpoint=np.asarray(angles, dtype=np.float64))


def estimate(config: ControllerParameters, state: ControllerState, found: PayloadEstimate) -> ControllerState:
    """Take or refuse a payload estimate; the gains follow in ``step``."""
    verdict = judge(config, found)
    if verdict is Verdict.TRUSTED and config.use_estimate:
        return state._replace(verdict=verdict, trusted=payload_array(max(found.mass, 0.0), found.inertia,
                                                                               found.com))
    return state._replace(verdict=verdict)


def step(config: ControllerParameters, state: ControllerState, measured: Measured
         ) -> tuple[ControllerState, Array]:
    """Return the torques (L,) [N m] for a sample, within the limits."""
    links = len(config.arm.link_length)
    theta = chords(config.arm, measured.position[:links]) if state.x is None else state.x[:links]
    holding, sag = hold(config, theta, state.payload)
    x = _filtered(config, state, measured, sag)
    state = _scheduled(config, state, configuration(config, x[:links]))
    way = _onward(config, state, measured.position[:links], holding)
    state = state._replace(way=way, goal=state.setpoint)
    wanted, acceleration = _wanted(config, state, way)
    wanted[:links] -= chords(config.arm, sag[:links])
    feedforward = state.between(state.old.F, state.now.F) @ acceleration + holding
    limit = _limit(config, state)
    torque: Array = np.clip(measured.added + feedforward - state.gain @ (x - wanted), -limit, limit)
    return state._replace(x=state.now.A @ x + state.now.B @ (torque - holding), limit=limit), torque


def _limit(config: ControllerParameters, state: ControllerState) -> Array:
    """Return the limits (L,) of the torques [N m]: a lower one holds at once, a higher one is reached gradually.

    A limit rises from zero within ``blend_time``: a joint that was passive is far from its path, and the regulator asks
    for all that the limit allows.
    """
    wanted = np.asarray(config.effort_limit)
    return wanted if state.limit is None else np.minimum(wanted, state.limit + _share(config) * wanted)


def _filtered(config: ControllerParameters, state: ControllerState, measured: Measured, sag: Array) -> Array:
    """Correct the predicted state by a sample; at the first the arm counts as at rest. sag (2 L,): of ``hold``."""
    if state.x is None:
        first = np.zeros(len(state.now.A))
        links = len(measured.position) // 2
        first[:links] = chords(config.arm, (measured.position - sag)[:links])
        return first
    offset = np.zeros(len(state.C))
    offset[:len(sag)] = sag
    offset[len(config.joints):len(measured.position)] += config.arm.bend_offset
    innovation = np.concatenate([measured.position, measured.velocity]) - offset - state.C @ state.x
    x: Array = state.x + state.now.L @ innovation
    return x


def _onward(config: ControllerParameters, state: ControllerState, present: Array, holding: Array) -> Path:
    """Return the path: it stays at the first angles until the setpoint is new; holding (L,): torques of ``hold``."""
    way = rest(present) if state.way is None else state.way.after(1.0 / config.rate)
    if state.setpoint is None or state.setpoint is state.goal:
        return way
    position, rate, *_ = way.now()
    design = state.now
    links = len(position)
    bends = state.C[links:2 * links, links:len(design.A) // 2] @ design.E
    left = np.maximum(np.asarray(config.effort_limit) - np.abs(holding), SPARE * np.asarray(config.effort_limit))
    limits = np.concatenate([config.move_effort * left, [config.move_bend] * links])
    seconds = duration(
        chords(config.arm, state.setpoint - position), chords(config.arm, rate), config.setpoint_rate,
        np.vstack([design.F, bends]), limits)
    return plan(way, state.setpoint, seconds)


def _wanted(config: ControllerParameters, state: ControllerState, way: Path) -> tuple[Array, Array]:
    """Return the state (2n,) that belongs to the way, bends included, and the chords' acceleration (L,)."""
    n = len(state.now.A) // 2
    if way.ended:
        wanted = np.zeros(2 * n)
        goal = chords(config.arm, way.goal)
        wanted[:len(goal)] = goal
        return wanted, np.zeros(len(goal))
    position, rate, acceleration, jerk = (chords(config.arm, row) for row in way.now())
    bends = state.between(state.old.E, state.now.E)
    return np.concatenate([position, bends @ acceleration, rate, bends @ jerk]), acceleration


def _scheduled(config: ControllerParameters, state: ControllerState, theta: Array) -> ControllerState:
    """Follow the trusted payload; design the gains again when it or the configuration changed enough."""
    payload = state.payload
    if payload is not state.trusted:
        change, reach = state.trusted - payload, config.payload_rate / config.rate
        distance = _weight(config, state.trusted, change)
        payload = state.trusted if distance <= reach else payload + change * (reach / distance)
    state = state._replace(payload=payload, blend=min(state.blend + _share(config), 1.0))
    if state.blend < 1.0:
        return state  # one change after the other keeps the torque continuous and designs rare
    held_mass = config.arm.tip_mass + state.designed_payload[0]
    same = payload is state.designed_payload \
        or _weight(config, payload, payload - state.designed_payload) <= config.reschedule_mass * held_mass
    if same and np.abs(theta - state.designed_at).max() <= config.reschedule_angle:
        return state
    state = state._replace(designed_payload=payload, designed_at=theta)
    try:
        wanted = design(config, theta, payload)
    except ModelError:  # the gains in use stay
        return state._replace(failed_designs=state.failed_designs + 1)
    return state._replace(old=state.now, now=wanted, blend=0.0, designs=state.designs + 1)


def _share(config: ControllerParameters) -> float:
    """Return the share of a change that takes over within ``blend_time`` that one sample makes."""
    return 1.0 / (config.blend_time * config.rate) if config.blend_time > 0.0 else 1.0


def _weight(config: ControllerParameters, body: Array, change: Array) -> float:
    """Return the mass [kg] that changes the motion as much as a change of a body's inertial parameters (4,)."""
    size = max(BODY_SIZE * config.arm.link_length[-1], math.sqrt(body[3] / body[0]) if body[0] > 0.0 else 0.0)
    return float(np.abs(change / (1.0, size, size, size * size)).max())
