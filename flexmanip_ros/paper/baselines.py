"""The two estimators that the paper compares with: rigid least squares, and the algebraic method.

Rigid least squares (paper eqs. 45-46) takes both links as rigid and differentiates the angles by a filter. It neglects
bending, which biases it. The algebraic method (Fliess; Becedas; Cambera) models link 2 alone, with its base at rest.
With the known link subtracted, torque - J a'' - moment g L cos a = dm (L^2 a'' + g L cos a) + nu a'. The equation is
multiplied by t^2, with t from the capture on, and integrated twice, so that nothing is differentiated. Least squares
give (dm, nu). On a two-link arm the method neglects the moving base, as the paper does, which biases it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from flexmanip_ros.arm.manipulator import chords, pinned_frequencies
from flexmanip_ros.numerics.compiled import kernel
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples import sampling
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import QUANTILE, Array, CaptureEvent, Estimate, EventKind, JointRecord, Payload, Status

FEWEST = 200
"""Smallest number of samples since the event with which a payload is estimated."""


def _unknown(status: Status) -> Payload:
    """Return the payload of which nothing is known."""
    return Payload(0.0, math.inf, 0.0, math.inf, 1.0, status)


def _interval(mass: float, std: float, misfit: float) -> Payload:
    """Return mass and interval; misfit: residual power over the regression's power, 0 for a perfect fit.

    Neither method knows its noise: the deviation is that of the residuals. A fit that leaves more than a tenth of the
    power, or a negative mass, is called inconsistent.
    """
    if not (math.isfinite(mass) and math.isfinite(std)):
        return _unknown(Status.POORLY_EXCITED)
    status = Status.TRACKING
    if std > max(abs(mass), 1e-9):
        status = Status.POORLY_EXCITED
    elif misfit > 0.1 or mass < 0.0:
        status = Status.INCONSISTENT
    # a negative mass shows the size of the error: the interval reaches as far to the positive side
    lower, upper = max(0.0, mass - QUANTILE * std), abs(mass) + QUANTILE * std
    return Payload(max(mass, 0.0), std, lower, upper, 1.0 + float(misfit), status)


CUTOFF = 0.2
"""Cutoff of the differentiating filters over the lowest pinned frequency [-]; low, to remove the vibration."""
MEMORY_S = 10.0
"""Time after which the weight of a sample is 1/e [s]."""


def _rigid_take(config: IdentifierParameters, x: Array, sums: Array, dt: float, efforts: Array, angles: Array,
                restarted: bool) -> None:
    if restarted:
        x[:2], sums[4] = angles[0][:, None] * (1.0, 0.0, 1.0, 0.0), 0.0
    _rigid_kernel(_arm(config, dt), x, sums, dt, efforts, angles)


def _rigid_estimate(config: IdentifierParameters, x: Array, sums: Array, dt: float) -> Payload:
    """Return the payload; the interval takes the residuals as correlated over the filter's memory."""
    information, score, residual, count, _ = sums
    if count < 2 * FEWEST or information <= 0.0:
        return _unknown(Status.WARMING_UP)
    correlated = max(1.0, 4.0 / (_cutoff(config) * dt))
    variance = residual / count * correlated / information
    total = residual + score ** 2 / information
    return _interval(score / information, float(np.sqrt(variance)), residual / max(total, 1e-300))


def _cutoff(config: IdentifierParameters) -> float:
    """Return the cutoff of the filters [rad/s]."""
    return CUTOFF * 2 * np.pi * min(pinned_frequencies(config.arm))


def _arm(config: IdentifierParameters, dt: float) -> RigidArm:
    arm = config.arm
    (L1, L2), (rho1, rho2) = arm.link_length, arm.linear_density
    return RigidArm(
        Ma11=rho1 * L1 ** 3 / 3 + (arm.joint_mass + rho2 * L2 + arm.tip_mass) * L1 ** 2,
        Ma22=rho2 * L2 ** 3 / 3 + arm.tip_mass * L2 ** 2, coupling=(rho2 * L2 / 2 + arm.tip_mass) * L1 * L2,
        L1=L1, L2=L2, reaction=1.0 if arm.torque_convention == 'joint' else 0.0, cutoff=_cutoff(config),
        fade=float(np.exp(-dt / MEMORY_S)), frozen_turn=_frozen_turn(config))


def _frozen_turn(config: IdentifierParameters) -> float:
    """Return the angle between the links at the working point of a linear plant [rad]; nan where none is given."""
    point = config.payload.working_point
    frozen = config.payload.dynamics == 'linear' and len(point) == 2
    return point[1] - point[0] if frozen else float('nan')


STILL = 1e-6
"""Motion below which a link gives no information on the payload [rad]."""


def _algebraic_take(config: IdentifierParameters, x: Array, sums: Array, dt: float, efforts: Array, angles: Array,
                    restarted: bool) -> None:
    if restarted:
        x[:], sums[:] = 0.0, 0.0
    arm = config.arm
    L, rho = arm.link_length[1], arm.linear_density[1]
    _algebraic_kernel(rho * L ** 3 / 3 + arm.tip_mass * L ** 2, rho * L / 2 + arm.tip_mass, L, -arm.gravity[1], x,
                      sums, dt, np.ascontiguousarray(angles[:, 1]), np.ascontiguousarray(efforts[:, 1]))


def _algebraic_estimate(config: IdentifierParameters, x: Array, sums: Array, dt: float) -> Payload:
    """Return the payload; each tenth of the record counts as one independent residual."""
    if sums[6] < FEWEST:
        return _unknown(Status.WARMING_UP)
    A = np.array([[sums[0], sums[1]], [sums[1], sums[2]]])
    b, square = sums[3:5], float(sums[5])
    scale = np.sqrt(np.diag(A))
    still = STILL * config.arm.link_length[1] ** 2 * x[0] ** 2 * np.sqrt(sums[6])
    if scale[0] <= still or scale[1] == 0.0 or np.linalg.cond(A / np.outer(scale, scale)) > 1e12:
        return _unknown(Status.POORLY_EXCITED)
    solved = np.linalg.solve(A / np.outer(scale, scale), np.column_stack([b / scale, [1.0 / scale[0], 0.0]]))
    mass = float(solved[0, 0] / scale[0])
    residual = max(square - float(b @ (solved[:, 0] / scale)), 0.0)
    spread = float(solved[0, 1] / scale[0])
    return _interval(mass, float(np.sqrt(residual / 10.0 * spread)), residual / max(square, 1e-300))


class RigidArm(NamedTuple):
    """Two rigid links: constants of the mass matrix Ma and of the payload's part in it, and the filter settings."""

    Ma11: float
    Ma22: float
    coupling: float
    """Ma12 at cos = 1 [kg m^2]."""
    L1: float
    L2: float
    reaction: float
    """1: torque 2 reacts on link 1; 0: it acts on link 2 alone."""
    cutoff: float
    """Cutoff of the differentiating filters [rad/s]."""
    fade: float
    """Forgetting factor per sample [-]."""
    frozen_turn: float
    """Angle between the links at which a linear plant stays [rad]; nan: measured, with centripetal terms."""


@kernel
def _rigid_kernel(arm: RigidArm, x: Array, sums: Array, dt: float, efforts: Array, chords: Array) -> None:
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
                    # the mean over the sample; the value at its end would show the steps of the held input
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
            continue  # the filters still depend on their initial state
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
def _algebraic_kernel(
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


class Baseline(NamedTuple):
    """One of the two methods."""

    x: tuple[int, ...]
    """Shape of the states of filters or integrals."""
    sums: int
    """Number of sums of the least squares."""
    keeps_filters: bool
    """Whether an event restarts the sums alone, not the states of filters or integrals."""
    take: Callable[[IdentifierParameters, Array, Array, float, Array, Array, bool], None]
    """Take samples into states and sums: efforts (N, 2), chord angles (N, 2), whether a gap comes before them."""
    fitted: Callable[[IdentifierParameters, Array, Array, float], Payload]
    """Return the payload of states and sums."""


BASELINES: Mapping[str, Baseline] = {
    'rigid_rls': Baseline((4, 4), 5, True, _rigid_take, _rigid_estimate),
    'algebraic': Baseline((11,), 7, False, _algebraic_take, _algebraic_estimate)}


class Recorded(NamedTuple):
    """The rows of a recording with both torques and both angles, and its events by stamp."""

    rows: Rows
    events: tuple[CaptureEvent, ...]


def recorded(config: IdentifierParameters, items: Iterable[JointRecord | CaptureEvent]) -> Recorded:
    """Return the samples and events of messages."""
    clock, log = sampling.Clock(), sampling.EMPTY
    events: list[CaptureEvent] = []
    for item in items:
        if isinstance(item, CaptureEvent):
            events.append(item)
        else:
            clock, log, _ = sampling.push(config, clock, log, item)
    events.sort(key=lambda event: event.stamp_ns)
    return Recorded(log.rows(log.start, log.end), tuple(events))


def run(name: str, config: IdentifierParameters, recorded: Recorded) -> Iterator[Estimate]:
    """Yield estimates with a payload and no model: at each publishing instant and at the last sample.

    The least squares begin again at an event. Without a captured object the payload is exactly 0, as these methods do
    not test for one.
    """
    method, (rows, given) = BASELINES[name], recorded
    stamps = rows.stamp_ns
    instants = ((stamps - stamps[0]) * config.publish_rate * 1e-9 + 1e-6).astype(np.int64)
    due = {*(np.flatnonzero(np.diff(instants, prepend=-1) > 0) + 1).tolist(), len(rows)}
    events = [(rows.log.row_at(event.stamp_ns, rows.first) - rows.first, event) for event in given]
    efforts = np.vstack([rows.u[:1], rows.u[:-1]])  # held before each sample
    angles = np.array([chords(config.arm, measured) for measured in rows.angles])
    dt = float(np.median(np.diff(stamps))) * 1e-9
    x, sums, held, cursor = np.zeros(method.x), np.zeros(method.sums), False, 0
    for until in sorted(due | {row for row, _ in events if row > 0}):
        while events and events[0][0] == cursor:
            held = events.pop(0)[1].kind is EventKind.CAPTURE
            sums[:] = 0.0
            if not method.keeps_filters:
                x[:] = 0.0
        # no time has passed before the first sample, which is a piece of its own
        method.take(config, x, sums, dt if cursor else 0.0, efforts[cursor:until], angles[cursor:until],
                    cursor == 0 or bool(rows.gap[cursor]))
        cursor = until
        if until in due:
            payload = method.fitted(config, x, sums, dt) if held else Payload(0.0, 0.0, 0.0, 0.0, 1.0, Status.TRACKING)
            yield Estimate(int(stamps[until - 1]), payload.status, None, (), payload)
