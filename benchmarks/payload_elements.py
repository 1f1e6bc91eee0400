"""Claim: on nine in ten arms of finite elements, damped or not, `structured` is within 1 % after a second.

Random arms of half to one and a quarter the reference size, 5 to 20 elements a link, damping ratio 0 (two in
five) to 0.01, payloads of 5 to 100 kg, 30 or 40 dB, the paper's conventions or ours, rates continuous at the
capture or not. The estimator has three modes a link and knows the arm's dimensions, stiffness to 3 %.

Use: python benchmarks/payload_elements.py [--runs 60]
"""

from __future__ import annotations

import argparse

import claims
import numpy as np
from parts import payload_trials as trials

from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, Status

PAPER = {'torque_convention': 'paper', 'angle_convention': 'chord', 'shortening': False,
         'shape_functions': 'sines'}
MARKS = (100, 250, 1000, 2990)


def one(seed: int) -> trials.Trial:
    """A random arm and capture."""
    rng = np.random.default_rng(1000 + seed)
    conventions = PAPER if rng.integers(2) else {}
    size = 10 ** rng.uniform(-0.3, 0.1)
    arm = ArmParameters(
        link_length=(3.0 * size * rng.uniform(0.8, 1.1), 3.0 * size * rng.uniform(0.7, 1.0)),
        linear_density=(5.0 * rng.uniform(0.5, 1.2), 5.0 * rng.uniform(0.4, 1.0)),
        bending_stiffness=(5000.0 * rng.uniform(0.4, 1.5), 5000.0 * rng.uniform(0.3, 1.0)),
        joint_mass=10.0 * rng.uniform(0.3, 1.2), tip_mass=10.0 * rng.uniform(0.2, 1.2), modes=3,
        damping_ratio=float(rng.choice([0.0, 0.0, 0.001, 0.003, 0.01])), **conventions)
    first = rng.uniform(-np.pi, np.pi)
    plant = PlantParameters(
        model='finite_element', arm=arm, seed=seed, initial_angles=(first, first + rng.uniform(-2.0, 2.0)),
        payload_mass=10 ** rng.uniform(0.7, 2.0), elements=int(rng.integers(5, 21)),
        snr_db=float(rng.choice([30.0, 40.0])), capture_impact=str(rng.choice(['continuous', 'momentum'])))
    capture = int(rng.integers(2000, 3001))
    efforts = excitation.sequence(ExcitationParameters(), capture + MARKS[-1] + 10)
    record = simulator.simulate(plant, efforts, (CaptureEvent(capture * 1_000_000, EventKind.CAPTURE),))
    samples = trials.as_samples(record.position, record.velocity, record.effort, 1e-3)
    return trials.follow(
        trials.configuration(arm, dynamics='linear'), samples, capture, MARKS, plant.payload_mass)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=60)
    runs = parser.parse_args().runs
    done = [one(seed) for seed in range(runs)]
    error = np.abs(trials.errors(done))
    tracking = [[found.status is Status.TRACKING for found in trial.found] for trial in done]
    wrong = [trials.trusted_and_outside(trial.found, trial.truth)[1] for trial in done]
    row = {
        'runs': runs, 'samples_after_capture': MARKS, 'coverage': trials.numbers(trials.coverage(done), 3),
        'median_percent': trials.numbers(np.median(error, axis=0), 3),
        'share_beyond_1_percent': trials.numbers(np.mean(error > 1.0, axis=0), 3),
        'beyond_1_percent_and_tracking': trials.numbers(np.mean((error > 1.0) & tracking, axis=0), 3),
        'share_tracking': trials.numbers(np.mean(tracking, axis=0), 3),
        'tracking_and_outside_percent': trials.numbers(100.0 * np.mean(wrong), 2)}
    for name, value in row.items():
        print(f'{name:30}', value)
    claims.write('payload_elements', [row])


if __name__ == '__main__':
    main()
