"""When the prediction-error fit is made, and what it works on: whole stretches at first, then blocks.

After a start or an event the fit is repeated on all samples since then, each time their number has doubled.
From ``LONGEST`` samples on the linearization is good enough to go on recursively: each block of samples updates
parameters and state together and is not read again. Memory is constant; the work is bounded.

A fit takes far longer than the time between two samples. So it is asked for as a ``FitRequest``, and its result is
taken a fixed number of samples later (``numerics.background``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flexmanip_ros.identification.batch_fit import BLOCK, Recursion
from flexmanip_ros.identification.moments import triangle
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import Rows
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


@dataclass(frozen=True, eq=False)
class FitRequest:
    """A fit to be made; ``background.Request``.

    rows: its samples, a slice of the sample log; R: (q, q) factor of the moments and scale: (r + m,), both
    None for the update by a block; old: the fit before, if any; older: that of before the last event, where
    it is another; later: samples from its last one until the result is taken.
    """

    config: IdentifierParameters
    rows: Rows
    R: Array | None
    scale: Array | None
    old: Recursion | None
    older: Recursion | None = None
    later: int = 0

    def solve(self) -> FitResult:
        """Make the fit."""
        from flexmanip_ros.identification import fitting  # it imports this module
        return fitting.solve(self)


class FitResult(NamedTuple):
    """What a request gave: None where nothing fits. failed: a decomposition did."""

    recursion: Recursion | None
    failed: bool = False


class Refined(NamedTuple):
    """What the refinement remembers.

    begin: row of the sample log with which the stretch began; it may still be to come (a pause after a fit
    that failed); end: the row after the last one taken; seen: the row after the last one that the fit has
    taken in; batch: the fit still sees every sample of the stretch; request: under way, its result is taken at
    row ``due``; before: the fit of before the last event, to start from; since_ns: stamp of the first sample.
    """

    begin: int
    end: int
    seen: int
    batch: bool = True
    recursion: Recursion | None = None
    request: FitRequest | None = None
    due: int = 0
    before: Recursion | None = None
    since_ns: int = 0

    @property
    def total(self) -> int:
        """Samples of the stretch; negative while it is still to begin."""
        return self.end - self.begin

    @property
    def closed(self) -> int:
        """Row up to which the stretch consists of whole chunks."""
        return self.begin + self.total // CHUNK * CHUNK


def start(row: int, before: Recursion | None = None) -> Refined:
    """Begin without a fit at a row of the sample log."""
    return Refined(row, row, row, before=before)


def restart(refined: Refined) -> Refined:
    """Begin again: the plant has changed, and yet is another of its kind."""
    return start(refined.end, refined.recursion or refined.before)


def first_needed(refined: Refined) -> int:
    """Return the first row of the sample log that will be read again."""
    return min(refined.end, refined.seen if not refined.batch else refined.begin)


def until_chunk(refined: Refined) -> int:
    """Samples until the next piece of work (at least 1)."""
    return CHUNK - refined.total % CHUNK


def take(refined: Refined, rows: Rows) -> Refined:
    """Take note of rows, at most ``until_chunk(refined)``."""
    if refined.total == 0:
        refined = refined._replace(since_ns=int(rows.stamp_ns[0]))
    return refined._replace(end=rows.until)


def is_fit_due(refined: Refined) -> bool:
    """Whether the whole stretch is to be fitted now: at FIRST samples and each time they double."""
    total = refined.total
    if not refined.batch or refined.request is not None or total <= 0 or total % FIRST:
        return False
    doublings = total // FIRST
    return doublings & (doublings - 1) == 0


def is_block_due(refined: Refined) -> bool:
    """Whether a recursive update is due."""
    waiting = refined.closed - refined.seen
    return refined.recursion is not None and refined.request is None and waiting >= BLOCK


def result_delay(refined: Refined, now_ns: int) -> int:
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


def ask_fit(config: IdentifierParameters, refined: Refined, rows: Rows, R: Array, scale: Array) -> Refined:
    """Ask for a fit of the whole stretch, see ``batch_fit.fit_stretch``; rows: the latest."""
    old, older, *_ = *(fit for fit in (refined.recursion, refined.before) if fit is not None), None, None
    later = result_delay(refined, int(rows.stamp_ns[-1]))
    request = FitRequest(config, rows.since(refined.begin).between(refined.begin, refined.closed), R.copy(),
                         scale.copy(), old, older, later)
    return refined._replace(request=request, due=refined.end + later)


def ask_block(config: IdentifierParameters, refined: Refined, rows: Rows) -> Refined:
    """Ask for an update by the oldest block that the fit has not seen; rows: the latest."""
    block = rows.since(refined.seen).between(refined.seen, refined.seen + BLOCK)
    request = FitRequest(config, block, None, None, refined.recursion)
    later = max(CHUNK, _chunks(refined, int(rows.stamp_ns[-1]), BLOCK_S, BLOCK - CHUNK))
    return refined._replace(request=request, due=refined.end + later)


def deliver(refined: Refined, result: FitResult) -> Refined:
    """Go on with the result of the request."""
    request = refined.request
    assert request is not None
    refined = refined._replace(request=None)
    if result.failed:  # the subspace model remains; a new stretch begins
        return start(refined.end)
    if request.R is None:
        if result.recursion is None and not refined.batch:
            return give_up(refined)
        return refined._replace(recursion=result.recursion, seen=refined.seen + BLOCK)
    count = len(request.rows)
    if result.recursion is None and count >= LONGEST:
        return give_up(refined)
    return refined._replace(recursion=result.recursion, batch=count < LONGEST, seen=refined.begin + count)


def give_up(refined: Refined) -> Refined:
    """Drop a fit that does not hold, and wait before the next: the plant may not be of this kind at all."""
    later = refined.end + PAUSE
    return Refined(later, refined.end, later)


def skip(refined: Refined) -> Refined:
    """Pass over one row, of a stretch that has not begun."""
    return refined._replace(begin=refined.begin + 1, end=refined.end + 1, seen=refined.seen + 1)


def break_window(refined: Refined) -> Refined:
    """Samples are missing: what was learnt is kept, the state is unknown, the open stretch is over."""
    old = refined.recursion
    fresh = start(refined.end, refined.before)
    if old is None:
        return fresh
    n = old.theta.A.shape[0]
    k = old.root.shape[0]
    root = np.zeros((k, k))
    root[:k - n, :k - n] = triangle(old.root[:k - n].T).T[:, :k - n]
    root[k - n:, k - n:] = 10.0 * np.eye(n)  # signals are at unit power
    theta = old.theta._replace(x=np.zeros(n))
    return fresh._replace(batch=False, recursion=old._replace(theta=theta, root=root, lost=True))
