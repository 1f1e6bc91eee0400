"""Cramer-Rao bounds against the published figures of the reference case."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from recording import config

from flexmanip_ros.arm.linearization import discretize, vibration_model
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters
from flexmanip_ros.payload import cramer_rao
from flexmanip_ros.simulation import excitation

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
    settings = config()
    noise = np.array([2e-5, 2e-5, 7e-4, 7e-4, 1e-4, 1e-4])
    efforts = excitation.sequence(ExcitationParameters(), 600)
    weak, strong = (cramer_rao.nonlinear(settings, THETA, 20.0, scale * efforts, noise, 1e-3, (200, 400, 600))
                    for scale in (1.0, 2.0))
    assert np.all(np.diff(weak) < 0.0)
    assert strong == pytest.approx(weak / 2, rel=0.35)
    assert 0.01 < weak[-1] < 1.0
