"""Claim: in pick and place 5 % of the trusted payloads, 1 % of the trusted models are wrong at most.

A controlled arm catches an object of 0.5 to 60 kg, carries it to random angles and lets go, eight times in 128 s. The
controller's torques are all the excitation there is, and the arm rests between the moves. Cases: an arm with a damping
ratio of 0.005, with noise of encoders and gauges (0.02 mm, 1 mrad/s), with 25 dB, with 5 % of the messages lost, and
with friction in the joints and rotors, told and not told; and an arm at 100 Hz under a multisine. A payload is wrong
where its interval does not hold the mass; a model, where the band of a frequency misses the truth by three times its
width, or a mode is not there. Truth: the linearized arm at the angles of the last half second. Use:
identification_missions.py
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import claims
import numpy as np
from identification_moving_arm import frequencies
from identification_status import LATELY_S, misses, renamed

from flexmanip_ros import pipeline
from flexmanip_ros.arm.manipulator import chords, payload_array
from flexmanip_ros.control import controller
from flexmanip_ros.parameters import (
    ArmParameters,
    ControllerParameters,
    ExcitationParameters,
    IdentifierParameters,
    PlantParameters,
)
from flexmanip_ros.simulation import excitation, sensors, simulator
from flexmanip_ros.types import Array, CaptureEvent, EventKind, JointBlock, Mode, Status

ARM = ArmParameters(damping_ratio=0.005)
ROUGH = replace(ARM, joint_viscous_friction=(8.0, 1.5), joint_coulomb_friction=(2.0, 0.4), rotor_inertia=(3.0, 0.4))
CYCLES, CYCLE_S, SECONDS = 8, 15.0, 128.0
SENSORS = np.array([2e-5] * 4 + [1e-3] * 4)
"""Noise of angles and bends [rad, m] and of their rates [rad/s, m/s], standard deviations."""
TOLD_S = 0.3
"""Time after a capture at which the controller takes the mass over."""
BLOCK = 5000


class Run(NamedTuple):
    """Noise-free signals, and what was caught when: (stamp [ns], mass [kg], 0 for a release)."""

    stamp_ns: Array
    position: Array
    velocity: Array
    effort: Array
    caught: tuple[tuple[int, float], ...]


def plan(seed: int) -> tuple[list[tuple[float, float]], list[tuple[float, Array]]]:
    """Return times and masses of the captures and releases, and times and goals of the moves."""
    rng = np.random.default_rng(seed)
    events, moves = [], [(1.0, np.array([1.2, -0.6]))]
    for k in range(CYCLES):
        begin = 4.0 + k * CYCLE_S
        end = begin + CYCLE_S * rng.uniform(0.45, 0.6)
        events += [(begin, float(np.exp(rng.uniform(np.log(0.5), np.log(60.0))))), (round(end, 3), 0.0)]
        for time in (begin + rng.uniform(0.3, 3.0), end + rng.uniform(0.3, 2.0)):
            moves.append((time, rng.uniform([0.2, -1.8], [1.6, -0.2])))
    return events, moves


def moved(plant: PlantParameters, seed: int, torques: Array | None = None) -> Run:
    """Simulate the arm under given torques (N, 2), or under its controller, which then moves it."""
    events, moves = plan(seed)
    if torques is not None:
        return driven(plant, torques, events)
    known = replace(plant.arm, joint_viscous_friction=(0.0, 0.0), joint_coulomb_friction=(0.0, 0.0))
    law = ControllerParameters(arm=known, rate=plant.rate)
    return driven(plant, np.zeros((round(SECONDS * plant.rate), 2)), events, law, moves)


def driven(plant: PlantParameters, torques: Array, events: Sequence[tuple[float, float]],
           law: ControllerParameters | None = None, moves: Sequence[tuple[float, Array]] = ()) -> Run:
    """Simulate the arm under torques (N, 2), with the controller ``law`` on top; events, moves: see ``plan``."""
    waiting, to_go, caught, told = list(events), list(moves), list[tuple[int, float]](), list[tuple[float, float]]()
    body, state, own = simulator.init(plant), None if law is None else controller.init(law), np.zeros(2)
    rows, stamps = [], []
    for k, given in enumerate(torques):
        time = k / plant.rate
        while waiting and waiting[0][0] <= time:
            _, mass = waiting.pop(0)
            caught.append((simulator.stamp(plant, body), mass))
            told.append((time + TOLD_S, mass))
            body = simulator.attach(replace(plant, payload_mass=mass), body) if mass else simulator.release(plant, body)
        body, record = simulator.step(plant, body, own + given)
        assert record is not None
        stamps.append(record.stamp_ns)
        rows.append(np.concatenate([record.position, record.velocity, record.effort[:2]]))
        if law is None or state is None:
            continue
        while told and told[0][0] <= time:
            state = state._replace(trusted=payload_array(told.pop(0)[1], 0.0, (0.0, 0.0)))
        while to_go and to_go[0][0] <= time:
            state = controller.goto(state, to_go.pop(0)[1])
        state, own = controller.step(law, state, controller.Measured(record.position, record.velocity, np.zeros(2)))
    table = np.array(rows)
    return Run(np.array(stamps), table[:, :4], table[:, 4:8], table[:, 8:], tuple(caught))


def messages(run: Run, noise: Array, lost: float, seed: int) -> list[JointBlock | CaptureEvent]:
    """Return noisy messages and events in order, as other joints, so that the angles are named."""
    rng = np.random.default_rng(seed)
    position = run.position + noise[:4] * rng.standard_normal(run.position.shape)
    velocity = run.velocity + noise[4:] * rng.standard_normal(run.velocity.shape)
    effort = np.hstack([run.effort, np.zeros_like(run.effort)])
    kept = rng.random(len(position)) >= lost
    names = ('joint1', 'joint2', 'link1_bend', 'link2_bend')
    items: list[JointBlock | CaptureEvent] = []
    first = 0
    for stamp, mass in (*run.caught, (int(run.stamp_ns[-1]) + 1, 0.0)):
        until = int(np.searchsorted(run.stamp_ns, stamp))
        rows = first + np.flatnonzero(kept[first:until])
        items += [JointBlock(names, run.stamp_ns[some], position[some], velocity[some], effort[some])
                  for some in np.split(rows, range(BLOCK, len(rows), BLOCK)) if len(some)]
        items.append(CaptureEvent(stamp, EventKind.CAPTURE if mass else EventKind.RELEASE))
        first = until
    return renamed(items[:-1])


def held(run: Run, stamp_ns: int) -> float:
    """Return the mass that the arm holds at a stamp [kg]."""
    return next((mass for stamp, mass in reversed(run.caught) if stamp <= stamp_ns), 0.0)


def is_wrong(plant: PlantParameters, run: Run, stamp_ns: int, modes: Sequence[Mode]) -> bool:
    """Whether a reading misses the truth of the half second before this stamp, see ``misses``."""
    row = int(np.searchsorted(run.stamp_ns, stamp_ns))
    lately = run.position[max(0, row - round(LATELY_S * plant.rate)):row + 1, :2]
    return misses(modes, frequencies(plant, chords(plant.arm, lately.mean(axis=0)), held(run, stamp_ns)))


def row_of(name: str, plant: PlantParameters, told: ArmParameters, run: Run, items: list[JointBlock | CaptureEvent]
           ) -> dict[str, Any]:
    """Identify one run, told this arm, and count its estimates."""
    config = IdentifierParameters(
        arm=told, inputs=('shoulder/effort', 'elbow/effort'), angles=('shoulder/position', 'elbow/position'))
    counts = dict.fromkeys(('estimates', 'trusted', 'outside', 'readings', 'tracking', 'wrong'), 0)
    for _, estimate in pipeline.replay(config, items):
        if estimate is None:
            continue
        payload, mass = estimate.payload, held(run, estimate.stamp_ns)
        assert payload is not None
        trusted = payload.status is Status.TRACKING
        counts['estimates'] += 1
        counts['trusted'] += trusted
        counts['outside'] += trusted and not payload.lower <= mass <= payload.upper
        if estimate.model_is_new and estimate.model is not None:
            tracking = estimate.model_status is Status.TRACKING
            counts['readings'] += 1
            counts['tracking'] += tracking
            counts['wrong'] += tracking and is_wrong(plant, run, estimate.stamp_ns, estimate.modes)
    return {'case': name, **counts}


def main() -> None:
    table = []
    plant, rough = PlantParameters(arm=ARM, noise='none'), PlantParameters(arm=ROUGH, noise='none')
    slow = PlantParameters(arm=ARM, noise='none', rate=100.0)
    smooth, sticky = moved(plant, 1), moved(rough, 1)
    loud = sensors.std_for_snr(smooth.position, smooth.velocity, 25.0)
    multisine = moved(slow, 1, excitation.sequence(
        ExcitationParameters(shape='multisine', rate=slow.rate, amplitude=(10.0, 5.0)), round(SECONDS * slow.rate)))
    quiet = sensors.std_for_snr(multisine.position, multisine.velocity, 40.0)
    for name, arm, told, run, noise, lost in (
            ('pick and place', plant, ARM, smooth, SENSORS, 0.0), ('25 dB', plant, ARM, smooth, loud, 0.0),
            ('5 % lost', plant, ARM, smooth, SENSORS, 0.05), ('friction, rotors', rough, ROUGH, sticky, SENSORS, 0.0),
            ('friction, rotors, not told', rough, ARM, sticky, SENSORS, 0.0),
            ('multisine, 100 Hz', slow, ARM, multisine, quiet, 0.0)):
        table.append(row_of(name, arm, told, run, messages(run, noise, lost, 1)))
        print(json.dumps(table[-1]), flush=True)
    claims.write('identification_missions', table)


if __name__ == '__main__':
    main()
