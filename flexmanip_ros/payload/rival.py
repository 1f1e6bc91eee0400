"""What the two rival estimators share: samples in, a fit since the last event out, one rule of interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload.angles import chords
from flexmanip_ros.types import Array, Payload, Sample, Status

QUANTILE = 1.959963984540054
"""Of the normal distribution, for 95 %."""
FEWEST = 200
"""Samples since the event before anything is claimed."""


@dataclass(frozen=True, eq=False)
class RivalState:
    """Everything remembered; constant in size."""

    x: Array
    """States of filters or integrals."""
    sums: Array
    """Sums of the least squares."""
    held: bool = False
    dt: float = 0.0
    last_ns: int | None = None
    effort: Array | None = None
    """(2,) torque held since the last sample."""


def series(
    config: IdentifierParameters, state: RivalState, samples: Sequence[Sample],
) -> tuple[Array, Array, float]:
    """Return efforts held before each sample (N, 2), chord angles (N, 2), and the sample time [s]."""
    first = samples[0].u if state.effort is None else state.effort
    efforts = np.array([first, *(sample.u for sample in samples[:-1])])
    angles = np.array([chords(config.arm, sample.angles) for sample in samples])
    dt = state.dt
    if dt == 0.0:
        stamps = [stamp for stamp in (state.last_ns,) if stamp is not None]
        stamps += [sample.stamp_ns for sample in samples]
        dt = float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else 0.0
    return efforts, angles, dt


def usable(config: IdentifierParameters) -> bool:
    """Whether both torques and both angles are configured."""
    return len(config.inputs) == 2 and len(config.angles) == 2


def unknown(status: Status) -> Payload:
    """Return the payload of which nothing is known."""
    return Payload(0.0, math.inf, 0.0, math.inf, 1.0, status)


def nothing_held() -> Payload:
    """Return the payload of an arm that is empty because nothing was caught; these methods do not test it."""
    return Payload(0.0, 0.0, 0.0, 0.0, 1.0, Status.TRACKING)


def interval(mass: float, std: float, misfit: float) -> Payload:
    """Return mass and interval; misfit: share of the regression's power that is left, 0 where it fits.

    Neither method knows its noise: the deviation is that of the residuals, and a fit that leaves most of the
    power is called inconsistent.
    """
    if not (math.isfinite(mass) and math.isfinite(std)):
        return unknown(Status.POORLY_EXCITED)
    status = Status.TRACKING
    if std > max(abs(mass), 1e-9):
        status = Status.POORLY_EXCITED
    elif misfit > 0.1 or mass < 0.0:
        status = Status.INCONSISTENT
    # a negative mass says how wrong the method is here: the interval reaches as far to the other side
    lower, upper = max(0.0, mass - QUANTILE * std), abs(mass) + QUANTILE * std
    return Payload(max(mass, 0.0), std, lower, upper, 1.0 + float(misfit), status)
