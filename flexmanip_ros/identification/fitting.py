"""The work that a ``recursive_fit.FitRequest`` asks for, and its place among the samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import solve_triangular

from flexmanip_ros.identification import model_output, recursive_fit
from flexmanip_ros.identification.batch_fit import (
    BLOCK,
    UNEXPLAINED,
    Recursion,
    arrive,
    fit_stretch,
    unexplained,
)
from flexmanip_ros.identification.factor import Kinds
from flexmanip_ros.identification.moments import triangle
from flexmanip_ros.identification.prediction_error import derivatives, moved, run
from flexmanip_ros.identification.prediction_error_kernel import condition
from flexmanip_ros.identification.recursive_fit import FitRequest, FitResult, Refined
from flexmanip_ros.numerics.background import Background
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import Array

MEMORY = 1_000_000.0
"""Samples after which parameters may have drifted by their own standard deviation."""
NOISE_BLOCKS, DRIFT_BLOCKS, WENT_BLOCKS = 16, 4, 8
"""Blocks over which the noise is remembered, how fast the parameters move, and where they go."""
SURPRISE = 4.0
"""Standard deviations beyond which a block says that the parameters have gone elsewhere."""
AGE = 1.25
"""Blocks from the middle of one to when its result is read, in the mean."""
CHANCE = 2.0
"""Standard deviations that are left to chance before anything is taken to swell or to move."""
LARGEST_DRIFT = 1.4
"""Logarithm of the largest factor on a variance from one block."""


def solve(request: FitRequest) -> FitResult:
    """Make the fit."""
    try:
        if request.R is None or request.scale is None:
            assert request.old is not None
            return FitResult(_block(request.old, request.rows.u_y))
        return FitResult(_stretch(request, request.R, request.scale))
    except np.linalg.LinAlgError:
        return FitResult(None, failed=True)


def _stretch(request: FitRequest, R: Array, scale: Array) -> Recursion | None:
    """Fit the whole stretch, see ``batch_fit.fit_stretch``, from the subspace model of one or two windows."""
    config = request.config
    starts = [model_output.from_factor(config, R, scale)]
    if config.order > len(config.outputs) and config.past_window > config.future_window:
        longer = replace(config, future_window=config.past_window)
        starts.append(model_output.from_factor(longer, R, scale))
    found = fit_stretch(
        request.rows.u_y, [realized for realized, _, _ in starts if realized is not None],
        [fit for fit in (request.old, request.older) if fit is not None],
        starts[0][2], config.direct_feedthrough, 'sensor' if config.refinement == 'output_error' else 'any')
    if found is None or found.going == 0.0:
        return found
    return found._replace(behind=request.later / BLOCK + 1.0)  # the arm goes on until it is read


def _block(old: Recursion, samples: Array) -> Recursion | None:
    """One recursive block, square-root covariance form: parameters and state together. None: no fit holds."""
    r = old.theta.B.shape[1]
    U = np.ascontiguousarray(samples[:, :r] * old.scale[:r])
    Y = np.ascontiguousarray(samples[:, r:] * old.scale[r:])
    k = old.root.shape[0]
    kept = old.root * np.sqrt(1.0 + len(U) / MEMORY) * np.exp(0.5 * old.drift)
    if old.going > 0.0:
        kept = triangle(np.hstack([kept, old.going * old.went[:, None]]).T).T
    noise = old.covariance
    if not old.lost:  # what the model leaves (a moving arm is not linear) is noise to it
        before, _ = run(U, Y, old.theta)
        if not np.all(np.isfinite(before)):
            return None
        power = float(np.trace(np.linalg.solve(noise, before))) / Y.shape[1]
        known = min(old.weight, 2.0 * NOISE_BLOCKS * len(U))
        noise = noise * max(1.0, power - CHANCE * np.sqrt(2.0 / Y.shape[1] * (1.0 / len(U) + 1.0 / known)))
    zeta, theta, further = np.zeros(k), old.theta, 0.0
    arrival, root = np.zeros((0, k)), kept
    for _ in range(2 if old.lost else 1):  # a state that was lost makes the first derivatives poor
        information, gradient, _, arrival, _ = derivatives(U, Y, theta, old.structure, noise, old.P)
        H = kept.T @ information @ kept
        if not np.all(np.isfinite(H)):
            return None
        g = kept.T @ gradient
        root, step = kept.copy(), np.empty(k)
        condition(H.copy(), root, g - zeta, step)
        if not old.lost and is_surprising(float(g @ step), H, old.widening):
            further = drift(H, g, old.widening)
            kept, H, g = np.exp(0.5 * further) * kept, np.exp(further) * H, np.exp(0.5 * further) * g
            root = kept.copy()
            condition(H, root, g, step)
        if not np.all(np.isfinite(step)):
            return None
        zeta = zeta + step
        theta = moved(old.theta, old.P @ (kept @ zeta), old.structure)
    covariance, end = run(U, Y, theta)
    left = unexplained(covariance, Y)
    strikes = old.strikes + 1 if not left < UNEXPLAINED else 0
    if strikes >= 2 or not np.isfinite(left):
        return None
    share = max(len(U) / (old.weight + len(U)), 1.0 / NOISE_BLOCKS)
    step = kept @ zeta
    step[k - len(end):] = 0.0  # the state moves anyway
    moving = old.drift + further if further > 0.0 else 0.0
    went = old.went if old.lost else old.went + (step - old.went) / WENT_BLOCKS
    lasting, behind = going(went[:k - len(end)], kept[:k - len(end)], root[:k - len(end)])
    return old._replace(
        theta=theta._replace(x=end), root=arrive(root, arrival), strikes=strikes,
        gain=theta.K if old.structure.free_gain else old.gain, lost=False,
        covariance=(1.0 - share) * old.covariance + share * covariance,
        weight=min(old.weight + len(U), MEMORY),
        drift=old.drift + (moving - old.drift) / DRIFT_BLOCKS,
        went=went, going=lasting, behind=behind)


def is_surprising(size: float, H: Array, widening: float) -> bool:
    """Whether a block says that the parameters have gone elsewhere, or its residuals have a memory.

    H: (k, k) information of the block in coordinates of unit prior deviation, size: g' (I + H)^-1 g with its
    gradient g (k,). Parameters that stayed where they were give it the mean tr H and the variance 2 tr H^2.
    """
    deviation = np.sqrt(2.0) * float(np.linalg.norm(H))
    return bool(size > widening ** 2 * (float(np.trace(H)) + SURPRISE * deviation))


def drift(H: Array, g: Array, widening: float) -> float:
    """Logarithm >= 0 of the factor on the prior variances at which the block is what it should be."""
    values, vectors = np.linalg.eigh(H)
    values = np.maximum(values, 0.0)
    square = (vectors.T @ g) ** 2
    mean = widening ** 2 * float(values.sum())
    low, high = 0.0, LARGEST_DRIFT
    for _ in range(40):
        middle = 0.5 * (low + high)
        more = np.sum(square / (1.0 + np.exp(middle) * values)) > mean
        low, high = (middle, high) if more else (low, middle)
    return low


def going(went: Array, before: Array, after: Array) -> tuple[float, float]:
    """Share of the mean step ``went`` (a,) that is no chance, 0..1, how many steps the fit is behind.

    before, after: (a, k) roots of the covariance around a block. Estimates of parameters that stay where they
    are move too, by what a block teaches: T = 1 - after after', in units of the covariance before. Their mean
    over the blocks has the size tr T / (2 WENT_BLOCKS - 1), with the deviation sqrt(2) |T| / (..). T is also
    the share of an error that a block takes away: a steady drift stays (1 - T) / T steps ahead of the fit.
    """
    L = triangle(before.T).T
    step = solve_triangular(L, went, lower=True, check_finite=False)
    size = float(step @ step)
    if not size > 0.0:
        return 0.0, 0.0
    left = solve_triangular(L, after, lower=True, check_finite=False)
    T = np.eye(len(went)) - left @ left.T
    likely = float(np.trace(T)) + CHANCE * np.sqrt(2.0) * float(np.linalg.norm(T))
    share = float(np.sqrt(max(1.0 - likely / (2.0 * WENT_BLOCKS - 1.0) / size, 0.0)))
    gain = float(step @ T @ step) / size
    lag = min((1.0 - gain) / max(gain, 1e-9), float(WENT_BLOCKS))
    return share, share * (AGE + lag)


def refine(config: IdentifierParameters, refined: Refined, rows: Rows, outcome: Kinds, R: Array, scale: Array,
           background: Background) -> Refined:
    """Hand rows to the prediction-error fit; ask for the work that is due, take the result that is due.

    rows: at most until_chunk(refined); outcome: (N,) of each; R, scale: factor of the moments and scale after
    them. Rejected samples break the stretch, and so do quiet ones: there is nothing to learn from them.
    """
    first = rows.first
    for k in np.flatnonzero(outcome):
        row = rows.first + int(k)
        refined = recursive_fit.take(refined, rows.between(first, row)) if row > first else refined
        refined = recursive_fit.skip(broken(refined, background))
        first = row + 1
    if first == rows.until:
        return refined
    refined = recursive_fit.take(refined, rows.between(first, rows.until))
    if refined.request is not None and refined.end >= refined.due:
        refined = delivered(refined, background)
    before = refined.request
    if recursive_fit.is_fit_due(refined):
        refined = recursive_fit.ask_fit(config, refined, rows, R, scale)
    elif recursive_fit.is_block_due(refined):
        refined = recursive_fit.ask_block(config, refined, rows)
    if refined.request is not None and refined.request is not before:
        background.start(refined.request)
    return refined


def broken(refined: Refined, background: Background) -> Refined:
    """Samples are missing: take what is under way, and begin another stretch."""
    return recursive_fit.break_window(delivered(refined, background)) if refined.total > 0 else refined


def delivered(refined: Refined, background: Background) -> Refined:
    """Take the result of the fit under way."""
    if refined.request is None:
        return refined
    return recursive_fit.deliver(refined, background.result(refined.request))
