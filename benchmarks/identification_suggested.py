"""Claim: told names alone, identify_bag --suggest predicts measured arms 0.25 s ahead as well as the best of a grid.

The first half of each recording is looked at and identified, the second is predicted 0.25 s ahead of the last sample
used. The grid is batch PBSID over decimation 1, 2, 5, 10, order 4 to 10 and windows of 0.1 and 0.3 s, past and future;
each model with the state of its predictor and with that of its last window. The wide grid beside it has, where the past
is of bearable length, unweighted states and a short future window too. The best of each is chosen knowing the second
half, which the suggestion does not. Records: folder FLEXMANIP_DATA or ../shared/data.
"""

from __future__ import annotations

import itertools
import os
import time
from pathlib import Path
from typing import NamedTuple

import claims
import numpy as np

from flexmanip_ros.cli.replay import Request, identify
from flexmanip_ros.cli.suggest import suggest
from flexmanip_ros.errors import ModelError
from flexmanip_ros.identification import decimation, validation
from flexmanip_ros.identification.pbsid import pbsid
from flexmanip_ros.io import bag
from flexmanip_ros.parameters import configure
from flexmanip_ros.parameters.identifier import IdentifierParameters
from flexmanip_ros.samples import sampling
from flexmanip_ros.studies.whole_recording import HORIZON_S
from flexmanip_ros.types import Array, StateSpace

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get('FLEXMANIP_DATA', ROOT.parent / 'shared' / 'data'))
IST = (('motor/effort',), ('motor/position', 'strain/position'))
CASES = {
    'ist_arm_a05_f10': IST, 'ist_arm_a10_f08': IST, 'ist_arm_a15_f04': IST,
    'merit_two_link_1': (('joint2/effort', 'joint3/effort'),
                         ('joint2/position', 'joint3/position', 'strain2a/position', 'strain3a/position')),
    'quanser_2dsfl_first_half': (('joint1/effort', 'joint2/effort'),
                                 ('joint1/position', 'joint2/position', 'link1_bend/position', 'link2_bend/position')),
    'daisy_robot_arm': (('arm/effort',), ('arm/position',)),
}
FACTORS, ORDERS, WINDOWS_S = (1, 2, 5, 10), range(4, 11), (0.1, 0.3)
BEARABLE = 320
"""Regressors beyond which one batch takes seconds."""


def windowed(model: StateSpace, U: Array, Y: Array, past: int, steps: int) -> tuple[Array, int]:
    """Predictions from the state that the last ``past`` samples alone give, and the row of the first."""
    F, G = model.A - model.K @ model.C, model.B - model.K @ model.D
    driven = U @ G.T + Y @ model.K.T
    count = len(U) - past - steps + 1
    X = np.zeros((max(count, 0), model.order))
    for j in range(past):
        X = X @ F.T + driven[j:j + count]
    for j in range(steps - 1):
        X = X @ model.A.T + U[past + j:past + j + count] @ model.B.T
    last = past + steps - 1
    return X @ model.C.T + U[last:last + count] @ model.D.T, last


class Best(NamedTuple):
    """The best point of a grid: its VAF [%] in the mean and one per output, and which it was."""

    mean: float = -1.0
    scores: tuple[float, ...] = ()
    name: str = ''


def grids(u: Array, y: Array, dt: float, half: int) -> tuple[Best, Best]:
    """Return the best of the grid and that of the wide one."""
    best, wide = Best(), Best()
    joint = np.hstack([u, y])
    r = u.shape[1]
    for factor in FACTORS:
        learned, _ = decimation.whole(joint[:half], factor)
        whole, rows = decimation.whole(joint, factor)
        steps = max(1, round(HORIZON_S / (factor * dt))) + (decimation.LAG if factor > 1 else 0)
        for window in WINDOWS_S:
            past = max(2, round(window / (factor * dt)))
            short = past * joint.shape[1] <= BEARABLE
            kinds = itertools.product(ORDERS, sorted({past, min(past, 10)} if short else {past}),
                                      (True, False) if short else (True,))
            for order, future, weighted in kinds:
                try:
                    model, _ = pbsid(learned[:, :r], learned[:, r:], n=order, p=past, f=future, dt=factor * dt,
                                     weighted=weighted)
                except (ModelError, np.linalg.LinAlgError):
                    continue
                with np.errstate(all='ignore'):
                    filtered = validation.predict_ahead(model, whole[:, :r], whole[:, r:], steps)
                    for ahead, first in ((filtered, steps - 1),
                                         windowed(model, whole[:, :r], whole[:, r:], past, steps)):
                        at = rows[first:]
                        scored = at >= half + round(HORIZON_S / dt) - 1  # the predictions that ours has there
                        scores = validation.vaf(y[at[scored]], ahead[scored])
                        name = f'decimation {factor}, order {order}, window {window:g} s'
                        found = Best(float(scores.mean()) if len(scores) else -1.0, tuple(scores.tolist()), name)
                        wide = max(wide, found)
                        if weighted and future == past:
                            best = max(best, found)
    return best, wide


def main() -> None:
    table = claims.read('identification_suggested') or {}
    for name, (inputs, outputs) in CASES.items():
        if not (DATA / name).exists():
            print(f'{name}: not at {DATA}, skipped')
            continue
        given = {'inputs': inputs, 'outputs': outputs, 'angles': (), 'payload_method': 'none'}
        signals = sampling.collect(configure(IdentifierParameters, given), bag.read_blocks(DATA / name))
        half = len(signals.stamp_ns) // 2
        half_s, dt = float(signals.time[half]), float(signals.time[1])
        begin = time.perf_counter()
        place = claims.RESULTS / 'suggested.yaml'
        config, _ = suggest(str(DATA / name), str(place), given, bag.Topics(), half_s, HORIZON_S)
        place.unlink()
        took = time.perf_counter() - begin
        summary = identify(Request(DATA / name, config, validate_from=half_s)).summary
        assert summary.vaf_horizon_percent is not None
        ours = [float(score or 0.0) for score in summary.vaf_horizon_percent]
        best, wide = grids(signals.u, signals.y, dt, half)
        print(f'{name}: suggested in {took:.1f} s: decimation {config.decimation}, order {config.order}, '
              f'past window {config.past_window}; VAF {HORIZON_S:g} s ahead [%]')
        for words, scores in ((f'best of the grid ({best.name})', best.scores),
                              (f'best of the wide grid ({wide.name})', wide.scores), ('suggested', ours)):
            print(f'  {words:<62} {" ".join(f"{score:7.2f}" for score in scores)}  mean {np.mean(scores):.3f}',
                  flush=True)
        table[name] = {'suggested': ours, 'grid': best.scores, 'grid_best': best.name, 'wide': wide.scores,
                       'wide_best': wide.name, 'simulation': summary.vaf_simulation_percent,
                       'gain': float(np.mean(ours)) - best.mean, 'gain_wide': float(np.mean(ours)) - wide.mean,
                       'seconds': took}
    claims.write('identification_suggested', table)


if __name__ == '__main__':
    main()
