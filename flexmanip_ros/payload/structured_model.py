"""The arm and its sensors as the structured estimator's compiled functions take them."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flexmanip_ros.arm.manipulator import manipulator, workspace
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.payload.measurement_update import Sensors
from flexmanip_ros.payload.process_model import PARAMETERS, Motion
from flexmanip_ros.payload.residual_modes import tail
from flexmanip_ros.payload.signals import Quantity, Role, signals
from flexmanip_ros.types import Array

STEP_ANGLE = 1.0
"""Largest angle [rad] the fastest mode may turn in an integration step."""


class Model(NamedTuple):
    """Constants of the estimator; what ends up as scratch inside holds nothing between calls."""

    motion: Motion
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


def motion(config: IdentifierParameters) -> Motion:
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
    return Motion(
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
) -> Sensors:
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
    more = tail(config.arm, theta, model.motion.arm.kappa, rows, rate)
    return Sensors(H=H, rate=rate, feed=feed, tail=more, block=block, diffusion=diffusion,
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
