"""Claim: default settings follow both frequencies of the moving nonlinear arm, and say how sure they are.

Default plant (nonlinear, six modes, 40 dB, it turns under the paper's torques), captures of 5 to 100 kg at
3 s in four configurations, told by events; every model read from 0.8 s after the capture until 7 s. The truth
goes with the configuration: that of the last half second, and that of the instant (`now`). `found`: readings
whose two modes are the two lowest ones, not one of them and the next at 50 Hz; the rest is told of those.
Use: identification_moving_arm.py [seeds]
"""

from __future__ import annotations

import itertools
import sys

import claims
import numpy as np

from flexmanip_ros import pipeline
from flexmanip_ros.arm.linearization import vibration_model
from flexmanip_ros.arm.manipulator import chords
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters, configure
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind

CAPTURE_S, AFTER_S, END_S, LATELY_S = 3.0, 0.8, 7.0, 0.5
MASSES = (5.0, 20.0, 50.0, 100.0)
FOUND = 0.1
HEADS = ('found %', 'median err %', 'nine of ten', 'band +- %', 'inside %')
CONFIGURATIONS = ((60.0, 45.0), (0.0, 0.0), (45.0, 0.0), (-45.0, 45.0))


def frequencies(plant: PlantParameters, theta: np.ndarray, payload: float, count: int = 2) -> np.ndarray:
    """The ``count`` lowest [Hz] at chords theta (2,)."""
    Ac, _ = vibration_model(plant.arm, theta, payload)
    poles = np.linalg.eigvals(Ac)
    return np.sort(poles.imag[poles.imag > 0.0])[:count] / (2.0 * np.pi)


def readings(mass: float, degrees: tuple[float, float], seed: int, **given: object) -> list[np.ndarray]:
    """One row a reading: time, error of f1, f2 lately and now, deviations, relative to the frequency.

    given: other parameters of the identifier than its defaults.
    """
    plant = configure(PlantParameters, {
        'seed': seed, 'payload_mass': mass, 'initial_angles': tuple(np.radians(degrees))})
    torque = excitation.sequence(ExcitationParameters(), int(END_S * 1000))
    events = [CaptureEvent(round(CAPTURE_S * 1e9), EventKind.CAPTURE)]
    run = simulator.simulate(plant, torque, events)
    config = configure(IdentifierParameters, {'payload_method': 'none', **given})
    rows = []
    for estimate in pipeline.run(config, simulator.records(run, events)):
        time = estimate.stamp_ns * 1e-9
        if not estimate.model_is_new or time < CAPTURE_S + AFTER_S:
            continue
        last = round(time * plant.rate)
        lately = run.position[last - round(LATELY_S * plant.rate):last + 1, :2]
        truth = [frequencies(plant, chords(plant.arm, angles), mass)
                 for angles in (lately.mean(axis=0), lately[-1])]
        found = std = np.full(2, np.nan)
        if len(estimate.modes) == 2:
            found, std = np.array([(mode.frequency_hz, mode.frequency_std_hz) for mode in estimate.modes]).T
        rows.append(np.concatenate([[time], *((found - f) / f for f in truth), std / truth[0]]))
    return rows


def row_of(label: str, data: np.ndarray, i: int, name: str) -> dict[str, object]:
    """What the readings (N, 7) say of frequency i."""
    found = np.abs(data[:, 2]) < FOUND
    data = data[found]
    error, std = np.abs(data[:, 1 + i + 2 * (name == 'now')]), data[:, 5 + i]
    return {
        'case': label, 'frequency': i + 1, 'truth': name, 'found_percent': 100 * float(found.mean()),
        'median_error_percent': 100 * float(np.median(error)),
        'ninety_error_percent': 100 * float(np.quantile(error, 0.9)),
        'band_percent': 196 * float(np.median(std)),
        'inside_percent': 100 * float(np.mean(error < 1.96 * std))}


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 2
    table = []
    print(f'{"frequency":<24}' + ''.join(f'{head:>13}' for head in HEADS))
    gathered: dict[str, list[np.ndarray]] = {}
    for mass, degrees, seed in itertools.product(MASSES, CONFIGURATIONS, range(1, seeds + 1)):
        label = f'{degrees[0]:.0f}/{degrees[1]:.0f} deg'
        gathered.setdefault(label, []).extend(readings(mass, degrees, seed))
    gathered['all'] = list(itertools.chain(*gathered.values()))
    for label, rows in gathered.items():
        for i, name in itertools.product((0, 1), ('lately', 'now')):
            row = row_of(label, np.array(rows), i, name)
            table.append(row)
            print(f'{label + f", f{i + 1} {name}":<24}'
                  + ''.join(f'{value:13.3f}' for value in list(row.values())[3:]), flush=True)
    claims.write('identification_moving_arm', table)


if __name__ == '__main__':
    main()
