"""Assumed modes converge to the finite element plant as kappa grows: frequencies, bends and encoder angles.

Reference arm at 60/45 degrees with 20 kg, 40 Hermite elements a link. Bends and angles: relative
root-mean-square difference of the linear plants over 2 s of the paper's square waves, 1 % damping.
Draws docs/images/plant_convergence.png.

Use: python benchmarks/plant_convergence.py
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import claims
import matplotlib as mpl
import numpy as np
from scipy.linalg import eigh

from flexmanip_ros.arm import linearization
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, PlantParameters
from flexmanip_ros.simulation import excitation, models, simulator
from flexmanip_ros.types import CaptureEvent, EventKind

mpl.use('Agg')
from matplotlib import pyplot as plt

HERE = Path(__file__).resolve().parent
KAPPAS = (1, 2, 3, 4, 6, 8, 10, 12)
ELEMENTS = 40
ARM = ArmParameters(damping_ratio=0.01)
CONFIG = PlantParameters(noise='none', arm=ARM, elements=ELEMENTS)


def main() -> None:
    """Compute, print, draw and write."""
    theta = np.array(CONFIG.initial_angles)
    parts = models.chain(ARM, CONFIG.initial_angles, ELEMENTS)
    M = parts.M + CONFIG.payload_mass * parts.tip[:2].T @ parts.tip[:2]
    exact = np.sqrt(eigh(parts.K, M, eigvals_only=True)[2:6]) / (2 * np.pi)
    efforts = excitation.sequence(ExcitationParameters(), 2000)
    event = (CaptureEvent(1_000_000_000, EventKind.CAPTURE),)
    elements = simulator.simulate(replace(CONFIG, model='finite_element'), efforts, event)
    rows = []
    for kappa in KAPPAS:
        undamped = replace(ARM, damping_ratio=0.0)
        Ac, _ = linearization.vibration_model(undamped, theta, CONFIG.payload_mass, kappa)
        found = linearization.frequencies(Ac)
        shift = [abs(float(f / e - 1)) for f, e in zip(found, exact, strict=False)]
        linear = replace(CONFIG, model='linear', arm=replace(ARM, modes=kappa))
        off = simulator.simulate(linear, efforts, event).position - elements.position
        gap = np.sqrt(np.mean(off**2, axis=0)) / elements.position.std(axis=0)
        rows.append({'kappa': kappa, 'frequency': shift, 'response': gap.tolist()})
        print(f'kappa {kappa:2}: frequencies ' + ' '.join(f'{value:.1e}' for value in shift).ljust(32)
              + ' joint1 {:.1e} joint2 {:.1e} bend1 {:.1e} bend2 {:.1e}'.format(*gap))
    draw(rows)
    claims.write('plant_convergence', {'elements': ELEMENTS, 'rows': rows})


def draw(rows: list[dict]) -> None:
    """Two panels: frequencies, responses."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.6), constrained_layout=True)
    for mode in range(4):
        points = [(row['kappa'], row['frequency'][mode]) for row in rows if len(row['frequency']) > mode]
        left.semilogy(*zip(*points, strict=True), 'o-', label=f'mode {mode + 1}')
    left.set_title('natural frequencies')
    for column, name in enumerate(simulator.joint_names(2)):
        style = 's--' if column < 2 else 'o-'
        right.semilogy(KAPPAS, [row['response'][column] for row in rows], style, label=name.replace('_', ' '))
    right.set_title('response to square waves')
    for axes in (left, right):
        axes.set_xlabel('assumed modes a link (kappa)')
        axes.set_ylabel(f'relative difference from {ELEMENTS} finite elements')
        axes.grid(True, which='both', alpha=0.3)
        axes.legend()
    target = HERE.parent / 'docs' / 'images' / 'plant_convergence.png'
    target.parent.mkdir(exist_ok=True)
    figure.savefig(target, dpi=110)


if __name__ == '__main__':
    main()
