"""Run every compiled kernel once, so that the cache on disk is full before the first sample comes.

Use: ``python -m flexmanip_ros.cli.warm_up`` after an installation into a place that is later read-only, or
just to have the compiler's half minute behind you. `make setup` and `colcon build` do it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

from flexmanip_ros import pipeline
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters
from flexmanip_ros.plant import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord

Item = JointRecord | CaptureEvent

SAMPLES = 200
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


def recipes() -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield the parts in the order in which they are wanted."""
    made: list[Item] = []
    yield 'plant', lambda: made.extend(simulation())
    yield 'identifier', lambda: estimation('none', made)
    yield 'payload from the blocks', lambda: estimation('block', made)
    yield 'payload from the dynamics', lambda: estimation('structured', made)


def main() -> int:
    """Compile what can be compiled. Never an error: what fails here says so again where it is used."""
    begin = time.perf_counter()
    for name, recipe in recipes():
        try:
            recipe()
        except Exception as problem:  # whatever it is, an installation does not fail for it
            print(f'{name} is not compiled yet: {type(problem).__name__}: {problem}', file=sys.stderr)
    print(f'kernels ready after {time.perf_counter() - begin:.1f} s')
    return 0


if __name__ == '__main__':
    sys.exit(main())
