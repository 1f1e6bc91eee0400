"""Claim: an object taken over some time, announced early or late, or taken by an arm at rest is known a second later.

Arms of ``parts.real_arms``. ``ramp``: a gripper takes the object in equal parts over a time; its begin is announced.
``early``: the object is caught at an instant that much later than was announced. ``late``: the event arrives that much
later than its stamp. ``by hand``: it has the stamp of its arrival, that much later. ``rest``: the arm rests for 2 s
after the capture, then moves. Counted are the estimates from 1 s after the object is held, announced, or the arm moves,
on.

Use: python benchmarks/payload_slow_captures.py [--seeds 3]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import claims
import numpy as np
from parts import payload_trials as trials
from parts.real_arms import CAPTURE, SAMPLES, plant_of, told

from flexmanip_ros import pipeline
from flexmanip_ros.parameters import ExcitationParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, Status

ARMS = ('ideal', 'friction and rotor', 'all')
CASES = (('instant', 0.0), ('ramp', 0.02), ('ramp', 0.05), ('ramp', 0.1), ('ramp', 0.3), ('ramp', 1.0), ('early', 0.1),
         ('early', 0.3), ('late', 0.4), ('late', 1.5), ('by hand', 0.4), ('by hand', 1.5), ('rest', 2.0))
"""What is slow, and its time [s]."""


def items_of(kind: str, time_s: float, arm: str, seed: int) -> tuple[list[Any], float, Any]:
    """Return messages and announced event, the truth [kg], and the estimator's parameters."""
    plant = plant_of(arm, seed)
    late_ns = round(1e9 * time_s)
    efforts = excitation.sequence(ExcitationParameters(), SAMPLES + round(1e3 * time_s))
    announced = CAPTURE
    if kind == 'ramp':
        plant = replace(plant, gripper_ramp=time_s)
    if kind == 'early':
        announced = CaptureEvent(CAPTURE.stamp_ns - late_ns, CAPTURE.kind)
    if kind == 'rest':  # the arm is at rest before its first motion, too
        begin = CAPTURE.stamp_ns // 1_000_000 + round(1e3 * time_s)
        efforts = np.vstack([np.zeros((begin, 2)), efforts[:3000]])
    run = simulator.simulate(plant, efforts, (CAPTURE,))
    records = [item for item in simulator.records(run, (CAPTURE,)) if not isinstance(item, CaptureEvent)]
    if kind == 'by hand':
        announced = CaptureEvent(CAPTURE.stamp_ns + late_ns, CAPTURE.kind)
    came = 1
    if kind in ('late', 'by hand'):
        came = sum(record.stamp_ns < CAPTURE.stamp_ns + late_ns for record in records)
    return [*records[:came], announced, *records[came:]], plant.payload_mass, told(plant)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=3)
    seeds = parser.parse_args().seeds
    rows: list[dict[str, Any]] = []
    for kind, time_s in CASES:
        since = CAPTURE.stamp_ns + round(1e9 * (0.0 if kind == 'early' else time_s)) + 1_000_000_000
        for arm in ARMS if kind != 'rest' else ARMS[:1]:  # friction is not learned at rest
            tracking, wrong, ends, errors = [], [], 0, []
            for seed in range(1, 1 + seeds):
                items, truth, config = items_of(kind, time_s, arm, seed)
                found = [one.payload for one in pipeline.run(config, items)
                         if one.payload is not None and one.stamp_ns >= since]
                trusted, outside = trials.trusted_and_outside(found, truth)
                tracking.append(trusted)
                wrong.append(outside)
                ends += found[-1].status is Status.TRACKING
                errors.append(100.0 * abs(found[-1].mass / truth - 1.0))
            rows.append({'case': kind, 'time_s': time_s, 'arm': arm, 'runs': seeds, 'tracking_at_end': ends,
                         'tracking_percent': round(100.0 * float(np.mean(tracking)), 1),
                         'wrong_and_tracking_percent': round(100.0 * float(np.mean(wrong)), 2),
                         'worst_percent': round(float(max(errors)), 3)})
            print(rows[-1], flush=True)
    claims.write('payload_slow_captures', rows)


if __name__ == '__main__':
    main()
