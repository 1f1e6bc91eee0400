"""The paper's first rival: recursive least squares on two rigid links, angles differentiated by a filter.

It knows nothing of bending, hence its bias; of a linear plant it is told the working point. Same calls as
``structured``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import rival
from flexmanip_ros.payload.rival import RivalState
from flexmanip_ros.payload.rival_kernel import RigidArm, rigid
from flexmanip_ros.payload.structured_model import pinned_frequencies
from flexmanip_ros.types import CaptureEvent, EventKind, Payload, Sample, Status

CUTOFF = 0.2
"""Of the differentiating filters, over the lowest pinned frequency: it must not see the vibration."""
MEMORY = 10.0
"""Seconds after which a sample counts 1/e."""


def init(config: IdentifierParameters) -> RivalState:
    """Start with an empty arm."""
    return RivalState(np.zeros((4, 4)), np.zeros(5))


def step(config: IdentifierParameters, state: RivalState, sample: Sample) -> RivalState:
    """Take one sample."""
    return advance(config, state, (sample,))


def advance(config: IdentifierParameters, state: RivalState, samples: Sequence[Sample]) -> RivalState:
    """Take samples in the order of their stamps."""
    if not samples or not rival.usable(config):
        return state
    efforts, angles, dt = rival.series(config, state, samples)
    x, sums = state.x.copy(), state.sums.copy()
    if state.last_ns is None or samples[0].gap:
        x[:2], sums[4] = angles[0][:, None] * (1.0, 0.0, 1.0, 0.0), 0.0
    rigid(_arm(config, dt), x, sums, dt, efforts, angles)
    return replace(state, x=x, sums=sums, dt=dt, last_ns=samples[-1].stamp_ns, effort=samples[-1].u)


def event(config: IdentifierParameters, state: RivalState, event: CaptureEvent) -> RivalState:
    """Begin the least squares, and the filters, anew."""
    held = event.kind is EventKind.CAPTURE
    return replace(state, sums=np.zeros(5), held=held)


def estimate(config: IdentifierParameters, state: RivalState) -> Payload:
    """Return the payload; the interval takes the residuals as correlated over the filter's memory."""
    if not rival.usable(config):
        return rival.unknown(Status.UNOBSERVABLE)
    if not state.held:
        return rival.nothing_held()
    information, score, residual, count, _ = state.sums
    if count < 2 * rival.FEWEST or information <= 0.0:
        return rival.unknown(Status.WARMING_UP)
    correlated = max(1.0, 4.0 / (_cutoff(config) * state.dt))
    variance = residual / count * correlated / information
    total = residual + score ** 2 / information
    return rival.interval(score / information, float(np.sqrt(variance)), residual / max(total, 1e-300))


def _cutoff(config: IdentifierParameters) -> float:
    """Of the filters [rad/s]."""
    return CUTOFF * 2 * np.pi * min(pinned_frequencies(config.arm))


def _arm(config: IdentifierParameters, dt: float) -> RigidArm:
    arm = config.arm
    (L1, L2), (rho1, rho2) = arm.link_length, arm.linear_density
    return RigidArm(
        Ma11=rho1 * L1 ** 3 / 3 + (arm.joint_mass + rho2 * L2 + arm.tip_mass) * L1 ** 2,
        Ma22=rho2 * L2 ** 3 / 3 + arm.tip_mass * L2 ** 2, coupling=(rho2 * L2 / 2 + arm.tip_mass) * L1 * L2,
        L1=L1, L2=L2, reaction=1.0 if arm.torque_convention == 'joint' else 0.0, cutoff=_cutoff(config),
        fade=float(np.exp(-dt / MEMORY)), frozen_turn=_frozen_turn(config))


def _frozen_turn(config: IdentifierParameters) -> float:
    """Where a linear plant stays, as far as it is given [rad]."""
    point = config.payload.working_point
    frozen = config.payload.dynamics == 'linear' and len(point) == 2
    return point[1] - point[0] if frozen else float('nan')
