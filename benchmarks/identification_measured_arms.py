"""Claim: on the measured DaISy arm one recursive pass simulates the unseen half to 98 % or more, n = 4, 6.

First half identifies, second half validates; the Quanser rig (closed loop) is reported beside it. Peers run
when FLEXMANIP_PEERS names a Python interpreter that has sippy_unipi 1.0.1 and nfoursid 1.0.2; without it their
recorded scores are kept, as are those of a record that is not there. The settings
are the defaults but for order, windows and signals. Records: folder FLEXMANIP_DATA or ../shared/data.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from pathlib import Path

import claims
import numpy as np

from flexmanip_ros.identification import rpbsid
from flexmanip_ros.io.bag import read
from flexmanip_ros.parameters import IdentifierParameters, configure
from flexmanip_ros.samples.sample_log import Signals, log_of
from flexmanip_ros.studies import whole_recording
from flexmanip_ros.types import JointRecord

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get('FLEXMANIP_DATA', ROOT.parent / 'shared' / 'data'))
DT = 0.01
CASES = (
    ('daisy_robot_arm', 1, 0.5, ({'order': 4}, {'order': 6, 'future_window': 10})),
    ('quanser_2dsfl_first_half', 2, 0.6, (
        {'order': 8}, {'order': 8, 'past_window': 20, 'future_window': 10},
        {'order': 12, 'past_window': 20, 'future_window': 10})),
)


def record(name: str, inputs: int) -> tuple[np.ndarray, np.ndarray]:
    items = [item for item in read(DATA / name) if isinstance(item, JointRecord)]
    return np.array([i.effort[:inputs] for i in items]), np.array([i.position for i in items])


def ours(u: np.ndarray, y: np.ndarray, half: int, values: dict[str, object]) -> dict[str, list[float]]:
    config = configure(IdentifierParameters, {
        'inputs': [f'in{i}/effort' for i in range(u.shape[1])],
        'outputs': [f'out{i}/position' for i in range(y.shape[1])], 'angles': [''], 'payload_method': 'none',
        **values})
    state = rpbsid.advance(config, rpbsid.init(config), log_of(u, y).rows(0, half))
    found = rpbsid.identified(config, rpbsid.finish(state), DT)
    assert found is not None
    stamps = (np.arange(len(u)) * round(DT * 1e9)).astype(np.int64)
    signals = Signals(stamps, u, y, np.empty((len(u), 0)), np.zeros(len(u), dtype=bool), np.zeros(len(u), dtype=int),
                      config.inputs, config.outputs)
    scores = whole_recording.score(found.model, signals, half * DT, constant=found.constant)
    return {'simulation': scores.simulation.tolist(), 'prediction': scores.prediction.tolist()}


def peers(u: np.ndarray, y: np.ndarray, half: int, orders: list[int]) -> dict[str, object]:
    interpreter = os.environ.get('FLEXMANIP_PEERS')
    if not interpreter:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'record.npz'
        np.savez(path, u=u, y=y, half=half, orders=orders)
        run = subprocess.run(
            [interpreter, str(ROOT / 'benchmarks' / 'identification_peers.py'), str(path)],
            capture_output=True, text=True, check=False, timeout=900)
    if run.returncode:
        return {'peers': run.stderr[-300:]}
    return dict(json.loads(run.stdout.splitlines()[-1]))


def words(scores: object) -> str:
    return ' '.join(f'{v:7.2f}' for v in scores) if isinstance(scores, list) else str(scores)


def main() -> None:
    recorded = claims.read('identification_measured_arms') or {}
    table: dict[str, object] = {}
    for name, inputs, share, settings in CASES:
        if not (DATA / name).exists():
            print(f'{name}: not at {DATA}, skipped')
            continue
        u, y = record(name, inputs)
        half = int(share * len(u))
        rows: dict[str, object] = {}
        print(f'{name}: {half} samples identify, {len(u) - half} validate; variance accounted for [%]')
        for values in settings:
            scores = ours(u, y, half, values)
            label = 'ours ' + ' '.join(f'{k}={v}' for k, v in values.items())
            rows[label] = scores
            print(f'  {label:<48} simulation {words(scores["simulation"])}   '
                  f'prediction {words(scores["prediction"])}', flush=True)
        others = peers(u, y, half, sorted({int(v['order']) for v in settings})) or {
            label: score for label, score in recorded.get(name, {}).items() if not label.startswith('ours')}
        for label, score in others.items():
            print(f'  {label:<48} simulation {words(score)}')
        table[name] = {**rows, **others}
    claims.write('identification_measured_arms', recorded | table)


if __name__ == '__main__':
    main()
