"""The 95 % interval of the payload and its status, from covariance, moves and the consistency of the innovations."""

import math

import numpy as np

from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload import structured_model
from flexmanip_ros.payload.gauss_newton import FITS, MOST_BIAS, agrees, holds_still
from flexmanip_ros.payload.measurement_update import OVERLAP, MeasurementModel, misfit, white_variance
from flexmanip_ros.payload.process_model import Kind
from flexmanip_ros.payload.structured_model import Model
from flexmanip_ros.types import QUANTILE, Array, Payload, Status

UNKNOWN_STD = 0.3
"""Relative standard deviation above which the payload counts as unknown; the prior's is then published at least."""
UNTOLD = math.sqrt(0.5)
"""Deviation of an empty arm's payload over its prior deviation, above which samples tell less of it than the prior: it
may hold something that was not announced."""
FEW = 50
"""Samples after an event before anything is claimed, but that a fit was begun again and still does not fit."""
POWER_LIMIT = 2.0
"""Innovation power over white noise beyond which the model does not fit."""
UNKNOWN_POWER = 4.0
"""Innovation power over white noise beyond which the object may weigh anything: most of the residuals are no noise, so
the fit may be in a wrong minimum. After a fit that was given up, ``POWER_LIMIT`` takes its place."""
WIDENING_LIMIT = 4.0
"""Factor on the payload's deviation, by the moves and the misfit, beyond which the model does not fit."""
FREE_BIAS = 2.0
"""Standard deviations that an empty arm may seem to hold before the interval is widened."""
SHARE_ERROR = 0.03
"""Mean error of the share of Coulomb friction that acts on a joint. Simulated at 16 kHz a fifth to a half of the
samples are near rest, and there the share is 0.02 to 0.27 too large. That is 0.01 to 0.1 in the mean of all samples,
with the geometric mean of 0.03."""
SETTLED = 1000
"""Samples after a restart until the status is no longer DIVERGED."""


def judge(config: IdentifierParameters, model: Model | None, sensors: MeasurementModel | None,
          m: mem.FilterState | None, restarts: int, peak: Array) -> Payload:
    """Return the payload; never a NaN. peak: (L,) largest size of each torque so far [N m]."""
    if model is None:
        return Payload(0.0, math.inf, 0.0, math.inf, 1.0, Status.UNOBSERVABLE)
    if m is None or sensors is None:
        begun = Status.DIVERGED if restarts else Status.WARMING_UP  # the filter may diverge again with every sample
        return Payload(0.0, math.inf, 0.0, math.inf, 1.0, begun)
    state = model.payload
    held = bool(m.counts[mem.HELD])
    consistency, share = innovation_power(sensors, m)
    fitting = held and m.counts[mem.STORED] < mem.HORIZON
    g = moves(m)
    if fitting:  # the next step may be as long as the last one
        g = max(g, 1.0 + float(m.score[mem.SHIFT]) ** 2)
    restless = math.sqrt(g * max(1.0, consistency / POWER_LIMIT))
    widening = max(restless, abs(float(m.score[mem.EMPTY_ARM_BIAS])) / FREE_BIAS)
    status, doubted = Status.TRACKING, abs(m.score[mem.EXCESS_BIAS]) > MOST_BIAS or (fitting and not agrees(m))
    if consistency > POWER_LIMIT or restless > WIDENING_LIMIT or doubted:
        status = Status.INCONSISTENT
    refitted = bool(m.counts[mem.REFITS] or m.counts[mem.SKIPPED])
    failed = refitted and status is Status.INCONSISTENT  # a fit before it fitted no better
    too_few = m.counts[mem.SINCE_EVENT] < FEW or (status is Status.INCONSISTENT and is_fitted_to_few(m))
    if (too_few and not failed) or (fitting and status is Status.TRACKING and is_behind(m)):
        status = Status.WARMING_UP
    if restarts and m.counts[mem.SEEN] < SETTLED:
        status = Status.DIVERGED
    body = m.x[state:state + model.body].copy()
    spread = (widening ** 2) * (m.S[state:state + model.body] @ m.S[state:state + model.body].T)
    # of the payload, by the error of all inertia at the tip [kg]
    considered = config.payload.model_error * ((max(float(body[0]), 0.0) if held else 0.0) + model.motion.scale)
    spread[0, 0] += (share * considered) ** 2
    expected, deviation = structured_model.body_mean(config, model), structured_model.body_std(config, model)
    prior = float(deviation[0])
    if not held:
        std = math.sqrt(spread[0, 0])
        if status is Status.TRACKING and std > UNTOLD * structured_model.EMPTY_STD * model.motion.scale:
            return Payload(0.0, prior, 0.0, QUANTILE * prior, consistency, Status.POORLY_EXCITED)
        return empty(float(body[0]), std, considered, consistency, status)
    moved = by_rotors(model, m)
    spread += moved @ moved.T
    spread[0, 0] += (friction_error(model, m, peak) * (max(float(body[0]), 0.0) + model.motion.scale)) ** 2
    spread[0, 0] += (2.0 * config.payload.length_std * max(float(body[0]), 0.0)) ** 2  # by that of the last link
    if doubted or consistency > (POWER_LIMIT if refitted else UNKNOWN_POWER):
        return Payload(max(float(body[0]), 0.0), math.inf, 0.0, math.inf, consistency, status)
    known_point = model.body > 1 and not spread[1:, 1:].any()
    if model.body > 1 and not known_point:
        body, spread = point_or_body(body, spread, expected, deviation)
    mass, std = max(float(body[0]), 0.0), math.sqrt(spread[0, 0])
    # a linearization is too sure of a payload that is hardly excited, or was not known where it was made
    least = 0.0 if fitting else structured_model.EMPTY_STD * model.motion.scale  # a gripper may close on nothing
    still = (fitting or m.counts[mem.RESTS] == mem.RESTING) and holds_still(sensors, m)
    if still or std > UNKNOWN_STD * max(mass, least) or (fitting and m.score[mem.DOUBT] > UNKNOWN_STD):
        std = max(std, prior)
        status = Status.POORLY_EXCITED if status is Status.TRACKING else status
    found = Payload(mass, std, max(0.0, mass - QUANTILE * std), mass + QUANTILE * std, consistency, status)
    if model.body == 1 or known_point:
        return found
    if body[0] < math.sqrt(spread[0, 0]):  # a centre of mass h / m may be anywhere: it is that of an unknown object
        body, spread = expected, np.diag(deviation ** 2)
    return with_body(found, body, spread)


def is_behind(m: mem.FilterState) -> bool:
    """Whether the fit of an open horizon neither fits nor has read half of the samples: the object may be another one.

    So it is where an object was lost in a gap: the fit begins with a mass that was known exactly. A horizon that lost
    messages have begun again is not judged before ``FEW`` samples.
    """
    if m.counts[mem.STORED] < FEW:
        return False
    unfit = m.counts[mem.AGAIN] == 1 and m.score[mem.MISFIT] > FITS
    return bool(unfit or 2 * m.counts[mem.BEFORE] <= m.counts[mem.STORED])


def is_fitted_to_few(m: mem.FilterState) -> bool:
    """Whether the fit has read fewer than ``FEW`` of the samples since the event, and more will be read soon.

    The iterations end with 36, 51 and 71 samples, so at ``FEW`` samples the variances are those of a fit to 36. A fit
    that twice ``FEW`` samples have not brought further is judged as it is.
    """
    is_first = m.counts[mem.SINCE_EVENT] <= m.counts[mem.STORED] < 2 * FEW  # no loss has begun the horizon again
    return bool(is_first and m.counts[mem.BEFORE] < FEW)


def moves(m: mem.FilterState) -> float:
    """Return the factor, at least 1, by which variances of payload and arm parameters are too small for their moves.

    See ``judge_moves``; 1 before the first move.
    """
    return max(1.0, float(m.score[mem.MOVES])) if m.counts[mem.MOVED] else 1.0


def point_or_body(body: Array, spread: Array, mean: Array, std: Array) -> tuple[Array, Array]:
    """Return inertial parameters (4,) and covariance (4, 4) of an object that may be a point.

    Savage-Dickey density ratio: the Bayes factor of a point (no first moments, no inertia about the tip) is the
    posterior density of these zeros over their prior density. Both objects are as likely before; the result has mean
    and covariance of the mixture. mean, std: (4,) of the prior.
    """
    rest = slice(1, 4)
    gain = np.linalg.solve(spread[rest, rest], spread[rest, 0])
    point = np.array([body[0] - gain @ body[rest], 0.0, 0.0, 0.0])
    left = max(float(spread[0, 0] - gain @ spread[rest, 0]), 0.0)
    scale = std[rest]
    scaled = spread[rest, rest] / np.outer(scale, scale)
    logarithm = 0.5 * (float((mean[rest] / scale) @ (mean[rest] / scale))
                       - float(body[rest] @ np.linalg.solve(spread[rest, rest], body[rest]))
                       - float(np.linalg.slogdet(scaled)[1]))
    share = 1.0 / (1.0 + math.exp(-min(max(logarithm, -700.0), 700.0)))
    middle = share * point + (1.0 - share) * body
    mixed = (1.0 - share) * spread + share * (1.0 - share) * np.outer(point - body, point - body)
    mixed[0, 0] += share * left
    return middle, mixed


def with_body(found: Payload, body: Array, spread: Array) -> Payload:
    """Add centre of mass and inertia about it, with the covariance of mass, both coordinates and inertia."""
    m = max(float(body[0]), 1e-9)
    x, y = body[1] / m, body[2] / m
    J = about_com(body)
    inertia = max(float(body[3] - m * (x * x + y * y)), 0.0)
    return found._replace(com=(float(x), float(y), 0.0), inertia=(0.0, 0.0, 0.0, 0.0, 0.0, inertia),
                          covariance=tuple((J @ spread @ J.T).ravel().tolist()))


def about_com(body: Array) -> Array:
    """Return the derivative (4, 4) of mass, centre of mass x, y and inertia about it by the inertial parameters."""
    m = max(float(body[0]), 1e-9)
    x, y = body[1] / m, body[2] / m
    return np.array([[1.0, 0.0, 0.0, 0.0], [-x / m, 1.0 / m, 0.0, 0.0], [-y / m, 0.0, 1.0 / m, 0.0],
                     [x * x + y * y, -2.0 * x, -2.0 * y, 1.0]])


def empty(seeming: float, std: float, considered: float, consistency: float, status: Status) -> Payload:
    """Return the payload of an arm that should be empty and seems to hold ``seeming`` kg.

    An arm that does not move as an empty one may hold anything: a capture was not announced, or it is another arm.
    After minutes std is far below the error to which the inertia of any arm is known. So what the arm seems to hold is
    tested against the consider covariance (Schmidt): the error of the inertia, which is not estimated, adds its
    deviation ``considered`` [kg].
    """
    if status in (Status.INCONSISTENT, Status.DIVERGED):
        return Payload(0.0, math.inf, 0.0, math.inf, consistency, status)
    if abs(seeming) > MOST_BIAS * std:
        std = math.hypot(std, considered)
    upper = max(seeming, 0.0) + QUANTILE * std
    if abs(seeming) > MOST_BIAS * std and status is Status.TRACKING:
        return Payload(0.0, math.inf, 0.0, math.inf, consistency, Status.INCONSISTENT)
    return Payload(0.0, std, 0.0, upper, consistency, status)


def by_rotors(model: Model, m: mem.FilterState) -> Array:
    """Return by how much the body's parameters (body, rotors) move with one consider deviation of each rotor inertia.

    The shape functions that are left out respond to fast torques much as a rotor does, so a rotor that is learned has a
    bias that its variance P_rr does not hold. A bias b of the rotor moves the body by P_br / P_rr b, the regression on
    it (consider covariance, Schmidt).
    """
    rotors = np.flatnonzero(model.motion.kind == Kind.ROTOR)
    S, body = m.S[model.payload + rotors], m.S[model.payload:model.payload + model.body]
    own = (S * S).sum(axis=1)
    regression = np.divide(body @ S.T, own, out=np.zeros((model.body, rotors.size)), where=own > 0.0)
    moved: Array = regression * model.rotor_error[model.motion.link[rotors]]
    return moved


def friction_error(model: Model, m: mem.FilterState, peak: Array) -> float:
    """Return the relative error of the inertia that the form of the Coulomb friction seems to be.

    The friction is F tanh(rate / ``STICTION_RATE``) with the rate in a line over a sample. Innovations do not show the
    error of that, as they are compared with the process noise of the friction. A torque that is off by a share of F
    accelerates an arm as an inertia does that is off by that share of F over the torque. The joint with the most
    counts. peak: (L,) largest size of each torque so far [N m].
    """
    friction = model.motion.kind == Kind.COULOMB
    F = np.maximum(m.x[model.payload + np.flatnonzero(friction)], 0.0)
    torques = peak[model.motion.link[friction]]
    return SHARE_ERROR * float(np.max(np.divide(F, torques, out=np.zeros(F.size), where=torques > F), initial=0.0))


def innovation_power(sensors: MeasurementModel, m: mem.FilterState) -> tuple[float, float]:
    """Return the innovation power over white noise, and the share of ``model_error`` that the interval carries, 0 to 1.

    Before a sensor tells of the payload, the power is the median of those of the displacements. The share grows
    linearly with the innovation power over white noise of the sensor with the most. It is 0 up to what chance explains
    if the samples are independent, and 1 from what chance explains if only blocks are independent.
    """
    power = misfit(m.noise, sensors.rate, mem.LEVEL)
    if math.isnan(power):
        power = float(np.median([sensor[mem.POWER] / white_variance(sensor, mem.LEVEL)
                                 for sensor in m.noise[~sensors.rate]]))
    # a mean of N squares scatters by sqrt(2 / N); 2.5 times that is exceeded by chance in 0.6 % of the blocks
    blocks, of_white = max(m.counts[mem.BLOCKS], 1), 2.0 * OVERLAP / max(m.counts[mem.SEEN], 1)
    most = 2.5 * math.sqrt(2.0 / blocks + of_white)
    least = 2.5 * math.sqrt(2.0 / (blocks * sensors.block) + of_white)
    excess = max(sensor[mem.EFFECTIVE] / white_variance(sensor, mem.LEVEL) - 1.0 for sensor in m.noise.tolist())
    return power, float(min(max((excess - least) / (most - least), 0.0), 1.0))
