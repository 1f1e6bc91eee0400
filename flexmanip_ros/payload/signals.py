"""What each configured signal means to an arm: a joint angle, a joint rate, a bend, a bend rate."""

from __future__ import annotations

import re
from enum import IntEnum
from typing import NamedTuple

from flexmanip_ros.parameters import IdentifierParameters


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
