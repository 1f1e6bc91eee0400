"""How accurate a payload estimate from a given run can be at best: the bound beside every estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flexmanip_ros.errors import ModelError
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import cramer_rao
from flexmanip_ros.payload.angles import chords
from flexmanip_ros.samples.sample_log import Signals
from flexmanip_ros.types import Array

ORDER = 4
"""Differences of this order leave the noise and take away what swings slowly against the sample time."""
GAIN = float(np.sqrt(70.0))
"""Root of the sum of squared binomials 1 4 6 4 1: what ORDER differences make of white noise."""
NORMAL_MEDIAN = 0.6744897501960817
"""Median of |x| of a standard normal x."""
RATE_WINDOW = 50
"""Samples over which the chords' rates at the capture are taken."""
LONGEST = 20_000
"""Samples after the capture that are looked at; more make the bound smaller still."""


def noise_std(columns: Array) -> Array:
    """Return the standard deviation of white noise on smooth signals (N, k): (k,).

    The median of high differences, which jumps and vibrations do not move.
    """
    if columns.shape[0] <= ORDER:
        return np.zeros(columns.shape[1])
    differences = np.abs(np.diff(columns, ORDER, axis=0))
    return np.asarray(np.median(differences, axis=0) / (NORMAL_MEDIAN * GAIN), dtype=np.float64)


def payload_std(config: IdentifierParameters, signals: Signals, capture_time: float, mass: float,
                dt: float) -> float | None:
    """Return the Cramer-Rao bound [kg] at the end of a run: moving arm, from the samples after the capture.

    An estimator that learned stiffness and damping from the empty arm before can do a little better.
    mass: the payload, or its estimate [kg]; the noise is measured on the signals. None where the run or its
    signals have no such bound (no angles, no sample after the capture, no noise).
    """
    if signals.angles.shape[1] != 2 or not mass > 0.0 or dt <= 0.0:
        return None
    first = int(np.searchsorted(signals.time, capture_time - 0.5 * dt))
    count = min(signals.stamp_ns.size - first, LONGEST)
    if count < RATE_WINDOW:
        return None
    config = replace(config, outputs=signals.outputs)
    extra = [k for k, name in enumerate(config.angles) if name not in signals.outputs]
    noise = np.concatenate([noise_std(signals.y[first:]), noise_std(signals.angles[first:][:, extra])])
    if not (noise > 0.0).all():
        return None
    theta = chords(config.arm, signals.angles[first])
    later = chords(config.arm, signals.angles[first + RATE_WINDOW - 1])
    rates = (later - theta) / ((RATE_WINDOW - 1) * dt)
    try:
        found = float(cramer_rao.nonlinear(
            config, theta, mass, signals.u[first:], noise, dt, (count,), rates)[0])
    except ModelError:
        return None
    return found if np.isfinite(found) else None
