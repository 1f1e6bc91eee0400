"""The prediction-error fit of a whole stretch: starting points, noise model, and uncertainty of the result."""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from flexmanip_ros.errors import ModelError
from flexmanip_ros.identification.mode_drift import drifting
from flexmanip_ros.identification.moments import Realized, triangle
from flexmanip_ros.identification.pbsid import pbsid
from flexmanip_ros.identification.prediction_error import (
    Fit,
    Structure,
    Theta,
    averaged,
    candidate,
    covariance_root,
    derivatives,
    descend,
    directions,
    forgets,
    measured,
)
from flexmanip_ros.identification.realization import lightly_damped
from flexmanip_ros.types import Array, StateSpace

ITERATIONS = 12
BLOCK = 256
"""Samples of a recursive update; a multiple of ``recursive_fit.CHUNK``."""
LIGHT = 0.005
"""Largest damping ratio in a second starting model. The subspace model of a short past window has too much damping, and
a fit that starts from it may fail."""
CLEAN = 1e-20
"""Innovation power, as a share of the outputs' power, below which the subspace model has no bias worth removing. The
innovation covariance of a recursion is raised by the same share."""
UNEXPLAINED = 0.5
"""Largest share of the outputs' power that a fit with K = 0 may leave; a fit that leaves more simulates nothing."""
PIECES = 16
"""Number of pieces of a stretch whose gradients are compared, see ``_widening``; also the effective sample size where
residuals are correlated, see ``_with_constant``."""
LARGE_MEAN = 0.5
"""Mean of a signal, in its standard deviations, above which subspace models of signals that are not centred are poor
starting points: with 1 of an output the poles of a random system of order 3 were real instead of complex."""


class Recursion(NamedTuple):
    """A fit that further blocks update.

    scale: (r + m,) factors on the signals; P: (d, k) coordinates, see ``Fit``; root: (k, k) S with S S' the covariance
    of these coordinates, the state last; covariance: (m, m) of the innovations, estimated from ``weight`` samples;
    widening: factor on standard deviations, see ``_widening``; strikes: bad blocks in a row; gain: (n, m) published K,
    theta's own unless that is held; mean: (m,) see ``middle``; singular_values, condition: of the subspace model that
    the fit started from; lost: the state is unknown; drift: logarithm of the factor by which the variances grow in a
    block because the plant changes; trend: (k,) mean step of the coordinates in a block, over the last blocks;
    trend_share: the part of it that chance does not explain (0 to 1); trend_lag: steps of ``trend`` by which the fit
    may lag behind the arm.
    """

    theta: Theta
    structure: Structure
    scale: Array
    P: Array
    root: Array
    covariance: Array
    weight: float
    widening: float
    strikes: int
    gain: Array
    mean: Array
    singular_values: Array
    condition: float
    trend: Array
    lost: bool = False
    drift: float = 0.0
    trend_share: float = 0.0
    trend_lag: float = 0.0


class Attempt(NamedTuple):
    """A fit from one starting point.

    cost: penalized log det of the innovation covariance in the units of the samples; wants_gain: a score test asks for
    K; begin: K of the starting point.
    """

    fit: Fit
    structure: Structure
    scale: Array
    cost: float
    wants_gain: bool
    begin: Array


def fit_stretch(
    samples: Array, starts: list[Realized], fits: list[Recursion], scale: Array, feedthrough: bool,
    noise: str, constant: bool,
) -> Recursion | None:
    """Fit samples (N, r + m) from several starting points and keep the fit of least cost.

    starts: subspace models, each also tried with little damping; fits: earlier fits; a batch model of averaged samples
    is another starting point. scale: (r + m,) of the subspace models' signals; noise: ``sensor`` holds K = 0 while the
    system is fitted, ``any`` frees K where that is the better model; constant: whether the state's equation may have
    a constant, an input of ones. A fit without one comes first: see ``_with_constant``. None where no fit simulates the
    stretch.
    """
    m = starts[0].C.shape[0] if starts else 0
    if starts and not np.all(np.nanmax(samples[:, -m:], axis=0) > np.nanmin(samples[:, -m:], axis=0)):
        return None  # a constant output carries no information
    power = np.nansum((samples[:, -m:] * scale[-m:]) ** 2, axis=0)
    floors = [-np.inf]
    for realized in starts:
        moments = realized.residual.T @ realized.residual
        if np.all(np.diag(moments) <= CLEAN * power):
            return None
        size = np.linalg.slogdet(moments / len(samples) + 1e-300 * np.eye(m))[1]
        floors.append(float(size) + realized.Xi.size * np.log(len(samples)) / len(samples))

    def likeliest(constant: bool) -> Attempt | None:
        found = _attempts(samples, starts, fits, scale, feedthrough, noise, floors, constant)
        return min(found, key=lambda attempt: attempt.cost, default=None)

    best = likeliest(False)
    if constant:
        best = _with_constant(samples, best, lambda: likeliest(True))
    if best is None:
        return None
    recursion = _recursion(samples, _with_direct(samples, best))
    if not starts:
        return recursion
    length = np.linalg.norm(starts[0].state, axis=0)
    return recursion._replace(
        singular_values=starts[0].singular_values,
        condition=float(np.linalg.cond(starts[0].state / np.where(length > 0.0, length, 1.0))))


def _attempts(
    samples: Array, starts: list[Realized], fits: list[Recursion], scale: Array, feedthrough: bool, noise: str,
    floors: list[float], constant: bool,
) -> list[Attempt]:
    """Fit from every starting point, see ``fit_stretch``, with or without a constant.

    With a constant the subspace models are those of the stretch about its means. floors: see ``_attempt``, before the
    first subspace model and after each of them.
    """
    found, means = [], None
    if starts:
        filled, r = interpolated(samples) * scale, starts[0].B.shape[1]
        U, Y = filled[:, :r], filled[:, r:]
        means = (U.mean(axis=0), Y.mean(axis=0)) if constant else None
    for realized, floor in zip(starts, floors[1:], strict=True):
        model = _centred(U, Y, realized) if constant else StateSpace(
            realized.A, realized.B, realized.C, realized.D, realized.K, 1.0)
        if model is None:
            continue
        begin, structure = candidate(model, feedthrough, means)
        found.append(_attempt(samples, begin, structure, scale, noise, floor))
        light = lightly_damped(begin.A, LIGHT)
        if light is not begin.A:
            found.append(_attempt(samples, begin._replace(A=light), structure, scale, noise, floor))
    floor = floors[-1]
    slow = averaged(U, Y, starts[0].A.shape[0], constant) if starts else None
    if slow is not None:
        found.append(_attempt(samples, *candidate(slow, feedthrough, means), scale, noise, floor))
    for k, old in enumerate(fits):
        best, m = min((one.cost for one in found if one is not None), default=np.inf), len(old.covariance)
        if k > 0 and best + 2.0 * float(np.sum(np.log(scale[-m:]))) < floor:
            break  # below the cost of the long regression (VARX): good enough
        n, r = len(old.theta.A), old.theta.D.shape[1]
        B = np.hstack([old.theta.B, np.zeros((n, 1))])[:, :r + constant]
        begin = old.theta._replace(B=np.ascontiguousarray(B), x=np.zeros(n), K=old.gain)
        own = floor + 2.0 * float(np.sum(np.log(old.scale[-m:] / scale[-m:]))) if starts else floor
        found.append(_attempt(samples, begin, old.structure, old.scale, noise, own))
    return [attempt for attempt in found if attempt is not None]


def _centred(U: Array, Y: Array, like: Realized) -> StateSpace | None:
    """Return the batch subspace model of signals about their means, of the order and windows of another one."""
    n, past = like.T.shape
    m, width = Y.shape[1], U.shape[1] + Y.shape[1]
    try:
        return pbsid(U, Y, n=n, p=past // width, f=like.S.shape[1] // m, dt=1.0, centred=True)[0]
    except (ModelError, np.linalg.LinAlgError):  # other starting points may do
        return None


def interpolated(samples: Array) -> Array:
    """Return samples (N, c) with interpolated values in the place of those that were not measured (NaN)."""
    absent = np.isnan(samples[:, -1])
    if not absent.any():
        return samples
    filled, rows = samples.copy(), np.arange(len(samples))
    for column in filled.T:
        gone = np.isnan(column)
        column[gone] = np.interp(rows[gone], rows[~gone], column[~gone])
    return filled


def unexplained(covariance: Array, Y: Array, mean: Array) -> float:
    """Share of the power of Y (N, m) about ``mean`` (m,) in residuals of this covariance (m, m), mean over outputs."""
    power = np.nanmean((Y - mean) ** 2, axis=0)
    return float(np.mean(np.diag(covariance) / np.where(power > 0.0, power, np.inf)))


def middle(Y: Array, theta: Theta) -> Array:
    """Return what the powers of Y (N, m) refer to: the mean, or zero for a model without constant terms."""
    return np.nanmean(Y, axis=0) if theta.B.shape[1] > theta.D.shape[1] else np.zeros(Y.shape[1])


def scaled(samples: Array, scale: Array, theta: Theta) -> tuple[Array, Array]:
    """Return inputs (N, r), with a constant in the model (N, r + 1), and outputs (N, m) of samples (N, r + m)."""
    r = theta.D.shape[1]
    U = np.ones((len(samples), theta.B.shape[1]))
    U[:, :r] = samples[:, :r] * scale[:r]
    return U, np.ascontiguousarray(samples[:, r:] * scale[r:])


def _attempt(
    samples: Array, begin: Theta, structure: Structure, scale: Array, noise: str, floor: float,
) -> Attempt | None:
    """Fit from one starting point; None where the fit does not simulate the samples.

    The first fit has K = 0. It is the maximum-likelihood fit for sensor noise, and simulates well with any noise. With
    ``noise`` = ``any`` a fit with free K replaces it where the likelihood gains more than the price of K. If the first
    fit simulates, the order must also suffice: a cost below ``floor``, the penalized cost of the long regression
    (VARX). With too low an order a free K improves the next sample's prediction at the expense of all slower motion.
    """
    n, r = len(begin.A), begin.D.shape[1]
    begin, scale = _without_idle(samples, begin), np.where(scale > 0.0, scale, 1.0)
    U, Y = scaled(samples, scale, begin)
    m, count = Y.shape[1], len(U)
    penalty = _price(n * m, count)
    chosen = structure._replace(free_gain=False, only_gain=False)
    best = descend(U, Y, begin._replace(K=np.zeros_like(begin.K)), chosen, ITERATIONS)
    simulates = best is not None and unexplained(best.covariance, Y, middle(Y, begin)) < UNEXPLAINED
    cost = np.inf if best is None else best.cost + (_price(m * r, count) if structure.free_direct else 0.0)
    wanted = False
    if noise == 'any' or simulates:
        wanted = best is None or _gain_asked_for(U, Y, best, chosen, penalty)
    if wanted and noise == 'any':
        free = chosen._replace(free_gain=True)
        other = descend(U, Y, begin, free, ITERATIONS)
        better = other is not None and settles(other.theta, count) and other.cost + penalty < cost
        if other is not None and better and (not simulates or other.cost + penalty < floor):
            best, chosen, cost, simulates, wanted = other, free, other.cost + penalty, True, False
    if best is None or not simulates:
        return None
    shift = 2.0 * float(np.sum(np.log(scale[r:])))
    return Attempt(best, chosen, scale, cost - shift, wanted, begin.K)


def _without_idle(samples: Array, begin: Theta) -> Theta:
    """Return a starting point in which an input that is zero in all samples (N, r + m) has no effect.

    The samples say nothing of its effect. Where that is exactly zero, its coordinates stand alone in ``directions`` and
    have no information at all. Otherwise they are mixed with others, and rounding errors count as information on them.
    """
    idle = np.flatnonzero(np.all(samples[:, :begin.D.shape[1]] == 0.0, axis=0))
    if not idle.size:
        return begin
    B, D = begin.B.copy(), begin.D.copy()
    B[:, idle], D[:, idle] = 0.0, 0.0
    return begin._replace(B=B, D=D)


def _with_constant(samples: Array, best: Attempt | None, likeliest: Callable[[], Attempt | None]) -> Attempt | None:
    """Free a constant where the likelihood gains more than its price.

    best: fit without one, if any; likeliest: makes the best fit with one. It is called where that may be far from
    ``best``: where a constant pays from there, and where a signal has a large mean (``LARGE_MEAN``). Modes above the
    order and an arm that turns leave correlated residuals. So the stretch counts as ``PIECES`` independent samples:
    this effective sample size takes the place of N in Schwarz's criterion.
    """
    if best is None:
        return likeliest()
    n = len(best.fit.theta.A)
    begin = best.fit.theta._replace(B=np.hstack([best.fit.theta.B, np.zeros((n, 1))]))
    other, price = descend(*scaled(samples, best.scale, begin), begin, best.structure, ITERATIONS), _price(n, PIECES)
    found = [] if other is None else [best._replace(fit=other, cost=best.cost - best.fit.cost + other.cost)]
    far = np.abs(np.nanmean(samples, axis=0)) > LARGE_MEAN * np.nanstd(samples, axis=0)
    if far.any() or (found and found[0].cost + price < best.cost):
        again = likeliest()
        found += [] if again is None else [again]
    freed = min(found, key=lambda attempt: attempt.cost, default=best)
    return freed if freed.cost + price < best.cost else best


def _with_direct(samples: Array, attempt: Attempt) -> Attempt:
    """Free D where the likelihood gains more than the price of D.

    Modes above the model's order follow the input at once, as a compliance in D. Without D the modes of the model
    represent this compliance and are biased.
    """
    fit, structure = attempt.fit, attempt.structure
    if structure.free_direct:
        return attempt
    U, Y = scaled(samples, attempt.scale, fit.theta)
    free = structure._replace(free_direct=True)
    other = descend(U, Y, fit.theta, free, ITERATIONS)
    if other is None or not other.cost + _price(fit.theta.D.size, len(U)) < fit.cost:
        return attempt
    return attempt._replace(fit=other, structure=free)


def _price(parameters: int, count: int) -> float:
    """Return the decrease of the cost, ln det of the residuals' covariance, that pays for parameters (Schwarz)."""
    return parameters * float(np.log(count)) / count


def _recursion(samples: Array, attempt: Attempt) -> Recursion:
    """Start the recursion from the best attempt; where a score test asks for K, K is fitted with the system held."""
    fit, structure = attempt.fit, attempt.structure
    U, Y = scaled(samples, attempt.scale, fit.theta)
    gain = None
    if attempt.wants_gain:
        alone = structure._replace(free_gain=True, only_gain=True)
        gain = _gain_alone(U, Y, fit.theta, attempt.begin, alone)
    root, blocks = arrive(covariance_root(fit.information), fit.arrival), len(U) / BLOCK
    trend, trend_share = np.zeros(fit.directions.shape[1]), 0.0
    widening = _widening(U, Y, fit, structure)
    try:
        drift = drifting(U, Y, fit, structure, widening)
    except np.linalg.LinAlgError:  # the fit itself is sound
        drift = None
    if drift is not None:  # the fit is that of the arm at an earlier time
        root = triangle(np.hstack([root, drift.ahead[:, None]]).T).T
        trend, trend_share = drift.rate / blocks, 1.0
    return Recursion(
        theta=fit.theta._replace(x=fit.end), structure=structure, scale=attempt.scale, P=fit.directions,
        root=root,
        covariance=fit.covariance + CLEAN * np.diag(np.nanmean(Y ** 2, axis=0)), weight=float(measured(Y)),
        widening=widening, strikes=0, gain=fit.theta.K if gain is None else gain,
        mean=middle(Y, fit.theta), singular_values=np.zeros(0), condition=float('nan'), trend=trend,
        trend_share=trend_share)


def _gain_alone(U: Array, Y: Array, theta: Theta, begin: Array, structure: Structure) -> Array | None:
    """K (n, m) of the best predictor with the system held, from two starting points; None where none ``settles``."""
    tried = [descend(U, Y, theta._replace(K=K), structure, ITERATIONS) for K in (begin, np.zeros_like(begin))]
    done = [fit for fit in tried if fit is not None and settles(fit.theta, len(U))]
    return min(done, key=lambda fit: fit.cost).theta.K if done else None


def settles(theta: Theta, count: int) -> bool:
    """Whether the predictor A - K C forgets its first state in ``count`` samples, and no more slowly than the system.

    One that forgets it more slowly fits that state, not the noise: from another state it predicts worse than the system
    alone. Of a resonance at 20 samples a second, 256 of them, it left 30 % unexplained where K = 0 leaves 0.02 %.
    """
    if not forgets(theta, count):
        return False
    predictor, system = (np.abs(np.linalg.eigvals(A)).max() for A in (theta.A - theta.K @ theta.C, theta.A))
    return bool(predictor <= system)


def arrive(root: Array, arrival: Array) -> Array:
    """Covariance root of [coordinates; state at the end] from that of [coordinates; state at the start]."""
    n = arrival.shape[0]
    return np.vstack([root[:root.shape[0] - n], arrival @ root])


def _gain_asked_for(U: Array, Y: Array, fit: Fit, structure: Structure, penalty: float) -> bool:
    """Score test of K = 0 at the fit: whether a free K would raise the likelihood by more than its price."""
    full = structure._replace(free_gain=True)
    P = directions(fit.theta, full)
    information, gradient, _, _ = derivatives(U, Y, fit.theta, full, fit.covariance, P)
    if not np.all(np.isfinite(information)):
        return True
    root = covariance_root(information)
    gain = float(np.sum((root.T @ gradient) ** 2))
    return gain > penalty * len(U)


def _widening(U: Array, Y: Array, fit: Fit, structure: Structure) -> float:
    """Scatter of the gradient over pieces of the stretch, as a factor >= 1 on its standard deviation.

    With white innovations the gradients of the pieces scatter as the information matrix predicts. Correlated or growing
    residuals make them scatter more.
    """
    theta = fit.theta
    root = covariance_root(fit.information)
    sums = []
    X: Array | None = None
    edges = np.linspace(0, len(U), PIECES + 1).astype(int)
    for a, b in itertools.pairwise(edges):
        _, gradient, X, end = derivatives(
            U[a:b], Y[a:b], theta, structure, fit.covariance, fit.directions, X)
        sums.append(root.T @ gradient)
        theta = theta._replace(x=end)
    gradients = np.array(sums)
    freedom = fit.information.shape[0]
    power = float(np.sum(gradients ** 2)) / freedom
    noise = np.sqrt(2.0 / (freedom * PIECES))
    return float(np.sqrt(power)) if power > 1.0 + 4.0 * noise else 1.0
