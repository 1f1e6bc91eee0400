"""Claim: on arms of any size the modes that are TRACKING are right, and most readings of a moving arm are TRACKING.

Each run draws lengths, masses, stiffness, damping, sample rate, noise and payload; f1 of the empty arm is 1.5 to 8 Hz.
A controller moves the arm between random goals; with odds of one half a small dither of its first two modes is added.
The arm catches the object after 8 s. The angles have names of their own, so that they are read without a payload.
Truth: the six lowest modes of the linearized arm at the angles of the instant or of the last half second. A reading is
off where one of its modes differs from all of these by more than 1 %, and wrong where it does by more than three times
its band. Use: identification_random_arms.py [--runs 20]
"""

from __future__ import annotations

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any, NamedTuple

import claims
import numpy as np
from identification_missions import driven
from identification_moving_arm import frequencies
from identification_status import renamed

from flexmanip_ros import pipeline
from flexmanip_ros.arm.manipulator import chords
from flexmanip_ros.parameters import (
    ArmParameters,
    ControllerParameters,
    ExcitationParameters,
    IdentifierParameters,
    PlantParameters,
)
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import Array, CaptureEvent, EventKind, JointBlock, Status

CAPTURE_S, SECONDS = 8.0, 40.0
FIRST_SEED = 66_000
"""Seed of the first draw, far from those of the noise, which are the numbers of the runs."""
BEND = 0.01
"""Bend at the sensors that a move may need, as a share of the shorter link."""
MODES = 6
"""Modes of the arm among which those of a reading are looked for."""
BLOCK = 1000


class Case(NamedTuple):
    """What was drawn; goals: times [s] and encoder angles [rad]."""

    plant: PlantParameters
    dither: ExcitationParameters | None
    goals: tuple[tuple[float, Array], ...]


def draw(run: int) -> Case:
    """Draw the arm, its object and its moves."""
    rng = np.random.default_rng(FIRST_SEED + run)

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    first, density = between(0.5, 3.5), between(0.5, 8.0)
    length = (first, first * rng.uniform(0.6, 1.2))
    densities = (density, density * rng.uniform(0.4, 1.0))
    links = np.array(length) * densities
    joint, tip = rng.uniform(0.3, 1.5) * links[0], rng.uniform(0.2, 1.0) * links[1]
    stiffness = np.array([1.0, rng.uniform(0.25, 1.0)])
    relative = -rng.uniform(0.3, 1.8)
    arm = ArmParameters(
        link_length=length, linear_density=densities, bending_stiffness=tuple(stiffness.tolist()), joint_mass=joint,
        tip_mass=tip, damping_ratio=between(0.003, 0.02))
    f1, f2 = frequencies(PlantParameters(arm=arm), np.array([0.8, 0.8 + relative]), 0.0)
    wanted = between(1.5, 8.0)
    stiffness *= (wanted / f1) ** 2
    plant = PlantParameters(
        arm=replace(arm, bending_stiffness=tuple(stiffness.tolist())), seed=run, initial_angles=(0.8, relative),
        rate=float(rng.choice([500.0, 1000.0, 1000.0])),
        payload_mass=between(0.1, 1.2) * float(links.sum() + joint + tip), snr_db=float(rng.choice([30, 40, 40, 50])))
    bent = rng.uniform(0.1, 0.4, 2)  # % of the links
    shape = str(rng.choice(['none', 'none', 'multisine', 'prbs']))
    dither = None if shape == 'none' else ExcitationParameters(
        rate=plant.rate, shape=shape, amplitude=tuple((bent * holding(plant.arm)).tolist()), bit_time=0.15 / wanted,
        seed=int(rng.integers(100)), band=(0.5 * wanted, 1.3 * wanted * f2 / f1))
    goals, time = [], 1.0
    while time < SECONDS:
        goals.append((time, rng.uniform([0.2, -2.0], [1.6, -0.3])))
        time += rng.uniform(2.0, 5.0)
    return Case(plant, dither, tuple(goals))


def holding(arm: ArmParameters) -> Array:
    """Return the torques (2,) at the root of pinned links that bend their middles by 1 % of the length [N m]."""
    return 0.16 * np.array(arm.bending_stiffness) / np.array(arm.link_length)


def torques_of(case: Case) -> Array:
    """Return the torques (N, 2) of the controller, which measures without noise, and of the dither."""
    plant, arm = case.plant, case.plant.arm
    count, lengths, most = round(SECONDS * plant.rate), np.array(arm.link_length), 3.0 * holding(arm)
    bend = BEND * float(lengths.min())
    law = ControllerParameters(
        arm=arm, rate=plant.rate, bend_scale=2.0 * bend, move_bend=bend, effort_scale=tuple((most / 3.0).tolist()),
        effort_limit=tuple(most.tolist()), setpoint_rate=1.0, disturbance_std=tuple((most / 300.0).tolist()),
        noise_std=tuple(np.concatenate([[3e-3] * 2, 3e-3 * lengths, [0.2] * 2, 0.2 * lengths]).tolist()))
    added = np.zeros((count, 2))
    if case.dither is not None:  # it acts from the next sample on, as the controller's torque does
        added = excitation.sequence(case.dither, count)
        added = np.vstack([added[:1], added[:-1]])
    return driven(replace(plant, noise='none'), added, [(CAPTURE_S, plant.payload_mass)], law, case.goals).effort


def judged(run: int) -> dict[str, Any]:
    """Identify one run and count its readings."""
    case = draw(run)
    plant, event = case.plant, CaptureEvent(round(CAPTURE_S * 1e9), EventKind.CAPTURE)
    motion = simulator.simulate(plant, torques_of(case), [event])
    effort = np.hstack([motion.effort, np.zeros_like(motion.effort)])
    blocks = [JointBlock(motion.names, *(part[at:at + BLOCK] for part in (
        motion.stamp_ns, motion.position, motion.velocity, effort))) for at in range(0, len(effort), BLOCK)]
    split = next(k for k, block in enumerate(blocks) if block.stamp_ns[0] >= event.stamp_ns)
    config = IdentifierParameters(
        arm=plant.arm, payload_method='none', inputs=('shoulder/effort', 'elbow/effort'),
        angles=('shoulder/position', 'elbow/position'))
    counts: Counter[str] = Counter()
    for estimate in pipeline.run(config, renamed([*blocks[:split], event, *blocks[split:]])):
        if not estimate.model_is_new:
            continue
        counts['readings'] += 1
        if estimate.model_status is not Status.TRACKING:
            continue
        row = int(np.searchsorted(motion.stamp_ns, estimate.stamp_ns))
        lately = motion.position[max(0, row - round(0.5 * plant.rate)):row + 1, :2]
        mass = plant.payload_mass if estimate.stamp_ns >= event.stamp_ns else 0.0
        truth = np.concatenate([frequencies(plant, chords(plant.arm, angles), mass, MODES)
                                for angles in (lately[-1], lately.mean(axis=0))])
        missed = [np.abs(truth - mode.frequency_hz).min() for mode in estimate.modes]
        counts['tracking'] += 1
        counts['off'] += any(error > 0.01 * mode.frequency_hz
                             for error, mode in zip(missed, estimate.modes, strict=True))
        counts['wrong'] += any(error > 3.0 * 1.96 * mode.frequency_std_hz
                               for error, mode in zip(missed, estimate.modes, strict=True))
    empty = frequencies(plant, chords(plant.arm, np.array(plant.initial_angles)), 0.0, 3)
    return {'run': run, 'empty_hz': [round(float(f), 2) for f in empty], 'rate': plant.rate,
            **{name: counts[name] for name in ('readings', 'tracking', 'off', 'wrong')}}


def main() -> None:
    """Measure, print and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=20)
    rows = []
    with ProcessPoolExecutor() as pool:
        for row in pool.map(judged, range(parser.parse_args().runs)):
            rows.append(row)
            print(row, flush=True)
    claims.write('identification_random_arms', rows)


if __name__ == '__main__':
    main()
