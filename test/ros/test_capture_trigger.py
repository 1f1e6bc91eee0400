from __future__ import annotations

from joint_states import START_NS, joint_state
from ros_harness import Ros, overrides
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from flexmanip_ros.parameters import ExcitationParameters, PlantParameters
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import joint_state as joint_state_message
from flexmanip_ros.ros.conversions import stamp_ns
from flexmanip_ros.ros.nodes.capture_trigger import CaptureTrigger
from flexmanip_ros.simulation import simulator
from flexmanip_ros.simulation.excitation import sequence
from flexmanip_ros.types import CaptureEvent, EventKind


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
    assert node.announced == 0


def test_a_looped_recording_starts_the_count_again(ros: Ros) -> None:
    node = ros.managed(CaptureTrigger(context=ros.context, overrides=overrides(
        mode='time', capture_time=0.01, lead_time=0.0)))
    heard = ros.listen(Header, 'capture_event', qos.latched_input())
    publisher = ros.publisher(JointState, 'joint_states', qos.sensor_output())
    for start in (START_NS, START_NS - 5_000_000_000):
        for k in range(12):
            publisher.publish(joint_state(k, start_ns=start))
    ros.wait(lambda: len(heard) == 2)
    assert [stamp_ns(event.stamp) for event in heard] == [START_NS + 10**7, START_NS - 5 * 10**9 + 10**7]
    ros.wait(lambda: node.announced == 2)  # counted on the node's thread, once the event is out


def test_one_stamp_from_far_ahead_does_not_make_the_count_begin_again(ros: Ros) -> None:
    node = ros.managed(CaptureTrigger(context=ros.context, overrides=overrides(
        mode='time', capture_time=0.03, lead_time=0.0)))
    heard = ros.listen(Header, 'capture_event', qos.latched_input())
    publisher = ros.publisher(JointState, 'joint_states', qos.sensor_output())
    for k in range(80):
        publisher.publish(joint_state(k, start_ns=START_NS + (k == 10) * 10**11))
    ros.wait(lambda: node._last_ns == START_NS + 79_000_000)
    ros.wait(lambda: heard)
    assert [stamp_ns(event.stamp) for event in heard] == [START_NS + 30_000_000]


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
    assert node.announced == 0


def test_mode_auto_finds_a_capture_and_tells_it_where_the_plant_does_not_listen(ros: Ros) -> None:
    node = ros.managed(CaptureTrigger(context=ros.context, overrides=overrides(mode='auto')))
    commanded = ros.listen(Header, 'capture_event', qos.latched())
    detected = ros.listen(Header, 'capture_detected', qos.latched())
    publisher = ros.publisher(JointState, 'joint_states', qos.sensor_output())
    count, capture = 2600, CaptureEvent(START_NS + 2_100_000_000, EventKind.CAPTURE)
    run = simulator.simulate(PlantParameters(), sequence(ExcitationParameters(), count), (capture,), START_NS)
    for k, record in enumerate(simulator.records(run)):
        publisher.publish(joint_state_message(record))
        if k % 200 == 199:
            ros.wait(lambda k=k: node._watch.clock.counters.received == k + 1)
    ros.wait(lambda: detected, what='the detected capture')
    assert detected[0].frame_id == 'capture'
    assert abs(stamp_ns(detected[0].stamp) - capture.stamp_ns) < 30_000_000
    assert node.detected == 1
    assert commanded == []
