"""The 95 % interval of the payload and its status, from the covariance and the consistency of the innovations."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.numerics.compiled import kernel
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload.filter_state import BATCHES, BLOCKS, DRIFT, EFFECTIVE, FLOOR, POWER, WEIGHT, WHITE
from flexmanip_ros.payload.measurement_update import MeasurementModel
from flexmanip_ros.payload.process_model import PARAMETERS
from flexmanip_ros.payload.residual_modes import residual_probability
from flexmanip_ros.payload.structured_model import Model
from flexmanip_ros.types import Array, Payload, Status

QUANTILE = 1.959963984540054
"""Of the normal distribution, for 95 %."""
UNKNOWN_STD = 0.5
"""A payload whose logarithm is less certain than this is not known."""
VAGUE_STD = 0.2
"""A rotary inertia whose logarithm is less certain than this is not told."""
FEW = 50
"""Samples after an event before anything is claimed."""
POWER_LIMIT = 2.0
"""Innovation power over white noise beyond which the model does not fit."""
WIDENING_LIMIT = 4.0
"""Factor on the standard deviation, the model error apart, beyond which the model does not fit."""
FREE_BIAS = 2.0
"""Standard deviations that an empty arm may seem to hold without a doubt of the model."""
SETTLED = 1000
"""Samples after which a restart is forgotten."""


def judge(config: IdentifierParameters, model: Model | None, sensors: MeasurementModel | None,
          m: mem.FilterState | None,
          restarts: int) -> Payload:
    """Return the payload; never a NaN."""
    if model is None:
        return Payload(0.0, math.inf, 0.0, math.inf, 1.0, Status.UNOBSERVABLE)
    if m is None or sensors is None:
        begun = Status.DIVERGED if restarts else Status.WARMING_UP  # it may fall over at every sample
        return Payload(0.0, math.inf, 0.0, math.inf, 1.0, begun)
    state = m.x.size - PARAMETERS
    scale = model.motion.scale
    held = bool(m.counts[mem.HELD])
    deviation, consistency, drift, reckoned = figures(
        m.S, state, m.noise, sensors.rate, m.score, m.counts)
    if math.isnan(consistency):
        consistency = plain_misfit(sensors, m)
    restless = math.sqrt(drift * max(1.0, consistency / POWER_LIMIT))
    widening, doubt = (restless * max(1.0, abs(float(m.score[bias])) / FREE_BIAS)
                       for bias in (mem.EMPTY_ARM_BIAS, mem.EXCESS_BIAS))
    std = widening * deviation
    status = Status.TRACKING
    if consistency > POWER_LIMIT or doubt > WIDENING_LIMIT:
        status = Status.INCONSISTENT
    if m.counts[mem.SINCE_EVENT] < FEW:
        status = Status.WARMING_UP
    if restarts and m.counts[mem.SEEN] < SETTLED:
        status = Status.DIVERGED
    mass = scale * math.exp(min(float(m.x[state]), 12.0)) if held else 0.0
    error = reckoned * inertia_error(config, model, mass)
    if not held:
        return empty(float(m.x[state]), math.hypot(std, error), consistency, status)
    std = math.hypot(std, error / mass)
    if std > UNKNOWN_STD and status is Status.TRACKING:
        status = Status.POORLY_EXCITED
    lower = max(0.0, mass * (1.0 - QUANTILE * std))
    upper = mass * math.exp(min(QUANTILE * std, 20.0))
    inertia, status = rotary(model, m, widening, status)
    return Payload(mass, mass * std, lower, upper, consistency, status, inertia=inertia)


def rotary(
    model: Model, m: mem.FilterState, widening: float, status: Status,
) -> tuple[tuple[float, float, float, float, float, float], Status]:
    """Return the payload's inertia about its centre of mass, refused with a status where it is not known.

    A planar arm feels the turning about z alone; the rest stays zero.
    """
    nothing = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if model.motion.inertia == 0.0:
        return nothing, status
    std = widening * spread(m.S, m.x.size - 1)
    if std > VAGUE_STD:
        return nothing, Status.POORLY_EXCITED if status is Status.TRACKING else status
    about_z = model.motion.inertia * math.exp(min(float(m.x[-1]), 12.0))
    return (0.0, 0.0, 0.0, 0.0, 0.0, about_z), status


def empty(seeming: float, std: float, consistency: float, status: Status) -> Payload:
    """Return the payload of an arm that should be empty and seems to hold ``seeming`` kg.

    An arm that does not move as an empty one may hold anything: nobody said so, or it is another arm.
    """
    if status is Status.INCONSISTENT:
        return Payload(0.0, math.inf, 0.0, math.inf, consistency, status)
    upper = max(seeming, 0.0) + QUANTILE * std
    if abs(seeming) > 3.0 * std and status is Status.TRACKING:
        return Payload(max(seeming, 0.0), std, 0.0, upper, consistency, Status.INCONSISTENT)
    return Payload(0.0, std, 0.0, upper, consistency, status)


def inexact(config: IdentifierParameters, model: Model, m: mem.FilterState, mass: float) -> float:
    """Deviation [kg] of a payload by the error to reckon with in the arm's inertia; 0 for an exact arm."""
    return misjudged(m.noise, m.score, m.counts) * inertia_error(config, model, mass)


def inertia_error(config: IdentifierParameters, model: Model, mass: float) -> float:
    """Deviation [kg] of a payload by ``model_error`` of everything at the tip; more below three modes a link.

    What the modes left out give way under a torque falls with the third power of kappa + 1/2. Chains read at
    kappa 1, 2, 3 and 5 err rather as its root: 0.8, 0.3, 0.1 and 0.1 % of everything at the tip.
    """
    coarse: float = max(1.0, (3.5 / (model.motion.arm.kappa + 0.5)) ** 1.5)
    return config.payload.model_error * coarse * (mass + model.motion.scale)


def plain_misfit(sensors: MeasurementModel, m: mem.FilterState) -> float:
    """Innovation power over white noise of the sensors of displacements, before any tells of the payload."""
    ratio = m.noise[:, mem.POWER] / np.maximum(m.noise[:, mem.WHITE], m.noise[:, mem.FLOOR])
    return float(np.median(ratio[~sensors.rate]))


RESIDUAL_SHARE = 0.5
"""Of the error to reckon with, what is left where nothing misfits but the modes beyond kappa, allowed for."""

Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


@kernel
def spread(S: Array, row: int) -> float:
    """Standard deviation of one state, S: (nx, nx) square root of the covariance."""
    square = 0.0
    for c in range(S.shape[1]):
        square += S[row, c] * S[row, c]
    return math.sqrt(square)


@kernel
def misfit(noise: Array, rate: Booleans) -> float:
    """Innovation power over white noise, each sensor weighted by what it tells of the payload; nan: none yet.

    noise: (m, 8), see ``memory``; rate: (m,) whether a sensor is one of rates. Those are left out where there
    are displacements: they show the modes that the model leaves out, and have been given a larger noise.
    """
    total = sum_of_weights = 0.0
    for i in range(noise.shape[0]):
        if not rate[i]:
            total += noise[i, WEIGHT] * noise[i, POWER] / max(noise[i, WHITE], noise[i, FLOOR])
            sum_of_weights += noise[i, WEIGHT]
    return total / sum_of_weights if sum_of_weights > 0.0 else math.nan


@kernel
def drift(score: Array, counts: Integers) -> float:
    """Factor on the payload's variance: how much farther it moved than it should, beyond chance."""
    if counts[BATCHES] == 0:
        return 1.0
    beyond: float = score[DRIFT] - 2.0 * math.sqrt(2.0 / counts[BATCHES])
    return max(1.0, beyond)


@kernel
def misjudged(noise: Array, score: Array, counts: Integers) -> float:
    """Share of the model-error allowance that the interval carries, 0 to 1.

    1 where the innovations of a sensor exceed its white noise; else ``RESIDUAL_SHARE`` times the probability of
    residual modes.
    """
    chance = 2.5 * math.sqrt(2.0 / max(counts[BLOCKS], 1))
    for i in range(noise.shape[0]):
        if noise[i, EFFECTIVE] >= (1.0 + chance) * max(noise[i, WHITE], noise[i, FLOOR]):
            return 1.0
    return RESIDUAL_SHARE * residual_probability(score)


@kernel
def figures(S: Array, row: int, noise: Array, rate: Booleans, score: Array, counts: Integers
            ) -> tuple[float, float, float, float]:
    """Return deviation of the payload's state, misfit, drift and ``misjudged``, in one call."""
    return spread(S, row), misfit(noise, rate), drift(score, counts), misjudged(noise, score, counts)
