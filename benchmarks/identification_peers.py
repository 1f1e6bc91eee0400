"""The peers' side of identification_measured_arms.py: for an interpreter that has sippy_unipi and nfoursid.

Use: python identification_peers.py RECORD.npz (keys u, y, half, orders); prints one JSON object.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys

import numpy as np


def simulate(A, B, C, D, u, y, half):  # type: ignore[no-untyped-def]
    """Free run over the second half, from the state that explains the first half best."""
    n = len(A)
    forced, power, rows, left = np.zeros(n), np.eye(n), [], []
    first = max(0, half - 400)
    for k in range(first, half):
        rows.append(C @ power)
        left.append(y[k] - C @ forced - D @ u[k])
        forced, power = A @ forced + B @ u[k], A @ power
    x0 = np.linalg.lstsq(np.vstack(rows), np.concatenate(left), rcond=None)[0]
    x, out = power @ x0 + forced, []
    for k in range(half, len(u)):
        out.append(C @ x + D @ u[k])
        x = A @ x + B @ u[k]
    return np.array(out)


def vaf(y, yhat):  # type: ignore[no-untyped-def]
    with np.errstate(all='ignore'):
        score = 100 * (1 - np.var(y - yhat, axis=0) / np.var(y, axis=0))
    return [float(max(v, 0.0)) if np.isfinite(v) else 0.0 for v in score]


def main() -> None:
    record = np.load(sys.argv[1])
    u, y, half = record['u'], record['y'], int(record['half'])
    results = {}
    for n in record['orders']:
        for method in ('N4SID', 'MOESP', 'CVA', 'PARSIM-P', 'PARSIM-S', 'PARSIM-K'):
            for window in (20, 30):
                name = f'sippy {method} f={window}'
                try:
                    with contextlib.redirect_stdout(io.StringIO()):
                        from sippy_unipi import system_identification
                        model = system_identification(
                            y[:half].T, u[:half].T, method, SS_fixed_order=int(n), SS_f=window, SS_p=window)
                    A, B, C, D = (np.asarray(part) for part in (model.A, model.B, model.C, model.D))
                    results[f'{name} n={n}'] = vaf(y[half:], simulate(A, B, C, D, u, y, half))
                except Exception as problem:
                    results[f'{name} n={n}'] = f'{type(problem).__name__}: {problem}'[:120]
        try:
            import pandas
            from nfoursid.nfoursid import NFourSID
            columns = {f'u{i}': u[:half, i] for i in range(u.shape[1])}
            columns |= {f'y{i}': y[:half, i] for i in range(y.shape[1])}
            found = NFourSID(
                pandas.DataFrame(columns), input_columns=[f'u{i}' for i in range(u.shape[1])],
                output_columns=[f'y{i}' for i in range(y.shape[1])], num_block_rows=20)
            found.subspace_identification()
            model, _ = found.system_identification(rank=int(n))
            free = simulate(model.a, model.b, model.c, model.d, u, y, half)
            results[f'nfoursid n={n}'] = vaf(y[half:], free)
        except Exception as problem:
            results[f'nfoursid n={n}'] = f'{type(problem).__name__}: {problem}'[:120]
    print(json.dumps(results))


if __name__ == '__main__':
    main()
