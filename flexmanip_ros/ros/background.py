"""Work of the identifier that must not wait in front of a sample: saved states, compiling."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from flexmanip_ros import pipeline
from flexmanip_ros.errors import CheckpointError, SignalError
from flexmanip_ros.identification import batch_fit, recursive_fit
from flexmanip_ros.io import checkpoint
from flexmanip_ros.parameters import IdentifierParameters, flatten, leaves
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord


class Saved(NamedTuple):
    """What a checkpoint of the identifier holds."""

    config: IdentifierParameters
    state: pipeline.State


class CheckpointWriter:
    """Writes the identifier's state to ``checkpoint_file`` every ``checkpoint_period``, on a thread.

    A state never changes after it was made, so the thread can write it while samples go on.
    """

    def __init__(self, config: IdentifierParameters) -> None:
        self._path = config.checkpoint_file
        self._period_s = config.checkpoint_period
        self._next_s = time.monotonic() + self._period_s
        self._thread: threading.Thread | None = None
        self.saves = 0
        self.problem = ''
        """Why the last save failed; empty when it did not."""

    def load(self, config: IdentifierParameters) -> pipeline.State | None:
        """Return the saved state, None when there is no file.

        Raises CheckpointError for a file that cannot be read or was written with other parameters.
        """
        found = checkpoint.load(self._path)
        if found is None:
            return None
        if not isinstance(found, Saved):
            raise CheckpointError(f"checkpoint '{self._path}' holds no state of the identifier",
                                  'the identifier starts with nothing known')
        for name in changed(found.config, config):
            raise CheckpointError(
                f"parameter '{name}' has another value than when checkpoint '{self._path}' was written",
                'the identifier starts with nothing known')
        return pipeline.reconfigure(config, found.state)

    def save_when_due(self, config: IdentifierParameters, state: pipeline.State) -> None:
        """Save on a thread if ``checkpoint_period`` has passed and no save is under way."""
        if time.monotonic() < self._next_s or (self._thread is not None and self._thread.is_alive()):
            return
        self._next_s = time.monotonic() + self._period_s
        self._thread = threading.Thread(target=self.save, args=(config, state), name='checkpoint')
        self._thread.start()

    def save(self, config: IdentifierParameters, state: pipeline.State) -> None:
        """Save now; a failure is kept in ``problem`` for the diagnostics."""
        try:
            checkpoint.save(self._path, Saved(config, state))
        except CheckpointError as error:
            self.problem = str(error)
        else:
            self.saves += 1
            self.problem = ''

    def join(self) -> None:
        """Wait for a save that is under way."""
        if self._thread is not None:
            self._thread.join()


def changed(before: IdentifierParameters, now: IdentifierParameters) -> list[str]:
    """Return the names of the parameters that differ and on which the state depends."""
    free = {leaf.name for leaf in leaves(IdentifierParameters)
            if leaf.live or leaf.name.startswith('checkpoint_')}
    old, new = flatten(before), flatten(now)
    return [name for name in new if name not in free and old.get(name) != new[name]]


def too_old(config: IdentifierParameters, state: pipeline.State, stamp_ns: int) -> bool:
    """Whether a sample is further than ``checkpoint_max_age`` from the last sample of a saved state."""
    return state.payload is not None and abs(stamp_ns - state.payload.last_ns) > config.checkpoint_max_age * 1e9


WARM_UP_EVENT = 40
"""Samples before the event of the warm-up: more than are needed to learn the sample time."""
WARM_UP_SAMPLES = WARM_UP_EVENT + 3 * batch_fit.BLOCK + 2 * recursive_fit.CHUNK
"""Samples of the warm-up: until the fits after the event were made and a block has followed."""
WARM_UP_STEP_NS = 1_000_000


def warm_up(config: IdentifierParameters) -> None:
    """Compile or load every kernel: run the pipeline on made-up samples of the configured signals and an event.

    Raises ParameterError when the configuration cannot work at all, before any message comes.
    """
    try:
        for _ in pipeline.run(config, _made_up(config)):
            pass
    except SignalError:  # a configured signal that even these messages, with every field filled, do not carry
        return


def _made_up(config: IdentifierParameters) -> Iterator[JointRecord | CaptureEvent]:
    """Yield joints that swing at two frequencies, driven by random torques, and a capture."""
    names = tuple(dict.fromkeys(
        signal.rpartition('/')[0] for signal in (*config.inputs, *config.outputs, *config.angles)))
    rng = np.random.default_rng(0)
    step = np.exp(1j * np.array([0.1, 0.2]) - 0.01)
    shape = rng.standard_normal((2, len(names)))
    state = np.zeros(2, dtype=complex)
    for k in range(WARM_UP_SAMPLES):
        if k == WARM_UP_EVENT:
            yield CaptureEvent((k - 1) * WARM_UP_STEP_NS, EventKind.CAPTURE)
        effort = rng.standard_normal(len(names))
        noise = 1e-3 * rng.standard_normal((2, len(names)))
        yield JointRecord(k * WARM_UP_STEP_NS, names, 0.01 * (state.imag @ shape + noise[0]),
                          state.real @ shape + noise[1], effort)
        state = step * state + shape @ effort / math.sqrt(len(names))
