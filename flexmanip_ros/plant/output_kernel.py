"""Compiled measurement: joint angles and bends of the arm, with the slopes of the truncated modes."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from flexmanip_ros.plant.compiled import kernel

if TYPE_CHECKING:
    from flexmanip_ros.plant.manipulator import Manipulator, Workspace
    from flexmanip_ros.types import Array


class Slopes(NamedTuple):
    """Quasi-static slopes of the modes beyond kappa (``slope_correction.py``)."""

    active: bool
    torque: Array
    """(4, 2) joint angles and bends by joint torques [rad/(N m), m/(N m)]."""


@kernel
def measure(
    arm: Manipulator, payload: Array, slopes: Slopes, q: Array, qd: Array, previous: Array,
    position: Array, velocity: Array, qdd: Array, work: Workspace,
) -> None:
    """Fill position and velocity (4,): joint1, joint2, link1_bend, link2_bend.

    previous: torque (2,) of the interval that ends at this instant; qdd: (n,) scratch.
    """
    for r in range(4):
        place, rate = 0.0, 0.0
        for c in range(q.size):
            place += arm.output[r, c] * q[c]
            rate += arm.output[r, c] * qd[c]
        position[r] = place
        velocity[r] = rate
