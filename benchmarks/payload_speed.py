"""Claim: `structured` takes 60 us or less a sample at kappa = 3; its ratio to the bare plant is shown.

Microseconds a sample over a run with a capture: the first half second after it (filter and refit), the rest
(filter), and all; for kappa 1, 3 and 5, beside a step of the simulated plant in the same process.

Use: python benchmarks/payload_speed.py
"""

from __future__ import annotations

import time
from dataclasses import replace

import claims
import numpy as np
from parts import payload_trials as trials

from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, PlantParameters
from flexmanip_ros.payload import structured
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind

ARM = ArmParameters(damping_ratio=0.003)


def timed(kappa: int) -> dict[str, float]:
    """Best of three runs."""
    arm = replace(ARM, modes=kappa)
    config = trials.configuration(arm)
    efforts = excitation.sequence(ExcitationParameters(), 4000)
    event = CaptureEvent(2_000_000_000, EventKind.CAPTURE)
    best = dict.fromkeys(('plant_us', 'filter_us', 'refit_us'), np.inf)
    for _ in range(3):
        start = time.perf_counter()
        record = simulator.simulate(PlantParameters(arm=arm), efforts, (event,))
        best['plant_us'] = min(best['plant_us'], (time.perf_counter() - start) / 4000 * 1e6)
        samples = trials.as_samples(record.position, record.velocity, record.effort, 1e-3)
        state = structured.advance(config, structured.init(config), samples.between(0, 2000))
        state = structured.event(config, state, event)
        for name, part in (('refit_us', samples.between(2000, 2500)), ('filter_us', samples.since(2500))):
            start = time.perf_counter()
            state = structured.advance(config, state, part)
            best[name] = min(best[name], (time.perf_counter() - start) / len(part) * 1e6)
    whole = (500 * best['refit_us'] + 1500 * best['filter_us']) / 2000
    return {'kappa': kappa, **{name: round(value, 2) for name, value in best.items()},
            'all_us': round(whole, 2),
            'ratio_filter_to_plant': round(best['filter_us'] / best['plant_us'], 2)}


def main() -> None:
    rows = [timed(kappa) for kappa in (1, 3, 5)]
    for row in rows:
        print(row)
    claims.write('payload_speed', rows)


if __name__ == '__main__':
    main()
