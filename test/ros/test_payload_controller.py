from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from joint_states import joint_state
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from ros_harness import Ros, overrides
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from flexmanip_ros.arm.manipulator import payload_array
from flexmanip_ros.control import controller, handover
from flexmanip_ros.errors import ModelError, ParameterError
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import joint_record
from flexmanip_ros.ros.nodes.payload_controller import PayloadController
from flexmanip_ros.ros.nodes.plant_simulator import PlantSimulator


def start(ros: Ros, readers: int = 1, **values: object) -> PayloadController:
    node = ros.managed(PayloadController(context=ros.context, overrides=overrides(
        **{'arm__modes': 1, 'stale_after': 5.0, **values})))
    ros.wait(lambda: node._commands.get_subscription_count() >= readers)
    return node


def controlled(ros: Ros, **values: object) -> tuple[PayloadController, Publisher, list[Float64MultiArray]]:
    """Return the node, a publisher of joint states, and the torques that are sent."""
    heard = ros.listen(Float64MultiArray, 'effort_controller/commands')
    node = start(ros, **values)
    return node, ros.publisher(JointState, 'joint_states', qos.sensor_output()), heard


def test_each_sample_gets_the_torque_of_the_core(ros: Ros) -> None:
    node, states, heard = controlled(ros)
    for k in range(50):
        states.publish(joint_state(k, ('link2_bend', 'joint1', 'other', 'joint2', 'link1_bend')))
    ros.wait(lambda: len(heard) == 50)
    state = controller.init(node.config)
    for k, message in enumerate(heard):
        record = joint_record(joint_state(k))
        state, torque = controller.step(node.config, state, controller.Measured(
            record.position, record.velocity, np.zeros(2)))
        assert np.array(message.data).tobytes() == torque.tobytes()


def test_bad_samples_get_no_torque_and_are_counted(ros: Ros) -> None:
    node, states, heard = controlled(ros)
    good, nan, nan_rate, short, unnamed, late = (joint_state(k) for k in (5, 6, 7, 8, 9, 4))
    nan.position[2] = nan_rate.velocity[1] = math.nan
    short.velocity = []
    unnamed.name = ['a', 'b', 'c', 'd']
    for message in (good, nan, nan_rate, short, unnamed, late):
        states.publish(message)
    ros.wait(lambda: (node.dropped, node.foreign) == (4, 1))
    ros.wait(lambda: heard)
    assert node.sent == 1
    assert np.isfinite(heard[0].data).all()


def test_the_joint_states_of_a_gripper_are_no_error_while_those_of_the_arm_come(
        ros: Ros, log: Callable[[str], str]) -> None:
    diagnostics = ros.listen(DiagnosticArray, '/diagnostics')
    node = start(ros, readers=0)
    states = ros.publisher(JointState, 'joint_states', qos.sensor_output())
    log('')
    count = itertools.count()

    def some(*kinds: tuple[str, ...]) -> None:
        for names in kinds:
            states.publish(joint_state(next(count), names) if names else joint_state(next(count)))

    timer = ros.helper.create_timer(0.01, lambda: some((), ('finger',)))
    ros.wait(lambda: node.foreign > 0)
    before = len(diagnosed(diagnostics, ''))
    ros.wait(lambda: len(diagnosed(diagnostics, '')) > before + 1)
    words = 'no joint state can be used: none has joint1, joint2, link1_bend, link2_bend'
    assert 'dropped' not in log('') + diagnostics[-1].status[0].message
    assert not diagnosed(diagnostics, words)
    ros.run(ros.helper, timer.cancel)
    ros.helper.create_timer(0.01, lambda: some(('finger',)))
    log(words)
    assert ros.wait(lambda: diagnosed(diagnostics, words), what='the error')[0][0] == b'\x02'
    assert node.dropped == 0


def test_a_trusted_latched_estimate_changes_the_schedule_and_a_wild_one_does_not(ros: Ros) -> None:
    estimates = ros.helper.create_publisher(
        Float64MultiArray, 'rpbsid_identifier/payload_estimate', qos.latched())
    estimates.publish(Float64MultiArray(data=[20.0, 0.1, 19.8, 20.2, 1.0]))
    node = start(ros, readers=0)
    ros.wait(lambda: node.state.trusted[0] == 20.0, what='the estimate from before the start')
    bodies = ros.helper.create_publisher(Float64MultiArray, 'rpbsid_identifier/payload_body', qos.latched())
    bodies.publish(Float64MultiArray(data=[20.05, 0.1, -0.2, 1.5, *[0.0] * 16]))
    ros.wait(lambda: node.state.trusted[3] > 0.0, what='the body')
    assert node.state.trusted == pytest.approx(payload_array(20.0, 1.5, (0.1, -0.2)))
    estimates.publish(Float64MultiArray(data=[80.0, 40.0, 0.0, 160.0, 1.0]))
    ros.wait(lambda: node.state.verdict.name == 'UNSURE')
    assert node.state.trusted[0] == 20.0


def test_a_clock_that_was_set_back_is_followed(ros: Ros) -> None:
    node, states, heard = controlled(ros)
    for start_ns in (2 * 10**18, 10**18):
        for k in range(5):
            states.publish(joint_state(k, start_ns=start_ns))
    ros.wait(lambda: len(heard) == 10)
    assert node.dropped == 0


@pytest.mark.parametrize('value', [math.nan, math.inf, 1e308, -1e300])
def test_no_value_of_a_sample_makes_the_torque_anything_but_a_limited_number(ros: Ros, value: float) -> None:
    node, states, heard = controlled(ros)
    for k in range(20):
        message = joint_state(k)
        if k % 5 == 1:
            message.position[k % 4] = value
        states.publish(message)
    ros.wait(lambda: len(heard) == 16)
    torques = np.array([message.data for message in heard])
    assert (np.abs(torques) <= node.config.effort_limit).all()
    assert node.dropped == 4


def test_where_there_is_no_regulator_the_gains_stay(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*given: object) -> None:
        raise ModelError('there is no regulator', 'none')

    heard = ros.listen(Float64MultiArray, 'effort_controller/commands')
    diagnostics = ros.listen(DiagnosticArray, '/diagnostics')
    node = start(ros, payload_rate=1e6)
    monkeypatch.setattr(controller, 'design', none)
    node._on_estimate(Float64MultiArray(data=[20.0, 0.1, 19.8, 20.2, 1.0]))
    states = ros.publisher(JointState, 'joint_states', qos.sensor_output())
    for k in range(20):
        states.publish(joint_state(k))
    ros.wait(lambda: len(heard) == 20)
    assert (node.state.failed_designs, node.state.designs) == (1, 0)
    ros.wait(lambda: diagnosed(diagnostics, 'no stable regulator was found'), what='the warning')


def test_silence_means_zero_torque_once(ros: Ros) -> None:
    _, states, heard = controlled(ros, stale_after=0.1, hold_present=False, setpoint=[1.0, 1.0])
    for k in range(20):
        states.publish(joint_state(k))
    ros.wait(lambda: len(heard) == 21)
    assert heard[-1].data.tolist() == [0.0, 0.0]
    assert heard[-2].data.tolist() != [0.0, 0.0]


def test_the_arm_is_brought_to_a_new_setpoint_live(ros: Ros) -> None:
    common = {'arm__modes': 1, 'arm__damping_ratio': 0.02, 'rate': 250.0}  # undamped, late torques ring it ever more
    node = start(ros, readers=0, rate=250.0, setpoint_rate=1.0)
    heard = ros.listen(JointState, 'joint_states', qos.sensor_output())
    plant = ros.add(PlantSimulator(context=ros.context, overrides=overrides(noise='none', **common)))
    plant.trigger_configure()
    ros.wait(lambda: plant.joint_states.get_subscription_count() == 2)
    plant.trigger_activate()
    ros.wait(lambda: len(heard) > 5)
    goal = np.array(heard[0].position[:2]) + np.array([0.05, -0.05])
    (result,) = node.set_parameters([Parameter('setpoint', value=goal.tolist())])
    assert result.successful
    # the loop runs by the wall's clock, so torques come late and ring the arm: its damping ends that
    ros.wait(lambda: np.abs(np.array(heard[-1].position[:2]) - goal).max() < 0.01, timeout=60.0)
    assert plant.dropped_commands == 0


def test_a_setpoint_ends_holding_the_present_angles_whatever_its_value_and_also_before_activation(ros: Ros) -> None:
    node, states, heard = controlled(ros)

    def sample(k: int) -> None:
        before = len(heard)
        states.publish(joint_state(k))
        ros.wait(lambda: len(heard) == before + 1)

    def set_default() -> None:
        (result,) = node.set_parameters([Parameter('setpoint', value=[0.0, 0.0])])
        assert result.successful

    sample(0)
    assert node.state.setpoint is None
    set_default()
    sample(1)
    assert node.state.setpoint.tolist() == [0.0, 0.0]
    for again, expected in ((lambda: None, None), (set_default, [0.0, 0.0])):
        before = len(heard)
        node.trigger_deactivate()
        ros.wait(lambda before=before: len(heard) == before + 1, what='the zero torque')
        again()
        node.trigger_activate()
        sample(2)
        assert (None if node.state.setpoint is None else node.state.setpoint.tolist()) == expected


def test_a_parameter_that_is_no_setpoint_moves_nothing(ros: Ros) -> None:
    node, states, heard = controlled(ros, setpoint=[0.5, 0.3], hold_present=False)
    for k, (name, value) in enumerate((('max_payload', 30.0), ('setpoint', [0.5, 0.3]), ('setpoint', [0.1, 0.0]))):
        (result,) = node.set_parameters([Parameter(name, value=value)])
        assert result.successful
        states.publish(joint_state(k))
        ros.wait(lambda k=k: len(heard) == k + 1)
        assert node.state is not None
        assert node.state.setpoint.tolist() == ([0.1, 0.0] if k == 2 else [0.5, 0.3])


def diagnosed(heard: list[DiagnosticArray], words: str) -> list[tuple[bytes, dict[str, str]]]:
    """Return level and values of the entries of payload_controller whose message contains the words."""
    return [(status.level, {item.key: item.value for item in status.values})
            for message in heard for status in message.status
            if status.name == '/payload_controller: status' and words in status.message]


@pytest.mark.parametrize(('rate', 'kept', 'said', 'not_said'), [
    (1000.0, lambda k: k % 4, '% of the joint states did not come', 'set rate'),  # every fourth is lost
    (500.0, lambda k: True, '1000 joint states a second by their stamps, designed for 500; set rate', 'did not come')])
def test_the_advice_to_set_the_rate_comes_where_the_stamps_have_another_one_and_not_where_messages_are_lost(
        ros: Ros, rate: float, kept: Callable[[int], object], said: str, not_said: str) -> None:
    diagnostics = ros.listen(DiagnosticArray, '/diagnostics')
    start(ros, readers=0, rate=rate)
    states = ros.publisher(JointState, 'joint_states', qos.sensor_output())
    count = itertools.count()

    def some() -> None:  # the wall clock runs slowly against the stamps
        for k in itertools.islice(count, 6):
            if kept(k):
                states.publish(joint_state(k))

    ros.helper.create_timer(0.02, some)
    level, _ = ros.wait(lambda: diagnosed(diagnostics, said), what='the words')[0]
    assert level == b'\x02'
    assert not diagnosed(diagnostics, not_said)


@pytest.mark.parametrize('angle', [90.0, -90.0, 1e6, 1e300, math.nan])
def test_a_setpoint_beyond_two_turns_is_rejected_live_and_at_start(ros: Ros, angle: float) -> None:
    node = start(ros, readers=0)
    (result,) = node.set_parameters([Parameter('setpoint', value=[0.1, angle])])
    assert not result.successful
    assert "parameter 'setpoint' is" in result.reason
    assert 'from -12.57 to 12.57 rad' in result.reason
    assert node.config.setpoint == (0.0, 0.0)
    with pytest.raises(ParameterError, match=r'from -12\.57 to 12\.57 rad'):
        PayloadController(context=ros.context, overrides=overrides(setpoint=[angle, 0.0]))


def test_a_setpoint_with_a_passive_joint_gives_finite_torques(ros: Ros) -> None:
    _, states, heard = controlled(ros, effort_limit=[300.0, 0.0], hold_present=False, setpoint=[0.5, 0.2])
    for k in range(200):
        states.publish(joint_state(k))
    ros.wait(lambda: len(heard) == 200)
    torques = np.array([message.data for message in heard])
    assert np.isfinite(torques).all()
    assert torques[:, 0].any()
    assert not torques[:, 1].any()


def test_a_torque_that_is_not_finite_is_never_sent_and_the_control_begins_again(
        ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    diagnostics = ros.listen(DiagnosticArray, '/diagnostics')
    node, states, heard = controlled(ros)
    for k, bad in enumerate((False, True, False, False)):
        with monkeypatch.context() as patch:
            if bad:
                patch.setattr(controller, 'duration', lambda *given: math.nan)
                (result,) = node.set_parameters([Parameter('setpoint', value=[0.5, 0.2])])
                assert result.successful
            states.publish(joint_state(k))
            ros.wait(lambda k=k: len(heard) == k + 1)
    assert heard[1].data.tolist() == [0.0, 0.0]
    assert np.isfinite([message.data for message in heard]).all()
    assert heard[3].data.tolist() != [0.0, 0.0]
    assert ros.wait(lambda: diagnosed(diagnostics, 'was not finite'), what='the error')[0][0] == b'\x02'


def test_an_arm_too_heavy_for_its_joints_is_said_once_with_the_torques_that_it_needs(
        ros: Ros, capfd: pytest.CaptureFixture[str]) -> None:
    diagnostics = ros.listen(DiagnosticArray, '/diagnostics')
    node, states, heard = controlled(ros, arm__gravity=[0.0, -9.81], rate=250.0, hold_present=False)
    words = 'holding the arm at 0 and 0 rad needs 1742 and 514.6 N m; effort_limit is 300 and 150 N m'
    for k in range(200):  # 0.8 s at the limits
        states.publish(joint_state(4 * k))
    ros.wait(lambda: len(heard) == 200)
    assert ros.wait(lambda: diagnosed(diagnostics, words), what='the error')[0][0] == b'\x02'
    ros.wait(lambda: len(diagnosed(diagnostics, words)) > 1, what='another entry')
    said = capfd.readouterr().err
    assert said.count(words) == 1
    assert 'Check rate' not in said
    (result,) = node.set_parameters([Parameter('effort_limit', value=[3000.0, 1500.0])])
    assert result.successful
    before = len(diagnosed(diagnostics, ''))
    ros.wait(lambda: len(diagnosed(diagnostics, '')) > before + 1)
    assert words not in diagnostics[-1].status[0].message


def test_estimates_that_cease_are_a_warning_with_the_payload_that_stays(
        ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    diagnostics = ros.listen(DiagnosticArray, '/diagnostics')
    node = start(ros, readers=0)
    _, before = ros.wait(lambda: diagnosed(diagnostics, ''))[0]
    assert (before['estimate'], before['estimate_age_s']) == ('none', 'unknown')
    estimates = ros.publisher(Float64MultiArray, 'rpbsid_identifier/payload_estimate', qos.latched())
    estimates.publish(Float64MultiArray(data=[20.0, 0.1, 19.8, 20.2, 1.0]))
    ros.wait(lambda: node.state.trusted[0] == 20.0)
    monkeypatch.setattr(handover, 'LONGEST_AGE', 0.2)
    level, values = ros.wait(lambda: diagnosed(diagnostics, 'no payload estimate for'), what='the warning')[0]
    assert diagnosed(diagnostics, 'the gains stay those of 20.00 kg')
    assert values['estimate'] == 'trusted'
    assert float(values['estimate_age_s']) > 0.2
    assert level == b'\x03'  # STALE, as no joint states come either; it outranks the warning
    assert node.state.trusted[0] == 20.0
