"""Claim: a study uses the cores it is given, by processes or by Dask, and one collector serves thousands.

The same runs of a scenario (6 s at 1 kHz, structured estimator, bound) with one worker and with two: runs a
second once every worker has done some (imports and kernels from the cache are left out), and the ratio
within this one run. Then what the collecting process needs to keep one run on disk, from which follows how
many workers it can serve.
"""

from __future__ import annotations

import importlib.util
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import claims

from flexmanip_ros.cli import workers
from flexmanip_ros.io.outputs import Journal
from flexmanip_ros.studies.scenario import scenario

RUNS, WARM = 24, 4
"""Runs that are timed; runs a worker before those."""
KEPT = 500
"""Runs given to the journal."""
SCENARIO = {'name': 'scaling', 'vary': {'plant.payload_mass': {'uniform': [12.0, 100.0]}},
            'plant': {'arm.damping_ratio': 0.003}, 'identifier': {'arm.damping_ratio': 0.003}}
Compute = Callable[[list[workers.Task], int], Iterator[workers.Outcome]]


def rate(compute: Compute, count: int) -> float:
    """Return runs a second of ``count`` workers."""
    made = scenario(SCENARIO)
    todo: list[workers.Task] = [workers.Simulated(made, seed) for seed in range(WARM * count + RUNS)]
    started = 0.0
    for done, outcome in enumerate(compute(todo, count), start=1):
        if outcome.error is not None:
            raise outcome.error
        if done == WARM * count:
            started = time.perf_counter()
    return RUNS / (time.perf_counter() - started)


def by_processes(todo: list[workers.Task], count: int) -> Iterator[workers.Outcome]:
    """Compute in processes of this machine."""
    return workers.processes(workers.work, todo, count)


def by_dask(todo: list[workers.Task], count: int) -> Iterator[workers.Outcome]:
    """Compute on a Dask cluster of this machine, through its scheduler's address as on any other."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=count, threads_per_worker=1, processes=True, dashboard_address=None) as there:
        yield from workers.cluster(workers.work, todo, there.scheduler_address)


def keeping() -> float:
    """Return the time to keep the row of one run [s]."""
    row = workers.work(workers.Simulated(scenario(SCENARIO), 0))
    with tempfile.TemporaryDirectory() as folder, Journal(Path(folder) / 'kept.csv', {}) as journal:
        started = time.perf_counter()
        for _ in range(KEPT):
            journal.add(row)
        return (time.perf_counter() - started) / KEPT


def measured(compute: Compute, name: str) -> dict[str, Any]:
    """Measure one way to compute, print it and return it."""
    rates = {count: rate(compute, count) for count in (1, 2)}
    ratio = rates[2] / rates[1]
    print(f'{name:10s} {rates[1]:8.2f} {rates[2]:8.2f} {ratio:8.2f}')
    return {'runs_per_second': rates, 'ratio': ratio}


def main() -> None:
    """Measure, print a table, write the results."""
    cores = len(os.sched_getaffinity(0))
    print(f'runs a second, {cores} cores\n{"":10s} {"1 worker":>8s} {"2":>8s} {"ratio":>8s}')
    found: dict[str, Any] = {'cores': cores, 'processes': measured(by_processes, 'processes')}
    if importlib.util.find_spec('distributed') is None:
        print('Dask is not installed: left out')
    else:
        found['dask'] = measured(by_dask, 'Dask')
    found['keeping_a_run_s'] = keeping()
    serves = 1.0 / (found['keeping_a_run_s'] * found['processes']['runs_per_second'][1])
    print(f'keeping a run on disk: {1e3 * found["keeping_a_run_s"]:.2f} ms; one collector serves '
          f'{serves:.0f} workers')
    claims.write('study_scaling', found)


if __name__ == '__main__':
    main()
