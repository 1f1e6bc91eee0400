"""Claims: the modes that the shape functions leave out are noise that follows the steps of the torques."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
from recording import BENDS, payload_at_end

from flexmanip_ros.arm.linearization import MORE_SINES, omitted_modes
from flexmanip_ros.parameters import (
    ArmParameters,
    ExcitationParameters,
    IdentifierParameters,
    PayloadParameters,
    PlantParameters,
)
from flexmanip_ros.payload import structured_model
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, Status

ARM = ArmParameters(damping_ratio=0.003)
ANGLES = (math.radians(60.0), math.radians(45.0))


def shown(efforts: np.ndarray, rate: float) -> np.ndarray:
    """What modes beyond the model's add to the displacements (N, 4) of the nonlinear arm, without noise."""
    found = []
    for modes in (ARM.modes, ARM.modes + MORE_SINES):
        plant = PlantParameters(arm=replace(ARM, modes=modes), rate=rate, initial_angles=ANGLES, noise='none')
        found.append(simulator.simulate(plant, efforts, ()).position)
    return found[1] - found[0]


@pytest.mark.parametrize('joint', [0, 1])
def test_their_variance_has_the_energy_of_what_the_nonlinear_arm_shows_after_a_step(joint: int) -> None:
    """Two simulated arms, one with more sines; a torque so small that both are linear, sampled at 4 kHz."""
    torque, rate = 1e-3, 4000.0
    efforts = np.zeros((int(0.1 * rate), 2))
    efforts[:, joint] = torque
    energy = np.sum((shown(efforts, rate) / torque) ** 2, axis=0) / rate
    omitted = omitted_modes(ARM, np.array(ANGLES))
    own = joint, 2 + joint  # the angle of this joint, the bend of its link
    np.testing.assert_allclose(omitted.variance[0, own, joint] * omitted.duration, energy[list(own)], rtol=0.02)
    assert 0.005 < omitted.duration < 0.02


def test_an_arm_of_sines_leaves_nothing_out() -> None:
    omitted = omitted_modes(replace(ARM, shape_functions='sines'), np.array(ANGLES))
    assert not omitted.variance.any()


def test_a_link_alone_and_a_floating_base_have_theirs_too() -> None:
    single = omitted_modes(ArmParameters(
        link_length=(0.41,), linear_density=(0.5,), bending_stiffness=(2.0,), hub_inertia=(0.002,)), np.zeros(1))
    assert single.variance.shape == (2, 2, 1)
    assert np.all(single.variance > 0.0)
    pinned = omitted_modes(ARM, np.array(ANGLES))
    heavy = omitted_modes(replace(ARM, base_mass=1e9, base_inertia=1e9), np.array(ANGLES))
    np.testing.assert_allclose(heavy.variance, pinned.variance, rtol=1e-3)


def test_the_largest_number_of_sines_that_may_be_given_leaves_modes_out_too() -> None:
    """They are computed with more sines than may be given: more than 8 sines ended with modes out of range."""
    many = omitted_modes(replace(ARM, modes=12), np.array(ANGLES))
    assert np.all(many.variance > 0.0)
    assert np.all(many.variance[0] < omitted_modes(ARM, np.array(ANGLES)).variance[0])


def test_they_belong_to_the_measured_angles_unless_a_linear_plant_stays_at_its_working_point() -> None:
    there, elsewhere, found = np.array([1.0, -0.3]), (0.0, 1.5), {}
    for name, payload in (('nowhere', {}), ('moving', {'working_point': elsewhere}),
                          ('linear', {'working_point': elsewhere, 'dynamics': 'linear'})):
        config = IdentifierParameters(arm=ARM, payload=PayloadParameters(**payload))
        model = structured_model.build(config)
        assert model is not None
        found[name] = structured_model.sensors(config, model, 1e-3, there).omitted
    np.testing.assert_array_equal(found['moving'], found['nowhere'])
    assert (found['linear'] != found['nowhere']).any()


@pytest.mark.parametrize(('own', 'snr_db'), [
    ({}, 50.0), ({}, 60.0),
    ({'modes': 4, 'joint_coulomb_friction': (1.0, 0.5)}, 60.0),  # a fifth sine triples the time of friction
    ({'torque_gain': (1.04, 1.04), 'bend_gain': (0.98, 0.98), 'bend_offset': (5e-4, 5e-4)}, 60.0)],
    ids=['16 bits', '18 bits', '18 bits, Coulomb friction', '18 bits, gains and offset'])
def test_precise_encoders_tell_the_payload_better_although_they_show_these_modes(own: dict, snr_db: float) -> None:
    """At 60 dB their noise is 1e-5 rad; the modes that are left out ring by 5e-4 rad after each step of the torques."""
    plant = PlantParameters(arm=replace(ARM, **{'modes': 5, **own}), payload_mass=20.0, snr_db=snr_db)
    capture = CaptureEvent(3_000_000_000, EventKind.CAPTURE)
    trajectory = simulator.simulate(plant, excitation.sequence(ExcitationParameters(), 5000), (capture,))
    found = payload_at_end(IdentifierParameters(arm=ARM, outputs=BENDS), simulator.records(trajectory, (capture,)))
    assert found.status is Status.TRACKING
    assert found.mass == pytest.approx(20.0, rel=0.003)
    assert found.lower < 20.0 < found.upper


def test_the_jitter_of_a_torque_adds_what_the_nonlinear_arm_shows() -> None:
    """Changes of a torque undo each other: as independent steps they would add 1.6 times as much."""
    std, rate = 1e-3, 1000.0
    efforts = np.zeros((1000, 2))
    efforts[:, 1] = np.random.default_rng(5).normal(0.0, std, len(efforts))
    omitted = omitted_modes(ARM, np.array(ANGLES))
    turn = np.exp((1j * omitted.frequency - 0.5 / omitted.duration) / rate)
    phasor = scipy.signal.lfilter([1.0], [1.0, -turn], np.diff(efforts[:, 1], prepend=0.0))
    expected = np.sqrt(omitted.variance[0, 1, 1] * np.mean(np.abs(phasor) ** 2))
    assert np.std(shown(efforts, rate)[:, 1]) == pytest.approx(expected, rel=0.25)
