from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexmanip_ros.arm.linearization import frequencies, vibration_model
from flexmanip_ros.arm.manipulator import chords
from flexmanip_ros.control.controller import design, model, observation
from flexmanip_ros.parameters import ArmParameters, ControllerParameters

BETWEEN = st.floats(-3.0, 3.0)
PAYLOAD = st.floats(0.0, 200.0)


def config(modes: int = 2, **values: object) -> ControllerParameters:
    return ControllerParameters(arm=ArmParameters(modes=modes, **values))


@settings(max_examples=20, deadline=None)
@given(BETWEEN, PAYLOAD)
def test_the_closed_loop_and_the_filter_are_stable_everywhere(between: float, payload: float) -> None:
    made = design(config(), np.array([0.0, between]), payload)
    C = np.kron(np.eye(2), observation(config()))
    assert np.abs(np.linalg.eigvals(made.A - made.B @ made.G)).max() < 1.0
    assert np.abs(np.linalg.eigvals(made.A - made.A @ made.L @ C)).max() < 1.0


@pytest.mark.parametrize('convention', ['joint', 'paper'])
def test_the_model_has_the_arms_frequencies_and_two_free_joints(convention: str) -> None:
    made = config(3, torque_convention=convention)
    A, _ = model(made, np.array([0.0, 0.4]), 20.0)
    poles = np.log(np.linalg.eigvals(A)) * made.rate
    expected = frequencies(vibration_model(made.arm, np.array([0.0, 0.4]), 20.0)[0])
    assert np.allclose(np.sort(poles.imag[poles.imag > 1.0]) / 2 / np.pi, expected, rtol=1e-6)
    assert (np.abs(poles) < 1e-2).sum() == 4


def test_a_straight_arm_reads_its_reference_on_the_encoders() -> None:
    made = config(3)
    angles = np.array([0.3, -0.2])
    x = np.zeros(12)
    x[:2] = chords(made.arm, angles)
    assert np.allclose(observation(made) @ x, [0.3, -0.2, 0.0, 0.0])


def test_sensors_at_mid_span_see_the_first_modes_and_not_the_second() -> None:
    T = observation(config(2))
    assert np.allclose(T[2, 2:4], [1.0, 0.0])
    assert np.allclose(T[3, 6:8], [1.0, 0.0])
    assert np.allclose(T[2, 6:], 0.0)
    assert np.allclose(T[3, 2:6], 0.0)
