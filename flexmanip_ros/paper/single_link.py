"""The run that the paper uses for the algebraic method: link 2 alone on a fixed base, under gravity.

The link is rigid here. Its torque is the sum of a constant part that balances the known link, a proportional and a
derivative part that keep it near its working point, and the square wave of joint 2. This torque is measured. It does
not know the payload, so the link sags at the capture.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from flexmanip_ros.paper.experiments import GRAVITY
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters
from flexmanip_ros.simulation import excitation
from flexmanip_ros.types import Array, CaptureEvent, EventKind, JointRecord

RATE = 1000.0
STIFFNESS, DAMPING = 20000.0, 4000.0
"""Proportional and derivative gain of the joint [N m/rad, N m s/rad]."""
JOINT_NAMES = ('joint1', 'joint2')


def messages(arm: ArmParameters, angle: float, payload: float, seed: int, *, duration: float,
             capture_time: float, snr_db: float) -> list[JointRecord | CaptureEvent]:
    """Return joint states of link 2 (joint 1 at rest at 0) with chord angle ``angle`` [rad] at the start."""
    torques, clean = motion(arm, angle, payload, duration, capture_time)
    noise = float(np.std(clean)) * 10.0 ** (-snr_db / 20.0)
    angles = clean + noise * np.random.default_rng(seed).normal(size=clean.size)
    empty = np.empty(0)
    items: list[JointRecord | CaptureEvent] = [
        JointRecord(round(k * 1e9 / RATE), JOINT_NAMES, np.array([0.0, angles[k]]), empty,
                    np.array([0.0, torques[k]])) for k in range(clean.size)]
    capture = round(capture_time * RATE)
    items.insert(capture, CaptureEvent(round(capture * 1e9 / RATE), EventKind.CAPTURE))
    return items


@cache
def motion(arm: ArmParameters, angle: float, payload: float, duration: float, capture_time: float
           ) -> tuple[Array, Array]:
    """Return the torque of the joint [N m] and its angle [rad], (N,) each; they are the same for all seeds."""
    count, capture = round(duration * RATE), round(capture_time * RATE)
    L, rho = arm.link_length[1], arm.linear_density[1]
    wave = excitation.sequence(ExcitationParameters(rate=RATE), count)[:, 1]
    torques, angles = np.empty(count), np.empty(count)
    x = np.array([angle, 0.0])
    for k in range(count):
        mass = payload if k >= capture else 0.0
        if k == capture:  # the object is at rest: momentum is shared
            x[1] *= inertia(arm, 0.0) / inertia(arm, mass)
        known = (rho * L / 2 + arm.tip_mass) * GRAVITY * L
        weight = known + mass * GRAVITY * L
        hold = -STIFFNESS * (x[0] - angle) - DAMPING * x[1]
        torques[k], angles[k] = wave[k] + known * math.cos(angle) + hold, x[0]
        x = _integrated(x, torques[k], weight, inertia(arm, mass))
    return torques, angles


def inertia(arm: ArmParameters, payload: float) -> float:
    """Return the link's inertia about its joint with the object at its end [kg m^2]."""
    L = arm.link_length[1]
    return arm.linear_density[1] * L**3 / 3 + (arm.tip_mass + payload) * L**2


def _integrated(x: Array, torque: float, weight: float, moment: float) -> Array:
    """One period of J theta'' + weight cos(theta) = torque by the classical Runge-Kutta method."""
    def slope(at: Array) -> Array:
        return np.array([at[1], (torque - weight * math.cos(at[0])) / moment])

    h = 1.0 / RATE
    a = slope(x)
    b = slope(x + h / 2 * a)
    c = slope(x + h / 2 * b)
    d = slope(x + h * c)
    return np.asarray(x + h / 6 * (a + 2 * b + 2 * c + d), dtype=np.float64)
