from __future__ import annotations

from joint_states import START_NS, joint_state
from ros_harness import Ros, overrides
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from flexmanip_ros.ros import qos
from flexmanip_ros.ros.capture_trigger import CaptureTrigger
from flexmanip_ros.ros.conversions import stamp_ns


def test_an_event_at_a_set_time_is_stamped_from_the_first_sample_and_announced_ahead(ros: Ros) -> None:
    ros.managed(CaptureTrigger(context=ros.context, overrides=overrides(
        mode='time', capture_time=0.1, release_time=0.2, lead_time=0.03)))
    events = ros.listen(Header, 'capture_event', qos.latched())
    publisher = ros.publisher(JointState, 'joint_states', qos.sensor_output())
    for k in range(69):
        publisher.publish(joint_state(k))
    publisher.publish(joint_state(70))
    ros.wait(lambda: len(events) == 1, what='the capture, 30 ms ahead')
    assert (stamp_ns(events[0].stamp), events[0].frame_id) == (START_NS + 100_000_000, 'capture')
    for k in range(71, 201):
        publisher.publish(joint_state(k))
    ros.wait(lambda: len(events) == 2, what='the release')
    assert (stamp_ns(events[1].stamp), events[1].frame_id) == (START_NS + 200_000_000, 'release')


def test_nothing_is_announced_before_its_lead_time(ros: Ros) -> None:
    node = ros.managed(CaptureTrigger(context=ros.context, overrides=overrides(
        mode='time', capture_time=0.1, lead_time=0.03)))
    publisher = ros.publisher(JointState, 'joint_states', qos.sensor_output())
    for k in range(70):
        publisher.publish(joint_state(k))
    ros.wait(lambda: node._last_ns == START_NS + 69_000_000)
    assert node.announced == []


def test_a_looped_recording_starts_the_count_again(ros: Ros) -> None:
    node = ros.managed(CaptureTrigger(context=ros.context, overrides=overrides(
        mode='time', capture_time=0.01, lead_time=0.0)))
    publisher = ros.publisher(JointState, 'joint_states', qos.sensor_output())
    for start in (START_NS, START_NS - 5_000_000_000):
        for k in range(12):
            publisher.publish(joint_state(k, start_ns=start))
    ros.wait(lambda: len(node.announced) == 2)
    assert [event.stamp_ns for event in node.announced] == [START_NS + 10**7, START_NS - 5 * 10**9 + 10**7]


def test_a_requested_capture_is_stamped_after_the_latest_sample_and_latched(ros: Ros) -> None:
    node = ros.managed(CaptureTrigger(context=ros.context, overrides=overrides(service_delay=0.02)))
    publisher = ros.publisher(JointState, 'joint_states', qos.sensor_output())
    publisher.publish(joint_state(5))
    ros.wait(lambda: node._last_ns is not None)
    assert ros.call(Trigger, 'capture_trigger/capture').success
    late = ros.listen(Header, 'capture_event', qos.latched())
    ros.wait(lambda: late, what='the latched event for a late joiner')
    assert (stamp_ns(late[0].stamp), late[0].frame_id) == (START_NS + 25_000_000, 'capture')
    assert ros.call(Trigger, 'capture_trigger/release').success
    ros.wait(lambda: len(late) == 2)
    assert late[1].frame_id == 'release'


def test_a_request_without_joint_states_is_refused_with_the_reason(ros: Ros) -> None:
    node = ros.managed(CaptureTrigger(context=ros.context))
    answer = ros.call(Trigger, 'capture_trigger/capture')
    assert not answer.success
    assert 'no joint_states' in answer.message
    assert node.announced == []
