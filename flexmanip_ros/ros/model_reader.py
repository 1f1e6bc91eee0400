"""Models read out of the identifier on a thread of their own, so that samples need not wait for it."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from flexmanip_ros import pipeline, schedule
from flexmanip_ros.types import CaptureEvent, Estimate, JointRecord


class ModelReader:
    """Reads one model at a time. The results are those of the pipeline alone, bit for bit.

    What a model says of the payload counts from the next estimate on: before that one, it must have been
    taken.
    """

    def __init__(self, begin: Callable[[], object] = lambda: None) -> None:
        """begin: called first on the thread."""
        self._pool = ThreadPoolExecutor(1, 'model', initializer=begin)
        self._future: Future[tuple[pipeline.State, Estimate]] | None = None

    def ask(self, state: pipeline.State, due: pipeline.Due, done: Callable[[], object]) -> None:
        """Begin to read the model of an estimate. done: called, on that thread, when it can be taken."""
        assert self._future is None, 'the model before has not been taken'
        self._future = self._pool.submit(pipeline.read, state, due)
        self._future.add_done_callback(lambda _: done())

    @property
    def done(self) -> bool:
        """Whether a model can be taken without waiting."""
        return self._future is not None and self._future.done()

    def ready(self, state: pipeline.State, before: JointRecord | CaptureEvent | None) -> bool:
        """Whether a model is to be taken: it is there, or needed before that message (None: at any rate)."""
        if self._future is None:
            return False
        needed = isinstance(before, JointRecord) and schedule.awaits(state, before.stamp_ns)
        return needed or before is None or self.done

    def take(self, state: pipeline.State) -> tuple[pipeline.State, Estimate]:
        """Return the state knowing the model, and the estimate it came with; waits for it."""
        future, self._future = self._future, None
        assert future is not None, 'no model was asked for'
        read, estimate = future.result()
        return pipeline.adopted(state, read), estimate

    def close(self) -> None:
        """Wait for what is under way."""
        self._pool.shutdown()
