"""Compiled time stepping: the nonlinear arm by Runge-Kutta methods, linear plants exactly."""

from typing import NamedTuple

import numpy as np
from scipy.integrate import DOP853

from flexmanip_ros.arm.equations_of_motion import acceleration, hold
from flexmanip_ros.arm.manipulator import Manipulator, Workspace
from flexmanip_ros.numerics.compiled import inner, kernel
from flexmanip_ros.types import Array

LIMIT = 1e6
"""Magnitude beyond which a coordinate or rate counts as diverged."""


class Method(NamedTuple):
    """An explicit Runge-Kutta method and the largest steps it may take."""

    stages: Array
    """(s, s) coefficients of the Butcher tableau."""
    weights: Array
    """(s,) weights of the slopes."""
    angle: float
    """Largest phase advance [rad] of the fastest mode in a step: its phase and amplitude are then accurate to 4e-6."""
    decay: float
    """Largest ratio of a step to the shortest time constant of a decaying motion: the rate of decay is then accurate to
    4e-5, and to 2 % for a joint that sticks by Coulomb friction."""
    stable: float
    """Largest stable product of the step and the magnitude of the fastest pole."""


SMOOTH = Method(np.ascontiguousarray(DOP853.A), np.ascontiguousarray(DOP853.B), angle=1.5, decay=2.5, stable=5.9)
"""Method of eighth order (Dormand and Prince), for smooth motion: it needs a third of the evaluations of ``ROUGH``."""
ROUGH = Method(np.diag([0.5, 0.5, 1.0], -1), np.array([1.0, 2.0, 2.0, 1.0]) / 6.0, angle=0.15, decay=1.0, stable=2.6)
"""Method of fourth order, for Coulomb friction: a higher order is no more accurate where the friction changes sign."""


@inner
def runge_kutta(
    arm: Manipulator, payload: Array, held: Array, x: Array, effort: Array, h: float, steps: int,
    stages: Array, weights: Array, scratch: Array, work: Workspace,
) -> bool:
    """Advance x = [q; qd] (2n,) by steps of h seconds under a held torque; return False when it diverges.

    held: (0 or L, n) rows whose product with q stays constant; stages, weights: see ``Method``; scratch: (s + 1, 2n),
    the slopes and the trial state.
    """
    size = x.size
    n = size // 2
    count = weights.size
    trial = scratch[count]
    for _ in range(steps):
        for stage in range(count):
            for r in range(size):
                trial[r] = x[r]
            for before in range(stage):
                weight = h * stages[stage, before]
                if weight != 0.0:
                    for r in range(size):
                        trial[r] += weight * scratch[before, r]
            slope = scratch[stage]
            for r in range(n):
                slope[r] = trial[n + r]
            if not acceleration(arm, payload, trial[:n], trial[n:size], effort, slope[n:size], work):
                return False
            if held.shape[0]:
                hold(work.M, held, slope[n:size], work.held)
        for stage in range(count):
            weight = h * weights[stage]
            if weight != 0.0:
                for r in range(size):
                    x[r] += weight * scratch[stage, r]
        for r in range(size):
            if not abs(x[r]) < LIMIT:
                return False
    return True


@kernel
def run_nonlinear(
    arm: Manipulator, payload: Array, held: Array, x: Array, efforts: Array, dt: float, steps: int,
    stages: Array, weights: Array, position: Array, velocity: Array, scratch: Array, work: Workspace,
) -> int:
    """Record each sample, then integrate to the next under its torque; return how many it completes without diverging.

    x (2n,) is advanced in place. efforts: (N, L); position, velocity: (N, 2 L) filled; scratch: see
    ``runge_kutta``.
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
        if not runge_kutta(arm, payload, held, x, efforts[k], dt / steps, steps, stages, weights, scratch, work):
            return k
    return count


@kernel
def run_linear(
    A: Array, B: Array, C: Array, rest: Array, x: Array, efforts: Array,
    position: Array, velocity: Array, scratch: Array,
) -> int:
    """Record and step x = [dq; dq'] by x = A x + B u; outputs rest + C dq and C dq'. See run_nonlinear.

    A: (2n, 2n), B: (2n, L), C: (2 L, n), rest: (2 L,), scratch: (1, 2n).
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
