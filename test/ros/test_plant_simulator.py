from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_harness import Ros, overrides
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header
from std_srvs.srv import Trigger

from flexmanip_ros.ros import diagnostics, qos
from flexmanip_ros.ros.conversions import joint_record, stamp_ns, time_message, to_message
from flexmanip_ros.ros.nodes.plant_simulator import PlantSimulator
from flexmanip_ros.simulation import simulator
from flexmanip_ros.types import CaptureEvent, EventKind

RATE = 200.0
STEP_NS = 5_000_000


def start(ros: Ros, **values: Any) -> tuple[PlantSimulator, list[JointState]]:
    heard = ros.listen(JointState, 'joint_states', qos.sensor_output())
    node = ros.add(PlantSimulator(context=ros.context, overrides=overrides(
        **{'rate': RATE, 'noise': 'none', 'arm__modes': 1, **values})))
    node.trigger_configure()
    ros.wait(lambda: node.joint_states.get_subscription_count() == 1)
    return node, heard


def stamps(heard: list[JointState]) -> np.ndarray:
    return np.array([stamp_ns(message.header.stamp) for message in heard])


def test_stamps_are_a_uniform_grid_even_when_the_timer_comes_late(ros: Ros) -> None:
    node, heard = start(ros)
    node.trigger_activate()
    ros.wait(lambda: len(heard) > 20)
    blocked = ros.helper.create_timer(0.01, lambda: (blocked.cancel(), __import__('time').sleep(0.2)))
    ros.wait(lambda: len(heard) > 120)
    assert set(np.diff(stamps(heard))) == {STEP_NS}


def test_the_node_gives_the_numbers_of_the_core(ros: Ros) -> None:
    node, heard = start(ros, noise='snr')
    commands = ros.publisher(Float64MultiArray, 'effort_controller/commands')
    commands.publish(Float64MultiArray(data=[3.0, -1.0]))
    node.trigger_activate()
    ros.wait(lambda: len(heard) >= 50)
    state = simulator.init(node.config, stamp_ns(heard[0].header.stamp))
    for message in heard[:50]:
        state, expected = simulator.step(node.config, state, np.array(message.effort[:2]))
        got = joint_record(message)
        assert (got.stamp_ns, got.names) == (expected.stamp_ns, expected.names)
        for field in ('position', 'velocity', 'effort'):
            assert getattr(got, field).tobytes() == getattr(expected, field).tobytes()


@pytest.mark.parametrize('bad', [[1.0], [1.0, 2.0, 3.0], [], [1.0, math.nan], [math.inf, 0.0]])
def test_a_wrong_command_is_dropped_whole_and_counted(ros: Ros, bad: list[float]) -> None:
    node, heard = start(ros)
    commands = ros.publisher(Float64MultiArray, 'effort_controller/commands')
    node.trigger_activate()
    commands.publish(Float64MultiArray(data=[2.0, 1.0]))
    ros.wait(lambda: heard and heard[-1].effort[:2].tolist() == [2.0, 1.0], what='the good command')
    commands.publish(Float64MultiArray(data=bad))
    ros.wait(lambda: node.dropped_commands == 1)
    before = len(heard)
    ros.wait(lambda: len(heard) > before + 5)
    assert heard[-1].effort[:2].tolist() == [2.0, 1.0]


@pytest.mark.parametrize('depth', [1, 1000])
@pytest.mark.parametrize('count', [3, 200])
def test_every_bad_command_of_a_burst_is_counted_as_dropped_or_as_lost(
        ros: Ros, count: int, depth: int) -> None:
    node, _ = start(ros)
    node.trigger_activate()
    commands = ros.publisher(Float64MultiArray, 'effort_controller/commands', depth)
    commands.publish(Float64MultiArray(data=[2.0, 1.0]))
    ros.wait(lambda: node.efforts.tolist() == [2.0, 1.0])
    for _ in range(count):
        commands.publish(Float64MultiArray(data=[1.0]))
    commands.publish(Float64MultiArray(data=[3.0, 1.0]))
    ros.wait(lambda: node.efforts.tolist() == [3.0, 1.0])
    assert node.dropped_commands + node.lost_commands.lost == count
    assert node.dropped_commands >= min(count, 9)


def test_two_publishers_with_numbers_of_their_own_are_no_loss(ros: Ros) -> None:
    node, _ = start(ros)
    node.trigger_activate()
    first, second = (ros.publisher(Float64MultiArray, 'effort_controller/commands') for _ in range(2))
    ros.wait(lambda: node.lost_commands.publishers == 2)
    torque = 0.0
    for publisher in (*[first] * 50, second, first, second):
        torque += 1.0
        publisher.publish(Float64MultiArray(data=[torque, 1.0]))
        ros.wait(lambda torque=torque: node.efforts[0] == torque)
    ros.helper.destroy_publisher(second)
    ros.wait(lambda: node.lost_commands.publishers == 1)
    first.publish(Float64MultiArray(data=[-1.0, 1.0]))
    ros.wait(lambda: node.efforts[0] == -1.0)
    assert node.lost_commands.lost == 0


def test_dropped_commands_show_in_the_diagnostics(ros: Ros) -> None:
    heard = ros.listen(DiagnosticArray, '/diagnostics', 10)
    node, _ = start(ros)
    node.trigger_activate()
    ros.publisher(Float64MultiArray, 'effort_controller/commands').publish(Float64MultiArray(data=[1.0]))

    def warned() -> bool:
        return any(
            status.name == '/plant_simulator: status' and status.level == b'\x01'
            and {'dropped_commands': '1'}.items() <= {v.key: v.value for v in status.values}.items()
            for message in heard for status in message.status)

    ros.wait(warned, what='a warning with the count')


def test_a_dropped_command_is_a_warning_for_a_minute(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnostics, 'RECENT_S', 3.0)
    heard = ros.listen(DiagnosticArray, '/diagnostics', 10)
    node, _ = start(ros)
    node.trigger_activate()
    ros.publisher(Float64MultiArray, 'effort_controller/commands').publish(Float64MultiArray(data=[1.0]))

    def said() -> list[str]:
        return [message.status[0].message for message in heard if message.status[0].name == '/plant_simulator: status']

    ros.wait(lambda: '1 command dropped in the last 3 s' in said(), what='the warning')
    ros.wait(lambda: said()[-1] == 'ok', what='its end')
    assert node.dropped_commands == 1


def test_an_event_ahead_of_its_stamp_acts_exactly_there(ros: Ros) -> None:
    node, heard = start(ros)
    node.trigger_activate()
    commands = ros.publisher(Float64MultiArray, 'effort_controller/commands')
    commands.publish(Float64MultiArray(data=[5.0, 2.0]))
    events = ros.publisher(Header, 'capture_event', qos.latched())
    ros.wait(lambda: len(heard) > 20)
    at = stamp_ns(heard[-1].header.stamp) + 60 * STEP_NS
    events.publish(to_message(CaptureEvent(at, EventKind.CAPTURE)))
    ros.wait(lambda: stamp_ns(heard[-1].header.stamp) > at + 20 * STEP_NS)
    assert node.late_events == 0
    state = simulator.init(node.config, stamp_ns(heard[0].header.stamp))
    for message in heard:
        if stamp_ns(message.header.stamp) == at:
            state = simulator.attach(node.config, state)
        state, expected = simulator.step(node.config, state, np.array(message.effort[:2]))
        assert joint_record(message).position.tobytes() == expected.position.tobytes()


def test_an_event_from_before_the_start_is_ignored(ros: Ros) -> None:
    node, heard = start(ros)
    events = ros.publisher(Header, 'capture_event', qos.latched())
    events.publish(to_message(CaptureEvent(10**18, EventKind.CAPTURE)))
    node.trigger_activate()
    late = ros.listen(Header, 'capture_event', qos.latched())
    ros.wait(lambda: late and len(heard) > 10)
    assert not node._pending
    assert not np.any(node.state.payload)


def test_reset_brings_the_start_back_while_stamps_go_on(ros: Ros) -> None:
    node, heard = start(ros)
    commands = ros.publisher(Float64MultiArray, 'effort_controller/commands')
    commands.publish(Float64MultiArray(data=[20.0, 10.0]))
    node.trigger_activate()
    ros.wait(lambda: len(heard) > 40)
    assert ros.call(Trigger, 'plant_simulator/reset').success
    count = len(heard)
    ros.wait(lambda: len(heard) > count + 10)
    first = joint_record(heard[0]).position
    assert joint_record(heard[-1]).position.tobytes() == first.tobytes()
    assert heard[-1].effort[:2].tolist() == [0.0, 0.0]
    assert set(np.diff(stamps(heard))) == {STEP_NS}


def test_both_kinds_of_reader_match(ros: Ros) -> None:
    node, reliable = start(ros)
    best_effort = ros.listen(
        JointState, 'joint_states', QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT))
    ros.wait(lambda: node.joint_states.get_subscription_count() == 2)
    node.trigger_activate()
    ros.wait(lambda: len(reliable) > 20 and len(best_effort) > 20)


def test_without_simulated_time_it_says_that_it_waits_for_the_clock_until_it_comes(
        ros: Ros, log: Callable[[str], str]) -> None:
    heard = ros.listen(DiagnosticArray, '/diagnostics', 10)
    node, samples = start(ros, use_sim_time=True)
    node.trigger_activate()
    log('waiting for /clock (use_sim_time is true)')
    status = ros.wait(lambda: next((item.status[0] for item in heard if '/clock' in item.status[0].message), 0))
    assert (status.level, status.message) == (b'\x03', 'no /clock (use_sim_time is true)')
    clock, ticks = ros.publisher(Clock, '/clock', 10), iter(range(10**9, 10**12, STEP_NS))

    def is_heard() -> bool:
        clock.publish(Clock(clock=time_message(next(ticks))))
        return bool(samples)

    ros.wait(is_heard)
    log('/clock is there')


def test_no_sample_is_missing_where_the_clock_is_much_slower_than_the_rate(ros: Ros) -> None:
    """`ros2 bag play --clock` publishes 40 times a second."""
    node, heard = start(ros, use_sim_time=True)
    clock = ros.publisher(Clock, '/clock', 10)
    node.trigger_activate()
    for steps in (0, 40, 80, 120):
        now = 10**9 + steps * STEP_NS

        def is_heard(now: int = now) -> bool:
            clock.publish(Clock(clock=time_message(now)))
            return bool(node.get_clock().now().nanoseconds == now)

        ros.wait(is_heard)
    ros.wait(lambda: heard and stamp_ns(heard[-1].header.stamp) >= 10**9 + 119 * STEP_NS, what='all samples')
    assert set(np.diff(stamps(heard))) == {STEP_NS}


def test_simulated_time_drives_the_samples_and_a_jump_back_begins_anew(ros: Ros) -> None:
    node, heard = start(ros, use_sim_time=True)
    clock = ros.publisher(Clock, '/clock', 10)
    node.trigger_activate()

    def is_heard() -> bool:
        """What is sent before the reader has found the clock is lost."""
        clock.publish(Clock(clock=time_message(10**9)))
        return bool(node.get_clock().now().nanoseconds == 10**9)

    ros.wait(is_heard)
    for tick in range(1, 41):
        clock.publish(Clock(clock=time_message(10**9 + tick * STEP_NS)))
        ros.wait(lambda tick=tick: len(heard) >= tick - 1)
    ros.wait(lambda: len(heard) > 30)
    seen = stamps(heard)
    assert seen[0] >= 10**9
    assert set(np.diff(seen)) == {STEP_NS}
    for tick in range(1, 41):
        clock.publish(Clock(clock=time_message(tick * STEP_NS)))
        ros.wait(lambda tick=tick: node.get_clock().now().nanoseconds == tick * STEP_NS)
    ros.wait(lambda: stamp_ns(heard[-1].header.stamp) < 10**9, what='a sample after the jump back')
