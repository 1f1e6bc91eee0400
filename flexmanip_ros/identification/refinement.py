"""The prediction-error fit kept up to date: whole stretches at first, then block by block.

After a start or an event the samples are kept and the fit is repeated on all of them each time their number
has doubled, from the subspace model and from the fit before, whichever ends better. From ``LONGEST`` samples
on the linearization is good enough to go on recursively: each block of samples updates parameters and state
together, in square-root covariance form, and is then forgotten. Memory is constant; the work is bounded.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from flexmanip_ros.identification.moments import Realized, triangle
from flexmanip_ros.identification.prediction_error import (
    Fit,
    Structure,
    Theta,
    covariance_root,
    derivatives,
    descend,
    directions,
    moved,
    run,
)
from flexmanip_ros.types import Array

CHUNK = 64
"""Samples handed over at once."""
FIRST, LONGEST = 256, 2048
"""Samples of the first fit, and of the last one that sees them all; multiples of CHUNK."""
ITERATIONS = 12
BLOCK = 256
"""Samples of a recursive update; a multiple of CHUNK."""
MEMORY = 1_000_000.0
"""Samples after which parameters may have drifted by their own standard deviation."""
CLEAN = 1e-20
"""Relative innovation power below which the subspace model has no bias worth removing; the least assumed."""
UNEXPLAINED = 0.5
"""Share of an output's power that a fit with K = 0 may leave before it is taken not to simulate at all."""
PARAMETERS = 80
"""With more parameters than this the subspace model is published as it is."""
PAUSE = 8192
"""Samples from a fit that failed to the next attempt; a multiple of CHUNK."""
MISFIT = 3.0
"""Residual power of a block that ends a recursion; twice in a row."""


class Recursion(NamedTuple):
    """A fit that goes on.

    scale: (r + m,) of its signals; root: (k, k) S with S S' the covariance of the coordinates P (d, k) and
    the state; covariance: (m, m) of the innovations, worth ``weight`` samples; widening: factor on standard
    deviations from the scatter of the gradients; gain: (n, m) published K, theta's own unless that is held;
    singular_values, condition: of the subspace model the fit began with; lost: the state is unknown.
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
    singular_values: Array
    condition: float
    lost: bool = False


class Refined(NamedTuple):
    """What the refinement remembers.

    Closed chunks (CHUNK, r + m) never written to again, the open one, samples since the start (negative:
    still to wait), and the fit. batch: the fit still sees every sample since the start.
    """

    chunks: tuple[Array, ...]
    current: Array
    total: int
    batch: bool
    recursion: Recursion | None


def start(width: int) -> Refined:
    """Begin without a fit."""
    return Refined((), np.zeros((CHUNK, width)), 0, True, None)


def due(refined: Refined) -> int:
    """Samples until the next piece of work (at least 1)."""
    return CHUNK - refined.total % CHUNK


def take(refined: Refined, samples: Array) -> Refined:
    """Store samples (k, r + m), k <= due(refined)."""
    current = refined.current.copy()
    if refined.total < 0:
        return refined._replace(total=refined.total + len(samples))
    at = refined.total % CHUNK
    current[at:at + len(samples)] = samples
    refined = refined._replace(current=current, total=refined.total + len(samples))
    if refined.total % CHUNK == 0:
        refined = refined._replace(chunks=(*refined.chunks, current))
    return refined


def is_fit_due(refined: Refined) -> bool:
    """Whether the whole stretch is to be fitted now: at FIRST samples and each time they double."""
    total = refined.total
    if not refined.batch or total <= 0 or total % FIRST:
        return False
    doublings = total // FIRST
    return doublings & (doublings - 1) == 0


def is_block_due(refined: Refined) -> bool:
    """Whether a recursive update is due."""
    if refined.recursion is None or refined.total % BLOCK or len(refined.chunks) * CHUNK < BLOCK:
        return False
    return refined.total % CHUNK == 0


def candidate(realized: Realized, feedthrough: bool) -> tuple[Theta, Structure]:
    """Starting point from the subspace model, C held when it can fix the basis."""
    n, m = realized.A.shape[0], realized.C.shape[0]
    theta = Theta(realized.A, realized.B, realized.C, realized.D, realized.K, np.zeros(n))
    if n == m and np.linalg.cond(realized.C) < 1e6:
        W = realized.C
        A = np.asarray(np.linalg.solve(W.T, (W @ realized.A).T).T, dtype=np.float64)
        theta = Theta(A, W @ realized.B, np.eye(n), realized.D, W @ realized.K, np.zeros(n))
        return _dense(theta), Structure(False, feedthrough, False)
    return _dense(theta), Structure(True, feedthrough, False)


def _dense(theta: Theta) -> Theta:
    return Theta(*(np.ascontiguousarray(part) for part in theta))


def fit_all(
    refined: Refined, starts: list[Realized], scale: Array, feedthrough: bool, noise: str,
) -> Refined:
    """Fit the whole stretch from subspace models and from the fit before; the best one is kept.

    noise: ``sensor`` holds K = 0 while the system is fitted, ``any`` frees it where that is the better model.
    """
    samples = np.vstack(refined.chunks)
    m = starts[0].C.shape[0] if starts else 0
    if starts and not np.all(np.ptp(samples[:, -m:], axis=0) > 0.0):
        return _next_phase(refined._replace(recursion=None))  # a silent output tells nothing
    found: list[tuple[Recursion, float]] = []
    floor = -np.inf
    for realized in starts:
        begin, structure = candidate(realized, feedthrough)
        m = realized.C.shape[0]
        size = np.linalg.slogdet(realized.residual.T @ realized.residual / len(samples) + 1e-300 * np.eye(m))
        power = np.sum((samples[:, -m:] * scale[-m:]) ** 2, axis=0)
        if np.all(np.diag(realized.residual.T @ realized.residual) <= CLEAN * power):
            return _next_phase(refined._replace(recursion=None))
        floor = float(size[1]) + realized.Xi.size * np.log(len(samples)) / len(samples)
        found += _fits(samples, begin, structure, scale, noise, floor)
    old = refined.recursion
    if old is not None:
        begin = old.theta._replace(x=np.zeros_like(old.theta.x))
        m = begin.C.shape[0]
        own = floor + 2.0 * float(np.sum(np.log(old.scale[-m:] / scale[-m:])))
        found += _fits(samples, begin, old.structure, old.scale, noise, own)
    best = min(found, key=lambda pair: pair[1])[0] if found else None
    if best is not None and starts:
        size = np.linalg.norm(starts[0].state, axis=0)
        best = best._replace(
            singular_values=starts[0].singular_values,
            condition=float(np.linalg.cond(starts[0].state / size)))
    return _next_phase(refined._replace(recursion=best))


def _fits(
    samples: Array, begin: Theta, structure: Structure, scale: Array, noise: str, floor: float,
) -> list[tuple[Recursion, float]]:
    """Fit from one starting point: with its penalized cost (in the samples' own units), if there is one.

    With K = 0 first: that is the maximum likelihood for sensor noise, and for any noise a model that
    simulates well. A free gain takes its place only where it raises the likelihood beyond its price and the
    order suffices, judged by the long regression (floor, its penalized cost): a model of too low an order
    with a free gain would predict the next sample at the expense of everything slower. Otherwise the gain is
    fitted last, to the system as it is.
    """
    n, r = begin.B.shape
    U = np.ascontiguousarray(samples[:, :r] * scale[:r])
    Y = np.ascontiguousarray(samples[:, r:] * scale[r:])
    m, count = Y.shape[1], len(U)
    penalty = n * m * np.log(count) / count
    chosen = structure._replace(free_gain=False, only_gain=False)
    free = chosen._replace(free_gain=True)
    best = descend(U, Y, begin._replace(K=np.zeros_like(begin.K)), chosen, ITERATIONS)
    power = np.mean(Y ** 2, axis=0)
    simulates = best is not None and bool(np.all(np.diag(best.covariance) < UNEXPLAINED * power))
    cost = np.inf if best is None else best.cost
    gain = None
    if best is None or _gain_asked_for(U, Y, best, chosen, penalty):
        other = descend(U, Y, begin, free, ITERATIONS) if noise == 'any' else None
        better = other is not None and other.cost + penalty < cost
        if other is not None and better and (not simulates or other.cost + penalty < floor):
            best, chosen, cost = other, free, other.cost + penalty
        elif best is not None and simulates:
            gain = _gain_alone(U, Y, best.theta, begin.K, free._replace(only_gain=True))
    if best is None or not (simulates or chosen.free_gain):
        return []
    recursion = Recursion(
        theta=best.theta._replace(x=best.end), structure=chosen, scale=scale, P=best.directions,
        root=_arrive(covariance_root(best.information), best.arrival),
        covariance=best.covariance + CLEAN * np.diag(power),
        weight=float(count), widening=_widening(U, Y, best, chosen), strikes=0,
        gain=best.theta.K if gain is None else gain, singular_values=np.zeros(0), condition=float('nan'))
    return [(recursion, cost - 2.0 * float(np.sum(np.log(scale[r:]))))]


def _gain_alone(U: Array, Y: Array, theta: Theta, begin: Array, structure: Structure) -> Array | None:
    """K (n, m) of the best predictor for a system that is held, from two starting points."""
    tried = [descend(U, Y, theta._replace(K=K), structure, ITERATIONS) for K in (begin, np.zeros_like(begin))]
    done = [fit for fit in tried if fit is not None]
    return min(done, key=lambda fit: fit.cost).theta.K if done else None


def _next_phase(refined: Refined) -> Refined:
    """From LONGEST samples on the stretch is let go: recursion with a fit, a new stretch without."""
    if refined.total < LONGEST:
        return refined
    if refined.recursion is None:
        return give_up(refined)
    return refined._replace(chunks=(), batch=False)


def give_up(refined: Refined) -> Refined:
    """Drop a fit that does not hold, and wait before the next: the plant may not be of this kind at all."""
    return start(refined.current.shape[1])._replace(total=-PAUSE)


def _arrive(root: Array, arrival: Array) -> Array:
    """Covariance root of [coordinates; state at the end] from that with the state at the start."""
    n = arrival.shape[0]
    moved_root: Array = np.vstack([root[:root.shape[0] - n], arrival @ root])
    return moved_root


def _gain_asked_for(U: Array, Y: Array, fit: Fit, structure: Structure, penalty: float) -> bool:
    """Score test of K = 0 at the fit: whether a gain would raise the likelihood by more than it costs."""
    full = structure._replace(free_gain=True)
    P = directions(fit.theta, full)
    information, gradient, _, _, _ = derivatives(U, Y, fit.theta, full, fit.covariance, P)
    if not np.all(np.isfinite(information)):
        return True
    root = covariance_root(information)
    gain = float(np.sum((root.T @ gradient) ** 2))
    return gain > penalty * len(U)


def _widening(U: Array, Y: Array, fit: Fit, structure: Structure, pieces: int = 16) -> float:
    """Scatter of the gradient over pieces of the stretch, as a factor on its standard deviation, >= 1.

    With white innovations the gradients of the pieces scatter as the information says; correlated or
    swelling residuals make them scatter more.
    """
    theta = fit.theta
    root = covariance_root(fit.information)
    sums = []
    X: Array | None = None
    edges = np.linspace(0, len(U), pieces + 1).astype(int)
    for a, b in itertools.pairwise(edges):
        _, gradient, _, X, end = derivatives(
            U[a:b], Y[a:b], theta, structure, fit.covariance, fit.directions, X)
        sums.append(root.T @ gradient)
        theta = theta._replace(x=end)
    gradients = np.array(sums)
    freedom = fit.information.shape[0]
    power = float(np.sum(gradients ** 2)) / freedom
    noise = np.sqrt(2.0 / (freedom * pieces))
    return float(np.sqrt(power)) if power > 1.0 + 4.0 * noise else 1.0


def update(refined: Refined) -> Refined:
    """One recursive block: parameters and state together, from the samples of the closed chunks."""
    old = refined.recursion
    assert old is not None
    samples = np.vstack(refined.chunks[-(BLOCK // CHUNK):])
    r = old.theta.B.shape[1]
    U = np.ascontiguousarray(samples[:, :r] * old.scale[:r])
    Y = np.ascontiguousarray(samples[:, r:] * old.scale[r:])
    k = old.root.shape[0]
    kept = old.root * np.sqrt(1.0 + len(U) / MEMORY)
    zeta, theta = np.zeros(k), old.theta
    arrival = np.zeros((0, k))
    for _ in range(2 if old.lost else 1):  # a state that was lost makes the first derivatives poor
        information, gradient, _, arrival, _ = derivatives(U, Y, theta, old.structure, old.covariance, old.P)
        H = kept.T @ information @ kept
        if not np.all(np.isfinite(H)):
            return give_up(refined)
        values, vectors = np.linalg.eigh(0.5 * (H + H.T))
        values = 1.0 + np.maximum(values, 0.0)
        zeta = zeta + vectors @ ((vectors.T @ (kept.T @ gradient - zeta)) / values)
        theta = moved(old.theta, old.P @ (kept @ zeta), old.structure)
    covariance, end = run(U, Y, theta)
    power = float(np.trace(np.linalg.solve(old.covariance, covariance))) / Y.shape[1]
    strikes = old.strikes + 1 if not power < MISFIT else 0
    if strikes >= 2 or not np.isfinite(power):
        return give_up(refined)
    root = kept @ (vectors / np.sqrt(values))
    share = len(U) / (old.weight + len(U))
    recursion = old._replace(
        theta=theta._replace(x=end), root=_arrive(root, arrival), strikes=strikes,
        gain=theta.K if old.structure.free_gain else old.gain, lost=False,
        covariance=(1.0 - share) * old.covariance + share * covariance,
        weight=min(old.weight + len(U), MEMORY))
    return refined._replace(chunks=refined.chunks if refined.batch else (), recursion=recursion)


def break_window(refined: Refined) -> Refined:
    """Samples are missing: what was learnt is kept, the state is unknown, the open stretch is over."""
    old = refined.recursion
    fresh = start(refined.current.shape[1])
    if old is None:
        return fresh
    n = old.theta.A.shape[0]
    k = old.root.shape[0]
    root = np.zeros((k, k))
    root[:k - n, :k - n] = triangle(old.root[:k - n].T).T[:, :k - n]
    root[k - n:, k - n:] = 10.0 * np.eye(n)  # signals are at unit power
    theta = old.theta._replace(x=np.zeros(n))
    return fresh._replace(batch=False, recursion=old._replace(theta=theta, root=root, lost=True))
