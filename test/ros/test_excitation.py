from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from joint_states import joint_state
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from ros_harness import Ros, overrides
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from flexmanip_ros.ros import qos
from flexmanip_ros.ros.nodes.excitation import Excitation
from flexmanip_ros.simulation.excitation import torque


def test_torques_follow_the_clock_and_end_at_zero(ros: Ros) -> None:
    heard = ros.listen(Float64MultiArray, 'effort_controller/commands', qos.sensor_output())
    node = ros.add(Excitation(context=ros.context, overrides=overrides(rate=200.0, period=[0.1, 0.05])))
    node.trigger_configure()
    ros.wait(lambda: node.commands.get_subscription_count() == 1)
    node.trigger_activate()
    ros.wait(lambda: len(heard) >= 60)
    node.trigger_deactivate()
    ros.wait(lambda: heard[-1].data.tolist() == [0.0, 0.0], what='zero torque at the end')
    expected = [torque(node.config, k) for k in range(node._last + 1)]
    said = [np.array(message.data) for message in heard[:-1]]
    steps = iter(expected)  # instants may be skipped on a busy machine, never reordered
    assert all(any((one == other).all() for other in steps) for one in said)
    assert len(said) + node.skipped == len(expected)


def test_amplitude_and_offset_change_while_it_runs(ros: Ros) -> None:
    heard = ros.listen(Float64MultiArray, 'effort_controller/commands')
    node = ros.managed(Excitation(context=ros.context, overrides=overrides(rate=200.0)))
    ros.wait(lambda: len(heard) > 3)
    assert set(np.abs(heard[-1].data)) == {10.0, 5.0}
    (result,) = node.set_parameters([Parameter('amplitude', value=[1.0, 2.0])])
    assert result.successful
    ros.wait(lambda: set(np.abs(heard[-1].data)) == {1.0, 2.0})


def test_without_simulated_time_it_says_that_it_waits_for_the_clock(ros: Ros, log: Callable[[str], str]) -> None:
    heard = ros.listen(DiagnosticArray, '/diagnostics', 10)
    log('')
    ros.managed(Excitation(context=ros.context, overrides=overrides(use_sim_time=True)))
    log('clock /clock (use_sim_time is true)')
    log('waiting for /clock (use_sim_time is true)')
    status = ros.wait(lambda: next((item.status[0] for item in heard if '/clock' in item.status[0].message), 0))
    assert (status.level, status.message) == (b'\x03', 'no /clock (use_sim_time is true)')


def test_nothing_is_sent_before_it_is_active(ros: Ros) -> None:
    heard = ros.listen(Float64MultiArray, 'effort_controller/commands')
    node = ros.add(Excitation(context=ros.context, overrides=overrides(rate=500.0)))
    node.trigger_configure()
    ros.wait(lambda: node.commands.get_subscription_count() == 1)
    node._grid.tick()
    assert heard == []


def in_step(ros: Ros) -> tuple[Excitation, list[Float64MultiArray], Publisher]:
    """A node that follows the stamps of joint states, what it sends, and the publisher of the joint states."""
    heard = ros.listen(Float64MultiArray, 'effort_controller/commands', qos.sensor_output())
    node = ros.managed(Excitation(context=ros.context, overrides=overrides(
        clock='joint_states', period=[0.02, 0.01])))
    ros.wait(lambda: node.commands.get_subscription_count() == 1)
    states = ros.publisher(JointState, 'joint_states', qos.sensor_output())
    return node, heard, states


def test_torques_keep_in_step_with_the_stamps_of_the_arm_whenever_they_come(ros: Ros) -> None:
    node, heard, states = in_step(ros)
    for k in range(100):
        states.publish(joint_state(k))
    ros.wait(lambda: len(heard) == 100)
    for k, message in enumerate(heard):
        assert message.data.tolist() == torque(node.config, k + 1).tolist()


def test_joint_states_without_a_stamp_as_those_of_a_gripper_do_not_disturb_the_torques(ros: Ros) -> None:
    node, heard, states = in_step(ros)
    for k in range(50):
        states.publish(JointState(name=['finger'], position=[0.1]))
        states.publish(joint_state(k))
    ros.wait(lambda: len(heard) >= 50)
    assert [message.data.tolist() for message in heard] == [torque(node.config, k + 1).tolist() for k in range(50)]


@pytest.mark.parametrize(('name', 'value', 'said'), [
    ('amplitude', [0.0, 0.0], 'the torque is zero'), ('offset', [500.0, 0.0], 'lower the offset'),
    ('amplitude', [1e-320, 0.0], 'the torque is zero')])
def test_a_torque_that_no_amplitude_fits_to_the_allowed_angle_is_rejected_and_the_node_goes_on(
        ros: Ros, name: str, value: list[float], said: str) -> None:
    heard = ros.listen(Float64MultiArray, 'effort_controller/commands')
    node = ros.managed(Excitation(context=ros.context, overrides=overrides(
        rate=200.0, arm__modes=1, allowed_angle=0.3, design_time=1.0)))
    ros.wait(lambda: heard)
    answers: list[Any] = []
    ros.run(node, lambda: answers.extend(node.set_parameters([Parameter(name, value=value)])))
    assert not answers[0].successful
    assert said in answers[0].reason
    before = len(heard)
    ros.wait(lambda: len(heard) > before + 10)
