"""A floating base catches a spinning body and moves on: the loop of arm, estimator and controller."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import eigh

from flexmanip_ros.arm.linearization import gravity_forces, mass_matrix
from flexmanip_ros.arm.manipulator import manipulator, payload_array
from flexmanip_ros.control import controller
from flexmanip_ros.control.handover import PayloadEstimate, Verdict, judge
from flexmanip_ros.parameters import (
    ArmParameters,
    ControllerParameters,
    ExcitationParameters,
    IdentifierParameters,
    PlantParameters,
)
from flexmanip_ros.payload import structured
from flexmanip_ros.samples.sample_log import SampleLog, Width
from flexmanip_ros.simulation import simulator, waveforms
from flexmanip_ros.types import Array, CaptureEvent, EventKind, JointRecord, Payload, Status

CAPTURE, KNOWN, MOVE, END = 250, 1500, 1900, 3600
STEP = np.array([0.15, -0.15])
ARM = ArmParameters(modes=1, damping_ratio=0.003, base_mass=700.0, base_inertia=180.0, base_joint_offset=(0.4, 0.2))
PLANT = PlantParameters(
    arm=ARM, payload_mass=60.0, payload_com=(0.5, 0.2), payload_inertia=10.0, object_velocity=(0.02, -0.03),
    object_spin=0.2)
CONTROL = ControllerParameters(arm=ARM)
THETA = np.array(PLANT.initial_angles)
WAVES = ExcitationParameters(amplitude=(30.0, 15.0))


class Run(NamedTuple):
    """Arm, controller and the torque held."""

    arm: simulator.PlantState
    control: controller.ControllerState
    torque: Array

    def step(self, added: Array) -> tuple[Run, JointRecord]:
        arm, record = simulator.step(PLANT, self.arm, self.torque)
        assert record is not None
        return Run(arm, *controller.step(
            CONTROL, self.control, controller.Measured(record.position, record.velocity, added))), record


class Caught(NamedTuple):
    """After the capture: the run, the angles (2,) that were held at its start, and the payload as estimated."""

    run: Run
    held: Array
    payload: Payload


def estimate_of(payload: Payload) -> PayloadEstimate:
    """Return what a controller needs of a payload."""
    return PayloadEstimate(*payload[:5], payload.com[:2], payload.inertia[5])


@pytest.fixture(scope='module')
def caught() -> Caught:
    settings = IdentifierParameters(arm=ARM)
    estimator, log = structured.init(settings), SampleLog(Width(2, 4, 2))
    run, angles = Run(simulator.init(PLANT), controller.init(CONTROL), np.zeros(2)), []
    for k, added in enumerate(waveforms.scaled(WAVES, WAVES.amplitude, np.arange(KNOWN))):
        if k == CAPTURE:
            estimator = structured.advance(settings, estimator, log.rows(estimator.cursor, log.end))
            event = CaptureEvent(simulator.stamp(PLANT, run.arm), EventKind.CAPTURE)
            estimator = structured.event(settings, estimator, event)
            run = run._replace(arm=simulator.attach(PLANT, run.arm))
        run, record = run.step(added)
        angles.append(record.position[:2])
        log = log.append(np.array([record.stamp_ns]), record.effort[None, :2],
                         np.concatenate([record.position[2:], record.velocity[2:]])[None], record.position[None, :2],
                         np.zeros(1, dtype=np.bool_))
        if k % 50 == 49:
            estimator = structured.advance(settings, estimator, log.rows(estimator.cursor, log.end))
            found = structured.estimate(settings, estimator)
            run = run._replace(control=controller.estimate(CONTROL, run.control, estimate_of(found)))
    return Caught(run, np.mean(angles[:100], axis=0), found)


def moved(caught: Caught, payload: PayloadEstimate) -> tuple[Array, float, controller.ControllerState]:
    """Return the error of the angles (2,) [rad] and the rms bend [m] in the last 0.2 s, and the controller.

    After the capture it takes ``payload`` to be held, and moves the arm to the setpoint.
    """
    run, last = caught.run, []
    run = run._replace(control=controller.estimate(CONTROL, run.control, payload))
    for k in range(KNOWN, END):
        if k == MOVE:
            run = run._replace(control=controller.goto(run.control, caught.held + STEP))
        run, record = run.step(np.zeros(2))
        last = [*last[-199:], record.position]
    found = np.array(last)
    return found[:, :2].mean(axis=0) - caught.held - STEP, float(np.sqrt(np.mean(found[:, 2:] ** 2))), run.control


def growth(config: ControllerParameters, held: Array, believed: float | Array) -> float:
    """Return the largest real part [1/s] of the poles of the arm that holds one payload, controlled for another."""
    A, B = controller.model(CONTROL, THETA, held)
    made, C = controller.design(config, THETA, believed), np.kron(np.eye(2), controller.observation(CONTROL))
    n, correction = len(A), made.L @ C
    filtered = np.hstack([correction, np.eye(n) - correction])
    loop = np.vstack([np.hstack([A, np.zeros((n, n))]) - B @ made.G @ filtered, (made.A - made.B @ made.G) @ filtered])
    return float(np.log(np.abs(np.linalg.eigvals(loop)).max()) * CONTROL.rate)


def test_the_estimator_knows_the_body_while_the_controller_holds_the_arm(caught: Caught) -> None:
    found = caught.payload
    assert found.status is Status.TRACKING
    assert found.com[:2] == pytest.approx(PLANT.payload_com, abs=6e-3)
    assert found.inertia[5] == pytest.approx(PLANT.payload_inertia, rel=0.05)


def test_the_mass_is_inside_its_interval_while_the_controller_holds_the_arm(caught: Caught) -> None:
    assert caught.payload.lower < PLANT.payload_mass < caught.payload.upper


def test_a_move_with_the_body_known_ends_at_rest_and_with_its_mass_alone_bends_the_links_more(caught: Caught) -> None:
    known = estimate_of(caught.payload)
    error, bend, control = moved(caught, known)
    assert control.payload == pytest.approx(payload_array(60.0, 10.0, (0.5, 0.2)), rel=0.03)
    assert np.abs(error).max() < 5e-3
    _, rings, _ = moved(caught, known._replace(com=(0.0, 0.0), inertia=0.0))
    assert bend < 0.8 * rings


def test_the_loop_is_stable_with_the_body_known_and_not_with_its_mass_alone_or_a_base_taken_as_fixed() -> None:
    held, fixed = payload_array(60.0, 10.0, (0.5, 0.2)), replace(CONTROL, arm=replace(ARM, base_mass=0.0))
    assert growth(CONTROL, held, held) < -0.8
    assert growth(CONTROL, held, 60.0) > 0.5
    assert growth(CONTROL, held, 0.0) > 0.5
    assert growth(fixed, held, held) > 0.5


def test_the_model_of_a_floating_arm_has_its_frequencies_and_drops_the_angle_of_its_base() -> None:
    arm, body = manipulator(ARM), payload_array(60.0, 10.0, (0.5, 0.2))
    M = mass_matrix(arm, body, np.append([0.3, 1.0], np.zeros(arm.stiffness.size - 2)))
    squares = np.sort(eigh(np.diag(arm.stiffness), M, eigvals_only=True))
    A, _ = controller.model(CONTROL, np.array([0.3, 1.0]), body)
    undamped = np.sort(np.abs(np.log(np.linalg.eigvals(A)).imag))[-1:-12:-2][::-1] * CONTROL.rate
    assert undamped == pytest.approx(np.sqrt(squares[3:]), rel=2e-3)


def test_a_body_that_is_not_that_of_the_estimate_is_not_taken() -> None:
    estimate = PayloadEstimate(20.0, 0.1, 19.8, 20.2, 1.0)
    covariance = [0.0] * 16
    taken = estimate.having([20.1, 0.1, 0.2, 1.5, *covariance])
    assert taken == estimate._replace(com=(0.1, 0.2), inertia=1.5)
    assert estimate.having([23.0, 0.1, 0.2, 1.5, *covariance]) is None
    assert estimate.having([20.0, math.nan, 0.2, 1.5, *covariance]) is None
    assert taken is not None
    assert judge(CONTROL, taken) is Verdict.TRUSTED
    assert judge(CONTROL, taken._replace(com=(9.0, 0.0))) is Verdict.OUT_OF_RANGE


@pytest.mark.parametrize(('mass', 'inertia', 'verdict'), [
    (0.0, 1e6, Verdict.OUT_OF_RANGE), (-0.01, 1e6, Verdict.OUT_OF_RANGE), (0.02, 1e6, Verdict.OUT_OF_RANGE),
    (0.0, 0.0, Verdict.TRUSTED), (-0.01, 0.0, Verdict.TRUSTED), (0.02, 1e-4, Verdict.TRUSTED)])
def test_an_inertia_needs_a_mass_within_the_reach_of_the_arm(mass: float, inertia: float, verdict: Verdict) -> None:
    assert judge(CONTROL, PayloadEstimate(mass, 0.02, mass - 0.04, mass + 0.04, 1.0, inertia=inertia)) is verdict


def test_the_torques_that_hold_a_stiff_arm_are_the_moments_of_all_weights_about_its_joints() -> None:
    arm = replace(ARM, base_mass=0.0, base_joint_offset=(0.0, 0.0), bending_stiffness=(1e9, 1e9), gravity=(0.0, -9.81))
    elbow, tip = 3.0 * np.cos(THETA[0]), 3.0 * np.cos(THETA[0]) + 3.0 * np.cos(THETA[1])
    body = tip + 0.5 * np.cos(THETA[1]) - 0.2 * np.sin(THETA[1])
    about_2 = 15.0 * (tip - elbow) / 2.0 + 10.0 * (tip - elbow) + 60.0 * (body - elbow)
    about_1 = 15.0 * elbow / 2.0 + 10.0 * elbow + 15.0 * (tip + elbow) / 2.0 + 10.0 * tip + 60.0 * body
    torque, _ = controller.hold(replace(CONTROL, arm=arm), THETA, payload_array(60.0, 10.0, (0.5, 0.2)))
    assert torque == pytest.approx([9.81 * about_1, 9.81 * about_2], rel=1e-5)


def test_an_arm_under_gravity_stays_where_it_is_and_sags_where_the_controller_knows_none() -> None:
    light = ArmParameters(modes=1, damping_ratio=0.003)
    arm = replace(light, gravity=(0.0, -0.5))
    plant = PlantParameters(arm=arm, noise='none', payload_mass=20.0, payload_com=(0.1, 0.05), payload_inertia=1.0)
    held, made = payload_array(20.0, 1.0, (0.1, 0.05)), manipulator(arm)
    rest, holding = np.append(THETA, np.zeros(6)), np.zeros(2)
    for _ in range(3):  # the bent links at rest
        force = gravity_forces(made, held, rest)
        holding = np.linalg.solve(made.torque[:2], force[:2])
        rest[2:] = (made.torque[2:] @ holding - force[2:]) / made.stiffness[2:]

    def falls(told: ArmParameters) -> float:
        config, body = ControllerParameters(arm=told), simulator.attach(plant, simulator.init(plant))
        body = body._replace(x=np.append(rest, np.zeros(8)))
        control, torque = controller.init(config)._replace(payload=held, trusted=held), holding
        angles = []
        for _ in range(600):
            body, record = simulator.step(plant, body, torque)
            assert record is not None
            angles.append(record.position[:2])
            control, torque = controller.step(
                config, control, controller.Measured(record.position, record.velocity, np.zeros(2)))
        return float(np.abs(angles[-1] - angles[0]).max())

    assert falls(arm) < 1e-3
    assert falls(light) > 1e-2
