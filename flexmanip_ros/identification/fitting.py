"""The work that a ``refinement.Job`` asks for, and its place among the samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flexmanip_ros.identification import publication, refinement
from flexmanip_ros.identification.factor_kernel import Kinds
from flexmanip_ros.identification.prediction_error import derivatives, moved, run
from flexmanip_ros.identification.prediction_error_kernel import condition
from flexmanip_ros.identification.refinement import Answer, Job, Refined
from flexmanip_ros.identification.stretch import Recursion, arrive, fit_stretch
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.types import Array

MEMORY = 1_000_000.0
"""Samples after which parameters may have drifted by their own standard deviation."""
MISFIT = 3.0
"""Residual power of a block that ends a recursion; twice in a row."""


def solve(config: IdentifierParameters, job: Job) -> Answer:
    """Make the fit."""
    try:
        if job.R is None or job.scale is None:
            assert job.old is not None
            return Answer(_block(job.old, np.vstack(job.chunks)))
        return Answer(_stretch(config, job, job.R, job.scale))
    except np.linalg.LinAlgError:
        return Answer(None, failed=True)


def _stretch(config: IdentifierParameters, job: Job, R: Array, scale: Array) -> Recursion | None:
    """Fit the whole stretch from the subspace model and from the fit before, whichever ends better."""
    starts = [publication.from_factor(config, R, scale)]
    if config.order > len(config.outputs) and config.past_window > config.future_window:
        longer = replace(config, future_window=config.past_window)
        starts.append(publication.from_factor(longer, R, scale))
    return fit_stretch(
        np.vstack(job.chunks), [realized for realized, _, _ in starts if realized is not None], job.old,
        starts[0][2], config.direct_feedthrough, 'sensor' if config.refinement == 'output_error' else 'any')


def _block(old: Recursion, samples: Array) -> Recursion | None:
    """One recursive block, square-root covariance form: parameters and state together. None: no fit holds."""
    r = old.theta.B.shape[1]
    U = np.ascontiguousarray(samples[:, :r] * old.scale[:r])
    Y = np.ascontiguousarray(samples[:, r:] * old.scale[r:])
    k = old.root.shape[0]
    kept = old.root * np.sqrt(1.0 + len(U) / MEMORY)
    zeta, theta = np.zeros(k), old.theta
    arrival, root = np.zeros((0, k)), kept
    for _ in range(2 if old.lost else 1):  # a state that was lost makes the first derivatives poor
        information, gradient, _, arrival, _ = derivatives(U, Y, theta, old.structure, old.covariance, old.P)
        H = kept.T @ information @ kept
        if not np.all(np.isfinite(H)):
            return None
        root, step = kept.copy(), np.empty(k)
        condition(H, root, kept.T @ gradient - zeta, step)
        if not np.all(np.isfinite(step)):
            return None
        zeta = zeta + step
        theta = moved(old.theta, old.P @ (kept @ zeta), old.structure)
    covariance, end = run(U, Y, theta)
    power = float(np.trace(np.linalg.solve(old.covariance, covariance))) / Y.shape[1]
    strikes = old.strikes + 1 if not power < MISFIT else 0
    if strikes >= 2 or not np.isfinite(power):
        return None
    share = len(U) / (old.weight + len(U))
    return old._replace(
        theta=theta._replace(x=end), root=arrive(root, arrival), strikes=strikes,
        gain=theta.K if old.structure.free_gain else old.gain, lost=False,
        covariance=(1.0 - share) * old.covariance + share * covariance,
        weight=min(old.weight + len(U), MEMORY))


def refine(config: IdentifierParameters, refined: Refined, samples: Array, fate: Kinds, R: Array, scale: Array
           ) -> Refined:
    """Hand samples to the prediction-error fit; ask for the work that is due, take that which was.

    samples: (N, r + m), N <= until_chunk(refined); R, scale: factor of the moments and scale after them.

    Refused samples break the stretch, and so do quiet ones: there is nothing to learn from them.
    """
    start = 0
    for k in np.flatnonzero(fate):
        refined = refinement.take(refined, samples[start:k]) if k > start else refined
        refined = broken(config, refined)
        start = int(k) + 1
    if start == len(samples):
        return refined
    refined = refinement.take(refined, samples[start:])
    if refined.job is not None and refined.total >= refined.due:
        refined = delivered(config, refined)
    if refinement.is_fit_due(refined):
        refined = refinement.ask_fit(refined, R, scale)
    elif refinement.is_block_due(refined):
        refined = refinement.ask_block(refined)
    return refined


def broken(config: IdentifierParameters, refined: Refined) -> Refined:
    """Samples are missing: take what is under way, and begin another stretch."""
    return refinement.break_window(delivered(config, refined)) if refined.total > 0 else refined


def delivered(config: IdentifierParameters, refined: Refined) -> Refined:
    """Take the result of the fit under way, computed here and now if nobody did."""
    if refined.job is None:
        return refined
    return refinement.deliver(refined, refined.answer or solve(config, refined.job))
