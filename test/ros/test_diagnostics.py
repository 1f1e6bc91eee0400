from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from joint_states import joint_state
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_harness import Ros, overrides
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from flexmanip_ros.ros import qos
from flexmanip_ros.ros.diagnostics import JointStateFaults, LossCounter, Meter, Stamps
from flexmanip_ros.ros.nodes.capture_trigger import CaptureTrigger
from flexmanip_ros.ros.nodes.plant_simulator import PlantSimulator
from flexmanip_ros.samples.sampling import Clock, Counters


def entries(heard: list[DiagnosticArray], name: str) -> list[Any]:
    return [status for message in heard for status in message.status if status.name == f'/{name}: status']


def values(status: Any) -> dict[str, str]:
    return {item.key: item.value for item in status.values}


def test_a_missed_deadline_shows_with_its_topic_and_count(ros: Ros) -> None:
    heard = ros.listen(DiagnosticArray, '/diagnostics', 10)
    ros.managed(CaptureTrigger(context=ros.context, overrides=overrides(
        **{'qos_overrides./joint_states.subscription.deadline': 20_000_000})))
    offered = qos.sensor_output()
    offered.deadline = Duration(nanoseconds=10_000_000)
    states = ros.publisher(JointState, 'joint_states', offered)
    states.publish(joint_state(0))
    found = ros.wait(lambda: [status for status in entries(heard, 'capture_trigger')
                              if 'joint_states deadline_missed' in values(status)], what='the deadline')
    assert int(values(found[0])['joint_states deadline_missed']) > 0


def test_a_publisher_of_another_quality_of_service_is_an_error(ros: Ros) -> None:
    heard = ros.listen(DiagnosticArray, '/diagnostics', 10)
    node = ros.managed(CaptureTrigger(context=ros.context, overrides=overrides(
        **{'qos_overrides./joint_states.subscription.reliability': 'reliable'})))
    ros.helper.create_publisher(
        JointState, 'joint_states', QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT))
    ros.wait(lambda: any(status.level == b'\x02' and 'incompatible' in status.message
                         for status in entries(heard, 'capture_trigger')), what='the error')
    assert node.events['joint_states incompatible_publishers'] == 1


def test_a_publisher_of_events_that_are_not_latched_is_told_the_policy_and_the_parameter(
        ros: Ros, log: Callable[[str], str]) -> None:
    ros.managed(PlantSimulator(context=ros.context, overrides=overrides(rate=100.0, arm__modes=1)))
    ros.helper.create_publisher(Header, 'capture_event', 10)
    log('a publisher of /capture_event offers durability volatile, so none of its messages is received; publish with '
        'durability transient_local, or start this node with '
        '-p qos_overrides./capture_event.subscription.durability:=volatile')


def test_joint_states_that_cease_are_said_to_have_ceased_and_for_how_long(
        ros: Ros, log: Callable[[str], str]) -> None:
    heard = ros.listen(DiagnosticArray, '/diagnostics', 10)
    ros.managed(CaptureTrigger(context=ros.context))
    states = ros.publisher(JointState, 'joint_states', qos.sensor_output())
    assert 'waiting for /joint_states' in log('waiting for /joint_states')
    states.publish(joint_state(0))
    log('messages arrive: ')
    log('no /joint_states for ')
    ros.wait(lambda: entries(heard, 'capture_trigger')[-1].message.startswith('no joint_states for '))


def test_diagnostics_come_once_a_second_active_or_not(ros: Ros) -> None:
    heard = ros.listen(DiagnosticArray, '/diagnostics', 10)
    node = ros.add(CaptureTrigger(context=ros.context, overrides=overrides(autostart=False)))
    found = ros.wait(lambda: entries(heard, 'capture_trigger'))
    assert found[0].message.startswith('not active')
    node.trigger_configure()
    node.trigger_activate()
    ros.wait(lambda: values(entries(heard, 'capture_trigger')[-1])['active'] == 'True')
    assert entries(heard, 'capture_trigger')[-1].message == 'no joint_states'


def test_the_lifecycle_services_start_and_stop_a_node(ros: Ros) -> None:
    node = ros.add(CaptureTrigger(context=ros.context, overrides=overrides(autostart=False)))
    assert node.autostart()
    for transition, state in (
            (1, 'inactive'), (3, 'active'), (4, 'inactive'), (3, 'active'), (7, 'finalized')):
        request = ChangeState.Request()
        request.transition.id = transition
        assert ros.call(ChangeState, 'capture_trigger/change_state', request).success
        assert ros.call(GetState, 'capture_trigger/get_state').current_state.label == state


def test_a_latched_event_is_offered_as_such(ros: Ros) -> None:
    ros.managed(CaptureTrigger(context=ros.context))
    (offer,) = ros.wait(lambda: ros.helper.get_publishers_info_by_topic('/capture_event'))
    assert offer.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert offer.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    assert offer.topic_type == 'std_msgs/msg/Header'


def test_losses_are_counted_from_numbers_and_a_new_publisher_is_none() -> None:
    losses = LossCounter()
    for number in (1, 2, 5, 6, 1, 2, 4, None):
        losses.note(number)
    assert losses.lost == 2 + 1


def test_several_publishers_are_a_likely_cause_of_gaps_that_no_loss_explains() -> None:
    faults, clock = JointStateFaults(('joint1',), '/joint_states'), Clock(counters=Counters(gaps=100))
    faults.losses.publishers = 2
    faults.note(Clock(), clock, ('joint1',))
    assert faults.likely_cause().startswith('2 publishers are on /joint_states: ')
    for number in (1, 1001, 2, 1102):  # those of two publishers; 100 of the second are missing
        faults.losses.note(number)
    assert faults.losses.recent() == 100
    assert faults.likely_cause() == ''


def test_a_meter_counts_times_and_begins_again() -> None:
    meter = Meter()
    for _ in range(10):
        with meter.timed():
            pass
    window = meter.window()
    assert window['rate_hz'] > 0.0
    assert 0.0 <= window['callback_p50_us'] <= window['callback_p99_us'] <= window['callback_max_us']
    assert 0.0 <= window['callback_share'] <= 1.0
    assert meter.window()['rate_hz'] == 0.0


def test_the_rate_is_that_of_the_stamps_whatever_is_lost_and_whoever_set_the_clock() -> None:
    stamps = Stamps()
    assert all(map(math.isnan, stamps.window()))
    for k in (0, 1, 2, 5, 6, 7, 9, 10):  # 3 of 11 are lost
        stamps.note(5_000_000 * k)
    rate, missing = stamps.window()
    assert (rate, missing) == (pytest.approx(200.0), pytest.approx(0.3))
    for k in range(5):
        stamps.note(10_000_000 * k)
    rate, missing = stamps.window()
    assert (rate, missing) == (pytest.approx(100.0), pytest.approx(0.0))
    assert all(map(math.isnan, stamps.window()))
