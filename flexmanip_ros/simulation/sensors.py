"""Imperfect sensors and drives between the arm and its messages, each off unless a parameter says so.

Everything random comes from ``noise``: it depends on the seed and the sample number alone, so that live
stepping and a simulation at once see the same faults.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from flexmanip_ros.numerics.compiled import kernel
from flexmanip_ros.parameters import PlantParameters
from flexmanip_ros.types import Array


@kernel
def low_pass(values: Array, state: Array, share: float) -> None:
    """Filter values (N, 2) in place by a first-order lag: state (2,) moves by share of the difference."""
    for k in range(values.shape[0]):
        for c in range(2):
            state[c] += share * (values[k, c] - state[c])
            values[k, c] = state[c]


def gauge(config: PlantParameters, position: Array, velocity: Array, state: Array) -> None:
    """Let strain gauges smooth the deflections, in place; state (2, 2) carries on between calls."""
    cutoff = config.sensors.strain_cutoff
    if cutoff:
        share = 1.0 - np.exp(-2.0 * np.pi * cutoff / config.rate)
        for row, values in enumerate((position, velocity)):
            bends = np.ascontiguousarray(values[:, 2:])
            low_pass(bends, state[row], share)
            values[:, 2:] = bends


def read(config: PlantParameters, position: Array, velocity: Array, std: Array, drawn: Array) -> None:
    """Add bias and noise, then round, in place; std (8,), drawn (N, 10) standard normal numbers."""
    bias = np.array(config.sensors.bias)
    position += bias[:4] + std[:4] * drawn[:, :4]
    velocity += bias[4:] + std[4:] * drawn[:, 4:8]
    for columns, step in ((slice(0, 2), config.sensors.encoder_resolution),
                          (slice(2, 4), config.sensors.bend_resolution)):
        if step:
            position[:, columns] = step * np.round(position[:, columns] / step)


def jitter_ns(config: PlantParameters, drawn: Array) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Errors (N,) of the stamps [ns]."""
    limited = np.minimum(np.maximum(drawn[:, 8], -3.0), 3.0)
    return np.round(limited * config.sensors.stamp_jitter * 1e9).astype(np.int64)


def arrives(config: PlantParameters, drawn: Array) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which samples (N,) are not lost on the way."""
    threshold = ndtri(config.sensors.drop_probability)
    return np.asarray(drawn[:, 9] >= threshold)


def saturated(config: PlantParameters, efforts: Array) -> Array:
    """Efforts (N, 2) [N m] within the torque limits."""
    limits = np.array(config.actuators.torque_limit)
    limits[limits == 0.0] = np.inf
    return np.asarray(np.minimum(np.maximum(efforts, -limits), limits))
