"""Run every compiled kernel once, so that the cache on disk is full before the first sample comes.

Use: ``python -m flexmanip_ros.cli.warm_up`` after an installation into a place that is later read-only, or
just to have the compiler's minute behind you. `make setup` and `colcon build` do it.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from flexmanip_ros import pipeline
from flexmanip_ros.identification import validation
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters
from flexmanip_ros.payload.capture_detection import with_detected
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord, StateSpace

Item = JointRecord | CaptureEvent

SAMPLES = 1200
"""Enough for the refinement of the model to begin."""
PERIOD_NS = 1_000_000


def simulation() -> list[Item]:
    """Return what the simulated arm sends while it catches and lets go; steps it both ways."""
    config = PlantParameters()
    efforts = excitation.sequence(ExcitationParameters(), SAMPLES)
    events = (CaptureEvent(SAMPLES // 3 * PERIOD_NS, EventKind.CAPTURE),
              CaptureEvent(SAMPLES // 3 * 2 * PERIOD_NS, EventKind.RELEASE))
    gauged = replace(config, model='linear', sensors=replace(config.sensors, strain_cutoff=100.0))
    simulator.simulate(gauged, efforts[:3])
    state = simulator.init(config)
    for torques in efforts[:3]:
        state, _ = simulator.step(config, state, torques)
    return list(simulator.records(simulator.simulate(config, efforts, events), events))


def estimation(method: str, items: list[Item]) -> None:
    """Run the identifier both ways, sample by sample and in blocks."""
    config = replace(IdentifierParameters(), payload_method=method)
    for _ in pipeline.run(config, items):
        pass
    state = pipeline.init()
    for item in items[:40]:
        state, _ = pipeline.step(config, state, item)


def validation_scores() -> None:
    """Run a made-up model over made-up signals in the three ways that a score needs."""
    column = np.ones((2, 1))
    model = StateSpace(np.eye(2) * 0.5, column, column.T.copy(), np.zeros((1, 1)), column, 1e-3)
    u, y = np.ones((20, 1)), np.ones((20, 1))
    validation.simulate(model, u)
    validation.predict(model, u, y, validation.state_at_end(model, u, y))


def recipes() -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield the parts in the order in which they are wanted."""
    made: list[Item] = []
    yield 'plant', lambda: made.extend(simulation())
    yield 'identifier', lambda: estimation('none', made)
    yield 'payload from the blocks', lambda: estimation('block', made)
    yield 'payload from the dynamics', lambda: estimation('structured', made)
    yield 'detection', lambda: deque(with_detected(IdentifierParameters(), made), maxlen=0)
    yield 'validation', validation_scores


def drop_stale(package: Path) -> int:
    """Delete compiled functions older than any kernel's source; return how many.

    numba looks at the file of a function alone, not at those of the functions it calls.
    """
    newest = max(path.stat().st_mtime_ns for path in package.rglob('*.py')
                 if '@kernel' in (text := path.read_text(encoding='utf-8')) or '@inlined' in text)
    stale = [path for path in package.rglob('__pycache__/*.nb[ic]') if path.stat().st_mtime_ns < newest]
    for path in stale:
        path.unlink(missing_ok=True)
    return len(stale)


def main() -> int:
    """Compile what can be compiled. Never an error: what fails here says so again where it is used."""
    begin = time.perf_counter()
    try:
        drop_stale(Path(__file__).parents[1])
    except OSError as problem:  # a place that is read-only has no stale files of its own making
        print(f'compiled functions are left as they are: {problem}', file=sys.stderr)
    for name, recipe in recipes():
        try:
            recipe()
        except Exception as problem:  # whatever it is, an installation does not fail for it
            print(f'{name} is not compiled yet: {type(problem).__name__}: {problem}', file=sys.stderr)
    print(f'kernels ready after {time.perf_counter() - begin:.1f} s')
    return 0


if __name__ == '__main__':
    sys.exit(main())
