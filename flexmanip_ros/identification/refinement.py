"""The prediction-error fit kept up to date: whole stretches at first, then block by block.

After a start or an event the samples are kept and the fit is repeated on all of them each time their number
has doubled, from the subspace model and from the fit before, whichever ends better. From ``LONGEST`` samples
on the linearization is good enough to go on recursively: each block of samples updates parameters and state
together, in square-root covariance form, and is then forgotten. Memory is constant; the work is bounded.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flexmanip_ros.identification.moments import Realized, triangle
from flexmanip_ros.identification.prediction_error import derivatives, moved, run
from flexmanip_ros.identification.prediction_error_kernel import condition
from flexmanip_ros.identification.stretch import Recursion, arrive, fit_stretch
from flexmanip_ros.types import Array

CHUNK = 64
"""Samples handed over at once."""
FIRST, LONGEST = 256, 2048
"""Samples of the first fit, and of the last one that sees them all; multiples of CHUNK."""
BLOCK = 256
"""Samples of a recursive update; a multiple of CHUNK."""
MEMORY = 1_000_000.0
"""Samples after which parameters may have drifted by their own standard deviation."""
PARAMETERS = 80
"""With more parameters than this the subspace model is published as it is."""
PAUSE = 8192
"""Samples from a fit that failed to the next attempt; a multiple of CHUNK."""
MISFIT = 3.0
"""Residual power of a block that ends a recursion; twice in a row."""


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


def fit_all(
    refined: Refined, starts: list[Realized], scale: Array, feedthrough: bool, noise: str,
) -> Refined:
    """Fit the whole stretch anew, see ``stretch.fit_stretch``."""
    best = fit_stretch(np.vstack(refined.chunks), starts, refined.recursion, scale, feedthrough, noise)
    return _next_phase(refined._replace(recursion=best))


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
    arrival, root = np.zeros((0, k)), kept
    for _ in range(2 if old.lost else 1):  # a state that was lost makes the first derivatives poor
        information, gradient, _, arrival, _ = derivatives(U, Y, theta, old.structure, old.covariance, old.P)
        H = kept.T @ information @ kept
        if not np.all(np.isfinite(H)):
            return give_up(refined)
        root, step = kept.copy(), np.empty(k)
        condition(H, root, kept.T @ gradient - zeta, step)
        zeta = zeta + step
        theta = moved(old.theta, old.P @ (kept @ zeta), old.structure)
    covariance, end = run(U, Y, theta)
    power = float(np.trace(np.linalg.solve(old.covariance, covariance))) / Y.shape[1]
    strikes = old.strikes + 1 if not power < MISFIT else 0
    if strikes >= 2 or not np.isfinite(power):
        return give_up(refined)
    share = len(U) / (old.weight + len(U))
    recursion = old._replace(
        theta=theta._replace(x=end), root=arrive(root, arrival), strikes=strikes,
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
