"""The long work of the identifier on a thread of its own, so that samples need not wait for it."""

from __future__ import annotations

import sys
from concurrent.futures import Future, ThreadPoolExecutor

from flexmanip_ros import pipeline
from flexmanip_ros.identification.fitting import solve
from flexmanip_ros.identification.recursive_fit import Answer, Job

TURN_S = 0.0002
"""A thread that computes gives way to a sample within this time; Python's own default is 5 ms."""
LATEST = 32
"""Samples before its result is needed at which a job begins, whatever else is due."""


class Worker:
    """Does one job at a time. The results are those of the pipeline alone, bit for bit."""

    def __init__(self) -> None:
        sys.setswitchinterval(TURN_S)
        self._pool = ThreadPoolExecutor(1, 'fit')
        self._job: Job | None = None
        self._future: Future[Answer] | None = None

    def attend(self, state: pipeline.State, *, published: bool) -> pipeline.State:
        """Hand in a result that is ready, or wait for one that is needed now; take up what is asked for.

        published: an estimate has just gone out. A job begins then, when nobody waits for the next one yet:
        beside a computing thread the kernel may keep a sample waiting for as long as that computes.
        """
        asked = pipeline.job(state)
        if self._future is not None and self._job is not None:
            current = asked is not None and asked[0] is self._job
            needed = current and asked is not None and asked[1] <= pipeline.GROUP
            if not self._future.done() and not needed:
                return state
            answer, job = self._future.result(), self._job
            self._future = self._job = None
            if current:
                return pipeline.answered(state, job, answer)
        if asked is not None and state.config is not None and (published or asked[1] <= LATEST):
            self._job = asked[0]
            self._future = self._pool.submit(solve, state.config, self._job)
        return state

    def close(self) -> None:
        """Wait for what is under way."""
        self._pool.shutdown()
