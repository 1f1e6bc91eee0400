"""Saves what the identifier knows, beside its work, and decides whether a saved state may be resumed."""

from __future__ import annotations

import threading
import time
from typing import NamedTuple

from flexmanip_ros import pipeline
from flexmanip_ros.errors import CheckpointError
from flexmanip_ros.io import checkpoint
from flexmanip_ros.parameters import IdentifierParameters, flatten, leaves

SECOND = 1_000_000_000


class Saved(NamedTuple):
    """What a checkpoint of the identifier holds."""

    config: IdentifierParameters
    state: pipeline.State


class Keeper:
    """One file. A state never changes after it was made, so another thread can write it meanwhile."""

    def __init__(self, config: IdentifierParameters) -> None:
        self._path = config.checkpoint_file
        self._period = config.checkpoint_period
        self._next = time.monotonic() + self._period
        self._thread: threading.Thread | None = None
        self.saves = 0
        self.problem = ''

    def resume(self, config: IdentifierParameters) -> pipeline.State | None:
        """Return the saved state, None when there is none. Raises CheckpointError when it is unfit."""
        found = checkpoint.load(self._path)
        if found is None:
            return None
        if not isinstance(found, Saved):
            raise CheckpointError(f"checkpoint '{self._path}' holds something else", 'it starts anew')
        for name in changed(found.config, config):
            raise CheckpointError(
                f"parameter '{name}' is not what it was when checkpoint '{self._path}' was made",
                'it starts anew')
        return pipeline.reconfigure(config, found.state)

    def due(self) -> bool:
        """Say whether it is time to save."""
        return time.monotonic() >= self._next and (self._thread is None or not self._thread.is_alive())

    def save_meanwhile(self, config: IdentifierParameters, state: pipeline.State) -> None:
        """Save on another thread."""
        self._next = time.monotonic() + self._period
        self._thread = threading.Thread(target=self.save, args=(config, state), name='checkpoint')
        self._thread.start()

    def save(self, config: IdentifierParameters, state: pipeline.State) -> None:
        """Save now; a problem is kept for the diagnostics."""
        try:
            checkpoint.save(self._path, Saved(config, state))
        except CheckpointError as error:
            self.problem = str(error)
        else:
            self.saves += 1
            self.problem = ''

    def finish(self) -> None:
        """Wait for a save that is under way."""
        if self._thread is not None:
            self._thread.join()


def changed(before: IdentifierParameters, now: IdentifierParameters) -> list[str]:
    """Return the parameters that differ and matter to the state."""
    free = {leaf.name for leaf in leaves(IdentifierParameters)
            if leaf.live or leaf.name.startswith('checkpoint_')}
    old, new = flatten(before), flatten(now)
    return [name for name in new if name not in free and old.get(name) != new[name]]


def too_old(config: IdentifierParameters, state: pipeline.State, stamp_ns: int) -> bool:
    """Say whether the first sample is too far from where a resumed state ended."""
    line = state.timeline
    return line is not None and abs(stamp_ns - line.last_ns) > config.checkpoint_max_age * SECOND
