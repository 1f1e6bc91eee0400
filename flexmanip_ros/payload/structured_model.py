"""The structured estimator before its first step: which signals it reads, its model of the arm, its first state."""

from __future__ import annotations

import re
from dataclasses import replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from flexmanip_ros.arm.capture import body_jacobian
from flexmanip_ros.arm.dynamics import mass_matrix
from flexmanip_ros.arm.manipulator import manipulator, workspace
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload.measurement_update import MeasurementModel
from flexmanip_ros.payload.process_model import PARAMETERS, ProcessModel, set_parameters
from flexmanip_ros.payload.residual_modes import residual_modes, residual_probability
from flexmanip_ros.types import Array


def chords(arm: ArmParameters, angles: Array) -> Array:
    """Return absolute chord angles (2,) [rad] of measured ones (2,).

    An encoder reads root slopes on top: some milliradians that swing about zero with the vibration, so
    they are left out at a working point (give averaged angles where that matters). ``structured`` keeps them.
    """
    if arm.angle_convention == 'chord':
        return np.asarray(angles, dtype=np.float64)
    return np.array([angles[0], angles[0] + angles[1]])


class Quantity(IntEnum):
    """What a signal measures."""

    ANGLE = 0
    ANGLE_RATE = 1
    BEND = 2
    BEND_RATE = 3


class Role(NamedTuple):
    """One signal: what it measures, of which link or joint (0 or 1)."""

    quantity: Quantity
    link: int


class Signals(NamedTuple):
    """Roles of the configured outputs, in their order; whether angles and both torques are there."""

    outputs: tuple[Role, ...]
    angles: bool
    torques: bool


def signals(config: IdentifierParameters) -> Signals | None:
    """Return what the configured names mean, or None where they describe no two-link arm.

    A name used in ``angles`` or ``inputs`` is a joint, in that order; any other is a bend sensor: of the link
    its digits say when one ends in 1 and the other in 2, else in the order of appearance.
    """
    joints = _names(config.angles) or _names(config.inputs)
    bends = _in_order_of_links(_names(tuple(name for name in config.outputs
                                            if name.rpartition('/')[0] not in joints)))
    if bends is None:
        return None
    roles: list[Role] = []
    for output in config.outputs:
        name, _, field = output.rpartition('/')
        if field == 'effort':
            return None
        is_rate = field == 'velocity'
        if name in joints:
            roles.append(Role(Quantity.ANGLE_RATE if is_rate else Quantity.ANGLE, joints.index(name)))
        else:
            roles.append(Role(Quantity.BEND_RATE if is_rate else Quantity.BEND, bends.index(name)))
    torques = (len(config.inputs) == 2 and _names(config.inputs) == joints
               and all(name.endswith('/effort') for name in config.inputs))
    angles = len(config.angles) == 2 and all(name.endswith('/position') for name in config.angles)
    return Signals(tuple(roles), angles, torques)


def _names(of: tuple[str, ...]) -> tuple[str, ...]:
    """Return the distinct names before the slash, in order of appearance."""
    return tuple(dict.fromkeys(name.rpartition('/')[0] for name in of))


def _in_order_of_links(names: tuple[str, ...]) -> tuple[str, ...] | None:
    """Return the bend sensors of link 1 and link 2; None when more than two or one of no known link."""
    numbers = [re.findall(r'\d+', name) for name in names]
    links = [int(found[0]) if found and found[0] in ('1', '2') else 0 for found in numbers]
    if len(names) == 2:
        return names[::-1] if links == [2, 1] else names
    if len(names) == 1:
        return {1: names, 2: ('', *names)}.get(links[0])
    return names if not names else None


STEP_ANGLE = 1.0
"""Largest angle [rad] the fastest mode may turn in an integration step."""


class Model(NamedTuple):
    """Constants of the estimator; what ends up as scratch inside holds nothing between calls."""

    motion: ProcessModel
    roles: tuple[Role, ...]
    """Of every measurement: the outputs, then the angles that are not among them."""
    extra: tuple[int, ...]
    """Which of the two angles are appended to the outputs."""
    slowest: float
    """Lowest pinned frequency of a link [Hz]."""


def build(config: IdentifierParameters) -> Model | None:
    """Return the model, or None when the configured signals cannot give a payload."""
    known = signals(config)
    if known is None or not known.torques or not known.angles:
        return None
    extra = tuple(i for i in range(2) if Role(Quantity.ANGLE, i) not in known.outputs)
    roles = known.outputs + tuple(Role(Quantity.ANGLE, i) for i in extra)
    slowest = min(pinned_frequencies(config.arm))
    return Model(motion(config), roles, extra, slowest)


def pinned_frequencies(arm: ArmParameters) -> tuple[float, ...]:
    """First frequency of each link alone, pinned at both ends [Hz]."""
    return tuple(
        float(np.pi / (2 * L ** 2) * np.sqrt(EI / rho))
        for L, EI, rho in zip(arm.link_length, arm.bending_stiffness, arm.linear_density, strict=True))


def motion(config: IdentifierParameters) -> ProcessModel:
    """Allocate the arm for the compiled functions; its mass matrices are set at the working point later."""
    nominal = manipulator(config.arm)
    n = 2 + 2 * nominal.kappa
    constants = n - 4 + PARAMETERS
    nx = 2 * n + constants
    unit = manipulator(replace(config.arm, damping_ratio=0.5)).damping / 0.5
    arm = nominal._replace(stiffness=nominal.stiffness.copy(), damping=nominal.damping.copy())
    lightest = config.arm.tip_mass + config.arm.linear_density[1] * config.arm.link_length[1] / 3
    rotary = lightest if config.payload.rotary_inertia else 0.0
    fastest = max(pinned_frequencies(config.arm)) * 2 * np.pi * (nominal.kappa + 0.25) ** 2
    return ProcessModel(
        arm=arm, work=workspace(nominal.kappa), frozen=config.payload.dynamics == 'linear',
        M0=np.zeros((n, n)), Mp=np.zeros((n, n)), Mi=np.zeros((n, n)), stiffness=nominal.stiffness,
        damping=unit,
        inertia=rotary * (0.1 * config.arm.link_length[1]) ** 2,
        scale=lightest, least=-0.5 * lightest, substeps=STEP_ANGLE / fastest, payload=np.zeros(4),
        a=np.zeros(n), q=np.zeros(n), k=np.zeros((8, n)), dq=np.zeros((n, n)), dqd=np.zeros((n, n)),
        dp=np.zeros((n, 4)),
        G=np.zeros((n, constants)), X=np.zeros((2 * n, nx)), Y=np.zeros((2 * n, nx)))


def sensors(
    config: IdentifierParameters, model: Model, dt: float, diffusion: Array, theta: Array,
) -> MeasurementModel:
    """Return how each measurement follows from the state; dt: sample time [s], theta: first chords (2,)."""
    output = model.motion.arm.output
    direct = truncated_feedthrough(config.arm, model.motion.arm.kappa)
    H = np.empty((len(model.roles), output.shape[1]))
    rows = np.zeros(len(model.roles), dtype=np.int64)
    rate = np.zeros(len(model.roles), dtype=np.bool_)
    feed = np.zeros((len(model.roles), 2))
    for i, role in enumerate(model.roles):
        row = rows[i] = role.link + (2 if role.quantity in (Quantity.BEND, Quantity.BEND_RATE) else 0)
        H[i] = output[row]
        rate[i] = role.quantity in (Quantity.ANGLE_RATE, Quantity.BEND_RATE)
        if not rate[i]:
            feed[i] = direct[row]
    nx = diffusion.size
    block = max(2, round(0.1 / (model.slowest * dt)))
    more = residual_modes(config.arm, theta, model.motion.arm.kappa, rows, rate)
    return MeasurementModel(H=H, rate=rate, feed=feed, residual=more, block=block, diffusion=diffusion,
                            deviation=np.zeros(nx), f=np.zeros(nx), W=np.zeros((nx, 2 * nx)))


def truncated_feedthrough(arm: ArmParameters, kappa: int) -> Array:
    """What the modes beyond kappa add to angles and bends under a held torque, (4, 2) per N m.

    A pinned beam under end moments has exact slopes and deflections; their sine series up to kappa is what
    the model has already. Zero for the paper's torques, which do not bend, and for chord angles.
    """
    through = np.zeros((4, 2))
    if arm.torque_convention != 'joint' or not arm.slope_correction:
        return through
    j = np.pi * np.arange(1, kappa + 1)
    sign = np.cos(j)
    near, far, bend_near, bend_far = [], [], [], []
    for L, EI, s in zip(arm.link_length, arm.bending_stiffness, arm.sensor_position, strict=True):
        near.append(L / (3 * EI) - np.sum(2 * L / (EI * j ** 2)))
        far.append(-L / (6 * EI) - np.sum(2 * L * sign / (EI * j ** 2)))
        shape = 2 * L ** 2 / (EI * j ** 3) * np.sin(j * s)
        bend_near.append(L ** 2 / (6 * EI) * s * (1 - s) * (2 - s) - np.sum(shape))
        bend_far.append(-L ** 2 / (6 * EI) * s * (1 - s ** 2) - np.sum(sign * shape))
    # link 1 carries torque 1 at its root and minus torque 2 at its tip, link 2 carries torque 2 at its root
    if arm.angle_convention == 'encoder':
        through[0] = near[0], -far[0]
        through[1] = -far[0], near[0] + near[1]
    through[2] = bend_near[0], -bend_far[0]
    through[3, 1] = bend_near[1]
    return through


CERTAIN = 1e-9
"""Standard deviation of what is taken as known."""
EMPTY_STD = 0.05
"""Standard deviation of what an empty arm seems to hold, over its lightest tip mass."""
PAYLOAD_STD = 2.0
"""Standard deviation of the logarithm of an unknown payload."""
ANGLE_STD, RATE_STD = 0.03, 1.0
"""Chords [rad] and their rates [rad/s] before the first sample."""
BEND_STD = 0.01
"""Bending over the length of the link before the first sample."""
OTHER_JUMP = 0.3
"""Part of the rate jump at a capture that the rigid impulse at the tip does not explain."""
RATE_NOISE = 10.0
"""Variance of rates over their white noise before they are known: rates show what the modes left out do."""
FLOORS = {Quantity.ANGLE: 1e-6, Quantity.ANGLE_RATE: 1e-5, Quantity.BEND: 1e-7, Quantity.BEND_RATE: 1e-6}
"""Least standard deviations of a sensor [rad, rad/s, m, m/s]: no signal is exact."""


def noise(model: Model, Y: Array) -> Array:
    """First guess of every sensor's noise from its first samples Y (N, m), as ``FilterState.noise``."""
    differences = np.diff(Y, n=4, axis=0)
    white = (1.4826 * np.median(np.abs(differences), axis=0)) ** 2 / 70
    rows = np.zeros((len(model.roles), 8))
    for i, role in enumerate(model.roles):
        rate = role.quantity in (Quantity.ANGLE_RATE, Quantity.BEND_RATE)
        rows[i, mem.FLOOR] = FLOORS[role.quantity] ** 2
        rows[i, mem.WHITE] = max(white[i], rows[i, mem.FLOOR])
        rows[i, mem.POWER] = rows[i, mem.WHITE] * (RATE_NOISE if rate else 2.0)
        rows[i, mem.SLOW] = rows[i, mem.EFFECTIVE] = rows[i, mem.POWER]
    return rows


def first(config: IdentifierParameters, model: Model, m: mem.FilterState, y: Array) -> None:
    """Fill x and S from the first measurement; the arm is empty and may move."""
    n = model.motion.q.size
    k = (n - 2) // 2
    m.x[:] = 0.0
    angles = np.zeros(2)
    for i, role in enumerate(model.roles):
        if role.quantity is Quantity.ANGLE:
            angles[role.link] = y[i]
        elif role.quantity is Quantity.BEND:
            shape = model.motion.arm.output[2 + role.link, 2 + role.link * k]
            m.x[2 + role.link * k] = y[i] * shape / (shape ** 2 + 0.1)
    m.x[:2] = chords(config.arm, angles)
    p = m.x.size - PARAMETERS
    m.x[p + 3:p + 5] = config.arm.damping_ratio
    std = np.zeros(m.x.size)
    std[:2], std[n:n + 2] = ANGLE_STD, RATE_STD
    for link, (L, EI, rho) in enumerate(zip(config.arm.link_length, config.arm.bending_stiffness,
                                            config.arm.linear_density, strict=True)):
        part = slice(2 + link * k, 2 + (link + 1) * k)
        j = np.arange(1, k + 1)
        std[part] = BEND_STD * L / j ** 2
        # a mode's rate is its bending times its frequency, which grows as j^2
        std[n + part.start:n + part.stop] = BEND_STD * L * (np.pi / L) ** 2 * np.sqrt(EI / rho)
    std[p] = EMPTY_STD * model.motion.scale
    # shear, rotary inertia and coarse elements all move a mode the farther the higher it is, as j^2 or faster
    deviations = config.payload.model_error * (np.arange(2, k + 1) ** 2 - 1) / 3
    std[2 * n:p] = np.maximum(np.tile(deviations, 2), CERTAIN)
    std[p + 1:p + 3] = max(config.payload.stiffness_std, CERTAIN)
    std[p + 3:p + 5] = max(config.payload.damping_std, CERTAIN)
    m.S[:] = np.diag(std)


def freeze(config: IdentifierParameters, model: Model, angles: Array) -> None:
    """Set the mass matrices of a linear plant at its working point, given or as measured (2,), unbent."""
    rest = np.zeros(model.motion.q.size)
    rest[:2] = config.payload.working_point or chords(config.arm, angles)
    nominal = model.motion.arm
    model.motion.M0[:] = mass_matrix(nominal, np.zeros(4), rest)
    model.motion.Mp[:] = mass_matrix(nominal, np.array([1.0, 0.0, 0.0, 0.0]), rest) - model.motion.M0
    model.motion.Mi[:] = mass_matrix(nominal, np.array([0.0, 1.0, 0.0, 0.0]), rest) - model.motion.M0


def widen(S: Array, columns: Array) -> Array:
    """Return a square root of S S' + columns columns'."""
    root: Array = np.linalg.qr(np.hstack([S, columns]).T)[1].T
    return root


def jump(config: IdentifierParameters, model: Model, m: mem.FilterState) -> Array:
    """Columns (nx, c) of the rate jump at an event: an impulse at the tip, and what it leaves open."""
    n = model.motion.q.size
    held = bool(m.counts[mem.HELD])
    set_parameters(model.motion, m.x, held)
    q = m.x[:n]
    if model.motion.frozen:
        M = (model.motion.M0 + model.motion.payload[0] * model.motion.Mp
             + model.motion.payload[1] * model.motion.Mi)
        q = np.concatenate([q[:2], np.zeros(n - 2)])
    else:
        M = mass_matrix(model.motion.arm, model.motion.payload, q)
    J = body_jacobian(model.motion.arm, q, (0.0, 0.0))[:2]
    impulse = np.linalg.solve(M, J.T)
    mobility, axes = np.linalg.eigh(J @ impulse)
    reach = mobility > 1e-3 * mobility[-1]  # a straight arm gives no way along its links
    speed = np.hypot(config.payload.capture_speed, np.linalg.norm(J @ m.x[n:2 * n]))
    rates = impulse @ axes[:, reach] / np.sqrt(mobility[reach]) * speed
    other = OTHER_JUMP * np.sqrt((rates ** 2).sum(axis=1))
    columns = np.zeros((m.x.size, rates.shape[1] + n))
    columns[n:2 * n] = np.hstack([rates, np.diag(other)])
    return columns


def shake(model: Model, m: mem.FilterState) -> None:
    """An event rings modes beyond kappa, and rates show it; by how much nobody knows, unlike at a torque."""
    for i, role in enumerate(model.roles):
        if role.quantity in (Quantity.ANGLE_RATE, Quantity.BEND_RATE):
            shaken = m.noise[i, mem.WHITE] * (1.0 + (RATE_NOISE - 1.0) * min(1.0, 2.0 * residual_probability(m.score)))
            m.noise[i, mem.EFFECTIVE] = max(m.noise[i, mem.EFFECTIVE], shaken)


def diffusion(config: IdentifierParameters, model: Model, m: mem.FilterState) -> Array:
    """Standard deviation (nx,) each state gains in the square root of a second, so that memory is finite."""
    n = model.motion.q.size
    T = config.payload.memory_time
    gained = np.zeros(m.x.size)
    # a rate is then forgotten over T: what it gains in T equals what T seconds of samples tell of it
    gained[n:n + 2] = 1e-4 / T
    gained[n + 2:2 * n] = 1e-5 / T * np.array(config.arm.link_length).max()
    p = m.x.size - PARAMETERS
    gained[2 * n:p] = 1e-4 / T
    gained[p] = (1e-4 if m.counts[mem.HELD] else 1e-3) / T
    gained[p + 1:p + 5] = 1e-4 / T
    gained[p + 5] = 1e-3 / T if config.payload.rotary_inertia else 0.0
    return gained
