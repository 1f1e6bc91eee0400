"""Compiled recursions of the two methods the paper compares with."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flexmanip_ros.numerics.compiled import kernel
from flexmanip_ros.types import Array


class RigidArm(NamedTuple):
    """Two rigid links: M11 = a + ..., constants of Ma and of the payload's part."""

    Ma11: float
    Ma22: float
    coupling: float
    """Ma12 at cos = 1 [kg m^2]."""
    L1: float
    L2: float
    reaction: float
    """1: torque 2 reacts on link 1; 0: it acts on link 2 alone."""
    cutoff: float
    """Of the differentiating filter [rad/s]."""
    fade: float
    """Forgetting factor a sample."""
    frozen_turn: float
    """Angle between the links at which a linear plant stays [rad]; nan: measured, with centripetal terms."""


@kernel
def rigid(arm: RigidArm, x: Array, sums: Array, dt: float, efforts: Array, chords: Array) -> None:
    """Take samples into the scalar least squares; efforts (N, 2) held before each sample, chords (N, 2).

    x: (4, 4) states of the filters, two for angles, two for torques; sums: (5,) information,
    score, residual power, samples, samples since the start of the filters.
    """
    w = arm.cutoff
    for k in range(chords.shape[0]):
        rate0 = rate1 = acc0 = acc1 = torque0 = torque1 = 0.0
        for i in range(2):
            for part in range(2):
                target = chords[k, i] if part == 0 else efforts[k, i]
                # twice w^2 / (s + w)^2, critically damped, exact for an input held over the sample
                acceleration = 0.0
                for stage in (2, 0):
                    row = x[i + 2 * part]
                    level, slope = row[stage] - target, row[stage + 1]
                    decay = np.exp(-w * dt)
                    drive = slope + w * level
                    row[stage] = target + (level + drive * dt) * decay
                    row[stage + 1] = (slope - w * drive * dt) * decay
                    # the mean over the sample: its end would show the staircase of the held input
                    acceleration = (row[stage + 1] - slope) / dt if dt > 0.0 else 0.0
                    target = row[stage]
                if part == 1:
                    if i == 0:
                        torque0 = x[2, 0]
                    else:
                        torque1 = x[3, 0]
                elif i == 0:
                    rate0, acc0 = x[0, 1], acceleration
                else:
                    rate1, acc1 = x[1, 1], acceleration
        sums[4] += 1.0
        if sums[4] * dt * w < 12.0:
            continue  # the filters still carry their start
        turn = x[1, 0] - x[0, 0]
        c, s = np.cos(turn), np.sin(turn)
        if not np.isnan(arm.frozen_turn):
            c, s = np.cos(arm.frozen_turn), 0.0
        known0 = arm.Ma11 * acc0 + arm.coupling * (c * acc1 - s * rate1 * rate1)
        known1 = arm.Ma22 * acc1 + arm.coupling * (c * acc0 + s * rate0 * rate0)
        cross = arm.L1 * arm.L2
        row0 = arm.L1 * arm.L1 * acc0 + cross * (c * acc1 - s * rate1 * rate1)
        row1 = arm.L2 * arm.L2 * acc1 + cross * (c * acc0 + s * rate0 * rate0)
        left0 = torque0 - arm.reaction * torque1 - known0
        left1 = torque1 - known1
        mass = sums[1] / sums[0] if sums[0] > 0.0 else 0.0
        e0, e1 = left0 - mass * row0, left1 - mass * row1
        sums[0] = arm.fade * sums[0] + row0 * row0 + row1 * row1
        sums[1] = arm.fade * sums[1] + row0 * left0 + row1 * left1
        sums[2] = arm.fade * sums[2] + e0 * e0 + e1 * e1
        sums[3] = arm.fade * sums[3] + 2.0


@kernel
def algebraic(
    inertia: float, moment: float, L: float, gravity: float, x: Array, normal: Array, dt: float,
    angles: Array, torques: Array,
) -> None:
    """Take samples of one link into the algebraic estimator's normal equations.

    inertia: rho L^3 / 3 + m_o L^2; moment: rho L / 2 + m_o; angles: (N,); torques: (N,) held before each.
    x: (11,) time, last angle, then int(t a), its integral, int(t^2 a), int(a), its integral, int(t^2 cos a),
    its integral, int(t^2 torque), its integral; normal: (7,) A11, A12, A22, B1, B2, square of q, samples.
    """
    for k in range(angles.shape[0]):
        t0, t1, a0, a1 = x[0], x[0] + dt, x[1], angles[k]
        if normal[6] == 0.0:
            t1 = t0
        h = t1 - t0
        # trapezoids; the torque is held, so its integrals are exact
        moments0 = (t0 * a0, t0 * t0 * a0, a0, t0 * t0 * np.cos(a0))
        moments1 = (t1 * a1, t1 * t1 * a1, a1, t1 * t1 * np.cos(a1))
        ta, taa, tc = x[2], x[5], x[7]
        x[2] += 0.5 * h * (moments0[0] + moments1[0])
        x[4] += 0.5 * h * (moments0[1] + moments1[1])
        x[5] += 0.5 * h * (moments0[2] + moments1[2])
        x[7] += 0.5 * h * (moments0[3] + moments1[3])
        x[3] += 0.5 * h * (ta + x[2])
        x[6] += 0.5 * h * (taa + x[5])
        x[8] += 0.5 * h * (tc + x[7])
        x[10] += h * x[9] + torques[k] * ((t1 ** 4 - t0 ** 4) / 12.0 - t0 ** 3 * h / 3.0)
        x[9] += torques[k] * (t1 ** 3 - t0 ** 3) / 3.0
        x[0], x[1] = t1, a1
        normal[6] += 1.0
        beta = t1 * t1 * a1 - 4.0 * x[2] + 2.0 * x[6]
        eta = x[4] - 2.0 * x[3]
        q = x[10] - inertia * beta - moment * gravity * L * x[8]
        row0, row1 = L * L * beta + gravity * L * x[8], eta
        normal[0] += row0 * row0
        normal[1] += row0 * row1
        normal[2] += row1 * row1
        normal[3] += row0 * q
        normal[4] += row1 * q
        normal[5] += q * q
