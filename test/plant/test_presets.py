"""The arms in config/arms: usable by plant and identifier alike, and what their sources say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import eigh

from flexmanip_ros.arm import linearization
from flexmanip_ros.io import parameter_file
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters, PlantParameters, configure
from flexmanip_ros.simulation import models, simulator

FOLDER = Path(__file__).parents[2] / 'config' / 'arms'
NAMES = ['reference', 'de_luca_siciliano', 'nasa_type', 'quanser']


def arm(name: str) -> ArmParameters:
    values = parameter_file.read(FOLDER / f'{name}.yaml', 'plant_simulator')
    return configure(PlantParameters, values).arm


def test_every_preset_is_tested() -> None:
    assert sorted(path.stem for path in FOLDER.glob('*.yaml')) == sorted(NAMES)


@pytest.mark.parametrize('name', NAMES)
def test_presets_suit_plant_and_identifier(name: str) -> None:
    values = parameter_file.read(FOLDER / f'{name}.yaml', 'rpbsid_identifier')
    assert configure(IdentifierParameters, values).arm == arm(name)


@pytest.mark.parametrize('name', NAMES)
def test_presets_can_be_simulated(name: str) -> None:
    config = configure(PlantParameters, {
        **parameter_file.read(FOLDER / f'{name}.yaml', 'plant_simulator'),
        'noise': 'none', 'payload_mass': 0.05, 'arm.modes': 1})
    run = simulator.simulate(config, np.tile([0.01, 0.0], (50, 1)))
    assert np.all(np.isfinite(run.position))
    assert run.position[-1, 0] != run.position[0, 0]


def test_the_reference_preset_is_the_default() -> None:
    assert arm('reference') == ArmParameters()


def test_de_luca_and_sicilianos_links() -> None:
    preset = arm('de_luca_siciliano')
    (L, _), (rho, rho2) = preset.link_length, preset.linear_density
    J = preset.hub_inertia[1] + rho2 * L**3 / 3 + preset.tip_mass * L**2 + preset.tip_inertia
    carried = (preset.joint_mass + rho2 * L + preset.tip_mass, J), (preset.tip_mass, preset.tip_inertia)
    for (mass, inertia), published in zip(carried, ((0.48, 1.80), (2.18, 15.91)), strict=True):
        link = models.beam(L, rho, preset.bending_stiffness[0], 20)
        link.M[-2, -2] += mass
        link.M[-1, -1] += inertia
        squares = eigh(link.K[2:, 2:], link.M[2:, 2:], eigvals_only=True)
        assert np.sqrt(squares[:2]) / (2 * np.pi) == pytest.approx(published, abs=5e-3)


def test_the_space_arm_with_its_stub() -> None:
    parts = models.chain(arm('nasa_type'), (0.0, 0.3), 20)
    poles = np.sqrt(np.abs(eigh(parts.K, parts.M, eigvals_only=True)[:12]))
    for published in (5.283, 20.842, 46.770):
        assert np.min(np.abs(poles - published)) < 5e-3 * published


def test_the_space_arm_by_assumed_modes() -> None:
    Ac, _ = linearization.vibration_model(arm('nasa_type'), np.array([0.0, 0.3]), 0.0, 8)
    poles = 2 * np.pi * linearization.frequencies(Ac)
    for published in (5.283, 20.842, 46.770):
        assert np.min(np.abs(poles - published)) < 5e-3 * published


def test_the_quanser_link_1_carries_its_published_inertia() -> None:
    preset = arm('quanser')
    carried = preset.joint_mass * preset.link_length[0] ** 2 + preset.joint_inertia
    assert carried == pytest.approx(0.1704, rel=0.05)
