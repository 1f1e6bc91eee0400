"""What the arm taught: values of its parameters with their deviations, and the same as parameters to be given."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from flexmanip_ros.parameters import ArmParameters, IdentifierParameters, flatten, leaves
from flexmanip_ros.payload.filter_state import HELD, SANDWICH
from flexmanip_ros.payload.interval import moves
from flexmanip_ros.payload.process_model import Kind
from flexmanip_ros.payload.structured import StructuredState, estimate
from flexmanip_ros.types import ArmParameter, Array, Status

NAMES = {
    Kind.STIFFNESS: 'link{}_bending_stiffness', Kind.DAMPING: 'link{}_damping_ratio',
    Kind.VISCOUS: 'joint{}_viscous_friction', Kind.COULOMB: 'joint{}_coulomb_friction',
    Kind.ROTOR: 'joint{}_rotor_inertia', Kind.TORQUE_GAIN: 'joint{}_torque_gain', Kind.BEND_GAIN: 'link{}_bend_gain',
    Kind.BEND_OFFSET: 'link{}_bend_offset', Kind.TORQUE_DELAY: 'torque_delay', Kind.TORQUE_LAG: 'joint{}_torque_lag',
    Kind.BEND_DELAY: 'bend_delay', Kind.TIP_INERTIA: 'tip_inertia'}
"""Published name of a parameter of a link or joint, counted from 1."""
LENGTH, DENSITY, JOINT, TIP, GRAVITY = 'link{}_length', 'link{}_linear_density', 'joint_mass', 'tip_mass', 'gravity{}'
"""Published names of lengths, masses and the components of gravity, where lengths and masses are unsure."""
FIELDS = {
    LENGTH: 'link_length', DENSITY: 'linear_density', JOINT: 'joint_mass', TIP: 'tip_mass', GRAVITY: 'gravity',
    NAMES[Kind.STIFFNESS]: 'bending_stiffness', NAMES[Kind.VISCOUS]: 'joint_viscous_friction',
    NAMES[Kind.COULOMB]: 'joint_coulomb_friction', NAMES[Kind.ROTOR]: 'rotor_inertia',
    NAMES[Kind.TORQUE_GAIN]: 'torque_gain', NAMES[Kind.BEND_GAIN]: 'bend_gain',
    NAMES[Kind.BEND_OFFSET]: 'bend_offset', NAMES[Kind.TORQUE_DELAY]: 'torque_delay',
    NAMES[Kind.TORQUE_LAG]: 'torque_lag', NAMES[Kind.BEND_DELAY]: 'bend_delay',
    NAMES[Kind.TIP_INERTIA]: 'tip_inertia'}
"""The parameter arm.* that takes it, by its published name."""


def taught(config: IdentifierParameters, state: StructuredState | None) -> tuple[ArmParameter, ...]:
    """Return value and standard deviation of each parameter that ``payload.learn`` names, in SI units; empty before.

    A parameter that was taken as known, as the simplest arm fits, has its given value and its prior deviation. Where
    the parameters move further than their variances say, or the residuals of the empty arm's fit are no white noise,
    the deviations are larger by that. Where lengths and masses are unsure, the parameters are those of a similar arm
    whose last link has its given length (``structured_model.constant_errors``): it moves as this arm does.
    """
    if state is None or state.model is None or state.memory is None:
        return ()
    model, m = state.model, state.memory
    factor = moves(m) if m.counts[HELD] else max(moves(m), float(m.score[SANDWICH]))
    found = []
    x, S = m.x[model.payload:].copy(), math.sqrt(factor) * m.S[model.payload:]
    late = model.motion.kind == Kind.TORQUE_LAG
    mirrored = late & (x < 0.0)
    if mirrored.any():  # what the filter means by a lag below zero, see ``late_torque``
        delay = model.motion.kind == Kind.TORQUE_DELAY
        x[delay] += 2.0 * x[mirrored].sum() / late.sum()
        S[delay] += 2.0 * S[mirrored].sum(axis=0) / late.sum()
        x[mirrored] *= -1.0
    axes = model.motion.kind == Kind.CONSTANT
    errors = model.motion.constants.transpose(1, 2, 0)
    ratio, stiff = model.motion.kind == Kind.DAMPING, model.motion.kind == Kind.STIFFNESS
    if ratio.any():  # the filter's is D over that of the given EI and rho at a ratio of one; D ~ ratio sqrt(EI rho)
        scale, scale_root = 0.5 * (errors[:, 0] @ x[axes]), 0.5 * (errors[:, 0] @ S[axes])
        if stiff.any():
            scale, scale_root = scale + 0.5 * x[stiff], scale_root + 0.5 * S[stiff]
        S[ratio] = np.exp(-scale)[:, None] * (S[ratio] - x[ratio][:, None] * scale_root)
        x[ratio] *= np.exp(-scale)
    root = S[axes] if S[axes].any() else np.eye(int(axes.sum()), S.shape[1])
    longer = errors[:, 2] @ x[axes], errors[:, 2] @ root
    for kind, sign in ((Kind.STIFFNESS, 1.0), (Kind.BEND_GAIN, -1.0)) if axes.any() else ():
        some = model.motion.kind == kind
        x[some] += sign * longer[0][model.motion.link[some]]
        S[some] += sign * longer[1][model.motion.link[some]]
    for c, (kind, link) in enumerate(zip(map(Kind, model.motion.kind), model.motion.link.tolist(), strict=True)):
        if kind not in NAMES or not model.motion.prior[c]:
            continue
        value, std = float(x[c]), float(np.linalg.norm(S[c])) or float(model.motion.prior[c])
        if kind is Kind.STIFFNESS:
            value = config.arm.bending_stiffness[link] * float(np.exp(value))
            std *= value
        elif kind in (Kind.TORQUE_GAIN, Kind.BEND_GAIN):
            value = float(np.exp(value))
            std *= value
        elif kind is Kind.ROTOR:
            value += config.arm.rotor_inertia[link]
        elif kind is Kind.TIP_INERTIA:
            value += config.arm.tip_inertia
        found.append(ArmParameter(NAMES[kind].format(link + 1), value, std))
    return (*found, *_constants(config.arm, errors @ x[axes], errors @ root))


def _constants(arm: ArmParameters, errors: Array, root: Array) -> list[ArmParameter]:
    """Return the lengths, densities and masses, and the gravity, that are unsure.

    errors: (L, 4) see ``constant_errors``; root: (L, 4, N) square root of their covariance.
    """
    found = []

    def add(name: str, given: float, factor: float, error: Array, deviations: Array) -> None:
        std = abs(factor) * float(np.linalg.norm(deviations))
        if std > 0.0:
            found.append(ArmParameter(name, given + factor * float(error), std))

    for i, (length, density) in enumerate(zip(arm.link_length, arm.linear_density, strict=True)):
        mass, name = (arm.tip_mass, TIP) if i + 1 == len(errors) else (arm.joint_mass, JOINT)
        (denser, heavier, longer, _), spread = errors[i], root[i]
        add(LENGTH.format(i + 1), length, length, longer, spread[2])
        add(DENSITY.format(i + 1), density, density, denser - 3.0 * longer, spread[0] - 3.0 * spread[2])
        add(name, mass, 1.0, heavier - 2.0 * mass * longer, spread[1] - 2.0 * mass * spread[2])
    for c, given in enumerate(arm.gravity):
        add(GRAVITY.format(c + 1), given, given, errors[-1, 3], root[-1, 3])
    return found


def input_friction(config: IdentifierParameters, state: StructuredState | None) -> tuple[float, ...] | None:
    """Return the Coulomb friction of each joint, in units of its input (L,) [N m]; None unless TRACKING.

    What the arm does not teach is as it was given.
    """
    if state is None or estimate(config, state).status is not Status.TRACKING:
        return None
    found = {one.name: one.value for one in taught(config, state)}
    torques, gains = (
        [found.get(NAMES[kind].format(joint + 1), value) for joint, value in enumerate(values)]
        for kind, values in ((Kind.COULOMB, config.arm.joint_coulomb_friction),
                             (Kind.TORQUE_GAIN, config.arm.torque_gain)))
    return tuple(max(torque, 0.0) / gain for torque, gain in zip(torques, gains, strict=True))


def as_parameters(config: IdentifierParameters, found: Sequence[ArmParameter]) -> dict[str, Any]:
    """Return every parameter of the arm by dotted name: as it was found, and what it does not teach as it was given.

    The damping ratio is one parameter: the mean of the links, each weighted by its information. A delay of the bends
    that is less than two deviations below zero is none. A value beyond the range that is declared for its parameter
    becomes the nearest one in it, as no node would take it.
    """
    by_name = {one.name: one for one in found}
    values: dict[str, Any] = flatten(config.arm, 'arm.')
    for name, field in FIELDS.items():
        given = getattr(config.arm, field)
        each = given if isinstance(given, tuple) else (given,)
        here = [by_name.get(name.format(link + 1)) for link in range(len(each))]
        if any(here):
            new = tuple(before if one is None else _possible(field, one.value, one.std)
                        for one, before in zip(here, each, strict=True))
            values[f'arm.{field}'] = new if isinstance(given, tuple) else new[0]
    ratios = [one for one in found if one.name.endswith('_damping_ratio')]
    if ratios:
        weights = np.array([one.std for one in ratios]) ** -2.0
        mean = float(weights @ np.array([one.value for one in ratios]) / weights.sum())
        values['arm.damping_ratio'] = _possible('damping_ratio', mean)
    return values


def _possible(field: str, value: float, std: float = 0.0) -> float:
    """Return a value of a parameter arm.*, to six digits and within its declared range; std: its deviation."""
    (leaf,) = (leaf for leaf in leaves(ArmParameters) if leaf.name == field)
    nearly_zero = field == 'bend_delay' and -2.0 * std < value < 0.0
    return float(np.clip(0.0 if nearly_zero else float(f'{value:.6g}'),
                         -np.inf if leaf.low is None else leaf.low, np.inf if leaf.high is None else leaf.high))
