"""Memory stays flat over an hour of simulated time at 1 kHz, sample by sample.

Captures and releases every ten minutes, noise on. Resident memory is read every simulated minute after the
first five (interpreter, compiled functions and caches in place by then).

Use: python benchmarks/plant_hour.py [--minutes N]
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import claims
import numpy as np

from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator

RATE = 1000


def resident_mb() -> float:
    """Resident memory of this process [MB]."""
    pages = int(Path('/proc/self/statm').read_text(encoding='ascii').split()[1])
    return pages * 4096 / 1e6


def main() -> None:
    """Run, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--minutes', type=int, default=60)
    minutes = parser.parse_args().minutes
    config = PlantParameters(noise='std', arm=ArmParameters(modes=1, damping_ratio=0.003))
    # a multisine has no mean, so that the arm does not spin up over the hour
    table = excitation.sequence(ExcitationParameters(shape='multisine', repeat_time=10.0), 10 * RATE)
    state = simulator.init(config)
    memory, largest = [], 0.0
    begin = time.perf_counter()
    for minute in range(minutes):
        if minute % 10 == 5:
            state = simulator.attach(config, state)
        elif minute and minute % 10 == 0:
            state = simulator.release(config, state)
        for k in range(60 * RATE):
            state, record = simulator.step(config, state, table[k % len(table)])
        assert record is not None
        largest = max(largest, float(np.max(np.abs(record.position[2:]))))
        memory.append(resident_mb())
    wall = time.perf_counter() - begin
    settled = memory[min(5, minutes - 1):]
    grown = settled[-1] - settled[0]
    samples = minutes * 60 * RATE
    print(f'{minutes} min simulated in {wall:.0f} s ({wall / samples * 1e6:.1f} us a sample); memory '
          f'{settled[0]:.1f} MB, grown by {grown:.2f} MB; bend up to {1e3 * largest:.1f} mm')
    claims.write('plant_hour', {
        'minutes': minutes, 'wall_s': wall, 'us_per_sample': wall / samples * 1e6,
        'resident_mb': settled[0], 'grown_mb': grown, 'largest_bend_mm': 1e3 * largest,
    })


if __name__ == '__main__':
    main()
