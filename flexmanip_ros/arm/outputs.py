"""Compiled measurement: joint angles and bends of the arm, with the slopes of the truncated modes."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from flexmanip_ros.numerics.compiled import kernel
from flexmanip_ros.types import Array

if TYPE_CHECKING:
    from flexmanip_ros.arm.manipulator import Manipulator


class Slopes(NamedTuple):
    """What the modes beyond kappa add to the outputs (``slope_correction.py``, ``tail.py``)."""

    active: bool
    flexibility: Array
    """(4, 7) outputs by loads."""
    moments: Array
    """(4, 2) end moments by joint torques."""
    hubs: Array
    """(4,) rotary inertias at root and tip of link 1, root and tip of link 2."""
    step: Array
    """(T, 2, 2) free motion of each oscillator of the tail over a sample."""
    start: Array
    """(T, 2) its motion by a unit force that falls to zero over the sample."""
    end: Array
    """(T, 2) the same for a force that rises from zero."""
    load: Array
    """(T, 7) forces on the oscillators by loads."""
    output: Array
    """(4, T) outputs by oscillators."""


@kernel
def measure(
    arm: Manipulator, slopes: Slopes, q: Array, qd: Array, memory: Array, position: Array, velocity: Array,
) -> None:
    """Fill position and velocity (4,): joint1, joint2, link1_bend, link2_bend.

    memory (7 + 2 T,): loads of the truncated modes at the end of the last interval, under its torque (at a
    jump of the torque they still show the one before), then places and rates of the tail's oscillators.
    """
    T = slopes.step.shape[0]
    for r in range(4):
        place, rate = 0.0, 0.0
        for c in range(q.size):
            place += arm.output[r, c] * q[c]
            rate += arm.output[r, c] * qd[c]
        for c in range(7):
            place += slopes.flexibility[r, c] * memory[c]
        for c in range(T):
            place += slopes.output[r, c] * memory[7 + c]
            rate += slopes.output[r, c] * memory[7 + T + c]
        position[r] = place
        velocity[r] = rate


@kernel
def shake(slopes: Slopes, before: Array, memory: Array) -> None:
    """Move the tail over a sample while the loads go from before (7,) to memory[:7]."""
    T = slopes.step.shape[0]
    for a in range(T):
        first, last = 0.0, 0.0
        for c in range(7):
            first += slopes.load[a, c] * before[c]
            last += slopes.load[a, c] * memory[c]
        z, rate = memory[7 + a], memory[7 + T + a]
        step = slopes.step[a]
        memory[7 + a] = (step[0, 0] * z + step[0, 1] * rate
                         + slopes.start[a, 0] * first + slopes.end[a, 0] * last)
        memory[7 + T + a] = (step[1, 0] * z + step[1, 1] * rate
                             + slopes.start[a, 1] * first + slopes.end[a, 1] * last)


@kernel
def end_loads(
    arm: Manipulator, payload: Array, slopes: Slopes, q: Array, qdd: Array, effort: Array, loads: Array,
) -> None:
    """Fill loads[:7] of the truncated modes, see ``slope_correction.flexibility``."""
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
