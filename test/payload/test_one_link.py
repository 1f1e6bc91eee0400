"""An arm of one link and one joint, through plant, estimators, detection and controller."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flexmanip_ros import pipeline
from flexmanip_ros.arm.linearization import frequencies, vibration_model
from flexmanip_ros.cli.write_urdf import urdf
from flexmanip_ros.control import controller
from flexmanip_ros.control.handover import PayloadEstimate
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import (
    ArmParameters,
    ControllerParameters,
    ExcitationParameters,
    IdentifierParameters,
    PlantParameters,
    TriggerParameters,
)
from flexmanip_ros.payload.capture_detection import watch, with_detected
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind, JointBlock, Status

LINK = ArmParameters(link_length=(0.41,), linear_density=(0.3,), bending_stiffness=(0.5,), tip_mass=0.01,
                     hub_inertia=(0.002,), damping_ratio=0.01)
MASS = 0.12 * 0.3 * 0.41
"""12 % of the link's mass."""


@pytest.fixture(scope='module')
def run() -> list:
    """Messages of a capture at 2 s."""
    plant = PlantParameters(arm=LINK, payload_mass=MASS, initial_angles=(0.3,))
    torque = ExcitationParameters(arm=LINK, amplitude=(0.02,))
    events = (CaptureEvent(2_000_000_000, EventKind.CAPTURE),)
    return list(simulator.records(simulator.simulate(plant, excitation.sequence(torque, 5000), events), events))


def last(config: IdentifierParameters, items: list) -> Estimate:
    """The estimate at the end; none is made on the way."""
    *_, ended = pipeline.absorb(config, items)
    found = pipeline.current(ended)
    assert found is not None
    return found


def test_parameters_of_two_links_lose_the_second_and_a_list_of_another_size_is_refused() -> None:
    config = IdentifierParameters(arm=LINK)
    assert config.inputs == ('joint1/effort',)
    assert config.angles == ('joint1/position',)
    assert config.outputs == ('link1_bend/position', 'link1_bend/velocity')
    assert LINK.sensor_position == (0.5,)
    assert PlantParameters(arm=LINK).noise_std == (1e-5, 1e-5, 1e-3, 1e-3)
    with pytest.raises(ParameterError, match='linear_density'):
        ArmParameters(link_length=(0.41,), linear_density=(0.3, 0.2))
    with pytest.raises(ParameterError, match='angles'):
        IdentifierParameters(arm=LINK, angles=('a/position', 'b/position'))


def test_a_mass_of_12_percent_of_the_link_is_known_within_2_percent(run: list) -> None:
    found = last(IdentifierParameters(arm=LINK), run)
    assert found.payload is not None
    assert found.payload.status is Status.TRACKING
    assert found.payload.mass == pytest.approx(MASS, rel=0.02)
    assert found.payload.lower < MASS < found.payload.upper
    true = frequencies(vibration_model(LINK, np.array([0.3]), MASS)[0])
    assert found.modes[0].frequency_hz == pytest.approx(true[0], rel=2e-3)


@pytest.mark.parametrize('method', ['block', 'frequency'])
def test_the_identified_model_alone_tells_it_within_10_percent(run: list, method: str) -> None:
    arm = replace(LINK, modes=1)
    found = last(IdentifierParameters(arm=arm, payload_method=method, order=2 if method == 'block' else 4), run)
    assert found.payload is not None
    assert found.payload.upper > 0.9 * MASS
    assert found.payload.lower < 1.1 * MASS


def test_its_capture_is_found_in_the_signals(run: list) -> None:
    records = [item for item in run if not isinstance(item, CaptureEvent)][:2500]
    messages = [JointBlock(records[0].names, np.array([one.stamp_ns for one in some]), *(
        np.array([getattr(one, name) for one in some]) for name in ('position', 'velocity', 'effort')))
        for some in (records[at:at + 20] for at in range(0, len(records), 20))]
    found = [item for item in with_detected(watch(IdentifierParameters(arm=LINK)), messages)
             if isinstance(item, CaptureEvent)]
    assert [event.kind for event in found] == [EventKind.CAPTURE]
    assert found[0].stamp_ns == pytest.approx(2e9, abs=20e6)
    assert TriggerParameters(arm=LINK).inputs == ('joint1/effort',)


def test_a_controller_takes_it_to_a_setpoint_and_to_rest() -> None:
    plant = PlantParameters(arm=LINK, payload_mass=MASS, noise='none', initial_angles=(0.0,))
    config = ControllerParameters(arm=LINK, effort_scale=(0.1,), effort_limit=(1.0,), disturbance_std=(1e-3,))
    arm, state, torque = simulator.init(plant), controller.init(config), np.zeros(1)
    for k in range(4000):
        if k == 300:
            arm = simulator.attach(plant, arm)
            state = controller.estimate(config, state, PayloadEstimate(MASS, 1e-4, MASS - 2e-4, MASS + 2e-4, 1.0))
        if k == 800:
            state = controller.goto(state, np.array([0.3]))
        arm, record = simulator.step(plant, arm, torque)
        assert record is not None
        state, torque = controller.step(
            config, state, controller.Measured(record.position, record.velocity, np.zeros(1)))
    assert record.position == pytest.approx([0.3, 0.0], abs=3e-3)
    assert abs(torque[0]) < 0.01


def test_its_description_has_one_joint() -> None:
    text = urdf(LINK)
    assert 'link1_tip' in text
    assert 'joint2' not in text
