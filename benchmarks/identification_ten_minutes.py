"""Claim: for ten minutes after a capture the model of every configuration follows the arm, and its bands hold.

`default`: the default plant under the default torques; nothing damps it, and it turns. `wander`: a damped arm whose
joints a soft controller leads slowly over many configurations, torques on top. Readings count from 3 s after the
capture on; truth: the linearized arm at the true chords of the instant. Use: identification_ten_minutes.py [seconds]
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from typing import Any, NamedTuple

import claims
import numpy as np
from identification_moving_arm import frequencies
from identification_status import renamed

from flexmanip_ros import pipeline
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters, configure
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import Array, CaptureEvent, Estimate, EventKind, JointBlock, Status

CAPTURE_S, SETTLED_S = 3.0, 3.0
CONFIG = configure(IdentifierParameters, {  # angles that are named are read without a payload, too
    'payload_method': 'none', 'inputs': ('shoulder/effort', 'elbow/effort'),
    'angles': ('shoulder/position', 'elbow/position')})
EVENT = CaptureEvent(round(CAPTURE_S * 1e9), EventKind.CAPTURE)
PLANTS = {
    'default': configure(PlantParameters, {'payload_mass': 20.0}),
    'wander': configure(PlantParameters, {'payload_mass': 25.0, 'arm.damping_ratio': 0.003})}
STIFFNESS, DAMPING = 150.0, 250.0
"""Of the soft controller, at both joints [N m/rad, N m s/rad]."""
SLOWLY_S = 0.1
"""Time over which it averages what it measures, so that it does not excite the bends [s]."""
SWAYS = (((0.25, 37.0), (0.15, 91.0)), ((0.9, 53.0), (0.5, 133.0)))
"""Of each joint's goal about its first angle: amplitudes [rad] and periods [s]."""
BLOCK = 1000


class Run(NamedTuple):
    """Messages of a run, and the true chords (N, 2) [rad] over time."""

    items: list[JointBlock | CaptureEvent]
    chords: Array


def goals(plant: PlantParameters, count: int) -> Array:
    """Return the angles (N, 2) [rad] to which the soft controller leads the joints."""
    t = np.arange(count) / plant.rate
    return np.column_stack([first + sum(size * np.sin(2.0 * np.pi * t / period) for size, period in sways)
                            for first, sways in zip(plant.initial_angles, SWAYS, strict=True)])


def led(plant: PlantParameters, added: Array) -> Array:
    """Return the torques (N, 2) under which the joints follow their goals, with ``added`` on top."""
    state, torques, goal = simulator.init(plant), np.empty_like(added), goals(plant, len(added))
    torque, capture, slow = added[0], round(CAPTURE_S * plant.rate), np.zeros(4)
    slow[:2] = goal[0]
    for k in range(len(added)):
        if k == capture:
            state = simulator.attach(plant, state)
        torques[k] = torque
        state, record = simulator.step(plant, state, torque)
        assert record is not None
        slow += (np.concatenate([record.position[:2], record.velocity[:2]]) - slow) / (SLOWLY_S * plant.rate)
        torque = added[k] + STIFFNESS * (goal[k] - slow[:2]) - DAMPING * slow[2:]
    return torques


def simulated(name: str, seconds: float) -> Run:
    """Run one of ``PLANTS``."""
    plant = PLANTS[name]
    torques = excitation.sequence(ExcitationParameters(), round(seconds * plant.rate))
    if name == 'wander':
        torques = led(plant, torques)
    run = simulator.simulate(plant, torques, [EVENT])
    exact = replace(plant, noise='none', arm=replace(plant.arm, angle_convention='chord'))
    chords = simulator.simulate(exact, torques, [EVENT]).position[:, :2]
    effort = np.hstack([run.effort, np.zeros_like(run.effort)])
    blocks = [JointBlock(run.names, *(part[at:at + BLOCK] for part in (
        run.stamp_ns, run.position, run.velocity, effort))) for at in range(0, len(chords), BLOCK)]
    return Run(renamed([EVENT, *blocks]), chords)


def reading(plant: PlantParameters, run: Run, estimate: Estimate) -> list[float]:
    """Return time, whether it is TRACKING with both modes, errors of f1 and f2, deviations, relative to the truth."""
    row = min(round(estimate.stamp_ns * 1e-9 * plant.rate), len(run.chords) - 1)
    truth = frequencies(plant, run.chords[row], plant.payload_mass)
    both = len(estimate.modes) == 2
    good = both and estimate.model_status is Status.TRACKING
    modes = estimate.modes if both else ()
    found = [(mode.frequency_hz, mode.frequency_std_hz) for mode in modes] or [(np.nan, np.nan)] * 2
    said = np.array(found)
    return [estimate.stamp_ns * 1e-9, float(good), *(said[:, 0] / truth - 1.0), *(said[:, 1] / truth)]


def figures(data: Array) -> dict[str, float]:
    """Return what readings (N, 6) are worth: errors and bands of those that are TRACKING."""
    good = data[data[:, 1] > 0.0]
    found = {'readings': len(data), 'tracking_percent': 100.0 * float(np.mean(data[:, 1]))}
    for i in (0, 1):
        error, band = np.abs(good[:, 2 + i]), 1.96 * good[:, 4 + i]
        values = {'median': np.median(error), '19_of_20': np.quantile(error, 0.95), 'inside': np.mean(error < band),
                  'beyond_3': np.mean(error > 3.0 * band)} if len(good) else {}
        found |= {f'f{i + 1}_{name}_percent': 100.0 * float(value) for name, value in values.items()}
    return found


def kept(state: pipeline.State) -> int:
    """Return the number of values that the state keeps: rows of the log, and the model's arrays."""
    assert state.identifier is not None
    refined = state.identifier.estimator.rpbsid.refined
    assert refined is not None
    varying = refined.varying
    arrays = [] if varying is None else [part for part in (*varying, *varying.past) if isinstance(part, np.ndarray)]
    return state.log.end - state.log.start + sum(part.size for part in arrays)


def follow(name: str, seconds: float) -> dict[str, Any]:
    """Identify one run; print its minutes and return its figures."""
    run, plant = simulated(name, seconds), PLANTS[name]
    rows, sizes, walls, begin = [], [], [], time.perf_counter()
    for state, estimate in pipeline.replay(CONFIG, run.items):
        if estimate is not None and estimate.model_is_new and estimate.stamp_ns >= (CAPTURE_S + SETTLED_S) * 1e9:
            rows.append(reading(plant, run, estimate))
            sizes.append(kept(state))
            walls.append(time.perf_counter() - begin)
    data = np.array(rows)
    half, wall = len(data) // 2, np.array(walls)
    for first in np.arange(0.0, seconds, 60.0):
        part = data[(data[:, 0] >= first) & (data[:, 0] < first + 60.0)]
        show(f'{name}, {first:.0f} s on', figures(part))
    found = {'case': name, 'seconds': seconds, **figures(data),
             'kept_late_over_early': max(sizes[half:]) / max(sizes[:half]),
             'time_late_over_early': (wall[-1] - wall[half]) / (wall[half] - wall[0])}
    show(name, found)
    return found


def show(words: str, found: dict[str, Any]) -> None:
    """Print a row."""
    print(f'{words:<24}' + '  '.join(f'{name} {value:.3g}' for name, value in found.items()
                                     if isinstance(value, float)), flush=True)


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 600.0
    table = [follow(name, seconds) for name in PLANTS]
    claims.write('identification_ten_minutes', table)


if __name__ == '__main__':
    main()
