"""One sample of 1 ms takes at most 10 us at kappa = 1 and 25 us at kappa = 3, far below scipy's time.

Offline loop of the nonlinear plant (shortening on) under the paper's square waves with a
capture half way; best of several runs (processor time). Beside it, in the same run: real time, one step of
the live interface, the linear and the finite element plant, and a bare scipy.integrate solution of the same
equations (DOP853, one call for each stretch of constant torque, the compiled accelerations its right side).

Use: python benchmarks/plant_speed.py
"""

from __future__ import annotations

import time
from collections.abc import Callable

import claims
import numpy as np
from scipy.integrate import solve_ivp

from flexmanip_ros.arm import manipulator
from flexmanip_ros.arm.equations_of_motion import acceleration
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind

SAMPLES = 4000
EVENT = (CaptureEvent(SAMPLES // 2 * 1_000_000, EventKind.CAPTURE),)
TARGETS_US = {1: 10.0, 3: 25.0}


def best(action: Callable[[], object], repeats: int = 7) -> float:
    """Shortest processor time [s]; the first call compiles and does not count."""
    action()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        action()
        times.append(time.process_time() - begin)
    return min(times)


def with_scipy(config: PlantParameters, efforts: np.ndarray) -> np.ndarray:
    """Coordinates and rates (N, 2 n) at the samples."""
    arm = manipulator.manipulator(config.arm)
    work, n = manipulator.workspace(arm), 2 + 2 * arm.kappa
    x, payload, qdd = simulator.init(config).x, np.zeros(4), np.empty(n)
    rows, first = [], 0
    changes = np.flatnonzero(np.any(np.diff(efforts, axis=0) != 0, axis=1)) + 1
    for last in [*sorted({*changes.tolist(), SAMPLES // 2}), SAMPLES]:
        if first == SAMPLES // 2:
            carried = simulator.attach(config, simulator.init(config)._replace(x=x))
            x, payload = carried.x, carried.payload
        torque = efforts[first]

        def motion(
            _: float, y: np.ndarray, torque: np.ndarray = torque, load: np.ndarray = payload,
        ) -> np.ndarray:
            acceleration(arm, load, y[:n], y[n:], torque, qdd, work)
            return np.concatenate([y[n:], qdd])

        times = np.arange(last - first + 1) * 1e-3
        found = solve_ivp(motion, (0.0, times[-1]), x, 'DOP853', times, rtol=1e-8, atol=1e-10)
        rows.append(found.y[:, :-1].T)
        x, first = np.ascontiguousarray(found.y[:, -1]), last
    return np.vstack(rows)


def main() -> None:
    """Measure, print and write the table."""
    efforts = excitation.sequence(ExcitationParameters(), SAMPLES)
    results: list[dict[str, object]] = []
    print(f'{"plant":34} {"us/sample":>10} {"x real time":>12} {"x scipy":>9}')

    def report(name: str, seconds: float, scipy_seconds: float | None = None, **more: object) -> None:
        us = seconds / SAMPLES * 1e6
        faster = scipy_seconds / seconds if scipy_seconds else None
        print(f'{name:34} {us:10.2f} {1000 / us:12.0f} {"" if faster is None else f"{faster:9.1f}"}')
        results.append({'plant': name, 'us_per_sample': us, 'times_real_time': 1000 / us,
                        'times_faster_than_scipy': faster, **more})

    for kappa in (1, 3, 5):
        config = PlantParameters(noise='none', arm=ArmParameters(shape_functions='sines', modes=kappa))
        run = simulator.simulate(config, efforts, EVENT)
        ours = best(lambda config=config: simulator.simulate(config, efforts, EVENT))
        theirs = best(lambda config=config: with_scipy(config, efforts), repeats=2)
        arm = manipulator.manipulator(config.arm)
        reference = with_scipy(config, efforts)[:, :2 + 2 * kappa] @ arm.output.T
        gap = np.max(np.abs(run.position - reference)[:, 2:].max(0) / reference.std(0)[2:])
        report(f'nonlinear, kappa {kappa}', ours, theirs, target_us=TARGETS_US.get(kappa),
               largest_bend_difference_from_scipy=float(gap))
        report(f'scipy, kappa {kappa}', theirs)
    for name, config in (
        ('component modes, three sines', PlantParameters(noise='none')),
        ('linear, the same', PlantParameters(noise='none', model='linear')),
        ('finite elements, 10 a link', PlantParameters(noise='none', model='finite_element')),
    ):
        report(name, best(lambda config=config: simulator.simulate(config, efforts, EVENT), repeats=3))

    live = PlantParameters()
    start = simulator.init(live)

    def stepping() -> None:
        state = start
        for torque in efforts:
            state, _ = simulator.step(live, state, torque)

    report('live interface, kappa 3', best(stepping, repeats=2))
    claims.write('plant_speed', results)


if __name__ == '__main__':
    main()
