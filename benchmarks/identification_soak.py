"""Claim: 10 million samples with silences, saturation and faults: finite, bounded, back at once.

A day in miniature, over and over: motion, silence, constant torque, noise alone, a gap, a burst of numbers
that are not finite; after each cycle the error of the poles within one window of returning motion is kept.
Use: identification_soak.py [samples].
"""

from __future__ import annotations

import resource
import sys
import time
from pathlib import Path

import claims
import numpy as np

from flexmanip_ros.arm.linearization import discretize, vibration_model
from flexmanip_ros.identification import rpbsid
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters, configure
from flexmanip_ros.samples.sample_log import SampleLog, Width

DT = 1e-3
LONG = {'forgetting_factor': [0.9995] * 3}
SETTINGS = ({'forgetting': 'innovation'}, {'forgetting': 'excitation', **LONG},
            {'forgetting': 'constant', **LONG}, {'estimator': 'paper', 'forgetting': 'excitation', **LONG})


def motion(
    A: np.ndarray, B: np.ndarray, count: int, rng: np.random.Generator, hold: tuple[int, int] = (500, 250),
) -> tuple[np.ndarray, np.ndarray]:
    """Square-wave torques (half periods ``hold``) and the arm's answer from rest, 40 dB of noise."""
    k = np.arange(count)
    u = np.stack([10.0 * np.where((k // h) % 2, -1.0, 1.0) for h in hold], 1)
    x, y = np.zeros(4), np.empty((count, 4))
    for i in range(count):
        y[i] = x
        x = A @ x + B @ u[i]
    return u, y + 0.01 * np.std(y, axis=0) * rng.standard_normal(y.shape)


def resident_mb() -> float:
    """Return the memory that this process has now [MB]."""
    pages = int(Path('/proc/self/statm').read_text(encoding='ascii').split()[1])
    return pages * resource.getpagesize() / 1e6


def soak(settings: dict[str, object], samples: int) -> dict[str, object]:
    arm = ArmParameters(torque_convention='paper', damping_ratio=0.01)
    A, B = discretize(*vibration_model(arm, np.radians([60.0, 45.0]), 20.0, kappa=1), DT)
    true = np.sort_complex(np.linalg.eigvals(A))
    rng = np.random.default_rng(0)
    u, y = motion(A, B, 3000, rng)
    level = motion(A, B, 20_000, rng, (20_000, 20_000))
    config = configure(IdentifierParameters, {'arm.torque_convention': 'paper', **settings})
    hush = 1e-4 * np.abs(y).max(axis=0)
    state, done, errors, memory, lost = rpbsid.init(config), 0, [], [], 0
    log = SampleLog(Width(2, 4, 0))

    def take(state: rpbsid.RpbsidState, torque: np.ndarray, output: np.ndarray) -> rpbsid.RpbsidState:
        nonlocal log
        count = len(torque)
        log = log.from_row(rpbsid.first_needed(state)).append(
            np.zeros(count, dtype=np.int64), torque, output, np.zeros((count, 0)), np.zeros(count, dtype=bool))
        return rpbsid.advance(config, state, log.rows(log.end - count, log.end))

    begin = time.perf_counter()
    while done < samples:
        for torque, output in (
            (u, y), (np.zeros((60_000, 2)), np.zeros((60_000, 4))),
            level,
            (np.zeros((20_000, 2)), hush * rng.standard_normal((20_000, 4))),
            (np.full((20, 2), np.nan), np.full((20, 4), np.inf)),
        ):
            state = rpbsid.window_restart(config, take(state, torque, output))
            done += len(torque)
            lost += not all(np.all(np.isfinite(array)) for array in state.memory)
        state = take(state, u[:100], y[:100])
        found = rpbsid.identified(config, state, DT)
        assert found is not None
        errors.append(float(np.abs(np.sort_complex(np.linalg.eigvals(found.model.A)) - true).max()))
        memory.append(resident_mb())
    return {
        'settings': settings, 'samples': done, 'cycles': len(errors), 'not_finite': lost,
        'first_pole_error': errors[0], 'worst_pole_error': max(errors), 'last_pole_error': errors[-1],
        'us_per_sample': 1e6 * (time.perf_counter() - begin) / done,
        'grown_mb': memory[-1] - memory[len(memory) // 10],  # the fits of the first cycles take their buffers
        'peak_memory_mb': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


def main() -> None:
    samples = int(float(sys.argv[1])) if len(sys.argv) > 1 else 10_000_000
    rows = []
    for settings in SETTINGS:
        row = soak(settings, samples)
        rows.append(row)
        error = '/'.join(f'{row[f"{which}_pole_error"]:.1e}' for which in ('first', 'worst', 'last'))
        print(f'{row["settings"]}: {row["samples"]} samples, pole error first/worst/last {error}, '
              f'not finite {row["not_finite"]}, '
              f'{row["us_per_sample"]:.2f} us, peak {row["peak_memory_mb"]:.0f} MB, '
              f'grown {row["grown_mb"]:.2f} MB', flush=True)
        samples = min(samples, 1_000_000)  # the default in full, the others for comparison
    claims.write('identification_soak', rows)


if __name__ == '__main__':
    main()
