"""Claim: told how well lengths and masses are known, `structured` knows what an arm with wrong ones holds.

The plants are those of `payload_real_arms` (points and bodies in turn), but their lengths, densities, masses and gains
are off by normal errors. The estimator is told the ideal arm, as exact or with the deviations of these errors
(``payload.length_std``, ``payload.mass_std``). Capture after 3 s, estimate after 6 s.

Use: python benchmarks/payload_unsure_arms.py [--runs 40]
"""

from __future__ import annotations

import argparse
import math
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import claims
import numpy as np
from parts import payload_trials as trials
from parts.real_arms import CAPTURE, plant_of, simulate, told

from flexmanip_ros import pipeline
from flexmanip_ros.simulation import simulator
from flexmanip_ros.types import Status

CASES = {  # errors of lengths, of densities and masses, of gains; told deviations of lengths and masses
    'as exact': (0.002, 0.02, 0.02, 0.0, 0.0),
    'as they are': (0.002, 0.02, 0.02, 0.002, 0.02),
    'as they are, 1 %': (0.01, 0.01, 0.0, 0.01, 0.01),
    'as unsure, and right': (0.0, 0.0, 0.0, 0.002, 0.02)}


def one(drawn: tuple[str, int]) -> tuple[bool, bool, float, float]:
    """Return of the last estimate whether it is TRACKING and inside, its relative half width, and what was wrong."""
    case, seed = drawn
    length, mass, gain, length_std, mass_std = CASES[case]
    plant = plant_of('body' if seed % 2 else 'ideal', seed)
    rng, arm = np.random.default_rng(9000 + seed), plant.arm

    def off(values: tuple[float, ...], error: float) -> tuple[float, ...]:
        return tuple(value * (1.0 + error * rng.standard_normal()) for value in values)

    (joint_mass, tip_mass) = off((arm.joint_mass, arm.tip_mass), mass)
    plant = replace(plant, arm=replace(
        arm, link_length=off(arm.link_length, length), linear_density=off(arm.linear_density, mass),
        joint_mass=joint_mass, tip_mass=tip_mass, torque_gain=off(arm.torque_gain, gain),
        bend_gain=off(arm.bend_gain, gain)))
    config = told(plant)
    config = replace(config, payload=replace(config.payload, length_std=length_std, mass_std=mass_std))
    found = [estimate.payload for estimate in pipeline.run(config, simulator.records(simulate(plant), (CAPTURE,)))
             if estimate.payload is not None and estimate.stamp_ns > CAPTURE.stamp_ns + 100_000_000]
    _, wrong = trials.trusted_and_outside(found, plant.payload_mass)
    last, true = found[-1], plant.payload_mass
    return last.status is Status.TRACKING, last.lower <= true <= last.upper, (last.upper - last.lower) / 2 / true, wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=40)
    given = parser.parse_args()
    rows = []
    for case in CASES:
        with ProcessPoolExecutor() as pool:
            done = list(pool.map(one, [(case, seed) for seed in range(given.runs)]))
        width = float(np.median([width for *_, width, _ in done]))
        rows.append({
            'told': case, 'runs': given.runs, 'tracking': sum(tracking for tracking, *_ in done),
            'inside': sum(tracking and inside for tracking, inside, *_ in done),
            'half_width_percent': round(100 * width, 2) if math.isfinite(width) else None,
            'wrong_and_tracking_percent': round(100 * float(np.mean([wrong for *_, wrong in done])), 2)})
        print(rows[-1], flush=True)
    claims.write('payload_unsure_arms', rows)


if __name__ == '__main__':
    main()
