"""Arms and objects as they are, simulated independently of this package: the estimator is told the ideal arm.

The recordings stand outside of the repository; without them these tests are skipped.
"""

from __future__ import annotations

import json
import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording import event, payload_at_end, record, run

from flexmanip_ros.io import bag
from flexmanip_ros.io.parameter_file import read
from flexmanip_ros.parameters import (
    ArmParameters,
    ExcitationParameters,
    IdentifierParameters,
    PayloadParameters,
    PlantParameters,
    configure,
)
from flexmanip_ros.parameters.identifier import LEARNABLE
from flexmanip_ros.payload import structured
from flexmanip_ros.payload.arm_parameters import as_parameters, taught
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import ArmParameter, CaptureEvent, EventKind, Payload, Status

ROOT = Path(__file__).resolve().parents[2]


@cache
def last_payload(name: str) -> tuple[Payload, dict[str, Any]]:
    """What is known of the payload at the end of a recording, and the truth."""
    folder = Path(os.environ.get('FLEXMANIP_DATA', ROOT.parent / 'shared' / 'data'))
    if not (folder / name).exists():
        pytest.skip(f'{name} is not at {folder}; set FLEXMANIP_DATA')
    truth = json.loads((folder / f'{name}.truth.json').read_text(encoding='utf-8'))
    arm = ArmParameters(damping_ratio=0.003)
    if 'base' in truth:
        arm = replace(arm, base_mass=truth['base']['mass'], base_inertia=truth['base']['inertia'])
    return payload_at_end(IdentifierParameters(arm=arm), bag.read(folder / name)), truth


@pytest.mark.parametrize('name', ['arm_friction_rotor', 'arm_gains', 'arm_body', 'arm_orbit'])
def test_the_mass_is_within_seven_tenths_of_a_percent_inside_its_interval_and_trusted(name: str) -> None:
    found, truth = last_payload(name)
    assert found.status is Status.TRACKING
    assert found.mass == pytest.approx(truth['payload'], rel=0.007)
    assert found.lower < truth['payload'] < found.upper


@pytest.mark.parametrize('inertia', [0.2, 0.5])
def test_rotors_that_nobody_told_of_are_learned_from_a_hundred_samples_a_second_too(inertia: float) -> None:
    arm = ArmParameters(damping_ratio=0.003)
    plant = PlantParameters(arm=replace(arm, modes=5, rotor_inertia=(inertia, inertia)), rate=100.0, payload_mass=20.0,
                            seed=3)
    capture = CaptureEvent(3_000_000_000, EventKind.CAPTURE)
    trajectory = simulator.simulate(plant, excitation.sequence(ExcitationParameters(rate=100.0), 600), (capture,))
    found = payload_at_end(IdentifierParameters(arm=arm), simulator.records(trajectory, (capture,)))
    assert found.status is Status.TRACKING
    assert found.mass == pytest.approx(20.0, rel=0.007)
    assert found.lower < 20.0 < found.upper


@pytest.mark.parametrize('name', ['arm_body', 'arm_orbit'])
def test_centre_and_inertia_of_a_body_are_known(name: str) -> None:
    found, truth = last_payload(name)
    assert found.com[:2] == pytest.approx(truth['com'], abs=0.006)
    assert found.inertia[5] == pytest.approx(truth['inertia'], rel=0.05)
    deviations = np.sqrt(np.diag(np.array(found.covariance).reshape(4, 4)))[1:]
    errors = np.array([*found.com[:2], found.inertia[5]]) - [*truth['com'], truth['inertia']]
    assert np.all(np.abs(errors) < 3.5 * deviations)


def simulated(arm: ArmParameters, mass: float, peaks: tuple[float, float] = (10.0, 5.0)) -> Payload:
    """What is known of a point mass 2 s after the capture, on a simulation of the very same arm."""
    caught, config = event(2.0), IdentifierParameters(arm=arm)
    samples = record(4.0, (caught,), payload=mass, arm=arm, peaks=peaks, seed=3)
    return structured.estimate(config, run(config, samples, (caught,)))


@pytest.mark.parametrize(('preset', 'mass', 'peaks'), [
    ('quanser', 0.05, (0.05, 0.02)), ('de_luca_siciliano', 0.1, (0.135, 0.045)), ('reference', 20.0, (10.0, 5.0))])
def test_every_arm_that_is_shipped_knows_its_payload(preset: str, mass: float, peaks: tuple[float, float]) -> None:
    path = ROOT / 'config' / 'arms' / f'{preset}.yaml'
    given = {name: value for name, value in read(path, 'rpbsid_identifier').items() if name.startswith('arm.')}
    found = simulated(configure(IdentifierParameters, given).arm, mass, peaks)
    assert found.status is Status.TRACKING
    assert found.mass == pytest.approx(mass, rel=0.01)
    assert abs(found.mass - mass) < 3.5 * found.std


@pytest.mark.parametrize('seed', [1, 3, 11])
def test_a_floating_arm_with_every_fault_learns_frictions_that_can_be_and_knows_what_it_catches(seed: int) -> None:
    """Frictions below zero are how such a fit was lost: with them the fit of one arm in three never came.

    That of 11 comes since a rejected step's damping fades over the next ones, and the closing horizon waits.
    """
    rng, told = np.random.default_rng(seed), ArmParameters(damping_ratio=0.003, base_mass=700.0, base_inertia=180.0)
    arm = replace(
        told, modes=5, joint_viscous_friction=(0.8, 0.8), joint_coulomb_friction=(0.15, 0.15),
        rotor_inertia=(0.2, 0.2), torque_gain=(1.04, 1.04), bend_gain=(0.98, 0.98), bend_offset=(5e-4, 5e-4))
    config, caught, mass = IdentifierParameters(arm=told), event(3.0), rng.uniform(10.0, 40.0)
    samples = record(4.6, (caught,), degrees=(rng.uniform(0.0, 90.0), rng.uniform(20.0, 100.0)), payload=mass, arm=arm,
                     seed=seed, payload_com=tuple(rng.uniform(-0.1, 0.1, 2).tolist()), payload_inertia=1.0,
                     object_spin=0.1)
    state = run(config, samples, (caught,))
    found = structured.estimate(config, state)
    assert found.status is Status.TRACKING
    assert abs(found.mass - mass) < 3.5 * found.std
    learned = [one for one in taught(config, state) if 'friction' in one.name]
    assert len(learned) == 4
    assert all(one.value > -3.5 * one.std for one in learned)


@pytest.mark.parametrize('seed', [2, 1002, 2002, 3002])
def test_a_body_that_no_point_resembles_is_known_a_second_after_its_capture(seed: int) -> None:
    """Fitted to the first 8, 20 and 38 samples before all of them, three of these runs ended in a wrong minimum."""
    told, caught, mass, com = ArmParameters(damping_ratio=0.003), event(3.0), 17.848364, (-0.09216824, -0.0600602)
    samples = record(4.1, (caught,), degrees=(26.864203, 85.138059), payload=mass, arm=replace(told, modes=5),
                     seed=seed, payload_com=com, payload_inertia=1.2014166,
                     object_velocity=(-0.018725936, -0.026691202), object_spin=-0.06750919)
    config = IdentifierParameters(arm=told)
    found = structured.estimate(config, run(config, samples, (caught,)))
    assert found.status is Status.TRACKING
    assert abs(found.mass - mass) < 3.5 * found.std
    assert found.com[:2] == pytest.approx(com, abs=0.006)


def test_what_is_saved_of_an_arm_is_within_the_ranges_of_its_parameters() -> None:
    far = {'link1_bending_stiffness': -1.0, 'joint1_torque_lag': 0.4, 'torque_delay': 0.5, 'bend_delay': -0.1,
           'link2_bend_gain': 50.0, 'joint2_torque_gain': 0.01, 'link1_damping_ratio': 1.8,
           'joint1_rotor_inertia': -0.2}
    saved = as_parameters(IdentifierParameters(), [ArmParameter(name, value, 1e-3) for name, value in far.items()])
    config = configure(ArmParameters, {name.removeprefix('arm.'): value for name, value in saved.items()})
    assert (config.torque_delay, config.bend_delay, config.damping_ratio) == (0.2, -0.02, 0.99)
    assert (config.torque_lag, config.rotor_inertia) == ((0.1, 0.0), (0.0, 0.0))


@pytest.mark.parametrize('inertia', [0.02, 0.2])
def test_the_inertia_of_a_gripper_that_nobody_told_is_learned(inertia: float) -> None:
    """A gripper is a body. Taken for a point, 0.2 kg m^2 of it read 17.8 kg +- 0.4 for 20, and 0.02 19.8 +- 0.16."""
    told, caught = ArmParameters(damping_ratio=0.01), event(3.0)
    config = IdentifierParameters(arm=told)
    state = run(config, record(4.5, (caught,), arm=replace(told, tip_inertia=inertia), seed=1), (caught,))
    found = structured.estimate(config, state)
    assert found.status is Status.TRACKING
    assert abs(found.mass - 20.0) < 3.5 * found.std < 0.2
    (learned,) = (one for one in taught(config, state) if one.name == 'tip_inertia')
    assert abs(learned.value - inertia) < 3.5 * learned.std < 0.01
    saved = as_parameters(config, [learned])['arm.tip_inertia']
    assert saved == pytest.approx(max(learned.value, 0.0), rel=1e-5)


def test_the_inertia_of_a_gripper_is_taken_as_given_while_the_simplest_arm_fits() -> None:
    """Its own deviation would make the interval 1.8 times as wide 2 s after a capture."""
    told, caught = ArmParameters(damping_ratio=0.01), event(3.0)
    config, samples = IdentifierParameters(arm=told), record(4.5, (caught,), arm=told, seed=1)
    without = replace(config, payload=PayloadParameters(learn=tuple(n for n in LEARNABLE if n != 'tip_inertia')))
    found, reference = (structured.estimate(one, run(one, samples, (caught,))) for one in (config, without))
    assert (found.mass, found.std) == pytest.approx((reference.mass, reference.std), rel=1e-5)


def test_damping_ratios_are_those_of_the_learned_stiffness() -> None:
    """A ratio of the given stiffness would be sqrt(1.15) = 1.07 times, or 0.92 times as large."""
    told = ArmParameters(damping_ratio=0.008)
    arm = replace(told, bending_stiffness=(1.15 * told.bending_stiffness[0], 0.85 * told.bending_stiffness[1]))
    config = IdentifierParameters(arm=told)
    learned = taught(config, run(config, record(3.0, arm=arm), ()))
    for one in learned:
        if one.name.endswith('damping_ratio'):
            assert abs(one.value - 0.008) < 3.5 * one.std < 0.0005
    for link, true in enumerate(arm.bending_stiffness):
        (stiffness,) = (one for one in learned if one.name == f'link{link + 1}_bending_stiffness')
        assert abs(stiffness.value - true) < 3.5 * stiffness.std


LIGHT = ArmParameters(
    link_length=(0.41,), linear_density=(0.157,), bending_stiffness=(1.0,), tip_mass=0.05, hub_inertia=(0.002,),
    joint_viscous_friction=(0.0,), joint_coulomb_friction=(0.0,), rotor_inertia=(0.0,), torque_gain=(1.0,),
    bend_gain=(1.0,), bend_offset=(0.0,), torque_lag=(0.0,), sensor_position=(0.5,), damping_ratio=0.01)
"""One link of 64 g."""


@pytest.mark.parametrize('share', [0.0, 0.7, 1.5], ids=['nothing told', 'told too little', 'told too much'])
def test_a_light_arm_learns_friction_of_seven_percent_of_its_torque(share: float) -> None:
    """With the priors of the default arm, as rates, it was INCONSISTENT to the end, told or not."""
    viscous, coulomb, caught = 0.02, 0.02, event(3.0)
    plant = PlantParameters(
        arm=replace(LIGHT, joint_viscous_friction=(viscous,), joint_coulomb_friction=(coulomb,),
                    rotor_inertia=(0.0005,)), initial_angles=(0.0,), payload_mass=0.05, rehearsal_torque=(0.3,),
        noise='std', noise_std=(1e-5, 1e-5, 1e-3, 1e-3), sensors=replace(PlantParameters().sensors, bias=(0.0,) * 4))
    t = np.arange(4500) * 1e-3
    trajectory = simulator.simulate(plant, np.where(t % 0.5 < 0.25, 0.3, -0.3)[:, None], (caught,))
    told = replace(LIGHT, joint_viscous_friction=(share * viscous,), joint_coulomb_friction=(share * coulomb,))
    config = IdentifierParameters(
        arm=told, inputs=('joint1/effort',), angles=('joint1/position',),
        outputs=('link1_bend/position', 'link1_bend/velocity'), order=2)
    found = payload_at_end(config, simulator.records(trajectory, (caught,)))
    assert found.status is Status.TRACKING
    assert found.mass == pytest.approx(0.05, rel=0.02)
    assert abs(found.mass - 0.05) < 3.5 * found.std


def test_hubs_do_not_bias_a_light_payload() -> None:
    found = simulated(ArmParameters(hub_inertia=(0.5, 0.3)), 1.5)
    assert found.status is Status.TRACKING
    assert abs(found.mass - 1.5) < 3.5 * found.std


def test_bodies_are_known_half_a_second_after_their_capture() -> None:
    arm, caught = ArmParameters(damping_ratio=0.003), event(2.0)
    config, truth = IdentifierParameters(arm=arm), (0.08, 0.05)
    inside = 0
    for seed in range(2, 8):
        samples = record(2.6, (caught,), arm=arm, payload_com=truth, payload_inertia=1.0, seed=seed)
        found = structured.estimate(config, run(config, samples, (caught,)))
        assert found.status is Status.TRACKING
        assert found.com[:2] == pytest.approx(truth, abs=0.006)
        assert abs(found.mass - 20.0) < 3.5 * found.std
        inside += found.lower < 20.0 < found.upper
    assert inside >= 5  # of intervals of 95 % two in six miss once in thirty times


def test_an_undamped_arm_that_rings_ever_more_is_followed() -> None:
    config, caught = IdentifierParameters(), event(2.0)
    samples = record(18.0, (caught,), arm=config.arm, seed=0)
    state = run(config, samples.between(0, 14000), (caught,))
    for first in range(14000, 18000, 50):
        found = structured.estimate(config, state)
        assert found.status is Status.TRACKING
        assert found.mass == pytest.approx(20.0, rel=0.001)
        state = structured.advance(config, state, samples.between(first, first + 50))
