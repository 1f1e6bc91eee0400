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
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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


def _rigid_sums(config: IdentifierParameters, dt: float, efforts: Array, angles: Array, begins: NDArray[np.bool_]
                ) -> Array:
    """Return the sums (N, 5) after each sample: information, score, residual power, equations, samples."""
    x, sums = np.zeros((4, 5)), np.empty((len(angles), 5))
    x[:2] = angles[0][:, None] * (1.0, 0.0, 1.0, 0.0, 0.0)
    _rigid_kernel(_arm(config, dt), x, sums, dt, efforts, angles, begins)
    return sums


def _rigid_estimate(config: IdentifierParameters, sums: Array, dt: float) -> Payload:
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
    point = config.payload.working_point
    is_frozen = config.payload.dynamics == 'linear' and len(point) == 2
    return RigidArm(
        Ma11=rho1 * L1 ** 3 / 3 + (arm.joint_mass + rho2 * L2 + arm.tip_mass) * L1 ** 2,
        Ma22=rho2 * L2 ** 3 / 3 + arm.tip_mass * L2 ** 2, coupling=(rho2 * L2 / 2 + arm.tip_mass) * L1 * L2,
        L1=L1, L2=L2, reaction=1.0 if arm.torque_convention == 'joint' else 0.0, cutoff=_cutoff(config),
        fade=float(np.exp(-dt / MEMORY_S)), frozen_turn=point[1] - point[0] if is_frozen else math.nan)


STILL = 1e-6
"""Motion below which a link gives no information on the payload [rad]."""


def _algebraic_sums(config: IdentifierParameters, dt: float, efforts: Array, angles: Array, begins: NDArray[np.bool_]
                    ) -> Array:
    """Return the sums (N, 8) after each sample: A11, A12, A22, B1, B2, square of q, samples, time."""
    starts = np.flatnonzero(begins).tolist()
    return np.vstack([_algebraic_stretch(config, dt, efforts[a:b, 1], angles[a:b, 1])
                      for a, b in pairwise([0, *(start for start in starts if start), len(angles)])])


def _algebraic_stretch(config: IdentifierParameters, dt: float, torque: Array, a: Array) -> Array:
    """Return the sums (N, 8) of a stretch without an event; torque (N,) held before each sample, a (N,): angles."""
    arm = config.arm
    L, rho, gravity = arm.link_length[1], arm.linear_density[1], -arm.gravity[1]
    inertia, moment = rho * L ** 3 / 3 + arm.tip_mass * L ** 2, rho * L / 2 + arm.tip_mass
    t = np.cumsum(np.append(0.0, np.full(len(a) - 1, dt)))
    h = np.diff(t, prepend=0.0)
    before = np.append(0.0, t[:-1])

    def integral(values: Array) -> Array:
        return np.cumsum(0.5 * h * (np.append(0.0, values[:-1]) + values))

    integral_a, integral_t2_cos = integral(a), integral(t * t * np.cos(a))
    # the torque is held, so its integrals are exact
    cube, cube_before = t * (t * t), before * (before * before)
    once = np.cumsum(torque * (cube - cube_before) / 3.0)
    twice = np.cumsum(h * np.append(0.0, once[:-1])
                      + torque * (((t * t) ** 2 - (before * before) ** 2) / 12.0 - cube_before * h / 3.0))
    weight = integral(integral_t2_cos)
    integral_ta = integral(t * a)
    beta = t * t * a - 4.0 * integral_ta + 2.0 * integral(integral_a)
    eta = integral(t * t * a) - 2.0 * integral(integral_ta)
    q = twice - inertia * beta - moment * gravity * L * weight
    row0 = L * L * beta + gravity * L * weight
    products = (row0 * row0, row0 * eta, eta * eta, row0 * q, eta * q, q * q, np.ones(len(a)))
    return np.column_stack([*(np.cumsum(product) for product in products), t])


def _algebraic_estimate(config: IdentifierParameters, sums: Array, dt: float) -> Payload:
    """Return the payload; each tenth of the record counts as one independent residual."""
    if sums[6] < FEWEST:
        return _unknown(Status.WARMING_UP)
    A = np.array([[sums[0], sums[1]], [sums[1], sums[2]]])
    b, square = sums[3:5], float(sums[5])
    scale = np.sqrt(np.diag(A))
    still = STILL * config.arm.link_length[1] ** 2 * sums[7] ** 2 * np.sqrt(sums[6])
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
def _rigid_kernel(arm: RigidArm, x: Array, sums: Array, dt: float, efforts: Array, chords: Array,
                  begins: NDArray[np.bool_]) -> None:
    """Fill the sums (N, 5) of the scalar least squares; efforts (N, 2) held before each sample, chords (N, 2).

    x: (4, 5) of each filter, two for angles, two for torques, four states and the acceleration over the last sample;
    begins (N,): where the sums begin again.
    """
    w = arm.cutoff
    information = score = residual = equations = samples = 0.0
    for k in range(chords.shape[0]):
        if begins[k]:
            information = score = residual = equations = samples = 0.0
        h = dt if k else 0.0  # no time has passed before the first sample
        decay = np.exp(-w * h)
        for i in range(4):
            target = chords[k, i] if i < 2 else efforts[k, i - 2]
            # twice w^2 / (s + w)^2, critically damped, exact for an input held over the sample
            for stage in (2, 0):
                row = x[i]
                level, slope = row[stage] - target, row[stage + 1]
                drive = slope + w * level
                row[stage] = target + (level + drive * h) * decay
                row[stage + 1] = (slope - w * drive * h) * decay
                # the mean over the sample; the value at its end would show the steps of the held input
                row[4] = (row[stage + 1] - slope) / h if h > 0.0 else 0.0
                target = row[stage]
        samples += 1.0
        if samples * h * w >= 12.0:  # before, the filters still depend on their initial state
            turn, rate0, rate1, acc0, acc1 = x[1, 0] - x[0, 0], x[0, 1], x[1, 1], x[0, 4], x[1, 4]
            c, s = np.cos(turn), np.sin(turn)
            if not np.isnan(arm.frozen_turn):
                c, s = np.cos(arm.frozen_turn), 0.0
            known0 = arm.Ma11 * acc0 + arm.coupling * (c * acc1 - s * rate1 * rate1)
            known1 = arm.Ma22 * acc1 + arm.coupling * (c * acc0 + s * rate0 * rate0)
            cross = arm.L1 * arm.L2
            row0 = arm.L1 * arm.L1 * acc0 + cross * (c * acc1 - s * rate1 * rate1)
            row1 = arm.L2 * arm.L2 * acc1 + cross * (c * acc0 + s * rate0 * rate0)
            left0 = x[2, 0] - arm.reaction * x[3, 0] - known0
            left1 = x[3, 0] - known1
            mass = score / information if information > 0.0 else 0.0
            e0, e1 = left0 - mass * row0, left1 - mass * row1
            information = arm.fade * information + row0 * row0 + row1 * row1
            score = arm.fade * score + row0 * left0 + row1 * left1
            residual = arm.fade * residual + e0 * e0 + e1 * e1
            equations = arm.fade * equations + 2.0
        sums[k] = information, score, residual, equations, samples


BASELINES: Mapping[str, tuple[Callable[..., Array], Callable[..., Payload]]] = {
    'rigid_rls': (_rigid_sums, _rigid_estimate), 'algebraic': (_algebraic_sums, _algebraic_estimate)}
"""The sums after each sample, and the payload that they give."""


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
    (sums_of, fitted), (rows, events) = BASELINES[name], recorded
    count, stamps = len(rows), rows.stamp_ns
    instants = ((stamps - stamps[0]) * config.publish_rate * 1e-9 + 1e-6).astype(np.int64)
    due = sorted({*np.flatnonzero(np.diff(instants, prepend=-1) > 0).tolist(), count - 1})
    begins, held = np.zeros((2, count), dtype=np.bool_)
    for event in events:
        row = rows.log.row_at(event.stamp_ns, rows.first) - rows.first
        begins[row:row + 1] = True
        held[row:] = event.kind is EventKind.CAPTURE
    efforts = np.vstack([rows.u[:1], rows.u[:-1]])  # held before each sample
    angles = np.array([chords(config.arm, measured) for measured in rows.angles])
    dt = float(np.median(np.diff(stamps))) * 1e-9
    sums = sums_of(config, dt, efforts, angles, begins)
    for row in due:
        payload = fitted(config, sums[row], dt) if held[row] else Payload(0.0, 0.0, 0.0, 0.0, 1.0, Status.TRACKING)
        yield Estimate(int(stamps[row]), payload.status, None, (), payload)
