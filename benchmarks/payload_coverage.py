"""Claim: on matched plants the 95 % intervals of `structured` cover 93-97 %.

The nonlinear plant the estimator models (kappa = 2), random payloads of 3-100 kg, configurations, capture
instants and noise at 40 dB; with displacements and rates, and with displacements alone.

Use: python benchmarks/payload_coverage.py [--runs 150]   (1000 for the claim)
"""

from __future__ import annotations

import argparse

import numpy as np
from parts import payload_trials as trials

from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind

ARM = ArmParameters(shape_functions='sines', damping_ratio=0.003, modes=2)
MARKS = (100, 250, 500, 1000, 2000)


def one(seed: int, outputs: tuple[str, ...]) -> trials.Trial:
    """A random capture."""
    rng = np.random.default_rng(seed)
    first = rng.uniform(-np.pi, np.pi)
    plant = PlantParameters(
        initial_angles=(first, first + rng.uniform(-2.0, 2.0)), payload_mass=10 ** rng.uniform(0.5, 2.0),
        arm=ARM, seed=seed)
    capture = int(rng.integers(1500, 2500))
    efforts = excitation.sequence(ExcitationParameters(), capture + MARKS[-1])
    record = simulator.simulate(plant, efforts, (CaptureEvent(capture * 1_000_000, EventKind.CAPTURE),))
    samples = trials.as_samples(record.position, record.velocity, record.effort, 1e-3, outputs)
    return trials.follow(trials.configuration(ARM, outputs), samples, capture, MARKS, plant.payload_mass)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=150)
    runs = parser.parse_args().runs
    rows = []
    for name, outputs in (('with rates', trials.BENDS + trials.RATES), ('displacements', trials.BENDS)):
        done = [one(seed, outputs) for seed in range(runs)]
        normalised = np.array([[(e.mass - t.truth) / e.std for e in t.found] for t in done])
        row = {
            'outputs': name, 'runs': runs, 'samples_after_capture': MARKS,
            'coverage': trials.numbers(trials.coverage(done), 3),
            'rms_percent': trials.numbers(trials.rms(trials.errors(done)), 3),
            'median_percent': trials.numbers(np.median(np.abs(trials.errors(done)), axis=0), 4),
            'rms_normalised': trials.numbers(trials.rms(normalised), 2)}
        rows.append(row)
        print(f'{name:14}', f'{runs} runs, after {MARKS} ms: coverage', row['coverage'])
        print('  rms error %', row['rms_percent'], 'median', row['median_percent'], 'error/std',
              row['rms_normalised'], flush=True)
    trials.write('payload_coverage', rows)


if __name__ == '__main__':
    main()
