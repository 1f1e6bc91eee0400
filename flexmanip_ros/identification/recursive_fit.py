"""When the prediction-error fit is made, and what it works on: whole stretches at first, then blocks.

After a start or an event the samples are kept and the fit is repeated on all of them each time their number
has doubled. From ``LONGEST`` samples on the linearization is good enough to go on recursively: each block of
samples updates parameters and state together and is then forgotten. Memory is constant; the work is bounded.

A fit takes far longer than the time between two samples. So it is asked for as a ``Job`` that holds all it
depends on, and its result is taken a fixed number of samples later: whoever runs the samples may work on it
meanwhile, and the numbers do not depend on when it was ready.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from flexmanip_ros.identification.batch_fit import BLOCK, Recursion
from flexmanip_ros.identification.moments import triangle
from flexmanip_ros.types import Array

CHUNK = 64
"""Samples handed over at once."""
FIRST, LONGEST = 256, 2048
"""Samples of the first fit, and of the last one that sees them all; multiples of CHUNK."""
DELAY = 4
SOONEST = 128
"""A fit of N samples is taken N / DELAY samples later, and at least so many."""
SOONEST_S, EACH_S = 0.1, 2e-4
"""Nor sooner than this, nor than so much for each of its samples [s]: at 1 kHz that is less."""
BLOCK_S = 0.06
"""A block is taken so much later [s], at least CHUNK samples, and less than BLOCK: so it catches up."""
LATEST = 4096
"""Nor later than this: what is kept meanwhile is bounded, at any rate."""
PARAMETERS = 80
"""With more parameters than this the subspace model is published as it is."""
PAUSE = 8192
"""Samples from a fit that failed to the next attempt; a multiple of CHUNK."""


class Job(NamedTuple):
    """A fit to be made.

    chunks: its samples, in arrays (CHUNK, r + m); R: (q, q) factor of the moments and scale: (r + m,), both
    None for the update by a block; old: the fit before, if any; older: that of before the last event, where
    it is another; later: samples from its last one until the result is taken.
    """

    chunks: tuple[Array, ...]
    R: Array | None
    scale: Array | None
    old: Recursion | None
    older: Recursion | None = None
    later: int = 0


class Answer(NamedTuple):
    """What a job gave: None where nothing fits. failed: a decomposition did."""

    recursion: Recursion | None
    failed: bool = False


class Refined(NamedTuple):
    """What the refinement remembers.

    Closed chunks (CHUNK, r + m) never written to again, the open one, samples since the start (negative:
    still to wait), and the fit. batch: the fit still sees every sample since the start; seen: samples from
    the first chunk on that the fit has taken in; job: under way, its result is taken at ``due`` samples;
    answer: to it, if it is known by now; before: the fit of before the last event, to start from; since_ns:
    stamp of the first sample.
    """

    chunks: tuple[Array, ...]
    current: Array
    total: int
    batch: bool
    recursion: Recursion | None
    seen: int = 0
    job: Job | None = None
    due: int = 0
    answer: Answer | None = None
    before: Recursion | None = None
    since_ns: int = 0


def start(width: int, before: Recursion | None = None) -> Refined:
    """Begin without a fit."""
    return Refined((), np.zeros((CHUNK, width)), 0, True, None, before=before)


def restart(refined: Refined) -> Refined:
    """Begin anew: the plant has changed, and yet is another of its kind."""
    return start(refined.current.shape[1], refined.recursion or refined.before)


def until_chunk(refined: Refined) -> int:
    """Samples until the next piece of work (at least 1)."""
    return CHUNK - refined.total % CHUNK


def take(refined: Refined, samples: Array, first_ns: int = 0) -> Refined:
    """Store samples (k, r + m), k <= until_chunk(refined), the first of them stamped first_ns."""
    if refined.total < 0:
        return refined._replace(total=refined.total + len(samples))
    if refined.total == 0:
        refined = refined._replace(since_ns=int(first_ns))
    current = refined.current.copy()
    at = refined.total % CHUNK
    current[at:at + len(samples)] = samples
    refined = refined._replace(current=current, total=refined.total + len(samples))
    if refined.total % CHUNK == 0:
        refined = refined._replace(chunks=(*refined.chunks, current))
    return refined


def is_fit_due(refined: Refined) -> bool:
    """Whether the whole stretch is to be fitted now: at FIRST samples and each time they double."""
    total = refined.total
    if not refined.batch or refined.job is not None or total <= 0 or total % FIRST:
        return False
    doublings = total // FIRST
    return doublings & (doublings - 1) == 0


def is_block_due(refined: Refined) -> bool:
    """Whether a recursive update is due."""
    waiting = len(refined.chunks) * CHUNK - refined.seen
    return refined.recursion is not None and refined.job is None and waiting >= BLOCK


def patience(refined: Refined, now_ns: int) -> int:
    """Samples until the result of a fit is taken, a multiple of CHUNK; now_ns: stamp of the last sample.

    From the stamps of the stretch, so that a replay waits as long as the live node.
    """
    count = refined.total
    needed = _chunks(refined, now_ns, max(SOONEST_S, EACH_S * count), LATEST)
    return max(SOONEST, count // DELAY, needed)


def _chunks(refined: Refined, now_ns: int, duration: float, most: int) -> int:
    """Samples, a multiple of CHUNK, that come in a time [s], by the stamps so far; 0 where unknown."""
    spacing = max(now_ns - refined.since_ns, 0) * 1e-9 / (refined.total - 1)
    return CHUNK * math.ceil(min(duration / spacing, most) / CHUNK) if spacing > 0.0 else 0


def ask_fit(refined: Refined, R: Array, scale: Array, now_ns: int = 0) -> Refined:
    """Ask for a fit of the whole stretch, see ``stretch.fit_stretch``."""
    old, older, *_ = *(fit for fit in (refined.recursion, refined.before) if fit is not None), None, None
    later = patience(refined, now_ns)
    job = Job(refined.chunks, R.copy(), scale.copy(), old, older, later)
    return refined._replace(job=job, due=refined.total + later)


def ask_block(refined: Refined, now_ns: int = 0) -> Refined:
    """Ask for an update by the oldest block that the fit has not seen."""
    first = refined.seen // CHUNK
    job = Job(refined.chunks[first:first + BLOCK // CHUNK], None, None, refined.recursion)
    later = max(CHUNK, _chunks(refined, now_ns, BLOCK_S, BLOCK - CHUNK))
    return refined._replace(job=job, due=refined.total + later)


def deliver(refined: Refined, answer: Answer) -> Refined:
    """Go on with the result of the job."""
    job = refined.job
    assert job is not None
    width = refined.current.shape[1]
    refined = refined._replace(job=None, answer=None)
    if answer.failed:  # the subspace model remains; a new stretch begins
        return start(width)
    if job.R is None:
        if answer.recursion is None and not refined.batch:
            return give_up(width)
        return _seen(refined._replace(recursion=answer.recursion), refined.seen + BLOCK)
    count = len(job.chunks) * CHUNK
    if answer.recursion is None and count >= LONGEST:
        return give_up(width)
    refined = refined._replace(recursion=answer.recursion, batch=count < LONGEST)
    return _seen(refined, count)


def _seen(refined: Refined, seen: int) -> Refined:
    """From LONGEST samples on, forget what the fit has taken in."""
    if refined.batch:
        return refined._replace(seen=seen)
    return refined._replace(chunks=refined.chunks[seen // CHUNK:], seen=0)


def give_up(width: int) -> Refined:
    """Drop a fit that does not hold, and wait before the next: the plant may not be of this kind at all."""
    return start(width)._replace(total=-PAUSE)


def break_window(refined: Refined) -> Refined:
    """Samples are missing: what was learnt is kept, the state is unknown, the open stretch is over."""
    old = refined.recursion
    fresh = start(refined.current.shape[1], refined.before)
    if old is None:
        return fresh
    n = old.theta.A.shape[0]
    k = old.root.shape[0]
    root = np.zeros((k, k))
    root[:k - n, :k - n] = triangle(old.root[:k - n].T).T[:, :k - n]
    root[k - n:, k - n:] = 10.0 * np.eye(n)  # signals are at unit power
    theta = old.theta._replace(x=np.zeros(n))
    return fresh._replace(batch=False, recursion=old._replace(theta=theta, root=root, lost=True))
