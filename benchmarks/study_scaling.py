"""Claim: a study uses the cores it is given; how many runs a second one and two workers do.

The same runs of a scenario (6 s at 1 kHz, structured estimator) with one worker process and with two, start
of the processes left out; runs a second, and the ratio within this one run.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

from flexmanip_ros.cli import tasks, workers
from flexmanip_ros.scenario import scenario

RUNS = 16
SCENARIO = {'name': 'scaling', 'vary': {'plant.payload_mass': {'uniform': [12.0, 100.0]}},
            'plant': {'arm.damping_ratio': 0.003}, 'identifier': {'arm.damping_ratio': 0.003}}


def rate(count: int) -> float:
    """Return runs a second of ``count`` workers after their first runs (imports, kernels from the cache)."""
    made = scenario(SCENARIO)
    todo = [tasks.Simulated(made, seed) for seed in range(count + RUNS)]
    started = 0.0
    for done, outcome in enumerate(workers.processes(tasks.work, todo, count), start=1):
        if outcome.error is not None:
            raise outcome.error
        if done == count:
            started = time.perf_counter()
    return RUNS / (time.perf_counter() - started)


def main() -> int:
    rates = {count: rate(count) for count in (1, 2)}
    ratio = rates[2] / rates[1]
    for count, value in rates.items():
        print(f'{count} worker{"s" if count > 1 else " "}  {value:6.2f} runs a second')
    print(f'two workers do {ratio:.2f} times the runs of one, on {len(os.sched_getaffinity(0))} cores')
    results = Path(__file__).parent / 'results'
    results.mkdir(exist_ok=True)
    (results / 'study_scaling.json').write_text(
        json.dumps({'runs_per_second': rates, 'ratio': ratio}, indent=1) + '\n', encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
