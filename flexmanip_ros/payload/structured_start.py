"""What the structured estimator believes before it has seen samples, and just after an event."""

from __future__ import annotations

import numpy as np

from flexmanip_ros.arm.capture import body_jacobian
from flexmanip_ros.arm.manipulator import mass_matrix
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload.angles import chords
from flexmanip_ros.payload.process_model import PARAMETERS, set_parameters
from flexmanip_ros.payload.signals import Quantity
from flexmanip_ros.payload.structured_model import Model
from flexmanip_ros.payload.tail_kernel import believed
from flexmanip_ros.types import Array

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
    """First guess of every sensor's noise from its first samples Y (N, m), as ``Memory.noise``."""
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


def first(config: IdentifierParameters, model: Model, m: mem.Memory, y: Array) -> None:
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
    uneven = config.payload.model_error * (np.arange(2, k + 1) ** 2 - 1) / 3
    std[2 * n:p] = np.maximum(np.tile(uneven, 2), CERTAIN)
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


def jump(config: IdentifierParameters, model: Model, m: mem.Memory) -> Array:
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


def shake(model: Model, m: mem.Memory) -> None:
    """An event rings modes beyond kappa, and rates show it; by how much nobody knows, unlike at a torque."""
    for i, role in enumerate(model.roles):
        if role.quantity in (Quantity.ANGLE_RATE, Quantity.BEND_RATE):
            shaken = m.noise[i, mem.WHITE] * (1.0 + (RATE_NOISE - 1.0) * min(1.0, 2.0 * believed(m.score)))
            m.noise[i, mem.EFFECTIVE] = max(m.noise[i, mem.EFFECTIVE], shaken)


def diffusion(config: IdentifierParameters, model: Model, m: mem.Memory) -> Array:
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
