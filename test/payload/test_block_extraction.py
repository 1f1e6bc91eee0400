"""The payload read back from exact matrices (paper eqs. 47-52)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import logm

from flexmanip_ros.arm.linearization import blocks, discretize, vibration_model
from flexmanip_ros.identification.realization import to_continuous
from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters, configure
from flexmanip_ros.payload import block_extraction
from flexmanip_ros.payload.block_extraction import estimate, extend_range, masses, to_modal
from flexmanip_ros.payload.structured_model import unobservable
from flexmanip_ros.samples.sample_log import log_of
from flexmanip_ros.types import StateSpace, Status

NOWHERE = np.empty(0)  # the arm has not moved
CONFIGURATIONS = [(60.0, 45.0), (0.0, 0.0), (45.0, 0.0), (-45.0, 45.0)]


@pytest.mark.parametrize('degrees', CONFIGURATIONS)
@pytest.mark.parametrize('convention', ['joint', 'paper'])
@pytest.mark.parametrize('known_mb', [False, True])
def test_exact_matrices_give_the_payload_back(degrees, convention, known_mb):
    arm = ArmParameters(torque_convention=convention)
    theta = np.radians(degrees)
    for kappa in (1, 2, 3, 5):
        for payload in (20.0, 50.0, 100.0):
            Ac, Bc = vibration_model(arm, theta, payload, kappa)
            found = masses(arm, blocks(arm, theta, kappa=kappa), Ac, Bc, known_mb)
            assert found == pytest.approx(payload, abs=1e-6)


@settings(max_examples=40, deadline=None)
@given(
    length=st.tuples(st.floats(0.5, 5.0), st.floats(0.5, 5.0)),
    density=st.tuples(st.floats(1.0, 10.0), st.floats(1.0, 10.0)),
    stiffness=st.tuples(st.floats(500.0, 2e4), st.floats(500.0, 2e4)), joint_mass=st.floats(0.01, 30.0),
    tip_mass=st.floats(0.1, 30.0), zeta=st.floats(0.0, 0.05), payload=st.floats(0.0, 200.0),
    theta=st.tuples(st.floats(-1.5, 1.5), st.floats(-1.0, 1.0)))
def test_any_damped_arm_gives_its_payload_back(
        length, density, stiffness, joint_mass, tip_mass, zeta, payload, theta):
    arm = ArmParameters(link_length=length, linear_density=density, bending_stiffness=stiffness,
                        joint_mass=joint_mass, tip_mass=tip_mass, damping_ratio=zeta)
    Ac, Bc = vibration_model(arm, np.array(theta), payload, 2)
    found = masses(arm, blocks(arm, np.array(theta), kappa=2), Ac, Bc, False)
    assert found == pytest.approx(payload, abs=1e-6 * (1.0 + payload))


@pytest.mark.parametrize('seen', [(True, True), (True, False)], ids=['with rates', 'displacements only'])
def test_any_basis_is_brought_back_to_the_modal_one(seen):
    arm, theta = replace(ArmParameters(), damping_ratio=0.01), np.radians([60.0, 45.0])
    Ac, Bc = vibration_model(arm, theta, 50.0, 1)
    T = np.random.default_rng(3).normal(size=(4, 4))
    rows = [row for row, use in zip((slice(0, 2), slice(2, 4)), seen, strict=True) if use]
    C = np.vstack([np.eye(4)[row] for row in rows])
    S = np.vstack([np.eye(2)] * len(rows))
    rates = (False, False, True, True)[:2 * len(rows)]
    found = to_modal(np.linalg.solve(T, Ac @ T), np.linalg.solve(T, Bc), C @ T, S, rates)
    assert np.allclose(found[0], Ac, atol=1e-8 * np.abs(Ac).max())
    assert masses(arm, blocks(arm, theta, kappa=1), *found, False) == pytest.approx(50.0, abs=1e-6)


@pytest.mark.parametrize(('tip_mass', 'noise'), [(5.0, 1e-7), (5.0, 1e-5), (9.9, 1e-5)])
def test_a_mass_below_zero_is_never_a_narrow_interval_at_zero(tip_mass, noise):
    config = configure(IdentifierParameters, {
        'payload_method': 'block', 'arm.angle_convention': 'chord', 'arm.shape_functions': 'sines', 'arm.modes': 1})
    theta, dt = np.radians([60.0, 45.0]), 1e-3
    lighter = replace(config.arm, tip_mass=tip_mass)
    A, B = discretize(*vibration_model(lighter, theta, 0.0, 1), dt)
    model = StateSpace(A, B, np.eye(4), np.zeros((4, 2)), np.zeros((4, 4)), dt)
    spread = np.zeros((16 + 8 + 16 + 8 + 16, 16))
    spread[:16] = noise * np.eye(16)
    found = estimate(config, Identified(
        model, spread, np.ones(4), 1.0, 1.0, 1.0, Status.TRACKING), theta, NOWHERE)
    missing = config.arm.tip_mass - tip_mass
    assert found.mass == found.lower == 0.0
    assert found.upper >= 1.95 * found.std
    if noise < 1e-6:
        assert found.status is Status.INCONSISTENT
        assert found.upper == pytest.approx(missing, rel=1e-3)


def _sharp(model, order=4):
    """A model identified almost without noise: (Ac, Bc) of two modes, all states measured."""
    A, B = discretize(*model, 1e-3)
    exact = StateSpace(A, B, np.eye(order), np.zeros((order, 2)), np.zeros((order, order)), 1e-3)
    spread = np.zeros((order * (2 * order + 2) + 2 * order + order * order, 16))
    spread[:16] = 1e-9 * np.eye(16)
    return Identified(exact, spread, np.ones(order), 1.0, 1.0, 1.0, Status.TRACKING)


def _config(**changes):
    return configure(IdentifierParameters, {
        'payload_method': 'block', 'arm.angle_convention': 'chord', 'arm.shape_functions': 'sines', 'arm.modes': 1,
        **{name.replace('__', '.'): value for name, value in changes.items()}})


def test_an_arm_on_a_floating_base_is_not_taken_for_one_on_a_fixed_base():
    """Exact matrices of an arm on 700 kg gave 18.5 kg of 20."""
    theta, config = np.radians([60.0, 45.0]), _config(arm__base_mass=700.0, arm__base_inertia=180.0)
    found = estimate(config, _sharp(vibration_model(config.arm, theta, 20.0, 1)), theta, NOWHERE)
    assert found.status is Status.UNOBSERVABLE
    assert unobservable(config)[0] == 'the payload method block needs a fixed base'


@pytest.mark.parametrize(('links', 'order', 'reason'), [
    (1, 3, 'the payload method block needs an order that 2 divides'),
    (1, 4, 'the outputs are not bends that show every mode of the links'),
    (2, 6, 'the payload method block needs an order that 4 divides')])
def test_what_the_method_lacks_is_said_for_one_link_and_for_two(links, order, reason):
    lists = ('link_length', 'linear_density', 'bending_stiffness')
    arm = ArmParameters(**{name: getattr(ArmParameters(), name)[:links] for name in lists})
    assert unobservable(IdentifierParameters(arm=arm, payload_method='block', order=order))[0] == reason


@pytest.mark.parametrize('known', [False, True])
@pytest.mark.parametrize('convention', ['joint', 'paper'])
def test_modes_that_the_model_has_not_widen_the_interval_to_hold_the_payload(convention, known):
    theta = np.radians([60.0, 45.0])
    config = _config(arm__modes=5, arm__torque_convention=convention, payload__known_coupling=known)
    seen = block_extraction.truncated(config, theta, 20.0, 1)
    found = estimate(config, _sharp(seen), theta, NOWHERE)
    assert found.mass > 20.01  # what two modes of ten make of 20 kg
    assert found.lower <= 20.0 <= found.upper
    assert found.status is Status.INCONSISTENT
    blind = estimate(replace(config, arm=replace(config.arm, modes=1)), _sharp(seen), theta, NOWHERE)
    assert blind.lower > 20.0


def test_a_linear_plant_keeps_its_working_point_whatever_the_angles_read():
    theta, drifted = np.radians([60.0, 45.0]), np.radians([63.0, 42.0])
    model = _sharp(vibration_model(_config().arm, theta, 20.0, 1))
    still = _config(payload__known_coupling=True, payload__dynamics='linear',
                    payload__working_point=theta.tolist())
    assert estimate(still, model, drifted, NOWHERE).mass == pytest.approx(20.0, abs=1e-4)
    moving = _config(payload__known_coupling=True)
    assert abs(estimate(moving, model, drifted, NOWHERE).mass - 20.0) > 0.5


def test_known_coupling_doubts_as_far_as_the_arm_moved():
    path = np.radians([[60.0, 45.0], [61.5, 43.5], [63.0, 42.0]])
    config = _config(payload__known_coupling=True)
    model = _sharp(vibration_model(config.arm, path[0], 20.0, 1))
    rows = log_of(np.zeros((3, 2)), np.zeros((3, 4)), path).rows(0, 3)
    configuration_range = extend_range(config, np.empty(0), rows)
    np.testing.assert_allclose(configuration_range, [np.cos(np.radians(21.0)), np.cos(np.radians(15.0))])
    one = extend_range(config, np.empty(0), rows.between(0, 1))
    np.testing.assert_array_equal(configuration_range, extend_range(config, one, rows.since(1)))
    found = estimate(config, model, path[-1], configuration_range)
    assert found.lower <= 20.0 + 1e-6
    assert found.upper >= 20.0 - 1e-6
    assert found.status is Status.INCONSISTENT


def test_the_logarithm_by_eigenvectors_is_the_matrix_logarithm():
    model = _sharp(vibration_model(_config(arm__damping_ratio=0.01).arm, np.zeros(2), 50.0, 1)).model
    Ac, Bc = to_continuous(model.A, model.B, model.dt)
    exact = np.real(logm(np.block([[model.A, model.B], [np.zeros((2, 4)), np.eye(2)]]))) / model.dt
    np.testing.assert_allclose(Ac, exact[:4, :4], atol=1e-9 * np.abs(exact).max())
    np.testing.assert_allclose(Bc, exact[:4, 4:], atol=1e-9 * np.abs(exact).max())
