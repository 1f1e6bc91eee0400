"""Cramer-Rao bounds against the published figures of the reference case."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from recording import config

from flexmanip_ros.arm.linearization import discretize, mass_matrix, vibration_model
from flexmanip_ros.arm.manipulator import manipulator, payload_array
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, PayloadParameters, PlantParameters
from flexmanip_ros.payload import cramer_rao, structured_model
from flexmanip_ros.payload.filter_state import memory
from flexmanip_ros.simulation import excitation, sensors, simulator

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / 'benchmarks'))

from parts.all_bounds import everything

PAPER = ArmParameters(torque_convention='paper', angle_convention='chord', modes=1)
THETA = np.radians([60.0, 45.0])


@cache
def reference(payload):
    """The paper's run: capture at 3 s of 6, rates continuous, 40 dB; signals from the capture on."""
    efforts = excitation.sequence(ExcitationParameters(), 6000)
    empty, loaded = (discretize(*vibration_model(PAPER, THETA, mass, 1), 1e-3) for mass in (0.0, payload))
    states, x = np.zeros((6000, 4)), np.zeros(4)
    for k in range(6000):
        states[k] = x
        A, B = empty if k < 3000 else loaded
        x = A @ x + B @ efforts[k]
    return states[3000:], efforts[3000:], 0.01 * states.std(axis=0)


@pytest.mark.parametrize(('payload', 'percent'), [
    (20.0, {250: 0.35, 1000: 0.057, 3000: 0.011}), (50.0, {1000: 0.050, 3000: 0.009}),
    (100.0, {1000: 0.040, 3000: 0.008})])
def test_known_structure(payload, percent):
    found = cramer_rao.structure_known(PAPER, THETA, payload, *reference(payload), 1e-3, tuple(percent))
    assert 100 * found / payload == pytest.approx(list(percent.values()), rel=0.06)


@pytest.mark.parametrize(
    ('payload', 'percent'), [(20.0, (3.39, 1.35)), (50.0, (4.70, 1.84)), (100.0, (7.41, 2.77))])
def test_unknown_structure_by_the_trace_formula(payload, percent):
    found = cramer_rao.structure_unknown(PAPER, THETA, payload, *reference(payload), 1e-3, (1000, 3000))
    assert 100 * found / payload == pytest.approx(percent, rel=0.01)


def test_unknown_structure_with_the_known_coupling():
    found = cramer_rao.structure_unknown(
        PAPER, THETA, 20.0, *reference(20.0), 1e-3, (1000, 3000), known_mb=True)
    assert 100 * found / 20.0 == pytest.approx((1.40, 0.40), rel=0.01)


def test_the_moving_arm_tells_more_with_more_samples_and_more_torque():
    settings = config()  # friction, gains and delays are what their priors say before the arm has moved for long
    settings = replace(settings, payload=replace(settings.payload, learn=('stiffness', 'damping')))
    noise = np.array([2e-5, 2e-5, 7e-4, 7e-4, 1e-4, 1e-4])
    efforts = excitation.sequence(ExcitationParameters(), 600)
    weak, strong = (cramer_rao.nonlinear(settings, THETA, 20.0, scale * efforts, noise, 1e-3, (200, 400, 600))
                    for scale in (1.0, 2.0))
    assert np.all(np.diff(weak) < 0.0)
    assert strong == pytest.approx(weak / 2, rel=0.1)
    assert 0.01 < weak[-1] < 1.0


ARM = ArmParameters(
    modes=1, damping_ratio=0.003, joint_viscous_friction=(0.8, 0.5), joint_coulomb_friction=(0.15, 0.1),
    rotor_inertia=(0.2, 0.1), torque_gain=(1.04, 0.97), bend_gain=(0.98, 1.03), bend_offset=(5e-4, -3e-4))
PLANT = PlantParameters(
    arm=ARM, noise='none', payload_mass=25.0, payload_com=(0.1, 0.06), payload_inertia=1.0,
    object_velocity=(0.02, -0.03), object_spin=0.15)
LEARN = ('stiffness', 'viscous_friction', 'coulomb_friction', 'rotor_inertia', 'torque_gain', 'bend_gain',
         'bend_offset')
NOISE = np.array([2e-5, 2e-5, 7e-4, 7e-4, 1e-4, 1e-4])
CAPTURE, COUNT = 150, 300


def measured(start, arm, plant, torque):
    """Bends and angles (COUNT, 4) of the simulated arm from a state (2n,) on; the capture at CAPTURE."""
    plant = replace(plant, arm=replace(ARM, **arm))
    state = simulator.init(plant, noise_std=np.zeros(8))
    x, rows = start.copy(), []
    for part in (slice(0, CAPTURE), slice(CAPTURE, COUNT)):
        applied = torque[part] * np.array(plant.arm.torque_gain)
        position, velocity = np.empty((2, len(applied), 4))
        assert state.model.advance(x, state.payload, applied, position, velocity) == len(applied)
        sensors.misread(plant, position, velocity)
        rows.append(position)
        state = simulator.attach(plant, state._replace(x=x))
        x = state.x.copy()
    return np.vstack(rows)[:, [2, 3, 0, 1]]


def test_bounds_of_arm_body_and_spin_are_those_of_differences_of_the_simulated_arm():
    """Fisher information from the analytic Jacobians of the filter, and from differences of whole simulations.

    The two integrate in steps of their own, near rest through friction that hardly is linear: 3 %.
    """
    torque = 10.0 * excitation.sequence(ExcitationParameters(), COUNT)
    settings = config(ARM, payload=PayloadParameters(learn=LEARN))
    found = everything(settings, PLANT, torque, CAPTURE, NOISE, (COUNT,))
    model = structured_model.build(settings)
    first = memory(2 * model.motion.arm.stiffness.size + model.motion.kind.size, len(model.roles), 2)
    structured_model.first(settings, model, first, np.zeros(len(model.roles)))
    std = np.diag(first.S)[:model.payload]
    rest = simulator.init(PLANT).x
    names = ('bending_stiffness', 'joint_viscous_friction', 'joint_coulomb_friction', 'rotor_inertia', 'torque_gain',
             'bend_gain', 'bend_offset')
    prior = model.motion.prior[4:].reshape(7, 2) * [
        ARM.bending_stiffness, *[(1.0, 1.0)] * 3, ARM.torque_gain, ARM.bend_gain, (1.0, 1.0)]
    body, inertial = structured_model.body_std(settings, model), payload_array(25.0, 1.0, (0.1, 0.06))
    sides = []
    for sign in (1.0, -1.0):
        steps = [(rest + sign * e, {}, {}) for e in np.diag(1e-4 * std)]
        for name, deviations in zip(names, prior, strict=True):
            for link in range(2):
                value = np.array(getattr(ARM, name))
                value[link] += sign * 1e-4 * deviations[link]
                steps.append((rest, {name: tuple(value)}, {}))
        for c in range(4):
            m, hx, hy, tip = inertial + sign * 1e-4 * np.eye(4)[c] * body
            steps.append((rest, {}, {'payload_mass': m, 'payload_com': (hx / m, hy / m),
                                     'payload_inertia': tip - (hx * hx + hy * hy) / m}))
        for c in range(3):
            vx, vy, spin = np.array([0.02, -0.03, 0.15]) + sign * 1e-4 * 0.3 * np.eye(3)[c]
            steps.append((rest, {}, {'object_velocity': (vx, vy), 'object_spin': spin}))
        sides.append(np.array([measured(start, arm, replace(PLANT, **plant), torque) for start, arm, plant in steps]))
    J = ((sides[0] - sides[1]) / 2e-4 / NOISE[[0, 1, 4, 5]]).reshape(len(steps), -1)
    covariance = np.linalg.inv(np.eye(len(J)) + J @ J.T)
    deviations = np.sqrt(np.diag(covariance))
    n = std.size
    expected = dict(zip(found, [*(prior.ravel() * deviations[n:n + 14]), body[0] * deviations[n + 14]], strict=False))
    expected['object_spin'] = 0.3 * deviations[-1]
    assert {name: found[name][0] for name in expected} == pytest.approx(expected, rel=0.03)
    assert expected['object_spin'] < 0.02


@pytest.mark.parametrize('convention', ['encoder', 'chord'])
def test_a_linear_plant_starts_with_the_mass_matrix_at_the_chords_that_are_given(convention):
    settings = config(ArmParameters(angle_convention=convention), payload=PayloadParameters(dynamics='linear'))
    model, m = cramer_rao.start(settings, THETA)
    there = mass_matrix(manipulator(settings.arm), np.zeros(4), m.x[:model.motion.arm.stiffness.size])
    np.testing.assert_allclose(model.motion.M0, there, rtol=1e-12, atol=1e-12)
