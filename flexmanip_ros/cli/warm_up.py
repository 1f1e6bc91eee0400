"""Compile the kernels: run each once, so that the cache on disk is full before the first sample comes.

Use: ``python -m flexmanip_ros.cli.warm_up``. `make setup` and `colcon build` do it. Two processes compile side by side.
The payload's filter takes longest: one process compiles its prediction, and then the filter, which finds the functions
that it calls in the cache, as the other process compiles them first.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from flexmanip_ros import pipeline
from flexmanip_ros.identification import validation
from flexmanip_ros.numerics.compiled import compile_for
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters, TriggerParameters
from flexmanip_ros.payload import (
    capture_detection,
    capture_detection_kernel,
    filter_state,
    gauss_newton,
    measurement_update,
    moving_horizon,
    process_model,
    structured,
)
from flexmanip_ros.payload.structured_model import build, sensors
from flexmanip_ros.samples.sample_log import log_of
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, StateSpace

SAMPLES = 1200
"""Number of samples, enough for the prediction-error fit to begin."""
REFINED = 2600
"""Number of samples, enough for the fit to continue block by block, and for a test of a drift."""
MOVING_SAMPLES = 1400
"""Number of samples, enough for the model of every configuration to begin."""
PERIOD_NS = 1_000_000
OPTIMIZATION = {'NUMBA_OPT': '1'}
"""Level of optimization, if none is set. At level 3, numba's default, compiling takes a fifth longer. The functions
take the same time at both levels, and give the same bits, as no level reorders sums without fast-math."""
GARBAGE = 100_000
"""Number of new objects after which Python looks for garbage, in place of 700. The compiler makes millions of objects,
most of which stay until the end: looking for garbage less often saves 3 of 50 s and takes 60 MB more."""


def simulator_and_identifier() -> None:
    """Simulate a capture and a release, identify a model from the samples, and simulate and predict with a model."""
    plant = PlantParameters()
    efforts = excitation.sequence(ExcitationParameters(), SAMPLES)
    events = (CaptureEvent(SAMPLES // 3 * PERIOD_NS, EventKind.CAPTURE),
              CaptureEvent(SAMPLES // 3 * 2 * PERIOD_NS, EventKind.RELEASE))
    gauged = replace(plant, model='linear', sensors=replace(plant.sensors, strain_cutoff=100.0))
    simulator.simulate(gauged, efforts[:3])
    state = simulator.init(plant)
    for torques in efforts[:3]:
        state, _ = simulator.step(plant, state, torques)
    longer = excitation.sequence(ExcitationParameters(), REFINED)
    for method, torques, happens in (('none', longer, ()), ('block', efforts, events)):
        messages = simulator.records(simulator.simulate(plant, torques, happens), happens)
        for _ in pipeline.run(replace(IdentifierParameters(), payload_method=method), messages):
            pass
    empty = simulator.simulate(plant, excitation.sequence(ExcitationParameters(), MOVING_SAMPLES), ())
    named = ('joint2/position', 'joint1/position')  # other angles than the default are read without a payload
    config = replace(IdentifierParameters(), payload_method='none', angles=named)
    for _ in pipeline.run(config, simulator.records(empty)):
        pass
    column = np.ones((2, 1))
    model = StateSpace(np.eye(2) * 0.5, column, column.T.copy(), np.zeros((1, 1)), column, 1e-3)
    u, y = np.ones((20, 1)), np.ones((20, 1))
    validation.simulate(model, u)
    validation.predict(model, u, y, validation.state_at_end(model, u, y))
    validation.predict_ahead(model, u, y, 2)


def steps_of_the_filter() -> None:
    """Compile what the payload's filter calls, but its prediction."""
    config = IdentifierParameters()
    model = build(config)
    assert model is not None
    memory = filter_state.memory(model.payload + model.motion.kind.size, len(model.roles),
                                 model.motion.effort.size)
    seen = sensors(config, model, 1e-3, np.zeros(len(config.arm.link_length)))
    fit = model.motion, seen, memory
    compile_for(moving_horizon.keep_possible, model.motion, memory, 0.0)
    for step in (gauss_newton.close_horizon, gauss_newton.finish_iteration, gauss_newton.reject_step,
                 moving_horizon.strays):
        compile_for(step, *fit)
    compile_for(measurement_update.measure, *fit[1:], np.zeros(1), np.zeros(1), model.motion.opened)
    compile_for(moving_horizon.diffuse, *fit, 0.0)
    compile_for(capture_detection_kernel.traces, *fit, capture_detection_kernel.UNWATCHED, np.zeros((1, 1)), 0.0)


def payload() -> None:
    """Estimate a payload from small random signals, and look for captures in them."""
    signals = 1e-4 * np.random.default_rng(0).standard_normal((SAMPLES, 8))
    stamps = np.arange(SAMPLES) * PERIOD_NS
    rows = log_of(signals[:, :2], signals[:, 2:6], signals[:, 6:], stamps).rows(0, SAMPLES)
    config = IdentifierParameters()
    state = structured.init(config)
    assert state.model is not None
    compile_for(process_model.predict, state.model.motion, np.zeros(1), np.zeros((1, 1)), 0, np.zeros((1, 1)), 0.0, 0.0)
    state = structured.advance(config, state, rows.between(0, SAMPLES // 2))
    state = structured.event(config, state, CaptureEvent(int(stamps[SAMPLES // 2]), EventKind.CAPTURE))
    structured.estimate(config, structured.advance(config, state, rows.since(SAMPLES // 2)))
    trigger = TriggerParameters()
    capture_detection.advance(trigger, capture_detection.init(trigger), rows)


PARTS: dict[str, tuple[Callable[[], None], ...]] = {
    'payload': (payload,), 'simulator and identifier': (steps_of_the_filter, simulator_and_identifier)}


def main(argv: list[str] | None = None) -> int:
    """Compile all parts side by side, or the one that is named. A part that fails is compiled at its first use."""
    begin = time.perf_counter()
    named = (sys.argv[1:] if argv is None else argv)[:1]
    if named:
        gc.set_threshold(GARBAGE, 20, 100)
        for run in PARTS[named[0]]:
            run()
        print(f'  compiled: {named[0]} ({time.perf_counter() - begin:.0f} s)', flush=True)
        return 0
    print(f'compiling {len(PARTS)} parts side by side, about a minute the first time: {", ".join(PARTS)}', flush=True)
    running = {name: subprocess.Popen([sys.executable, '-m', 'flexmanip_ros.cli.warm_up', name],
                                      env=OPTIMIZATION | os.environ) for name in PARTS}
    for name, process in running.items():
        if process.wait() != 0:  # an installation does not fail because of this
            print(f'{name} is not compiled yet; it is compiled at its first use', file=sys.stderr)
    print(f'kernels ready after {time.perf_counter() - begin:.1f} s')
    return 0


if __name__ == '__main__':
    sys.exit(main())
