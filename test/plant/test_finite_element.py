"""The finite element arm: published beams, and the assumed modes as they grow in number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh

from flexmanip_ros.arm import linearization
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, PlantParameters
from flexmanip_ros.simulation import excitation, models, simulator
from flexmanip_ros.types import Array, CaptureEvent, EventKind

POINT = np.radians([60.0, 45.0])
CONFIG = PlantParameters(noise='none', arm=ArmParameters(modes=5, damping_ratio=0.01))
SMALL = 1e-3 * excitation.sequence(ExcitationParameters(), 1500)
CAPTURE = (CaptureEvent(700_000_000, EventKind.CAPTURE),)


def loaded(beam: models.Beam, mass: float, inertia: float) -> Array:
    """Mass matrix of a beam with a body at its end."""
    M = beam.M.copy()
    M[-2, -2] += mass
    M[-1, -1] += inertia
    return M


@pytest.mark.parametrize(('mass', 'inertia', 'published'), [
    (1.2, 0.1338, (0.47969, 1.79659)),  # link 1: elbow, link 2 and tip as a body
    (0.1, 0.0005, (2.17833, 15.91451)),  # link 2: tip
])
def test_clamped_links_of_de_luca_and_siciliano(
    mass: float, inertia: float, published: tuple[float, float],
) -> None:
    """De Luca and Siciliano, IEEE Trans. SMC 21 (1991): 0.48 / 1.80 and 2.18 / 15.91 Hz."""
    inertia_exact = 0.1 + 0.2 * 0.5**3 / 3 + 0.1 * 0.5**2 + 0.0005 if mass > 1 else inertia
    link = models.beam(0.5, 0.2, 1.0, 40)
    M = loaded(link, mass, inertia_exact)[2:, 2:]
    squares = eigh(link.K[2:, 2:], M, eigvals_only=True)
    assert np.sqrt(squares[:2]) / (2 * np.pi) == pytest.approx(published, abs=2e-5)


def test_space_arm_whose_root_turns_freely() -> None:
    """DETC2007-35511: 5.28 / 20.9 / 46.7 rad/s."""
    rho, L = 2.82, 3.372
    link = models.beam(L, rho, 5.974**2 * rho, 40)
    M = loaded(link, 5.18 * rho * L, 0.0)
    squares = eigh(link.K[1:, 1:], M[1:, 1:], eigvals_only=True)
    assert np.sqrt(squares[1:4]) == pytest.approx([5.283, 20.842, 46.770], abs=1e-3)


@pytest.mark.parametrize('payload', [0.0, 20.0, 100.0])
def test_frequencies_are_those_of_many_assumed_modes(payload: float) -> None:
    parts = models.chain(CONFIG.arm, tuple(POINT), 12)
    M = parts.M + payload * parts.tip[:2].T @ parts.tip[:2]
    elements = np.sqrt(eigh(parts.K, M, eigvals_only=True)[2:6]) / (2 * np.pi)
    Ac, _ = linearization.vibration_model(replace(CONFIG.arm, damping_ratio=0.0), POINT, payload, 12)
    assert linearization.frequencies(Ac)[:4] == pytest.approx(elements, rel=2e-4)


def test_assumed_modes_converge_to_the_elements() -> None:
    arm = replace(CONFIG.arm, damping_ratio=0.0)
    parts = models.chain(arm, tuple(POINT), 40)
    exact = np.sqrt(eigh(parts.K, parts.M, eigvals_only=True)[2]) / (2 * np.pi)
    errors = [
        linearization.frequencies(linearization.vibration_model(arm, POINT, 0.0, k)[0])[0] / exact - 1
        for k in (1, 2, 4, 8)]
    assert np.all(np.diff(np.abs(errors)) < 0)
    assert abs(errors[-1]) < 2e-5


@pytest.mark.parametrize(('torque', 'angle'), [('joint', 'encoder'), ('paper', 'chord'), ('joint', 'chord')])
@pytest.mark.parametrize('damping', ['stiffness', 'modal'])
def test_responses_agree_with_the_assumed_modes(torque: str, angle: str, damping: str) -> None:
    arm = ArmParameters(modes=12, damping_ratio=0.01, damping_model=damping, torque_convention=torque,
                        angle_convention=angle, sensor_position=(0.4, 0.7))
    config = replace(CONFIG, arm=arm)
    elements = simulator.simulate(replace(config, model='finite_element'), SMALL, CAPTURE)
    modes = simulator.simulate(replace(config, model='linear'), SMALL, CAPTURE)
    gap = np.sqrt(np.mean((elements.position - modes.position) ** 2, axis=0)) / elements.position.std(axis=0)
    assert np.all(gap[2:] < 2e-3)
    assert np.all(gap[:2] < 5e-2)  # twelve sines make a slope slowly


def test_locked_joints_stay_and_the_models_agree() -> None:
    config = replace(CONFIG, locked=True, arm=ArmParameters(modes=10, damping_ratio=0.01))
    push = np.zeros((200, 2))
    hit = replace(config, object_velocity=(0.01, -0.02), payload_mass=5.0)
    runs = {}
    for model in ('nonlinear', 'linear', 'finite_element'):
        run = simulator.simulate(replace(hit, model=model), push, (CaptureEvent(0, EventKind.CAPTURE),))
        assert np.abs(run.position[:, :2] - run.position[0, :2]).max() < 1e-9
        runs[model] = run.position[:, 2:]
    scale = runs['finite_element'].std(axis=0)
    assert np.all(np.abs(runs['nonlinear'] - runs['linear']).max(axis=0) < 0.01 * scale)
    gap = (runs['finite_element'] - runs['linear']).std(axis=0)
    assert np.all(gap < 0.25 * scale)  # clamped roots of ten sines


def test_locked_frequencies_converge_to_clamped_ones() -> None:
    fine = replace(CONFIG, locked=True, model='finite_element', elements=20)
    exact = _lowest(simulator.init(fine).model)
    errors = []
    for kappa in (2, 4, 8):
        config = replace(fine, model='linear', arm=ArmParameters(modes=kappa))
        errors.append(_lowest(models.linear_model(config)) / exact - 1)
    assert np.all(np.diff(np.abs(errors)) < 0)
    assert abs(errors[-1]) < 0.05


def _lowest(model: models.LinearModel) -> float:
    return float(np.sqrt(eigh(model.K, model.M0, eigvals_only=True)[0]))


def test_stepping_and_simulating_give_the_same_bits() -> None:
    config = replace(CONFIG, model='finite_element', elements=4)
    run = simulator.simulate(config, SMALL[:50])
    state = simulator.init(config)
    for k in range(50):
        state, record = simulator.step(config, state, SMALL[k])
        assert np.array_equal(record.position, run.position[k])
        assert np.array_equal(record.velocity, run.velocity[k])
