"""Claim: told the ideal arm, the detector finds nine in ten captures by arms as they are, and nothing else.

Friction, rotors, gains and offsets of the signals, bodies that spin and drift, floating bases: one at a time and all
together (``parts.real_arms``). Three seconds of the empty arm, then the capture at a step of both torques, its worst
instant; three seconds more. What is found goes to the payload estimator.

Use: python benchmarks/detection_real_arms.py [--runs 4] [--cases NAME ..]
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import claims
import numpy as np
from parts.real_arms import CAPTURE, CASES, plant_of, simulate, told

from flexmanip_ros import pipeline
from flexmanip_ros.payload import capture_detection
from flexmanip_ros.simulation import simulator
from flexmanip_ros.types import EventKind, JointBlock, Payload, Status

NEAR_MS = 20.0
"""An event this near the capture is it: the payload is then estimated as if it had been announced."""


class Run(NamedTuple):
    """What came of one run."""

    dated_ms: float
    """Instant of the event nearest the capture, from it [ms]; infinite without any."""
    others: int
    """Events besides."""
    payload: Payload
    mass: float


def one(case: str, seed: int) -> Run:
    """Look for the capture in the signals, and identify with what is found."""
    plant = plant_of(case, seed)
    config, findings = told(plant), capture_detection.Findings()
    items = capture_detection.with_detected(
        capture_detection.watch(config), map(JointBlock.of, simulator.records(simulate(plant), ())), findings)
    last = [estimate.payload for estimate in pipeline.run(config, items)][-1]
    assert last is not None
    captures = [(event.stamp_ns - CAPTURE.stamp_ns) * 1e-6 for event in findings.events
                if event.kind is EventKind.CAPTURE]
    dated = min(captures, key=abs, default=np.inf)
    return Run(dated, len(findings.events) - (abs(dated) <= NEAR_MS), last, plant.payload_mass)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=4)
    parser.add_argument('--cases', nargs='*', default=list(CASES), help='names of cases; all by default')
    given = parser.parse_args()
    rows = []
    for case in given.cases:
        done = [one(case, seed) for seed in range(given.runs)]
        found = [run for run in done if abs(run.dated_ms) <= NEAR_MS]
        alone = [run for run in found if not run.others]
        row: dict[str, Any] = {
            'case': case, 'runs': given.runs, 'found': len(found),
            'other_events': sum(run.others for run in done), 'alone': len(alone),
            'median_dating_error_ms': round(float(np.median([abs(run.dated_ms) for run in found] or [np.inf])), 1),
            'inside': sum(run.payload.lower <= run.mass <= run.payload.upper for run in alone),
            'wrong_and_tracking': sum(run.payload.status is Status.TRACKING
                                      and not run.payload.lower <= run.mass <= run.payload.upper for run in done)}
        rows.append(row)
        print(row, [f'{run.dated_ms:.0f} ms, {run.others} others, {run.payload.status.name}' for run in done],
              flush=True)
    if given.cases == list(CASES):
        claims.write('detection_real_arms', rows)


if __name__ == '__main__':
    main()
