"""The paper's second rival: the algebraic method (Fliess; Becedas; Cambera) on link 2 alone, base at rest.

With the known link subtracted, torque - J a'' - moment g L cos a = dm (L^2 a'' + g L cos a) + nu a';
multiplied by t^2 (t from the capture on) and integrated twice, nothing is differentiated. Solved for
(dm, nu) by least squares. On a two-link arm the moving base is left out, as in the paper: that is its bias.
Same calls as ``structured``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import rival
from flexmanip_ros.payload.rival import RivalState
from flexmanip_ros.payload.rival_kernel import algebraic
from flexmanip_ros.types import CaptureEvent, EventKind, Payload, Sample, Status

STILL = 1e-6
"""Motion [rad] below which a link tells nothing."""


def init(config: IdentifierParameters) -> RivalState:
    """Start with an empty arm."""
    return RivalState(np.zeros(11), np.zeros(7))


def step(config: IdentifierParameters, state: RivalState, sample: Sample) -> RivalState:
    """Take one sample."""
    return advance(config, state, (sample,))


def advance(config: IdentifierParameters, state: RivalState, samples: Sequence[Sample]) -> RivalState:
    """Take samples in the order of their stamps."""
    if not samples or not rival.usable(config):
        return state
    efforts, angles, dt = rival.series(config, state, samples)
    x, normal = state.x.copy(), state.sums.copy()
    if samples[0].gap:
        x, normal = np.zeros(11), np.zeros(7)
    arm = config.arm
    L, rho = arm.link_length[1], arm.linear_density[1]
    algebraic(rho * L ** 3 / 3 + arm.tip_mass * L ** 2, rho * L / 2 + arm.tip_mass, L, config.payload.gravity,
              x, normal, dt, np.ascontiguousarray(angles[:, 1]), np.ascontiguousarray(efforts[:, 1]))
    return replace(state, x=x, sums=normal, dt=dt, last_ns=samples[-1].stamp_ns, effort=samples[-1].u)


def event(config: IdentifierParameters, state: RivalState, event: CaptureEvent) -> RivalState:
    """Time begins anew."""
    return replace(state, x=np.zeros(11), sums=np.zeros(7), held=event.kind is EventKind.CAPTURE)


def estimate(config: IdentifierParameters, state: RivalState) -> Payload:
    """Return the payload; the twice integrated residuals count as one a tenth of the record."""
    if not rival.usable(config):
        return rival.unknown(Status.UNOBSERVABLE)
    if not state.held:
        return rival.nothing_held()
    if state.sums[6] < rival.FEWEST:
        return rival.unknown(Status.WARMING_UP)
    A = np.array([[state.sums[0], state.sums[1]], [state.sums[1], state.sums[2]]])
    b, square = state.sums[3:5], float(state.sums[5])
    scale = np.sqrt(np.diag(A))
    still = STILL * config.arm.link_length[1] ** 2 * state.x[0] ** 2 * np.sqrt(state.sums[6])
    if scale[0] <= still or scale[1] == 0.0 or np.linalg.cond(A / np.outer(scale, scale)) > 1e12:
        return rival.unknown(Status.POORLY_EXCITED)
    solved = np.linalg.solve(A / np.outer(scale, scale), np.column_stack([b / scale, [1.0 / scale[0], 0.0]]))
    mass = float(solved[0, 0] / scale[0])
    residual = max(square - float(b @ (solved[:, 0] / scale)), 0.0)
    spread = float(solved[0, 1] / scale[0])
    return rival.interval(mass, float(np.sqrt(residual / 10.0 * spread)), residual / max(square, 1e-300))
