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
from flexmanip_ros.types import ArmParameter, Status

NAMES = {
    Kind.STIFFNESS: 'link{}_bending_stiffness', Kind.DAMPING: 'link{}_damping_ratio',
    Kind.VISCOUS: 'joint{}_viscous_friction', Kind.COULOMB: 'joint{}_coulomb_friction',
    Kind.ROTOR: 'joint{}_rotor_inertia', Kind.TORQUE_GAIN: 'joint{}_torque_gain', Kind.BEND_GAIN: 'link{}_bend_gain',
    Kind.BEND_OFFSET: 'link{}_bend_offset', Kind.TORQUE_DELAY: 'torque_delay', Kind.TORQUE_LAG: 'joint{}_torque_lag',
    Kind.BEND_DELAY: 'bend_delay'}
"""Published name of a parameter of a link or joint, counted from 1."""
FIELDS = {
    Kind.STIFFNESS: 'bending_stiffness', Kind.VISCOUS: 'joint_viscous_friction', Kind.COULOMB: 'joint_coulomb_friction',
    Kind.ROTOR: 'rotor_inertia', Kind.TORQUE_GAIN: 'torque_gain', Kind.BEND_GAIN: 'bend_gain',
    Kind.BEND_OFFSET: 'bend_offset', Kind.TORQUE_DELAY: 'torque_delay', Kind.TORQUE_LAG: 'torque_lag',
    Kind.BEND_DELAY: 'bend_delay'}
"""The parameter arm.* that takes it."""


def taught(config: IdentifierParameters, state: StructuredState | None) -> tuple[ArmParameter, ...]:
    """Return value and standard deviation of each parameter that ``payload.learn`` names, in SI units; empty before.

    A parameter that was taken as known, as the simplest arm fits, has its given value and its prior deviation. Where
    the parameters move further than their variances say, or the residuals of the empty arm's fit are no white noise,
    the deviations are larger by that.
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
        found.append(ArmParameter(NAMES[kind].format(link + 1), value, std))
    return tuple(found)


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
    for kind, field in FIELDS.items():
        given = getattr(config.arm, field)
        each = given if isinstance(given, tuple) else (given,)
        here = [by_name.get(NAMES[kind].format(link + 1)) for link in range(len(each))]
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
