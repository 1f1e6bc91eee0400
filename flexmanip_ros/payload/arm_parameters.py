"""What the arm taught: values of its parameters with their deviations, and the same as parameters to be given."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload.process_model import Kind
from flexmanip_ros.payload.structured import StructuredState
from flexmanip_ros.types import ArmParameter

NAMES = {
    Kind.STIFFNESS: 'link{}_bending_stiffness', Kind.DAMPING: 'link{}_damping_ratio',
    Kind.VISCOUS: 'joint{}_viscous_friction', Kind.COULOMB: 'joint{}_coulomb_friction',
    Kind.ROTOR: 'joint{}_rotor_inertia', Kind.TORQUE_GAIN: 'joint{}_torque_gain', Kind.BEND_GAIN: 'link{}_bend_gain',
    Kind.BEND_OFFSET: 'link{}_bend_offset'}
"""Published name of a parameter of a link or joint, counted from 1."""
FIELDS = {
    Kind.STIFFNESS: 'bending_stiffness', Kind.VISCOUS: 'joint_viscous_friction', Kind.COULOMB: 'joint_coulomb_friction',
    Kind.ROTOR: 'rotor_inertia', Kind.TORQUE_GAIN: 'torque_gain', Kind.BEND_GAIN: 'bend_gain',
    Kind.BEND_OFFSET: 'bend_offset'}
"""The parameter arm.* that takes it."""
POSITIVE = (Kind.VISCOUS, Kind.COULOMB, Kind.ROTOR)
"""Kinds that no parameter can give below zero."""


def taught(config: IdentifierParameters, state: StructuredState | None) -> tuple[ArmParameter, ...]:
    """Return value and standard deviation of each parameter that ``payload.learn`` names, in SI units; empty before.

    A parameter that was taken as known, as the simplest arm fits, has its given value and its prior deviation.
    """
    if state is None or state.model is None or state.memory is None:
        return ()
    model, m = state.model, state.memory
    first = 2 * model.motion.arm.stiffness.size
    found = []
    for c, (kind, link) in enumerate(zip(map(Kind, model.motion.kind), model.motion.link.tolist(), strict=True)):
        if kind not in NAMES or not model.prior[c]:
            continue
        value, std = float(m.x[first + c]), float(np.linalg.norm(m.S[first + c])) or float(model.prior[c])
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


def as_parameters(config: IdentifierParameters, found: Sequence[ArmParameter]) -> dict[str, Any]:
    """Return parameters by dotted name, with which the arm is given as it was found.

    The damping ratio is one parameter: the mean of the links, each weighted by its information.
    """
    by_name = {one.name: one for one in found}
    values: dict[str, Any] = {}
    for kind, field in FIELDS.items():
        given = getattr(config.arm, field)
        here = [by_name.get(NAMES[kind].format(link + 1)) for link in range(len(given))]
        if any(here):
            least = 0.0 if kind in POSITIVE else -np.inf
            values[f'arm.{field}'] = tuple(
                before if one is None else max(float(f'{one.value:.6g}'), least)
                for one, before in zip(here, given, strict=True))
    ratios = [one for one in found if one.name.endswith('_damping_ratio')]
    if ratios:
        weights = np.array([one.std for one in ratios]) ** -2.0
        mean = float(weights @ np.array([one.value for one in ratios]) / weights.sum())
        values['arm.damping_ratio'] = max(float(f'{mean:.6g}'), 0.0)
    return values
