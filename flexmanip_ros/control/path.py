"""The way from one pair of angles to another: as fast as rate, torque and bend allow, without a step in them.

A polynomial of fifth degree (minimum jerk: Flash and Hogan, J. Neuroscience 5, 1985) whose duration follows
from what the arm must bear on it, hence from the payload: a heavier arm is moved more slowly.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from flexmanip_ros.types import Array

PEAK_RATE, PEAK_ACCELERATION = 15.0 / 8.0, 10.0 / math.sqrt(3.0)
"""Of a move by 1 in 1 s from rest to rest."""
BRAKING = 4.0
"""Peak acceleration of coming to rest within 1 s from a rate of 1, where one is."""
SHORTEST = 1e-3
"""Duration of the shortest move [s]."""


class Path(NamedTuple):
    """Coefficients (6, L) of the time since the start over the duration [s], and how old it is [s]."""

    coefficients: Array
    duration: float
    age: float = 0.0

    @property
    def goal(self) -> Array:
        """Where it ends, (L,)."""
        end: Array = self.coefficients.sum(axis=0)
        return end

    def after(self, seconds: float) -> Path:
        """Return the path some time later."""
        return self._replace(age=min(self.age + seconds, self.duration))

    @property
    def ended(self) -> bool:
        """Whether the goal is reached."""
        return self.age >= self.duration

    def now(self) -> Array:
        """Return position, rate, acceleration and jerk (4, L) now."""
        s = self.age / self.duration
        powers = np.array([s**k for k in range(6)])
        rows, c, scale = np.zeros((4, self.coefficients.shape[1])), self.coefficients, 1.0
        for row in range(4):
            rows[row] = (powers[:len(c)] @ c) * scale
            c = c[1:] * np.arange(1, len(c))[:, None]
            scale /= self.duration
        if self.ended:
            rows[1:] = 0.0
        return rows


def rest(position: Array) -> Path:
    """Stay."""
    coefficients = np.zeros((6, len(position)))
    coefficients[0] = position
    return Path(coefficients, SHORTEST, SHORTEST)


def plan(before: Path, goal: Array, duration: float) -> Path:
    """Leave a path where it is now, with the rate and acceleration it has, to be at rest at the goal (L,)."""
    position, rate, acceleration, _ = before.now()
    a0, a1, a2 = position, rate * duration, acceleration * duration**2 / 2.0
    d = np.asarray(goal) - a0 - a1 - a2
    v, a = -a1 - 2.0 * a2, -2.0 * a2
    return Path(np.stack([a0, a1, a2, 10.0 * d - 4.0 * v + a / 2.0, -15.0 * d + 7.0 * v - a,
                          6.0 * d - 3.0 * v + a / 2.0]), duration)


def duration(distance: Array, rate: Array, fastest: float, loads: Array, limits: Array) -> float:
    """Return the duration [s] of a move by ``distance`` (L,) that begins with ``rate`` (L,).

    fastest: the largest rate; loads (r, L): what each acceleration costs (torques, bends); limits (r,): what
    they may. From rest it is the shortest that keeps to all of them.
    """
    by_rate = PEAK_RATE * float(np.abs(distance).max()) / fastest
    by_load = PEAK_ACCELERATION * float((np.abs(loads @ distance) / limits).max())
    braking = BRAKING * float((np.abs(loads @ rate) / limits).max())
    return max(by_rate, math.sqrt(by_load), braking, SHORTEST)
