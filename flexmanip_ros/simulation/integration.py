"""Compiled time stepping: the nonlinear arm by Runge-Kutta of fourth order, linear plants exactly."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from flexmanip_ros.arm.equations_of_motion import acceleration, hold
from flexmanip_ros.numerics.compiled import kernel, merged

if TYPE_CHECKING:
    from flexmanip_ros.arm.manipulator import Manipulator, Workspace
    from flexmanip_ros.types import Array

LIMIT = 1e6
"""A coordinate or rate beyond this has diverged."""


@merged
def runge_kutta(
    arm: Manipulator, payload: Array, held: Array, x: Array, effort: Array, h: float, steps: int,
    scratch: Array, work: Workspace,
) -> bool:
    """Advance x = [q; qd] (2n,) by steps of h seconds under a held torque; False when it diverged.

    held: (0 or 2, n) combinations of q that stay; scratch: (6, 2n), trial state and the four slopes.
    """
    size = x.size
    n = size // 2
    trial = scratch[0]
    for _ in range(steps):
        for stage in range(4):
            slope = scratch[1 + stage]
            if stage == 0:
                for r in range(size):
                    trial[r] = x[r]
            else:
                before = scratch[stage]
                reach = h if stage == 3 else 0.5 * h
                for r in range(size):
                    trial[r] = x[r] + reach * before[r]
            for r in range(n):
                slope[r] = trial[n + r]
            if not acceleration(arm, payload, trial[:n], trial[n:size], effort, slope[n:size], work):
                return False
            if held.shape[0]:
                hold(work.M, held, slope[n:size], work.held)
        for r in range(size):
            x[r] += h / 6.0 * (scratch[1, r] + 2.0 * (scratch[2, r] + scratch[3, r]) + scratch[4, r])
            if not abs(x[r]) < LIMIT:
                return False
    return True


@kernel
def run_nonlinear(
    arm: Manipulator, payload: Array, held: Array, x: Array, efforts: Array, dt: float, steps: int,
    position: Array, velocity: Array, scratch: Array, work: Workspace,
) -> int:
    """Record each sample, then integrate to the next under its torque; return how many samples are good.

    x (2n,) is advanced in place. efforts: (N, L); position, velocity: (N, 2 L) filled; scratch: (6, 2n).
    """
    n = x.size // 2
    count: int = efforts.shape[0]
    for k in range(count):
        for r in range(arm.output.shape[0]):
            place, rate = 0.0, 0.0
            for c in range(n):
                place += arm.output[r, c] * x[c]
                rate += arm.output[r, c] * x[n + c]
            position[k, r] = place
            velocity[k, r] = rate
        if not runge_kutta(arm, payload, held, x, efforts[k], dt / steps, steps, scratch, work):
            return k
    return count


@kernel
def run_linear(
    A: Array, B: Array, C: Array, rest: Array, x: Array, efforts: Array,
    position: Array, velocity: Array, scratch: Array,
) -> int:
    """Record and step x = [dq; dq'] by x = A x + B u; outputs rest + C dq and C dq'. See run_nonlinear.

    A: (2n, 2n), B: (2n, L), C: (2 L, n), rest: (2 L,), scratch: (6, 2n).
    """
    size = x.size
    n = size // 2
    count: int = efforts.shape[0]
    for k in range(count):
        for r in range(C.shape[0]):
            place, rate = rest[r], 0.0
            for c in range(n):
                place += C[r, c] * x[c]
                rate += C[r, c] * x[n + c]
            position[k, r] = place
            velocity[k, r] = rate
        for r in range(size):
            value = 0.0
            for i in range(efforts.shape[1]):
                value += B[r, i] * efforts[k, i]
            for c in range(size):
                value += A[r, c] * x[c]
            scratch[0, r] = value
        for r in range(size):
            x[r] = scratch[0, r]
            if not abs(x[r]) < LIMIT:
                return k
    return count


def scratch(size: int) -> Array:
    """Scratch rows for a state of the given size 2n."""
    return np.zeros((6, size))
