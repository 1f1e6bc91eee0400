"""The payload read back from exact matrices (paper eqs. 47-52)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexmanip_ros.errors import ModelError
from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters, configure
from flexmanip_ros.payload.block_extraction import estimate, extract
from flexmanip_ros.payload.modal_basis import to_modal
from flexmanip_ros.plant.linearization import discretize, vibration_model
from flexmanip_ros.types import StateSpace, Status

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
            assert extract(arm, Ac, Bc, theta, kappa, known_mb) == pytest.approx(payload, abs=1e-6)


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
    assert extract(arm, Ac, Bc, np.array(theta), 2) == pytest.approx(payload, abs=1e-6 * (1.0 + payload))


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
    assert extract(arm, *found, theta, 1) == pytest.approx(50.0, abs=1e-6)


def test_a_model_of_another_order_is_refused():
    with pytest.raises(ModelError, match='order must be 4 kappa'):
        extract(ArmParameters(), np.eye(6), np.ones((6, 2)), np.zeros(2), 1)


def test_a_model_without_stiffness_is_refused():
    with pytest.raises(ModelError, match='excite'):
        extract(ArmParameters(), np.zeros((4, 4)), np.zeros((4, 2)), np.zeros(2), 1)


@pytest.mark.parametrize(('tip_mass', 'noise'), [(5.0, 1e-7), (5.0, 1e-5), (9.9, 1e-5)])
def test_a_mass_below_zero_is_never_a_narrow_interval_at_zero(tip_mass, noise):
    config = configure(IdentifierParameters, {
        'payload_method': 'block', 'arm.angle_convention': 'chord', 'arm.modes': 1})
    theta, dt = np.radians([60.0, 45.0]), 1e-3
    lighter = replace(config.arm, tip_mass=tip_mass)
    A, B = discretize(*vibration_model(lighter, theta, 0.0, 1), dt)
    model = StateSpace(A, B, np.eye(4), np.zeros((4, 2)), np.zeros((4, 4)), dt)
    spread = np.zeros((16 + 8 + 16 + 8 + 16, 16))
    spread[:16] = noise * np.eye(16)
    found = estimate(config, Identified(
        model, spread, np.ones(4), 1.0, 1.0, 1.0, Status.TRACKING, np.eye(4), known_basis=True), theta)
    missing = config.arm.tip_mass - tip_mass
    assert found.mass == found.lower == 0.0
    assert found.upper >= 1.95 * found.std
    if noise < 1e-6:
        assert found.status is Status.INCONSISTENT
        assert found.upper == pytest.approx(missing, rel=1e-3)
