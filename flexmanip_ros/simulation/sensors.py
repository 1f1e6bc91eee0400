"""Sensors of the simulated arm: what they measure, their dynamics and noise."""

from functools import lru_cache

import numpy as np
from scipy.special import ndtri

from flexmanip_ros.numerics.compiled import kernel
from flexmanip_ros.parameters import PlantParameters
from flexmanip_ros.types import Array

BLOCK = 512
"""Number of samples whose random numbers are drawn at once."""
COLUMNS = 10


@lru_cache(maxsize=2)
def block(seed: int, number: int) -> Array:
    """Standard normal numbers (BLOCK, 10) from sample BLOCK * number on: positions, rates, stamp, loss; read only."""
    bits = np.random.Philox(key=seed, counter=[0, 0, 0, number])
    return np.random.Generator(bits).standard_normal((BLOCK, COLUMNS))


def normal(seed: int, count: int) -> Array:
    """Standard normal numbers (count, 10) of samples 0 .. count - 1."""
    return np.concatenate([block(seed, number) for number in range(count // BLOCK + 1)])[:count]


def std_for_snr(position: Array, velocity: Array, snr_db: float) -> Array:
    """Standard deviations (4 L,) for a signal-to-noise ratio [dB] of every output.

    The signal is the deviation from its mean over the run: for a joint angle the motion counts, not the
    posture. position, velocity: (N, 2 L) noise-free.
    """
    signal = np.concatenate([position.std(axis=0), velocity.std(axis=0)])
    level: Array = signal * 10.0 ** (-snr_db / 20.0)
    return level


@kernel
def low_pass(values: Array, state: Array, share: float) -> None:
    """Filter values (N, L) in place by a first-order lag: state (L,) moves by share of the difference."""
    for k in range(values.shape[0]):
        for c in range(values.shape[1]):
            state[c] += share * (values[k, c] - state[c])
            values[k, c] = state[c]


def gauge(config: PlantParameters, position: Array, velocity: Array, state: Array) -> None:
    """Apply the low-pass of strain gauges to deflections and their rates, in place, and update state (2, L)."""
    cutoff = config.sensors.strain_cutoff
    if cutoff:
        share = 1.0 - np.exp(-2.0 * np.pi * cutoff / config.rate)
        for row, values in enumerate((position, velocity)):
            links = values.shape[1] // 2
            bends = np.ascontiguousarray(values[:, links:])
            low_pass(bends, state[row], share)
            values[:, links:] = bends


def bends_needed(config: PlantParameters) -> int:
    """Return how many past samples delayed bends are interpolated from; 0 where they are not delayed."""
    return int(config.arm.bend_delay * config.rate) + 1 if config.arm.bend_delay else 0


def late_bends(config: PlantParameters, position: Array, velocity: Array, past: Array) -> Array:
    """Delay the bends by ``arm.bend_delay``, in place, with cubic Hermite interpolation between samples.

    past: (K, 2 L) deflections and rates of the last samples; returns those for the next call.
    """
    if not len(past):
        return past
    links, count = position.shape[1] // 2, len(position)
    whole = np.vstack([past, np.hstack([position[:, links:], velocity[:, links:]])])
    old, new = whole[:count], whole[1:count + 1]
    a, b, va, vb = old[:, :links], new[:, :links], old[:, links:] / config.rate, new[:, links:] / config.rate
    t = len(past) - config.arm.bend_delay * config.rate
    position[:, links:] = (a * (2 * t - 3) * t * t + a + va * ((t - 2) * t + 1) * t
                           + b * (3 - 2 * t) * t * t + vb * (t - 1) * t * t)
    velocity[:, links:] = config.rate * (6 * t * (t - 1) * (a - b) + va * ((3 * t - 4) * t + 1) + vb * (3 * t - 2) * t)
    return whole[count:]


def misread(config: PlantParameters, position: Array, velocity: Array) -> None:
    """Apply gain and offset of the bend sensors, in place."""
    if not any(config.arm.bend_offset) and all(gain == 1.0 for gain in config.arm.bend_gain):
        return  # arithmetic that changes nothing, here and below, costs a live plant 65 us a sample
    links = position.shape[1] // 2
    gain = np.array(config.arm.bend_gain)
    position[:, links:] = gain * position[:, links:] + np.array(config.arm.bend_offset)
    velocity[:, links:] *= gain


def read(config: PlantParameters, position: Array, velocity: Array, std: Array, drawn: Array) -> None:
    """Add bias and noise, then round, in place; std (4 L,), drawn (N, 10) standard normal numbers."""
    bias = np.array(config.sensors.bias)
    m = position.shape[1]
    position += bias[:m] + std[:m] * drawn[:, :m]
    velocity += bias[m:] + std[m:] * drawn[:, 4:4 + m]
    for columns, step in ((slice(0, m // 2), config.sensors.encoder_resolution),
                          (slice(m // 2, m), config.sensors.bend_resolution)):
        if step:
            position[:, columns] = step * np.round(position[:, columns] / step)


def jitter_ns(config: PlantParameters, drawn: Array) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Errors (N,) of the stamps [ns]."""
    if not config.sensors.stamp_jitter:
        return np.zeros(len(drawn), dtype=np.int64)
    limited = np.minimum(np.maximum(drawn[:, 8], -3.0), 3.0)
    return np.round(limited * config.sensors.stamp_jitter * 1e9).astype(np.int64)


def arrives(config: PlantParameters, drawn: Array) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which samples (N,) are not lost on the way."""
    if not config.sensors.drop_probability:
        return np.ones(len(drawn), dtype=np.bool_)
    threshold = ndtri(config.sensors.drop_probability)
    return np.asarray(drawn[:, 9] >= threshold)


def saturated(config: PlantParameters, efforts: Array) -> Array:
    """Return efforts (N, L) [N m] clipped to the torque limits."""
    if not any(config.actuators.torque_limit):
        return efforts
    limits = np.array(config.actuators.torque_limit)
    limits[limits == 0.0] = np.inf
    return np.asarray(np.minimum(np.maximum(efforts, -limits), limits))
