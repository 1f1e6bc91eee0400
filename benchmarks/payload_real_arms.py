"""Claim: told the ideal arm, `structured` knows what an arm as it is holds: mass within 0.7 %, in its interval.

Friction, rotors, gains and offsets of the signals, bodies that spin and drift, floating bases: one at a time and all
together (``parts.real_arms``). Capture after 3 s, estimate after 6 s.

Use: python benchmarks/payload_real_arms.py [--runs 12] [--cases NAME ..]
"""

from __future__ import annotations

import argparse
import math
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import claims
import numpy as np
from parts import payload_trials as trials
from parts.real_arms import CAPTURE, CASES, plant_of, simulate, told

from flexmanip_ros import pipeline
from flexmanip_ros.parameters import PlantParameters
from flexmanip_ros.simulation import simulator
from flexmanip_ros.types import Payload, Status


def one(drawn: tuple[str, int]) -> tuple[PlantParameters, Payload, float]:
    """Simulate a case with a seed; return plant, last estimate, share of estimates that miss the truth while TRACKING.

    Estimates count from 0.1 s after the capture on.
    """
    plant = plant_of(*drawn)
    found = [estimate.payload for estimate in pipeline.run(told(plant), simulator.records(simulate(plant), (CAPTURE,)))
             if estimate.payload is not None and estimate.stamp_ns > CAPTURE.stamp_ns + 100_000_000]
    _, wrong = trials.trusted_and_outside(found, plant.payload_mass)
    return plant, found[-1], wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=12)
    parser.add_argument('--cases', nargs='*', default=list(CASES), help='names of cases; all by default')
    given = parser.parse_args()
    rows = []
    for case in given.cases:
        with ProcessPoolExecutor() as pool:
            done = list(pool.map(one, [(case, seed) for seed in range(given.runs)]))
        errors = [100 * (found.mass / plant.payload_mass - 1) for plant, found, _ in done]
        row: dict[str, Any] = {
            'case': case, 'runs': given.runs,
            'within_0.7_percent': sum(abs(error) <= 0.7 for error in errors),
            'worst_percent': round(max(map(abs, errors)), 3),
            'half_width_percent': round(float(np.median(
                [50 * (found.upper - found.lower) / plant.payload_mass for plant, found, _ in done])), 3),
            'inside': sum(found.lower <= plant.payload_mass <= found.upper for plant, found, _ in done),
            'tracking': sum(found.status is Status.TRACKING for _, found, _ in done),
            'wrong_and_tracking_percent': round(100 * float(np.mean([wrong for *_, wrong in done])), 2)}
        if CASES[case][1]:
            known = [(plant, found) for plant, found, _ in done if found.covariance]
            row['com_worst_mm'] = round(max((1000 * math.dist(found.com[:2], plant.payload_com)
                                             for plant, found in known), default=math.inf), 2)
            row['inertia_worst_percent'] = round(max((100 * abs(found.inertia[5] / plant.payload_inertia - 1)
                                                      for plant, found in known), default=math.inf), 2)
            row['body_known'] = len(known)
        rows.append(row)
        print(row, [f'{error:.2f} {found.status.name}' for error, (_, found, _) in zip(errors, done, strict=True)],
              flush=True)
    if given.cases == list(CASES):
        claims.write('payload_real_arms', rows)


if __name__ == '__main__':
    main()
