"""Compiled measurement: joint angles and bends of the arm, with the slopes of the truncated modes."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from flexmanip_ros.plant.acceleration_kernel import acceleration, hold
from flexmanip_ros.plant.compiled import kernel
from flexmanip_ros.types import Array

if TYPE_CHECKING:
    from flexmanip_ros.plant.manipulator import Manipulator, Workspace


class Slopes(NamedTuple):
    """Quasi-static slopes of the modes beyond kappa (``slope_correction.py``)."""

    active: bool
    flexibility: Array
    """(4, 7) outputs by loads."""
    moments: Array
    """(4, 2) end moments by joint torques."""
    hubs: Array
    """(4,) rotary inertias at root and tip of link 1, root and tip of link 2."""


@kernel
def measure(
    arm: Manipulator, payload: Array, slopes: Slopes, held: Array, q: Array, qd: Array, previous: Array,
    position: Array, velocity: Array, qdd: Array, loads: Array, work: Workspace,
) -> None:
    """Fill position and velocity (4,): joint1, joint2, link1_bend, link2_bend.

    previous: torque (2,) of the interval that ends at this instant: at a jump of the torque the
    truncated modes still show the one before; held: see ``integration_kernel``. Scratch: qdd (n,),
    loads (7,).
    """
    for r in range(4):
        place, rate = 0.0, 0.0
        for c in range(q.size):
            place += arm.output[r, c] * q[c]
            rate += arm.output[r, c] * qd[c]
        position[r] = place
        velocity[r] = rate
    if slopes.active and acceleration(arm, payload, q, qd, previous, qdd, work):
        if held.shape[0]:
            hold(work.M, held, qdd, work.held)
        end_loads(arm, payload, slopes, q, qdd, previous, loads)
        for r in range(4):
            for c in range(7):
                position[r] += slopes.flexibility[r, c] * loads[c]


@kernel
def end_loads(
    arm: Manipulator, payload: Array, slopes: Slopes, q: Array, qdd: Array, effort: Array, loads: Array,
) -> None:
    """Fill loads (7,) of the truncated modes, see ``slope_correction.flexibility``."""
    k = arm.kappa
    base = arm.length[0] * np.cos(q[1] - q[0]) * qdd[0]
    turn1, turn2 = qdd[0], qdd[1]
    loads[4] = -turn1
    loads[5] = -turn2
    loads[6] = -base
    root1, tip1, root2, tip2 = turn1, turn1, turn2, turn2
    for j in range(k):
        root1 += arm.root_slope[0, j] * qdd[2 + j]
        tip1 += arm.tip_slope[0, j] * qdd[2 + j]
        root2 += arm.root_slope[1, j] * qdd[2 + k + j]
        tip2 += arm.tip_slope[1, j] * qdd[2 + k + j]
    loads[0] = -slopes.hubs[0] * root1
    loads[1] = -slopes.hubs[1] * tip1
    loads[2] = -slopes.hubs[2] * root2
    across = payload[0] * payload[2]
    loads[3] = (-(slopes.hubs[3] + payload[1] + across * payload[2] + payload[0] * payload[3] ** 2) * tip2
                - across * (base + arm.length[1] * turn2))
    for r in range(4):
        loads[r] += slopes.moments[r, 0] * effort[0] + slopes.moments[r, 1] * effort[1]
