"""Claim: 95 % intervals of frequencies, damping ratios and payload cover 93-97 % at 40 dB and 20 dB.

Linear plant at 60/45 deg holding 20 kg, kappa = 1 as configured, the paper's torques, sensor noise on
displacements and rates, 3 s at 1 kHz, default settings; at least 1000 seeds a case, others for each. Beside
it, what chance does to so many runs: `exact` is the coverage of an estimate that errs by the first order
of the noise alone, its interval the Cramer-Rao bound, on the same noise; claimed over bound is the claim's
width.
Use: identification_coverage.py [runs].
"""

from __future__ import annotations

import sys

import claims
import numpy as np

from flexmanip_ros.arm.linearization import blocks, discretize, vibration_model
from flexmanip_ros.identification import rpbsid
from flexmanip_ros.identification.realization import to_continuous
from flexmanip_ros.identification.uncertainty import modes
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters, configure
from flexmanip_ros.payload.block_extraction import estimate, masses
from flexmanip_ros.samples.sample_log import log_of

DT, COUNT, MASS = 1e-3, 3000, 20.0
THETA = np.radians([60.0, 45.0])
DAMPING = 0.01
NAMES = ('f1', 'f2', 'damping 1', 'damping 2', 'payload')
SEEDS = {40.0: 0, 20.0: 1_000_000}
"""First seed of each level."""
SEEN = 2816
"""Samples that the fit has taken in after 3 s: all but the block under way."""


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
    return u, y, derived(arm, A, B)


def derived(arm: ArmParameters, A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return what is estimated, (5,), of a discrete model with the state [eta; eta']."""
    Ac, Bc = to_continuous(A, B, DT)
    poles = np.linalg.eigvals(Ac)
    poles = poles[poles.imag > 0]
    poles = poles[np.argsort(poles.imag)]
    mass = float(masses(arm, blocks(arm, THETA, kappa=1), Ac, Bc, False))
    return np.array([*(poles.imag / (2 * np.pi)), *(-poles.real / np.abs(poles)), mass])


def influence(arm: ArmParameters, u: np.ndarray, clean: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return (5, 4 SEEN): what unit noise of each sample and output does to an efficient estimate.

    A, B and the first state are unknown; the length of a row is the Cramer-Rao bound of the deviation.
    """
    A, B = discretize(*vibration_model(arm, THETA, MASS, kappa=1), DT)
    n, r = B.shape
    X = np.hstack([np.zeros((n, n * (n + r))), np.eye(n)])
    rows = np.empty((SEEN, *X.shape))
    for k in range(SEEN):
        rows[k] = X / spread[:, None]
        X = A @ X
        for i in range(n):
            X[i, i * n:(i + 1) * n] += clean[k]
            X[i, n * n + i * r:n * n + (i + 1) * r] += u[k]
    both = np.concatenate([A.ravel(), B.ravel()])
    gradient = np.zeros((len(NAMES), X.shape[1]))
    for i, step in enumerate(1e-7 * np.maximum(np.abs(both), 1e-3)):
        ends = [both + sign * step * (np.arange(both.size) == i) for sign in (1, -1)]
        plus, minus = (derived(arm, end[:n * n].reshape(n, n), end[n * n:].reshape(n, r)) for end in ends)
        gradient[:, i] = (plus - minus) / (2 * step)
    tall = rows.reshape(-1, X.shape[1])
    size = np.linalg.norm(tall, axis=0)
    Q, R = np.linalg.qr(tall / size)
    return np.asarray(np.linalg.solve(R.T, (gradient / size).T).T @ Q.T)


def study(runs: int, snr_db: float) -> dict[str, object]:
    arm = ArmParameters(torque_convention='paper', damping_ratio=DAMPING, modes=1)
    config = configure(IdentifierParameters, {
        'arm.torque_convention': 'paper', 'arm.damping_ratio': DAMPING, 'arm.modes': 1,
        'payload_method': 'block'})
    u, clean, truth = clean_response(arm)
    spread = np.sqrt(np.mean(clean ** 2, axis=0) * 10.0 ** (-snr_db / 10.0))
    weights = influence(arm, u, clean, spread)
    bound = np.linalg.norm(weights, axis=1)
    errors, deviations, inside, exact = [], [], [], []
    for seed in range(SEEDS[snr_db], SEEDS[snr_db] + runs):
        noise = np.random.default_rng(seed).standard_normal(clean.shape)
        exact.append(np.abs(weights @ noise[:SEEN].ravel()) < 1.96 * bound)
        y = clean + spread * noise
        found = rpbsid.identified(config, rpbsid.advance(config, rpbsid.init(config), log_of(u, y).rows(0, len(u))), DT)
        if found is None or len(modes(found)) != 2:
            inside.append([False] * 5)
            continue
        both = modes(found)
        held = estimate(config, found, THETA, np.empty(0))
        values = [both[0].frequency_hz, both[1].frequency_hz, both[0].damping_ratio, both[1].damping_ratio]
        std = [both[0].frequency_std_hz, both[1].frequency_std_hz,
               both[0].damping_ratio_std, both[1].damping_ratio_std]
        error = np.array(values) - truth[:4]
        inside.append([*(np.abs(error) < 1.96 * np.array(std)), held.lower <= MASS <= held.upper])
        errors.append([*error, held.mass - MASS])
        deviations.append([*std, held.std])
    cover = np.mean(inside, axis=0)
    return {
        'snr_db': snr_db, 'damping_ratio': DAMPING, 'runs': runs, 'names': NAMES,
        'coverage_percent': (100 * cover).tolist(),
        'exact_percent': (100 * np.mean(exact, axis=0)).tolist(),
        'claimed_over_bound': (np.median(deviations, axis=0) / bound).tolist(),
        'bias': np.mean(errors, axis=0).tolist(),
        'scatter': np.std(errors, axis=0).tolist(), 'claimed': np.median(deviations, axis=0).tolist()}


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    rows = []
    print(f'{"case":<22}' + ''.join(f'{name:>12}' for name in NAMES))
    for snr_db in (40.0, 20.0):
        row = study(runs, snr_db)
        rows.append(row)
        label = f'{snr_db:.0f} dB, damping {DAMPING}'
        print(f'{label:<22}' + ''.join(f'{c:11.1f}%' for c in row['coverage_percent']), flush=True)
        print(f'  {"exact, same noise":<20}' + ''.join(f'{c:11.1f}%' for c in row['exact_percent']))
        for what in ('bias', 'scatter', 'claimed', 'claimed_over_bound'):
            print(f'  {what:<20}' + ''.join(f'{c:12.2e}' for c in row[what]), flush=True)
    claims.write('identification_coverage', rows)


if __name__ == '__main__':
    main()
