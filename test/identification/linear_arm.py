from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from flexmanip_ros.identification import rpbsid
from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.numerics.background import INLINE, Background
from flexmanip_ros.parameters import IdentifierParameters, configure
from flexmanip_ros.samples.sample_log import SampleLog, Width
from flexmanip_ros.types import StateSpace

ROOT = Path(__file__).resolve().parents[2]


def benchmark(name: str) -> ModuleType:
    """A benchmark as a module, so that a test can run a short form of it."""
    folder = str(ROOT / 'benchmarks')
    if folder not in sys.path:
        sys.path.append(folder)  # benchmarks import each other
    return importlib.import_module(name)


def shared_data(name: str) -> Path:
    """A measured record that stays outside the repository; skips where it is absent."""
    folder = Path(os.environ.get('FLEXMANIP_DATA', ROOT.parent / 'shared' / 'data'))
    if not (folder / name).exists():
        pytest.skip(f'{name} is not at {folder}; set FLEXMANIP_DATA')
    return folder / name


def configuration(r: int, m: int, **values: object) -> IdentifierParameters:
    return configure(IdentifierParameters, {
        'inputs': [f'in{i}/effort' for i in range(r)], 'outputs': [f'out{i}/position' for i in range(m)],
        'angles': [''], 'payload_method': 'none', **values})


class Run(NamedTuple):
    """An identifier with the sample log that it reads. Feeding it leaves the run it was as it was."""

    config: IdentifierParameters
    log: SampleLog
    state: rpbsid.RpbsidState

    def feed(self, u: np.ndarray, y: np.ndarray, stamp_ns: np.ndarray | None = None,
             background: Background = INLINE) -> Run:
        """Append samples u (N, r), y (N, m) to the log and take them."""
        stamps = np.zeros(len(y), dtype=np.int64) if stamp_ns is None else stamp_ns
        log = self.log.append(stamps, u, y, np.zeros((len(y), 0)), np.zeros(len(y), dtype=np.bool_))
        rows = log.rows(self.log.end, log.end)
        return Run(self.config, log, rpbsid.advance(self.config, self.state, rows, background))


def start(config: IdentifierParameters) -> Run:
    return Run(config, SampleLog(Width(len(config.inputs), len(config.outputs), 0)), rpbsid.init(config))


def run(config: IdentifierParameters, u: np.ndarray, y: np.ndarray, stamp_ns: np.ndarray | None = None) -> Run:
    """The identifier after a whole record."""
    return start(config).feed(u, y, stamp_ns)


def identified(config: IdentifierParameters, state: rpbsid.RpbsidState, dt: float) -> Identified:
    """The model that is there after enough samples."""
    found = rpbsid.identified(config, state, dt)
    assert found is not None
    return found


def observer(A: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Gain of a Kalman filter with strong process noise."""
    n, m = A.shape[0], C.shape[0]
    P = solve_discrete_are(A.T, C.T, 10.0 * np.eye(n), np.eye(m))
    return np.linalg.solve(C @ P @ C.T + np.eye(m), C @ P @ A.T).T


def random_system(n: int, r: int, m: int, rng: np.random.Generator) -> StateSpace:
    """Stable, with poles inside 0.95 and an observer that forgets within a few samples."""
    A = rng.standard_normal((n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    C = rng.standard_normal((m, n))
    K = observer(A, C)
    return StateSpace(A, rng.standard_normal((n, r)), C, np.zeros((m, r)), K, 0.01)


def record(
    model: StateSpace, count: int, noise: float, rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Inputs and outputs of the innovation form, driven by white noise."""
    m, r = model.D.shape
    u = rng.standard_normal((count, r))
    e = noise * rng.standard_normal((count, m))
    x = np.zeros(model.order)
    y = np.empty((count, m))
    for k in range(count):
        y[k] = model.C @ x + model.D @ u[k] + e[k]
        x = model.A @ x + model.B @ u[k] + model.K @ e[k]
    return u, y


def sorted_poles(A: np.ndarray) -> np.ndarray:
    return np.sort_complex(np.linalg.eigvals(A))
