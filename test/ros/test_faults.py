"""What goes wrong in the field, with the real node over DDS: it recovers, counts, claims nothing wrong."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

import numpy as np
from identifier_harness import CAPTURE, START_NS, Live, recording, replayed
from joint_states import joint_state
from ros_harness import Ros, overrides
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from flexmanip_ros import messages
from flexmanip_ros.ros import conversions, qos
from flexmanip_ros.ros.demo import compare
from flexmanip_ros.ros.nodes.plant_simulator import PlantSimulator
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord, Payload, Status

TRUTH = 20.0


def believed(live: Live) -> Payload:
    """Return the latest payload; every payload ever said must be finite in mass."""
    payload = live.node.estimate.payload
    assert payload is not None
    assert all(math.isfinite(mass.data) for mass in live.said[messages.PAYLOAD_MASS])
    return payload


def honest(payload: Payload, truth: float) -> bool:
    """Say whether a payload is near the truth for its own width, or says that it is not to be believed."""
    return (payload.status is not Status.TRACKING or not math.isfinite(payload.std)
            or abs(payload.mass - truth) < max(6.0 * payload.std, 0.03 * TRUTH))


def announce(ros: Ros, live: Live) -> None:
    live.events.publish(conversions.to_message(CAPTURE))
    ros.wait(lambda: live.node.state.payload is None or live.node.state.payload.latest)


def test_an_identifier_that_computes_for_seconds_loses_no_joint_state_and_takes_no_event_for_one_of_another_clock(
        ros: Ros, log: Callable[[str], str]) -> None:
    """As the fits of an arm with Coulomb friction do. 12 s wait here, more than the middleware keeps."""
    live = Live(ros, payload_method='none')
    live.send(*recording(300))
    for first in range(300, 12_300, 4000):
        held, release = threading.Event(), threading.Event()
        live.ros._of(live.node).jobs.append(lambda held=held, release=release: (held.set(), release.wait()))
        ros.wait(held.is_set)  # else the node may be within a callback that began before the messages came
        for k in range(first, first + 4000):
            live.joint_states.publish(joint_state(k))
        if first == 8300:
            live.events.publish(conversions.to_message(CaptureEvent(START_NS + 12_000_000_000, EventKind.CAPTURE)))
        taken = live.node.state.counters.received
        release.set()
        ros.wait(lambda taken=taken: live.node.state.counters.received > taken)
    assert 'after the last sample' not in log('capture_event: capture at')
    ros.wait(lambda: live.node.state.counters.received + live.node.losses.lost >= 12_300, timeout=60.0)
    assert (live.node.state.counters.received, live.node.losses.lost) == (12_300, 0)
    assert live.node.state.stamp_of(EventKind.CAPTURE) == START_NS + 12_000_000_000


def test_joint_states_that_wait_after_a_block_are_not_said_to_have_ceased(ros: Ros) -> None:
    live = Live(ros, payload_method='none')
    live.send(*recording(50))
    waiting = live.node._joint_states

    def blocked() -> None:
        for k in range(50, 80):
            live.joint_states.publish(joint_state(k))
        ros.wait(lambda: waiting.fetch() == 30)
        live.node.meter.window()  # as long as the block was, the node took no message
        live.node.diagnose()

    ros.run(live.node, blocked)
    said = message_with(live, 'wait: ')
    assert said.startswith('30 messages of joint_states wait: publish joint states less often')
    assert 'no joint_states' not in said
    ros.wait(lambda: live.node.state.counters.received == 80)


def test_a_publisher_that_dies_and_returns_is_a_gap_and_no_loss(ros: Ros) -> None:
    live = Live(ros)
    samples = recording(1100)
    live.send(*samples[:300])
    announce(ros, live)
    live.send(*samples[300:700])
    ros.helper.destroy_publisher(live.joint_states)
    live.joint_states = ros.publisher(JointState, 'joint_states', qos.sensor_output())
    live.send(*samples[900:])
    counters = live.node.state.counters
    assert (counters.accepted, counters.gaps, live.node.losses.lost) == (900, 1, 0)
    assert honest(believed(live), TRUTH)
    assert abs(believed(live).mass - TRUTH) < 0.1 * TRUTH


def test_every_sample_twice_gives_the_numbers_of_every_sample_once(ros: Ros) -> None:
    live = Live(ros, payload_method='none')
    samples = recording(400)
    live.send(*(sample for sample in samples for _ in range(2)))
    live.finish()
    once = replayed(live, list(samples))
    assert live.node.state.counters.repeated_stamp == 400
    ros.wait(lambda: len(live.said[messages.MODEL]) >= len(once[messages.MODEL]))
    assert compare({name: values for name, values in live.said.items() if values}, once) == ''


def test_samples_out_of_order_never_move_the_clock_back(ros: Ros) -> None:
    live = Live(ros)
    samples = list(recording(700))
    announce(ros, live)
    for k in range(100, 690, 50):
        samples[k], samples[k + 1] = samples[k + 1], samples[k]
    live.send(*samples)
    counters = live.node.state.counters
    assert counters.late_stamp == 12
    assert counters.accepted == 688
    live.finish()  # what waits is taken
    assert live.node.state.clock.last_ns == samples[-1].stamp_ns
    assert honest(believed(live), TRUTH)


def test_one_stamp_from_far_ahead_does_not_cost_what_was_identified(ros: Ros) -> None:
    live = Live(ros)
    announce(ros, live)
    samples = list(recording(1100))
    samples[700] = samples[700]._replace(stamp_ns=samples[700].stamp_ns + 10**12)
    live.send(*samples[:699])
    live.send(*samples[699:])
    counters = live.node.state.counters
    assert (counters.resets, counters.late_stamp, counters.gaps, counters.accepted) == (0, 1, 1, 1099)
    assert believed(live).status is Status.TRACKING
    assert honest(believed(live), TRUTH)


def test_a_storm_of_nan_leaves_no_trace_but_its_count_and_a_gap(ros: Ros) -> None:
    live = Live(ros)
    samples = list(recording(1100))
    announce(ros, live)
    for k in range(600, 800):
        bad = samples[k]
        samples[k] = JointRecord(bad.stamp_ns, bad.names, np.full(4, np.nan), np.full(4, np.nan), bad.effort)
    live.send(*samples)
    counters = live.node.state.counters
    assert (counters.not_finite, counters.gaps, counters.accepted) == (200, 1, 900)
    assert all(np.isfinite(model.data).all() for model in live.said[messages.MODEL])
    assert honest(believed(live), TRUTH)
    assert abs(believed(live).mass - TRUTH) < 0.1 * TRUTH


def test_one_message_in_ten_lost_costs_accuracy_and_never_honesty(ros: Ros) -> None:
    live = Live(ros)
    announce(ros, live)
    rng = np.random.default_rng(3)
    samples = [sample for sample in recording(1100) if rng.random() > 0.1]
    live.send(*samples)
    counters = live.node.state.counters
    assert counters.accepted == len(samples)
    assert counters.gaps > 50
    assert honest(believed(live), TRUTH)


def test_bursts_with_pauses_between_change_nothing(ros: Ros) -> None:
    live = Live(ros)
    samples = recording(600)
    for first in range(0, 600, 150):
        live.send(*samples[first:first + 150])
        time.sleep(0.05)  # a pause of the sender is what is tested
    live.finish()
    plain = replayed(live, list(samples))
    ros.wait(lambda: len(live.said[messages.PAYLOAD_MASS]) >= len(plain[messages.PAYLOAD_MASS]))
    assert compare({name: values for name, values in live.said.items() if values}, plain) == ''


def test_a_flood_is_taken_or_counted_as_lost_to_the_last_message(ros: Ros) -> None:
    live = Live(ros, payload_method='none')
    samples = recording(4000)
    live.send(samples[0])  # what is lost before the first message that comes is not counted
    for sample in samples[1:]:  # as fast as the publisher can: several times the usual rate
        live.joint_states.publish(conversions.to_message(sample))
    counts = [-1]

    def is_quiet() -> bool:
        counts.append(live.node.state.counters.received)
        time.sleep(0.5)
        return counts[-1] == counts[-2]

    ros.wait(is_quiet, timeout=60.0)
    last = samples[-1]
    live.send(last._replace(stamp_ns=last.stamp_ns + 1_000_000))
    node = live.node
    ros.wait(lambda: node.state.counters.received + node.losses.lost == 4001, what='every message')
    assert node.state.counters.accepted == node.state.counters.received


def test_joints_that_get_other_names_in_mid_run_are_named_and_the_old_ones_taken_again(ros: Ros) -> None:
    live = Live(ros, payload_method='none')
    samples = recording(300)
    live.send(*samples[:100])
    names = ('shoulder', 'elbow', 'link1_bend', 'link2_bend')
    live.send(*(JointRecord(s.stamp_ns, names, s.position, s.velocity, s.effort) for s in samples[100:150]))
    assert 'joint1/effort' in live.node.state.clock.rejection.problem
    live.send(*samples[150:])
    counters = live.node.state.counters
    assert (counters.missing_signal, counters.accepted, counters.gaps) == (50, 250, 1)


def test_a_release_without_a_capture_and_two_captures_claim_nothing_wrong(ros: Ros) -> None:
    live = Live(ros)
    samples = recording(900)
    live.send(*samples[:200])
    release = CaptureEvent(START_NS + 210_000_000, EventKind.RELEASE)
    live.events.publish(conversions.to_message(release))
    ros.wait(lambda: live.node.state.payload.latest)
    for stamp in (CAPTURE.stamp_ns, CAPTURE.stamp_ns + 1_000_000):
        live.events.publish(conversions.to_message(CAPTURE._replace(stamp_ns=stamp)))
    ros.wait(lambda: live.node.state.payload.repeated_events == 1)
    live.send(*samples[200:])
    assert honest(believed(live), TRUTH)


def renamed(record: JointRecord, *names: str) -> JointRecord:
    """Return a record whose joints have other names."""
    return record._replace(names=names)


def message_with(live: Live, words: str) -> str:
    """Return the first diagnostic message that has these words."""
    return str(live.ros.wait(lambda: next(
        (status.message for message in live.diagnostics for status in message.status if words in status.message), ''),
        what=words))


def test_two_publishers_on_two_clocks_are_named_and_the_resets_logged_once_in_two_seconds(
        ros: Ros, log: Callable[[str], str]) -> None:
    live = Live(ros, payload_method='none')
    other = ros.helper.create_publisher(JointState, 'joint_states', qos.sensor_output())
    ros.wait(lambda: live.node.losses.publishers == 2)
    log('')
    began = time.monotonic()
    samples = recording(700)
    for k in range(0, 700, 50):
        for sample in samples[k:k + 50]:
            live.joint_states.publish(conversions.to_message(sample))
        other.publish(conversions.to_message(samples[k]._replace(stamp_ns=k * 10**6)))
        ros.wait(lambda k=k: live.node.state.counters.received >= (k // 50 + 1) * 51)
    assert live.node.state.counters.resets > 5
    cause = '2 publishers are on /joint_states: only one may publish these joints, with the stamps of one clock'
    assert cause in message_with(live, 'the stamps jumped or their rate changed (')
    log(f'the stamps of the joint states are irregular: {cause}')
    lines = log(cause).count('everything identified is forgotten: the stamps jumped')
    assert 1 <= lines <= 1 + (time.monotonic() - began) / 2.0


def test_a_flood_of_events_that_are_late_or_of_another_clock_does_not_fill_the_log(
        ros: Ros, log: Callable[[str], str]) -> None:
    live = Live(ros, payload_method='none')
    plant = ros.managed(PlantSimulator(context=ros.context, namespace='other', overrides=overrides(
        rate=100.0, noise='none', arm__modes=1)))
    ros.wait(lambda: plant.samples > 20)
    live.send(*recording(100))

    def taken() -> int:
        events = live.node.state.payload
        return int(events.late_events + events.repeated_events + events.rewinds)

    log('')
    late = ros.publisher(Header, '/other/capture_event', qos.latched())
    began, words = time.monotonic(), ('stamp an event with the time of its samples', 'ms late and is applied now')
    for k in range(100):
        live.events.publish(conversions.to_message(CaptureEvent(k * 10**9, EventKind.CAPTURE)))
        late.publish(conversions.to_message(CaptureEvent(plant._restarted_ns + k, EventKind.RELEASE)))
        ros.wait(lambda k=k: taken() > k)
        ros.wait(lambda k=k: plant.late_events > k)
    said = [log(text).count(text) for text in words]
    assert max(said) <= 1 + (time.monotonic() - began) / 2.0


def test_two_publishers_of_different_joints_are_no_fault(ros: Ros, log: Callable[[str], str]) -> None:
    live = Live(ros, payload_method='none')
    gripper = ros.helper.create_publisher(JointState, 'joint_states', qos.sensor_output())
    ros.wait(lambda: live.node.losses.publishers == 2)
    log('')
    for k, sample in enumerate(recording(600)):
        live.joint_states.publish(conversions.to_message(sample))
        if k % 10 == 0:
            gripper.publish(conversions.to_message(renamed(sample, 'f1', 'f2', 'f3', 'f4')))
        if k % 100 == 99:
            ros.wait(lambda k=k: live.node.state.counters.accepted == k + 1)
    ros.wait(lambda: live.node.faults.foreign == 60)
    reports = len(live.diagnostics)
    ros.wait(lambda: len(live.diagnostics) > reports + 1)
    said = ' '.join(status.message for message in live.diagnostics for status in message.status)
    assert 'publishers' not in said
    assert 'dropped' not in said
    assert 'message dropped' not in log('')


def test_where_no_message_can_be_used_the_diagnostics_and_the_log_say_why(
        ros: Ros, log: Callable[[str], str]) -> None:
    live = Live(ros, payload_method='none')
    log('')
    live.send(*(renamed(sample, 'f1', 'f2', 'f3', 'f4') for sample in recording(50)))
    words = "'joint1/effort' of parameter 'inputs' is not in the messages; the joints there are: f1, f2, f3, f4"
    assert message_with(live, 'no message can be used: ').startswith(f'no message can be used: {words}')
    log(f'message dropped: {words}')


def test_a_drop_is_a_warning_with_its_reason(ros: Ros) -> None:
    live = Live(ros, payload_method='none')
    live.send(*recording(100), recording(100)[-1])
    assert '1 message dropped in the last 60 s: header stamps do not advance; ' in message_with(live, 'dropped')
