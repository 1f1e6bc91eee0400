"""The interval holds what is not estimated: a rotor biased by missing shape functions, the form of the friction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recording import BENDS, payloads_of, samples_of

from flexmanip_ros.arm.linearization import mass_matrix
from flexmanip_ros.arm.manipulator import manipulator
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, IdentifierParameters, PlantParameters
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload.interval import SHARE_ERROR, by_rotors, friction_error, judge
from flexmanip_ros.payload.process_model import Kind
from flexmanip_ros.payload.structured_model import ROTOR_ERROR, build, rate_noise, sensors
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, Status

MODEL = build(IdentifierParameters())
assert MODEL is not None
BODY = np.arange(MODEL.payload, MODEL.payload + MODEL.body)
ROTORS = MODEL.payload + np.flatnonzero(MODEL.motion.kind == Kind.ROTOR)
FRICTION = MODEL.payload + np.flatnonzero(MODEL.motion.kind == Kind.COULOMB)


def nothing_known() -> mem.FilterState:
    return mem.memory(MODEL.payload + MODEL.motion.kind.size, len(MODEL.roles), 2)


@settings(max_examples=30)
@given(seed=st.integers(0, 2 ** 32 - 1))
def test_a_bias_of_a_rotor_moves_the_body_as_a_gaussian_conditioned_on_that_rotor(seed: int) -> None:
    m = nothing_known()
    m.S[:] = np.random.default_rng(seed).standard_normal(m.S.shape)
    P = m.S @ m.S.T
    for rotor, error, moved in zip(ROTORS, MODEL.rotor_error, by_rotors(MODEL, m).T, strict=True):
        seen = [*BODY, rotor]
        information = np.linalg.inv(P[np.ix_(seen, seen)])  # another route: by the precision of what is left
        np.testing.assert_allclose(moved, -np.linalg.solve(information[:-1, :-1], information[:-1, -1]) * error,
                                   rtol=1e-6, atol=1e-9 * abs(error))


def test_rotors_that_are_taken_as_known_have_no_bias() -> None:
    m = nothing_known()
    m.S[:] = np.eye(len(m.S))
    m.S[ROTORS] = 0.0
    assert not by_rotors(MODEL, m).any()


def test_the_bias_is_of_the_links_alone_however_large_hub_and_rotor_are() -> None:
    heavy = IdentifierParameters(arm=ArmParameters(hub_inertia=(1.0, 1.0), rotor_inertia=(5.0, 3.0)))
    model, links_alone = build(heavy), manipulator(ArmParameters())
    assert model is not None
    M = mass_matrix(links_alone, np.zeros(4), np.zeros(links_alone.stiffness.size))
    fast = [1.0 / (row @ np.linalg.solve(M, row)) for row in links_alone.joint]
    np.testing.assert_allclose(model.rotor_error, ROTOR_ERROR * np.array(fast), rtol=1e-12)


@pytest.mark.parametrize('mass', [-0.1, 0.0, 0.01, 0.05, 20.0])
def test_what_weighs_no_more_than_its_deviation_has_the_centre_of_mass_of_an_unknown_object(mass: float) -> None:
    """It was h / m with m at least 1e-9 kg: some 1e7 m."""
    config, dt = IdentifierParameters(), 1e-3
    seen = sensors(config, MODEL, dt, np.zeros(2))
    m = nothing_known()
    m.x[BODY] = mass, 0.01, 0.02, 0.05
    m.S[np.ix_(BODY, BODY)] = np.diag([0.03, 0.005, 0.005, 0.01])
    m.counts[[mem.HELD, mem.SEEN, mem.SINCE_EVENT, mem.BLOCKS]] = 1, 2000, 5000, 100
    m.counts[mem.STORED] = mem.HORIZON
    m.noise[:, [mem.WHITE, mem.POWER, mem.EFFECTIVE, mem.LEVEL, mem.WEIGHT]] = 1e-6
    found = judge(config, MODEL, seen, m, 0, np.array([10.0, 5.0]))
    assert found.com is not None
    covariance = np.array(found.covariance).reshape(4, 4)
    reach = config.arm.link_length[-1]
    assert np.hypot(*found.com[:2]) < reach
    if mass < 0.03:
        assert found.com == (0.0, 0.0, 0.0)
        assert 0.1 * reach < np.sqrt(covariance[1, 1]) < reach
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)


@pytest.mark.parametrize(('friction', 'torques', 'error'), [
    ((1.0, 0.4), (10.0, 5.0), 0.1 * SHARE_ERROR), ((0.2, 0.5), (10.0, 5.0), 0.1 * SHARE_ERROR),
    ((0.0, 0.0), (10.0, 5.0), 0.0), ((-0.1, 0.0), (10.0, 5.0), 0.0), ((0.3, 0.2), (0.0, 0.0), 0.0)])
def test_the_form_of_the_friction_is_an_error_in_proportion_to_friction_over_torque(friction, torques, error) -> None:
    m = nothing_known()
    m.x[FRICTION] = friction
    assert friction_error(MODEL, m, np.array(torques)) == pytest.approx(error)


def test_a_light_body_on_an_arm_of_more_shape_functions_and_much_friction_is_in_its_interval() -> None:
    told = ArmParameters(damping_ratio=0.003)
    arm = replace(told, modes=told.modes + 2, joint_coulomb_friction=(0.95, 0.95), rotor_inertia=(0.23, 0.28))
    mass, capture = 6.12, CaptureEvent(3_193_000_000, EventKind.CAPTURE)
    plant = PlantParameters(arm=arm, payload_mass=mass, payload_com=(-0.12, 0.08), payload_inertia=0.36, snr_db=50.0,
                            initial_angles=(-1.477, -0.881))
    torques = excitation.sequence(
        ExcitationParameters(shape='prbs', amplitude=(11.44, 5.72), period=(0.894, 0.553), seed=37), 5200)
    records = (item if isinstance(item, CaptureEvent) else item._replace(velocity=item.velocity[:0])
               for item in simulator.records(simulator.simulate(plant, torques, (capture,)), (capture,)))
    config = IdentifierParameters(arm=told, outputs=BENDS)
    samples, events = samples_of(config, records)
    late = payloads_of(config, samples, events, 4200)
    assert all(found.status is Status.TRACKING for found in late)
    assert all(found.lower < mass < found.upper for found in late)
    assert late[-1].upper - late[-1].lower < 0.1 * mass


@settings(max_examples=20)
@given(seed=st.integers(0, 2 ** 32 - 1), quiet=st.floats(0.0, 0.7e-3), loud=st.floats(3e-3, 1.0))
def test_rates_tell_the_friction_unless_their_noise_hides_where_it_reverses(
        seed: int, quiet: float, loud: float) -> None:
    moving = np.sin(0.01 * np.arange(60))[:, None]  # 10 rad/s^2 at 1 kHz
    rates = moving + np.random.default_rng(seed).standard_normal((60, 2)) * [quiet, loud]
    assert np.isinf(rate_noise(rates, 1e-3)).tolist() == [False, True]
    assert not rate_noise(rates, 2e-3).any()  # vibrations would be taken for noise
    rates[1:] = np.nan
    assert not rate_noise(rates, 1e-3).any()  # one sample tells no noise


@pytest.mark.parametrize(('joint', 'noisy'), [(0, [True, False]), (1, [False, True])])
def test_rates_of_one_joint_alone_are_looked_at_too(joint: int, noisy: list[bool]) -> None:
    rates = np.full((24, 2), np.nan)
    rates[:, joint] = np.random.default_rng(0).normal(0.0, 0.01, 24)
    assert np.isinf(rate_noise(rates, 1e-3)).tolist() == noisy


def test_noise_hides_the_share_of_friction_as_reckoned() -> None:
    rng = np.random.default_rng(1)
    for std in (0.3, 1.0, 2.0):  # of the noise, over the rate where friction reverses
        share = np.tanh(std * rng.standard_normal(100_000))  # at a measured rate of zero
        assert np.var(share) == pytest.approx(1.0 - 1.0 / np.sqrt(1.0 + np.pi / 2.0 * std ** 2), abs=0.06)
