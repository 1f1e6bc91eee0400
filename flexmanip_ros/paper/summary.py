"""The results of the paper's cases over all runs: one line per case and method."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from flexmanip_ros.paper import experiments
from flexmanip_ros.studies import trial
from flexmanip_ros.studies.metrics import coverage
from flexmanip_ros.types import Array

Bounds = Mapping[tuple[str, str], float]
"""(case, method) -> Cramer-Rao bound of the payload at the end of a run [kg]."""
Line = dict[str, Any]


def summary(rows: Sequence[trial.Row], bounds: Bounds) -> list[Line]:
    """Return one line a case and method: error, bound, coverage with its interval, failures, cost."""
    lines = []
    for case in experiments.CASES:
        for method in experiments.METHODS:
            mine = of(rows, case, method.name)
            if not mine:
                continue
            good = [row for row in mine if not row['error'] and row['error_percent'] is not None]
            last = [row for row in good if row['payload_mass_kg'] is not None]
            final = np.array([100.0 * (row['payload_mass_kg'] / case.payload - 1.0) for row in last])
            half = [50.0 * (row['payload_upper_kg'] - row['payload_lower_kg']) / case.payload for row in good
                    if row['payload_upper_kg'] is not None and row['payload_lower_kg'] is not None]
            least = bounds.get((case.name, method.name))
            share, low, high = coverage(sum(bool(row['covered']) for row in good), len(good))
            lines.append({
                'case': case.title, 'method': method.name, 'runs': len(mine), 'failed': len(mine) - len(good),
                'mean error [%]': _of(column(good, 'error_percent'), np.mean),
                'median error [%]': _of(column(good, 'error_percent'), np.median),
                'bias at 6 s [%]': _of(final, np.mean), 'rms error at 6 s [%]': _of(final, _rms),
                'bound at 6 s [%]': None if least is None else 100.0 * least / case.payload,
                '95 % interval holds [%]': share, 'from [%]': low, 'to [%]': high,
                'half width [%]': _of(np.array(half), np.median),
                'frequency error [%]': _of(np.array([_frequency(row) for row in good]), np.nanmean),
                'time per sample [us]': _of(column(good, 'us_per_sample'), np.median)})
    return lines


def of(rows: Sequence[trial.Row], case: experiments.Case, method: str) -> list[trial.Row]:
    """Return the rows of a case and method."""
    return [row for row in rows if (row['case'], row['method']) == (case.name, method)]


def column(rows: Sequence[trial.Row], name: str) -> Array:
    """Return the values of a column, without missing ones."""
    return np.array([row[name] for row in rows if row.get(name) is not None], dtype=np.float64)


def errors(rows: Sequence[trial.Row]) -> dict[tuple[str, str], list[float]]:
    """Return (case, method) -> mean relative error of each run [%]."""
    found: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        if not row['error'] and row['error_percent'] is not None:
            found.setdefault((row['case'], row['method']), []).append(row['error_percent'])
    return found


def frequency_lines(rows: Sequence[trial.Row], cases: Sequence[experiments.Case]) -> list[list[Any]]:
    """Return Table 2: configuration, method, mean error [%] of both frequencies."""
    lines: list[list[Any]] = []
    for case in cases:
        for method in ('paper', experiments.BEST_MODEL):
            mine = of(rows, case, method)
            lines.append([case.title, method, *(
                _of(column(mine, f'frequency_error_percent_{k}'), np.mean) for k in (1, 2))])
    return lines


def _frequency(row: trial.Row) -> float:
    known = [row[name] for name in ('frequency_error_percent_1', 'frequency_error_percent_2')
             if row.get(name) is not None]
    return float(np.mean(known)) if known else np.nan


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _of(values: Array, how: Callable[[Array], Any]) -> float | None:
    known = values[np.isfinite(values)]
    return float(how(known)) if known.size else None
