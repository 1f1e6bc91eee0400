"""Claim: the whole identifier takes 5 us a sample at p = 10, r = 2, m = 4, n = 4 in the offline loop.

Beside it, in the same run: a bare compiled covariance update of the least-squares size (60 x 60, rank one),
the Givens update alone, the paper's recursion, and how all of it grows with p and m.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import claims
import numpy as np
from numba import njit

from flexmanip_ros.identification import rpbsid
from flexmanip_ros.identification.factor import rotate
from flexmanip_ros.parameters import IdentifierParameters, configure
from flexmanip_ros.samples.sample_log import log_of


@njit(cache=True)
def bare_update(P: np.ndarray, rows: np.ndarray, gain: np.ndarray, beta: float) -> None:
    """P <- (P - P phi phi' P / (beta + phi' P phi)) / beta for every row, as compiled code does it."""
    d = P.shape[0]
    for k in range(rows.shape[0]):
        for j in range(d):
            gain[j] = 0.0
        for i in range(d):
            a = rows[k, i]
            for j in range(d):
                gain[j] += a * P[i, j]
        total = beta
        for i in range(d):
            total += rows[k, i] * gain[i]
        back = 1.0 / beta
        for i in range(d):
            a = gain[i] / total
            for j in range(d):
                P[i, j] = (P[i, j] - a * gain[j]) * back


@njit(cache=True)
def sweeps(R: np.ndarray, rows: np.ndarray, root: float) -> None:
    """The least-squares step of the identifier alone: one Givens rotation of the factor a row."""
    row = np.empty(R.shape[1])
    for k in range(rows.shape[0]):
        row[:] = rows[k]
        rotate(R, row, 0, R.shape[1], root)


WARM_UP = 4096
"""Samples before the clock starts: the fits of the first stretch are over."""


def motion(r: int, m: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Random steps of the inputs (N, r) and the noisy response (N, m) of a lightly damped system, order 4."""
    rng = np.random.default_rng(0)
    blocks = [0.999 * np.array([[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]]) for w in (0.036, 0.043)]
    A = np.block([[blocks[0], np.zeros((2, 2))], [np.zeros((2, 2)), blocks[1]]])
    B, C = rng.standard_normal((4, r)), np.vstack([np.eye(4), rng.standard_normal((4, 4))])[:m]
    u = rng.standard_normal((count // 100 + 1, r)).repeat(100, axis=0)[:count]
    x, y = np.zeros(4), np.empty((count, m))
    for k in range(count):
        y[k] = C @ x
        x = A @ x + B @ u[k]
    return u, y + 0.01 * np.std(y, axis=0) * rng.standard_normal(y.shape)


def best(work, count: int, repeats: int = 7) -> float:  # type: ignore[no-untyped-def]
    """Shortest time of one sample [us]."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return 1e6 * min(times) / count


def identifier(p: int, r: int, m: int, count: int, publish: int = 0, **values: object) -> float:
    """Time of one sample [us]; publish: a model every so many samples."""
    config = configure(IdentifierParameters, {
        'inputs': [f'in{i}/effort' for i in range(r)], 'outputs': [f'out{i}/position' for i in range(m)],
        'order': 4, 'past_window': p, 'future_window': 5, **values})
    u, y = motion(r, m, count + WARM_UP)
    log = log_of(u, y)
    start = rpbsid.advance(config, rpbsid.init(config), log.rows(0, WARM_UP))

    def work() -> None:
        state = start
        for k in range(WARM_UP, log.end, publish or count):
            state = rpbsid.advance(config, state, log.rows(k, min(k + (publish or count), log.end)))
            if publish:
                rpbsid.identified(config, state, 1e-3)
    work()
    return best(work, count, 5)


def draw(growth: list[dict[str, float]]) -> None:
    """Draw docs/images/identification_speed.png."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7.0, 4.0), layout='constrained')
    for m in sorted({row['outputs'] for row in growth}):
        rows = [row for row in growth if row['outputs'] == m]
        axes.loglog([row['past_window'] for row in rows], [row['us'] for row in rows], 'o-',
                    label=f'{m:g} outputs')
    axes.set_xticks([10, 20, 50, 100], ['10', '20', '50', '100'])
    axes.set(xlabel='past window p [samples]', ylabel='update [us a sample]',
             title='Two inputs, order 4: an update costs the square of p (r + m)')
    axes.grid(True, which='both', alpha=0.3)
    axes.legend()
    target = Path(__file__).resolve().parents[1] / 'docs' / 'images' / 'identification_speed.png'
    target.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(target, dpi=110)


def main() -> None:
    count = 20000
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((count, 66))
    P, R = np.eye(60), np.eye(66)
    bare_update(P, rows[:1, :60], np.empty(60), 0.999)
    sweeps(R, rows[:1], 0.999)
    R60 = np.eye(64)
    table = {
        'bare 60 x 60 covariance update': best(
            lambda: bare_update(P, rows[:, :60], np.empty(60), 0.999), count),
        'least-squares step, 60 regressors, 4 outputs': best(
            lambda: sweeps(R60, np.ascontiguousarray(rows[:, :64]), 0.999), count),
        'identifier, update, no refinement': identifier(10, 2, 4, count, refinement='none'),
        'identifier, update': identifier(10, 2, 4, count),
        'identifier, update and a model every 20 samples': identifier(10, 2, 4, 4000, publish=20),
        "paper's recursion, update": identifier(10, 2, 4, count // 4, estimator='paper'),
    }
    bare = table['bare 60 x 60 covariance update']
    for name, value in table.items():
        print(f'{name:<52}{value:8.2f} us{value / bare:8.2f} x bare', flush=True)
    growth = []
    if 'short' not in sys.argv:
        for p in (10, 20, 50, 100):
            for m in (1, 2, 4, 8):
                value = identifier(p, 2, m, max(200, 40000 // p), refinement='none')
                growth.append({'past_window': p, 'outputs': m, 'us': value})
                print(f'p = {p:<4} m = {m:<3}{value:10.2f} us', flush=True)
    if growth:
        draw(growth)
    claims.write('identification_speed', {'microseconds': table, 'growth': growth})


if __name__ == '__main__':
    main()
