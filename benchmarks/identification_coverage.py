"""Claim: 95 % intervals of frequencies, damping ratios and payload cover 93-97 % at 40 dB and 20 dB.

Linear plant at 60/45 deg holding 20 kg, the paper's torques, sensor noise on displacements and rates, 3 s at
1 kHz, default settings; at least 1000 seeds a case. Use: identification_coverage.py [runs].
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from flexmanip_ros.identification import rpbsid
from flexmanip_ros.identification.modal import modes
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters, configure
from flexmanip_ros.payload.block_extraction import estimate
from flexmanip_ros.plant.linearization import discretize, vibration_model

DT, COUNT, MASS = 1e-3, 3000, 20.0
THETA = np.radians([60.0, 45.0])
NAMES = ('f1', 'f2', 'damping 1', 'damping 2', 'payload')


def clean_response(arm: ArmParameters) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Torques (N, 2), noise-free outputs (N, 4), true [f1, f2, damping 1, damping 2, payload]."""
    Ac, Bc = vibration_model(arm, THETA, MASS, kappa=1)
    A, B = discretize(Ac, Bc, DT)
    k = np.arange(COUNT)
    u = np.stack([10.0 * np.where((k // 500) % 2, -1.0, 1.0), 5.0 * np.where((k // 250) % 2, -1.0, 1.0)], 1)
    x, y = np.zeros(4), np.empty((COUNT, 4))
    for i in range(COUNT):
        y[i] = x
        x = A @ x + B @ u[i]
    poles = np.linalg.eigvals(Ac)
    poles = poles[poles.imag > 0]
    poles = poles[np.argsort(poles.imag)]
    return u, y, np.array([*(poles.imag / (2 * np.pi)), *(-poles.real / np.abs(poles)), MASS])


def study(runs: int, snr_db: float, damping: float) -> dict[str, object]:
    arm = ArmParameters(torque_convention='paper', damping_ratio=damping, modes=1)
    config = configure(IdentifierParameters, {
        'arm.torque_convention': 'paper', 'arm.damping_ratio': damping, 'payload_method': 'block'})
    u, clean, truth = clean_response(arm)
    spread = np.sqrt(np.mean(clean ** 2, axis=0) * 10.0 ** (-snr_db / 10.0))
    errors, deviations, inside = [], [], []
    for seed in range(runs):
        y = clean + spread * np.random.default_rng(seed).standard_normal(clean.shape)
        found = rpbsid.identified(config, rpbsid.advance(config, rpbsid.init(config), u, y), DT)
        if found is None or len(modes(found)) != 2:
            inside.append([False] * 5)
            continue
        both = modes(found)
        held = estimate(config, found, THETA)
        values = [both[0].frequency_hz, both[1].frequency_hz, both[0].damping_ratio, both[1].damping_ratio]
        std = [both[0].frequency_std_hz, both[1].frequency_std_hz,
               both[0].damping_ratio_std, both[1].damping_ratio_std]
        error = np.array(values) - truth[:4]
        inside.append([*(np.abs(error) < 1.96 * np.array(std)), held.lower <= MASS <= held.upper])
        errors.append([*error, held.mass - MASS])
        deviations.append([*std, held.std])
    cover = np.mean(inside, axis=0)
    return {
        'snr_db': snr_db, 'damping_ratio': damping, 'runs': runs, 'names': NAMES,
        'coverage_percent': (100 * cover).tolist(), 'bias': np.mean(errors, axis=0).tolist(),
        'scatter': np.std(errors, axis=0).tolist(), 'claimed': np.median(deviations, axis=0).tolist()}


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    rows = []
    print(f'{"case":<22}' + ''.join(f'{name:>12}' for name in NAMES))
    for snr_db in (40.0, 20.0):
        for damping in (0.01,):
            row = study(runs, snr_db, damping)
            rows.append(row)
            label = f'{snr_db:.0f} dB, damping {damping}'
            print(f'{label:<22}' + ''.join(f'{c:11.1f}%' for c in row['coverage_percent']), flush=True)
            for what in ('bias', 'scatter', 'claimed'):
                print(f'  {what:<20}' + ''.join(f'{c:12.2e}' for c in row[what]), flush=True)
    target = Path(__file__).parent / 'results' / 'identification_coverage.json'
    target.parent.mkdir(exist_ok=True)
    target.write_text(json.dumps(rows, indent=1) + '\n')


if __name__ == '__main__':
    main()
