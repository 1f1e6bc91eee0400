"""Claim: the more precise the sensors, the better the payload is known, up to 60 dB (encoders of 1e-5 rad).

Arms with friction, rotors, gains and offsets (``parts.real_arms``), whose sensors have 40, 50 and 60 dB. At 60 dB the
modes that the estimator's shape functions leave out exceed the noise by a factor of fifty after each step of the
torques. Capture after 3 s, estimate after 6 s. Draws docs/images/omitted_modes.png.

Use: python benchmarks/payload_precise_sensors.py [--runs 4]
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import claims
import numpy as np
from parts import payload_trials as trials
from parts.real_arms import CAPTURE, plant_of, simulate, told

from flexmanip_ros import pipeline
from flexmanip_ros.payload import structured
from flexmanip_ros.samples import sampling
from flexmanip_ros.simulation import simulator
from flexmanip_ros.types import Status

CASES = ('ideal', 'viscous', 'coulomb', 'rotor', 'friction and rotor', 'gains and offset')
SNR_DB = (40.0, 50.0, 60.0)
JUDGED_NS = 100_000_000
"""Time from the capture to the first estimate that is counted [ns]."""


class Trial(NamedTuple):
    """Which arm, which sensors, which draw."""

    case: str
    snr_db: float
    seed: int


def judged(trial: Trial) -> dict[str, Any]:
    """Identify one run."""
    plant = replace(plant_of(trial.case, trial.seed), snr_db=trial.snr_db)
    found = [estimate.payload for estimate in pipeline.run(told(plant), simulator.records(simulate(plant), (CAPTURE,)))
             if estimate.payload is not None and estimate.stamp_ns > CAPTURE.stamp_ns + JUDGED_NS]
    return {**trial._asdict(), **trials.judged(found, plant.payload_mass)}


def plot() -> None:
    """Draw docs/images/omitted_modes.png: an innovation over two steps of the torques, and what is expected of it."""
    import matplotlib.pyplot as plt

    plant = replace(plant_of('ideal', 1), snr_db=SNR_DB[-1])
    config = told(plant)
    clock, log, state, seen = sampling.Clock(), sampling.EMPTY, structured.init(config), []
    for record in simulator.records(simulate(plant), ()):
        clock, log, _ = sampling.push(config, clock, log, record)
        state = structured.advance(config, state, log.rows(state.cursor, log.end))
        if state.memory is not None:
            e, variance = state.memory.innovation[2]  # after both bends the first angle
            seen.append((record.stamp_ns * 1e-9, *(1e3 * np.array([e, np.sqrt(variance)]))))
    t, e, std = np.array(seen).T
    shown = (t > 2.4) & (t < 2.9)
    figure, axes = plt.subplots(figsize=(8.0, 3.2), layout='constrained')
    axes.fill_between(t[shown], -2.0 * std[shown], 2.0 * std[shown], color='0.85', label='two deviations')
    axes.plot(t[shown], e[shown], lw=0.8, label='innovation of joint 1')
    axes.set(xlabel='time [s]', ylabel='mrad', xlim=(2.4, 2.9))
    axes.legend(loc='upper right', frameon=False)
    figure.savefig(Path(__file__).resolve().parents[1] / 'docs' / 'images' / 'omitted_modes.png', dpi=110)


def main() -> None:
    """Measure, print and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=4)
    given = parser.parse_args()
    drawn = [Trial(case, snr_db, seed) for snr_db in SNR_DB for case in CASES for seed in range(given.runs)]
    done = []
    with ProcessPoolExecutor() as pool:
        for row in pool.map(judged, drawn):
            done.append(row)
            print(row, flush=True)
    rows = []
    for snr_db in SNR_DB:
        here = [row for row in done if row['snr_db'] == snr_db]
        at_end = [row for row in here if row['status'] == Status.TRACKING.value]
        rows.append({
            'snr_db': snr_db, 'runs': len(here), 'tracking_at_the_end': len(at_end),
            'inside_at_the_end': sum(row['inside'] for row in at_end),
            'wrong_and_tracking_percent': round(100.0 * float(np.mean([row['wrong'] for row in here])), 2),
            'median_error_percent': round(float(np.median([abs(row['error_percent']) for row in here])), 3),
            'worst_error_percent': round(max(abs(row['error_percent']) for row in here), 3),
            'median_half_width_percent': round(float(np.median([row['half_width_percent'] for row in here])), 3)})
        print(rows[-1])
    claims.write('payload_precise_sensors', rows)
    plot()


if __name__ == '__main__':
    main()
