"""Claim: header stamps may jitter by a fifth of the sample time, or with their samples by a tenth; payloads stay right.

Arms of ``parts.real_arms`` at 1 kHz. ``stamps``: samples are regular and stamps are off by white noise. ``loop``: a
control loop wakes up off by white noise, and samples, stamps and torques are off together (simulated at 10 kHz).

Use: python benchmarks/payload_jitter.py [--seeds 3]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import claims
import numpy as np
from parts import payload_trials as trials
from parts.real_arms import CAPTURE, SAMPLES, plant_of, told

from flexmanip_ros import pipeline
from flexmanip_ros.parameters import ExcitationParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, JointRecord, Payload

ARMS = ('ideal', 'friction and rotor', 'all')
CASES = (('none', 0.0), ('stamps', 0.05), ('stamps', 0.1), ('stamps', 0.2), ('loop', 0.1))
"""What jitters, and its standard deviation [ms]."""
FINE = 10
"""Instants of the fine simulation in a sample time."""


def stamped(plant: PlantParameters, efforts: np.ndarray, std_ms: float, rng: np.random.Generator
            ) -> Iterator[JointRecord | CaptureEvent]:
    """Yield regular samples whose stamps are off, in their order."""
    last = 0
    for item in simulator.records(simulator.simulate(plant, efforts, (CAPTURE,)), (CAPTURE,)):
        if isinstance(item, JointRecord):
            last = max(last + 1000, item.stamp_ns + round(rng.normal(0.0, std_ms * 1e6)))
            yield item._replace(stamp_ns=last)
        else:
            yield item


def looped(plant: PlantParameters, efforts: np.ndarray, std_ms: float, rng: np.random.Generator
           ) -> list[JointRecord | CaptureEvent]:
    """Return samples at the instants at which a loop woke up and set its torques."""
    off = np.clip(np.round(rng.normal(0.0, std_ms * FINE, len(efforts))), 1 - FINE // 2, FINE // 2 - 1)
    at = FINE * np.arange(len(efforts)) + off.astype(np.int64)
    at[0] = 0
    held = efforts[np.searchsorted(at, np.arange(FINE * len(efforts)), side='right') - 1]
    run = simulator.simulate(replace(plant, rate=FINE * plant.rate), held, (CAPTURE,))
    records = [item for item in simulator.records(run, (CAPTURE,)) if isinstance(item, JointRecord)]
    items: list[JointRecord | CaptureEvent] = [records[k] for k in at]
    return sorted([*items, CAPTURE], key=lambda item: (item.stamp_ns, isinstance(item, JointRecord)))


def estimates(plant: PlantParameters, items: Iterable[JointRecord | CaptureEvent]) -> list[Payload]:
    """Return the payloads from 0.1 s after the capture on."""
    return [found.payload for found in pipeline.run(told(plant), items)
            if found.payload is not None and found.stamp_ns > CAPTURE.stamp_ns + 100_000_000]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=3)
    seeds = parser.parse_args().seeds
    efforts = excitation.sequence(ExcitationParameters(), SAMPLES)
    rows: list[dict[str, Any]] = []
    for kind, std_ms in CASES:
        tracking, wrong, errors = [], [], []
        for arm in ARMS:
            for seed in range(1, 1 + seeds):
                plant, rng = plant_of(arm, seed), np.random.default_rng(1000 + seed)
                items = (looped if kind == 'loop' else stamped)(plant, efforts, std_ms, rng)
                found = estimates(plant, items)
                trusted, outside = trials.trusted_and_outside(found, plant.payload_mass)
                tracking.append(trusted)
                wrong.append(outside)
                errors.append(100.0 * abs(found[-1].mass / plant.payload_mass - 1.0))
        rows.append({'jitter': kind, 'std_ms': std_ms, 'runs': len(errors),
                     'tracking_percent': round(100.0 * float(np.mean(tracking)), 1),
                     'wrong_and_tracking_percent': round(100.0 * float(np.mean(wrong)), 2),
                     'within_0.7_percent': int(np.sum(np.array(errors) <= 0.7)),
                     'worst_percent': round(float(max(errors)), 3)})
        print(rows[-1], flush=True)
    claims.write('payload_jitter', rows)


if __name__ == '__main__':
    main()
