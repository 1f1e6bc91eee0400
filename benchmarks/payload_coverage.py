"""Claim: on matched plants the 95 % intervals of `structured` cover 93-97 %.

The nonlinear plant that the estimator models, random payloads of 3-100 kg, configurations, capture instants and noise
at 40 dB; the default arm, and one of two sines a link. Displacements alone: `structured` takes no rate of what is
measured itself. A tenth of the runs more for each arm of config/arms that carries payloads (nasa_type has a stub of 1 g
for a second link).

Use: python benchmarks/payload_coverage.py [--runs 150]   (1000 for the claim)
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import claims
import numpy as np
from parts import payload_trials as trials

from flexmanip_ros.io import parameter_file
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, PlantParameters, configure
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind

ARM = ArmParameters(damping_ratio=0.003)
SINES = ArmParameters(shape_functions='sines', damping_ratio=0.003, modes=2)
MARKS = (100, 250, 500, 1000, 3000)


class Case(NamedTuple):
    """An arm, the payloads that it catches [kg], the torques that move it, and its share of the runs."""

    name: str
    arm: ArmParameters
    payloads: tuple[float, float] = (10 ** 0.5, 100.0)
    peaks: tuple[float, ...] = ExcitationParameters().amplitude
    share: float = 1.0


def cases() -> list[Case]:
    """The default arm with both kinds of shape functions, and those that are shipped."""
    found = [Case('default arm', ARM), Case('two sines', SINES)]
    for name, payloads, peaks in (('quanser', (0.02, 0.2), (0.05, 0.02)),
                                  ('de_luca_siciliano', (0.03, 0.3), (0.135, 0.045))):
        file = Path(__file__).resolve().parents[1] / 'config' / 'arms' / f'{name}.yaml'
        arm = configure(PlantParameters, parameter_file.read(file, 'plant_simulator')).arm
        found.append(Case(f'arm {name}', arm, payloads, peaks, 0.1))
    return found


def one(seed: int, case: Case) -> trials.Trial:
    """A random capture."""
    rng = np.random.default_rng(seed)
    first = rng.uniform(-np.pi, np.pi)
    plant = PlantParameters(
        initial_angles=(first, first + rng.uniform(-2.0, 2.0)),
        payload_mass=10 ** rng.uniform(*np.log10(case.payloads)), arm=case.arm, seed=seed)
    capture = int(rng.integers(1500, 2500))
    efforts = excitation.sequence(ExcitationParameters(amplitude=case.peaks), capture + MARKS[-1])
    record = simulator.simulate(plant, efforts, (CaptureEvent(capture * 1_000_000, EventKind.CAPTURE),))
    samples = trials.as_samples(record.position, record.velocity, record.effort, 1e-3, trials.BENDS)
    return trials.follow(trials.configuration(case.arm, trials.BENDS), samples, capture, MARKS, plant.payload_mass)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=150)
    runs = parser.parse_args().runs
    rows = []
    for case in cases():
        count = max(1, round(case.share * runs))
        with ProcessPoolExecutor() as pool:
            done = list(pool.map(partial(one, case=case), range(count), chunksize=5))
        normalised = np.array([[(e.mass - t.truth) / e.std for e in t.found] for t in done])
        row = {
            'case': case.name, 'runs': count, 'samples_after_capture': MARKS,
            'coverage': trials.numbers(trials.coverage(done), 3),
            'rms_percent': trials.numbers(trials.rms(trials.errors(done)), 3),
            'median_percent': trials.numbers(np.median(np.abs(trials.errors(done)), axis=0), 4),
            'rms_normalised': trials.numbers(trials.rms(normalised), 2)}
        rows.append(row)
        print(f'{case.name:14}', f'{count} runs, after {MARKS} ms: coverage', row['coverage'])
        print('  rms error %', row['rms_percent'], 'median', row['median_percent'], 'error/std',
              row['rms_normalised'], flush=True)
    claims.write('payload_coverage', rows)


if __name__ == '__main__':
    main()
