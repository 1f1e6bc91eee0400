from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from joint_states import START_NS, joint_state
from rclpy.parameter import Parameter
from ros_harness import Ros, overrides
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from flexmanip_ros.parameters import ExcitationParameters, PlantParameters
from flexmanip_ros.ros import diagnostics, qos
from flexmanip_ros.ros.conversions import stamp_ns, to_message
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


def test_mode_time_without_a_time_says_that_no_event_comes(ros: Ros, log: Callable[[str], str]) -> None:
    ros.managed(CaptureTrigger(context=ros.context, overrides=overrides(mode='time', capture_time=-1.0)))
    log('ready: mode time, no event: capture_time and release_time are negative')


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


def assert_captured_once(ros: Ros, messages: list[JointState]) -> None:
    """Joint states of 80 ms give one event, at its time since the first of them."""
    node = ros.managed(CaptureTrigger(context=ros.context, overrides=overrides(
        mode='time', capture_time=0.03, lead_time=0.0)))
    heard = ros.listen(Header, 'capture_event', qos.latched_input())
    publisher = ros.publisher(JointState, 'joint_states', qos.sensor_output())
    for message in messages:
        publisher.publish(message)
    ros.wait(lambda: node._last_ns == START_NS + 79_000_000)
    ros.wait(lambda: heard)
    assert [stamp_ns(event.stamp) for event in heard] == [START_NS + 30_000_000]


def test_joint_states_without_a_stamp_as_those_of_a_gripper_do_not_disturb_the_count(ros: Ros) -> None:
    finger = JointState(name=['finger'], position=[0.1])
    assert_captured_once(ros, [message for k in range(80) for message in ([finger] * (k % 10 == 0) + [joint_state(k)])])


def test_one_stamp_from_far_ahead_does_not_make_the_count_begin_again(ros: Ros) -> None:
    assert_captured_once(ros, [joint_state(k, start_ns=START_NS + (k == 10) * 10**11) for k in range(80)])


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


def test_a_release_requested_before_the_next_joint_state_comes_after_the_capture(ros: Ros) -> None:
    """Of events with one stamp the identifier takes the release first, and the arm would hold an object."""
    node = ros.managed(CaptureTrigger(context=ros.context))
    ros.publisher(JointState, 'joint_states', qos.sensor_output()).publish(joint_state(5))
    ros.wait(lambda: node._last_ns is not None)
    heard = ros.listen(Header, 'capture_event', qos.latched())
    for request in ('capture', 'release', 'capture'):
        assert ros.call(Trigger, f'capture_trigger/{request}').success
    ros.wait(lambda: len(heard) == 3)
    assert [event.frame_id for event in sorted(heard, key=lambda event: stamp_ns(event.stamp))] == [
        'capture', 'release', 'capture']
    assert len({stamp_ns(event.stamp) for event in heard}) == 3


def test_an_event_that_an_identifier_takes_for_the_one_before_is_answered_so(ros: Ros) -> None:
    node = ros.managed(CaptureTrigger(context=ros.context))
    publisher = ros.publisher(JointState, 'joint_states', qos.sensor_output())
    answers = []
    for k, request in ((0, 'capture'), (60, 'capture'), (200, 'capture'), (230, 'release'), (260, 'capture')):
        publisher.publish(joint_state(k))
        ros.wait(lambda k=k: node._last_ns == START_NS + k * 1_000_000)
        answers.append(ros.call(Trigger, f'capture_trigger/{request}').message)
    assert ['event_merge_time (default 0.1 s)' in answer for answer in answers] == [False, True, False, False, False]


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
    count, capture = 1700, CaptureEvent(START_NS + 1_200_000_000, EventKind.CAPTURE)
    run = simulator.simulate(PlantParameters(), sequence(ExcitationParameters(), count), (capture,), START_NS)
    for k, record in enumerate(simulator.records(run)):
        publisher.publish(to_message(record))
        if k % 200 == 199:
            ros.wait(lambda k=k: node._watch.clock.counters.received == k + 1)
    ros.wait(lambda: detected, what='the detected capture')
    assert detected[0].frame_id == 'capture'
    assert abs(stamp_ns(detected[0].stamp) - capture.stamp_ns) < 30_000_000
    assert node.detected == 1
    assert commanded == []


class Auto:
    """The trigger in mode auto, with the diagnostics that it published."""

    def __init__(self, ros: Ros, *more: Parameter) -> None:
        self.ros = ros
        self.heard = ros.listen(DiagnosticArray, '/diagnostics', 10)
        self.node = ros.managed(CaptureTrigger(context=ros.context, overrides=[*overrides(mode='auto'), *more]))
        self.states = ros.publisher(JointState, 'joint_states', qos.sensor_output())

    def send(self, *samples: int, start_ns: int = START_NS) -> None:
        """Publish these samples and wait until they are taken, in portions that no queue overflows at."""
        for first in range(0, len(samples), 200):
            part = samples[first:first + 200]
            until = self.node._watch.clock.counters.received + len(part)
            for k in part:
                self.states.publish(joint_state(k, start_ns=start_ns))
            self.ros.wait(lambda until=until: self.node._watch.clock.counters.received >= until)

    def wait(self, words: str) -> DiagnosticStatus:
        """Return the first diagnostic entry that has these words."""
        return self.ros.wait(lambda: next((m.status[0] for m in self.heard if words in m.status[0].message), None),
                             what=words)


LOADED_BY_THE_WARM_UP = """
import sys
from flexmanip_ros.numerics.compiled import Separate
from flexmanip_ros.parameters import ExcitationParameters, PlantParameters, TriggerParameters
from flexmanip_ros.payload import capture_detection
from flexmanip_ros.ros.nodes.capture_trigger import warm_up
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord

def loaded():
    values = [value for name, module in list(sys.modules.items()) if name.startswith('flexmanip_ros')
              for value in vars(module).values()]
    kernels = [value.kernel if isinstance(value, Separate) else value for value in values]
    return {(str(kernel.py_func), str(types)) for kernel in kernels if hasattr(kernel, 'py_func')
            for types in kernel.signatures}

capture = CaptureEvent(1_500_000_000, EventKind.CAPTURE)
run = simulator.simulate(PlantParameters(), excitation.sequence(ExcitationParameters(), 2000), (capture,))
config, found = TriggerParameters(mode='auto'), ()
warm_up(config)
before, watch = loaded(), capture_detection.watching(config)
for item in simulator.records(run, (capture,)):
    if isinstance(item, JointRecord):
        watch, some = capture_detection.look(watch, item)
        found += tuple(some)
assert found and before, (found, before)
assert loaded() == before, loaded() - before
"""


def test_whatever_finds_a_capture_was_loaded_by_the_warm_up() -> None:
    subprocess.run([sys.executable, '-c', LOADED_BY_THE_WARM_UP], check=True, timeout=150)


def test_mode_auto_counts_what_it_lost_while_it_was_held_up_and_warns(
        ros: Ros, log: Callable[[str], str]) -> None:
    shallow = Parameter('qos_overrides./joint_states.subscription.depth', value=1000)
    auto, release = Auto(ros, shallow), threading.Event()
    auto.send(*range(600))
    spun = auto.ros._of(auto.node)
    spun.jobs.append(release.wait)
    for k in range(600, 3000):
        auto.states.publish(joint_state(k))
    release.set()
    ros.wait(lambda: auto.node._watch.clock.counters.received + auto.node.faults.losses.lost == 3000)
    assert auto.node.faults.losses.lost > 0
    log('the detection begins again after a gap in the joint states: a capture or release in the gap, or within 0.5 s '
        'after it, is not found')
    status = auto.wait('messages lost in the last 60 s')
    assert status.level == b'\x01'
    assert 'restart of the detection in the last 60 s' in auto.wait('restart').message


def test_mode_auto_says_that_a_jump_of_the_stamps_began_the_detection_again(
        ros: Ros, log: Callable[[str], str]) -> None:
    auto = Auto(ros)
    auto.send(*range(600))
    log('')
    auto.send(*range(100), start_ns=START_NS - 10**10)
    log('the detection begins again with an empty arm: the stamps jumped or their rate changed')
    auto.wait('1 restart of the detection')


def test_mode_auto_warns_where_samples_come_faster_than_they_are_computed(
        ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnostics, 'BUSY', 1e-6)  # this machine may be fast
    auto = Auto(ros)
    auto.send(*range(200))
    auto.wait(f'{diagnostics.TOO_SLOW}: publish joint states less often')
